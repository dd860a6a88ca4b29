"""One parameter, from step to step: what acts on it, what is kept for its rows, its next step."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor

from opt3dgs_optim import triton
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.mean import BEGAN, GRIDS, MEAN, OF_MEAN, RESIDUE, Mean
from opt3dgs_optim.messages import LOGGER
from opt3dgs_optim.moments import CODES, MOMENTS, as_codes
from opt3dgs_optim.step import Hyper, Step, mixed, take_step
from opt3dgs_optim.training import Training

KEPT = (*OF_MEAN, "curvature.history")  # what a checkpoint may hold for rows beside moments


class ParamStepper:
    """Makes the steps of one parameter of an optimizer, and knows how the last one has left it.

    Attributes:
        name, set: which Gaussian parameter it is, and of which set of Gaussians.
        acting: by `Training.exploiting`: the parts with a `plan`, with a `before`, with an `after`.
        grid: of its mean at 16 bits; None: it has none of these.
        counter: where its device counts numbers that are not finite; None on a CPU.
        stepped_in: the iteration of its last step; -1: none.
        framed: whether its moments are those of the own frame; None: it has none yet.
        keeps: whether parts keep something for its rows.
        noted: what they keep, by name, with the version of the tensor after the last step.
        version: of the Parameter then.
    """

    def __init__(
        self,
        call: str,
        training: Training,
        group: dict[str, Any],
        param: Tensor,
        slot: tuple[str, str | None],
    ) -> None:
        self.call, self.training, self.group, self.param = call, training, group, param
        self.counter = training.bad_numbers.counter_on(param.device)
        self.set, self.name = slot
        parts = training.parts
        mine = [p for p in parts if p.names is None or (self.name and self.name in p.names)]
        self.acting = tuple(
            tuple(
                [p for p in mine if p.overrides(hook) and p.during in (None, phase)]
                for hook in ("plan", "before", "after")
            )
            for phase in (Phase.EXPLORATION, Phase.EXPLOITATION)
        )
        self.grid = GRIDS.get(self.name or "")
        self.stepped_in = -1
        self.framed: bool | None = None
        self.keeps = False
        self.noted: dict[str, tuple[Tensor, int]] = {}
        self.version = param._version

    # -- a step ----------------------------------------------------------------------------------

    def step(self, state: dict[str, Any], iteration: int) -> None:
        """Plan the step, make it, and note how it has left the parameter."""
        step, training, group = self.plan(state, iteration), self.training, self.group
        count = state["step"].numpy()  # torch's own addition takes as long as a launch
        count[()] += 1
        t, (beta1, beta2) = count.item(), group["betas"]
        lr, decay = group["lr"], group["weight_decay"]
        coded = training.moments == 16
        if coded:
            as_codes(state)
        hyper = Hyper(
            lr, beta1, beta2, group["eps"], 1 - beta1**t, (1 - beta2**t) ** 0.5,
            state["exp_avg"], state["exp_avg_sq"], nonfinite=self.counter,
            key=mixed(int(t)) if coded else 0,
        )  # fmt: skip
        if decay:
            if group.get("decoupled_weight_decay"):
                hyper.shrink = 1 - lr * decay
            else:
                hyper.decay = decay
        if step.put is not None:
            hyper.mean = self.mean(state, step.put, int(t))
        if self.counter is not None and triton.takes(step):
            triton.take_step(step, hyper)
        elif bad := take_step(step, hyper):
            training.bad_numbers.add(bad)
        if self.keeps or self.acting[training.exploiting][2]:
            self.finish(step)

    def plan(self, state: dict[str, Any], iteration: int) -> Step:
        """What the step has, as the parts say; `state` is the optimizer's of the parameter."""
        param, training = self.param, self.training
        grad = cast(Tensor, param.grad)
        rows = param.numel()  # shapes take five times as long to compare
        if grad.layout is not torch.strided or grad.numel() != rows:
            raise ValueError(
                f"{self.call}.step: the gradient of {self.name or 'a parameter'} "
                f"{tuple(param.shape)} is {tuple(grad.shape)}, {grad.layout}; have the trainer "
                "make dense gradients of these rows (gsplat: no sparse_grad)"
            )
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device="cpu")
            dtype = CODES if training.moments == 16 else None
            for key in MOMENTS:
                state[key] = torch.zeros_like(
                    param, dtype=dtype, memory_format=torch.preserve_format
                )
        elif state["exp_avg"].numel() != rows or state["exp_avg_sq"].numel() != rows:
            self.check_rows(state)
        step = Step(
            param, grad, self.name, self.set, self.group, state, iteration, self.stepped_in,
            self.keep,
        )  # fmt: skip
        plans, befores, _ = self.acting[training.exploiting]
        for part in plans:
            part.plan(step, training)
        for part in befores:
            step.grad = checked_gradient(part, part.before(step, training), grad)
        if step.plain:
            step.frame = None  # the rate of a plain step is the trainer's
        framed = step.frame is not None
        if framed:
            step.fade = None  # a faded step would be half a standard deviation long
        if framed is not self.framed:
            self._change_units(step, framed)
        if step.fresh:
            state["step"].zero_()
            for key in MOMENTS:
                state[key].zero_()
            for key in OF_MEAN:
                state.pop(key, None)
        self.stepped_in = iteration
        return step

    def _change_units(self, step: Step, framed: bool) -> None:
        """Have the moments in the own frame's units from now on, or in the world's."""
        if self.framed is not None:
            step.fresh = True
            LOGGER.info("iteration %d: moments of the positions begin anew, in %s units",
                        step.iteration, "the own frame's" if framed else "world")  # fmt: skip
        self.framed = framed

    def finish(self, step: Step) -> None:
        """What comes after the arithmetic: parts of one's own, and a note of what is left.

        By the note, edits of rows show at the next step.
        """
        for part in self.acting[self.training.exploiting][2]:
            part.after(step, self.training)
        if self.keeps:
            self.version, state = self.param._version, step.state
            for key in KEPT:
                if (kept := state.get(key)) is not None:
                    self.noted[key] = kept, kept._version

    # -- what is kept for its rows ---------------------------------------------------------------

    def keep(
        self, state: dict[str, Any], key: str, shape: tuple[int, ...], dtype: Any = None
    ) -> Tensor:
        """What is kept for the rows under a name; a row of zeros: nothing is kept for it."""
        tensor, self.keeps = state.get(key), True
        if tensor is None or tensor.shape != shape:
            tensor = state[key] = torch.zeros(
                shape, dtype=dtype or self.param.dtype, device=self.param.device
            )
        return tensor

    def mean(self, state: dict[str, Any], put: bool, count: int) -> Mean:
        """The running mean, in the form that goes with the moments; see `mean`."""
        coded = self.grid is not None and state["exp_avg"].dtype is CODES
        key, param = RESIDUE if coded else MEAN, self.param
        mean, began = state.get(key), state.get(BEGAN)
        if mean is None or began is None or began.numel() != param.size(0):  # rows are others now
            for each in OF_MEAN:
                state.pop(each, None)
            mean = self.keep(state, key, tuple(param.shape), CODES if coded else None)
            began = self.keep(state, BEGAN, tuple(param.shape[:1]))
        self.keeps = True
        return Mean(put, count, mean, began, self.grid or 1.0)

    def follow(self, before: ParamStepper, state: dict[str, Any]) -> None:
        """Go on where the one before was, whose Parameter may be another."""
        self.stepped_in, self.framed, self.noted = before.stepped_in, before.framed, before.noted
        new = before.param is not self.param
        self.drop_moved(state, new, new and before.param._version != before.version)
        if self.name == "means" and len(self.param) < len(before.param):
            self.training.rows_removed(len(before.param) - len(self.param))

    def drop_moved(self, state: dict[str, Any], new: bool, written: bool) -> None:
        """Drop what is kept for rows that are others now, if the Parameter is new.

        Trainers that edit rows edit every tensor of the state so (gsplat's family), or none but
        Adam's moments (INRIA's): what they have left as it was belongs to other rows. gsplat's
        relocation writes rows of the old Parameter, and edits the state of others: `written`.
        """
        rows = len(self.param) if self.param.dim() else 1
        for key in KEPT:
            now, was = state.get(key), self.noted.get(key)
            if now is None:
                continue
            as_it_was = was is not None and now is was[0] and now._version == was[1]
            if len(now) != rows or (new and (as_it_was or written)):
                for each in OF_MEAN if key in OF_MEAN else (key,):  # they belong together
                    state.pop(each, None)

    def check_rows(self, state: dict[str, Any]) -> None:
        """Refuse moments of other rows than the parameter has, as a checkpoint may bring them."""
        for key in MOMENTS:
            moment = state.get(key)
            if moment is not None and moment.shape != self.param.shape:
                raise ValueError(
                    f"{self.call}.step: {self.name or 'a parameter'} is "
                    f"{tuple(self.param.shape)}, but its {key} is {tuple(moment.shape)}: "
                    f"{len(moment)} rows for {len(self.param)}; load the checkpoint of these "
                    "Gaussians, or edit their moments with them"
                )


def checked_gradient(part: Any, found: Any, grad: Tensor) -> Tensor:
    """What a part returned as the gradient; ValueError unless it has the gradient's shape."""
    if not isinstance(found, Tensor) or found.shape != grad.shape:
        got = tuple(found.shape) if isinstance(found, Tensor) else repr(found)
        raise ValueError(
            f"{type(part).__name__}.before: returned {got}, but a tensor of {tuple(grad.shape)} is "
            "needed, as the gradient has"
        )
    return found
