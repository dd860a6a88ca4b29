"""One parameter, from step to step: what acts on it, what is kept for its rows, its next step."""

from __future__ import annotations

import math
import weakref
from typing import Any, cast

import torch
from torch import Tensor

from opt3dgs_optim import triton
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.mean import Mean, drop_kept, drop_means, mean_of, take_into_mean
from opt3dgs_optim.messages import LOGGER
from opt3dgs_optim.moments import CODES, MOMENTS, as_codes
from opt3dgs_optim.step import Step, mixed, take_step
from opt3dgs_optim.training import Training

FRAME_EPS = 1e-15  # of 3DGS; torch's 1e-8 is large beside a gradient times a standard deviation


class ParamStepper:
    """Makes the steps of one parameter of an optimizer, and knows how the last one has left it.

    The rule of rows: a new Parameter, another length of it, or another `exp_avg` means that a
    trainer has edited rows, and what was kept for them begins anew. An edit in place does not show,
    and has to be told by `reset_rows`.

    Attributes:
        param: the Parameter, a weak reference: an old one lives no longer than the trainer wants.
        name, set: which Gaussian parameter it is, and of which set of Gaussians.
        place: where the optimizer has it: a Parameter that is new there follows the one before.
        acting: by `Training.exploiting`: the parts with a `plan`, and with an `after`.
        later: what later steps may have and the first has not, see `Part.later`.
        counter: where its device counts numbers that are not finite; None on a CPU.
        stepped_in: the iteration of its last step; None: it is not known, and counts as the one
            before its next step, so that events of earlier ones are not made up for.
        framed: whether its moments are those of the own frame; None: it has none yet.
    """

    def __init__(
        self,
        call: str,
        training: Training,
        group: dict[str, Any],
        param: Tensor,
        slot: tuple[str, str | None],
    ) -> None:
        self.call, self.training, self.group = call, training, group
        self.param = weakref.ref(param)
        self.counter = training.bad_numbers.counter_on(param.device)
        self.set, self.name = slot
        self.place: Any = None
        mine = [
            p for p in training.parts if p.names is None or (self.name and self.name in p.names)
        ]
        self.parts = mine
        self._arrange(-1)
        self.later = tuple(sorted({each for p in mine for each in p.later}))
        self.stepped_in: int | None = None
        self.framed: bool | None = None
        self._exp_avg: Any = None  # a weak reference to that beside which something is kept

    def _arrange(self, iteration: int) -> None:
        """Have the parts that act from this iteration on, until another begins."""
        begun = [part for part in self.parts if part.begins(self.training) <= max(iteration, 0)]
        self.acting = tuple(
            tuple(
                [p for p in begun if p.overrides(hook) and p.during in (None, phase)]
                for hook in ("plan", "after")
            )
            for phase in (Phase.EXPLORATION, Phase.EXPLOITATION)
        )
        others = [p.begins(self.training) for p in self.parts if p not in begun]
        self._arranged_until = min(others, default=math.inf)

    # -- a step ----------------------------------------------------------------------------------

    def step(self, param: Tensor, state: dict[str, Any], iteration: int) -> None:
        """Plan the step and make it; `state` is the optimizer's of the parameter."""
        step, training, group = self.plan(param, state, iteration), self.training, self.group
        try:
            count = state["step"].numpy()  # torch's own addition takes as long as a launch
        except TypeError:  # a trainer has it on its device
            state["step"] = state["step"].to("cpu", torch.float32)
            count = state["step"].numpy()
        count[()] += 1
        t, (beta1, beta2) = count.item(), group["betas"]
        # A launcher would take an integer, or a number of numpy, for another kind of argument.
        step.lr, step.beta1, step.beta2 = float(group["lr"]), float(beta1), float(beta2)
        step.eps = FRAME_EPS if step.frame is not None else float(group["eps"])
        step.correction1 = 1.0 - step.beta1**t
        step.sqrt_correction2 = (1.0 - step.beta2**t) ** 0.5
        step.nonfinite = self.counter
        if decay := group["weight_decay"]:
            if group.get("decoupled_weight_decay"):
                step.shrink = float(1.0 - step.lr * decay)
            elif not step.decayed:
                step.decay = float(decay)
        if training.moments == 16:
            step.rounding = mixed(int(t))
        if step.put is not None:
            step.mean = self.mean(step, int(t))
        if self.counter is not None and triton.takes(step):
            triton.take_step(step, self.later)
        elif bad := take_step(step):
            training.bad_numbers.add(bad)
        for part in self.acting[training.exploiting][1]:
            part.after(step, training)

    def after(self, step: Step, count: int) -> None:
        """What comes after a step that another has made, which was Adam's so many-th."""
        mean = None if step.put is None else self.mean(step, count)
        if mean is not None:
            take_into_mean(mean, step.param)
        for part in self.acting[self.training.exploiting][1]:
            part.after(step, self.training)

    def plan(self, param: Tensor, state: dict[str, Any], iteration: int) -> Step:
        """What the step has, as the parts say."""
        training, grad = self.training, cast(Tensor, param.grad)
        numbers = param.numel()  # shapes take five times as long to compare
        if grad.layout is not torch.strided or grad.numel() != numbers:
            raise ValueError(
                f"{self.call}.step: the gradient of {self.name or 'a parameter'} "
                f"{tuple(param.shape)} is {tuple(grad.shape)}, {grad.layout}; have the trainer "
                "make dense gradients of these rows (gsplat: no sparse_grad)"
            )
        if not state:
            self._begin(param, state)
        elif (
            state["exp_avg"].numel() != numbers or state["exp_avg_sq"].numel() != numbers
            or state["exp_avg"].dim() != param.dim()  # a checkpoint of [N] in the place of [N, 1]
        ):  # fmt: skip
            self.check_rows(param, state)
        if training.moments == 16:
            as_codes(state)
        before = iteration - 1 if self.stepped_in is None else self.stepped_in
        step = Step(
            param, grad, self.name, self.set, self.group, state, iteration, before, self.keep
        )
        if iteration >= self._arranged_until:
            self._arrange(iteration)
        for part in self.acting[training.exploiting][0]:
            part.plan(step, training)
        if step.grad is not grad or step.param is not param or isinstance(step.factor, Tensor):
            self._check_plan(step, param, grad)
        if step.plain:
            step.frame = None  # the rate of a plain step is the trainer's
        framed = step.frame is not None
        if framed:
            step.fade = None  # a faded step would be half a standard deviation long
        if framed is not self.framed:
            if self.framed is not None:
                step.fresh = True
                LOGGER.info("iteration %d: moments of the positions begin anew, in %s units",
                            iteration, "the own frame's" if framed else "world")  # fmt: skip
            self.framed = framed
        if step.fresh:
            begin_moments_anew(state)
        self.stepped_in = iteration
        return step

    def _check_plan(self, step: Step, param: Tensor, grad: Tensor) -> None:
        """Refuse what parts have put into a step that is no part of any."""
        of, got = self.name or "a parameter", getattr(step.grad, "shape", step.grad)
        put = None
        if step.param is not param:
            put = f"another tensor in the place of {of}; change it in place, in `after`"
        elif isinstance(step.factor, Tensor) and step.factor.numel() != 1:
            put = f"{step.factor.numel()} numbers as factor of {of}, but one is needed"
        elif got != grad.shape:
            needed = f"a tensor of {tuple(grad.shape)} is needed"
            put = f"{got} in the place of the gradient of {of}, but {needed}"
        if put is not None:
            raise ValueError(f"{self.call}.step: a part has put {put}")

    def _begin(self, param: Tensor, state: dict[str, Any]) -> None:
        state["step"] = torch.zeros((), dtype=torch.float32, device="cpu")
        dtype = CODES if self.training.moments == 16 else None
        for key in MOMENTS:
            state[key] = torch.zeros_like(param, dtype=dtype, memory_format=torch.preserve_format)

    # -- what is kept for its rows ---------------------------------------------------------------

    def keep(self, state: dict[str, Any], key: str, shape: tuple[int, ...]) -> Tensor:
        """What a part keeps for the rows; a row of zeros: nothing is kept for it.

        `key` is "part.what": by its dot it is known from Adam's own.
        """
        self.begin_edited_rows_anew(state)
        tensor = state.get(key)
        if tensor is None or tensor.shape != shape:
            like = state["exp_avg"]
            dtype = torch.float32 if like.dtype is CODES else like.dtype
            tensor = state[key] = torch.zeros(shape, dtype=dtype, device=like.device)
        return tensor

    def mean(self, step: Step, count: int) -> Mean | None:
        """The running mean; None where this iterate is left out, or there is no room for it."""
        if not self.training.averages or (count % step.every and not step.put):
            return None
        if self._exp_avg is None or self._exp_avg() is not step.state["exp_avg"]:
            self.begin_edited_rows_anew(step.state)
        try:
            return mean_of(step.param, step.state, self.name, bool(step.put), count / step.every)
        except torch.cuda.OutOfMemoryError:
            self.training.end_averaging()
            return None

    def begin_edited_rows_anew(self, state: dict[str, Any]) -> None:
        """Drop what is kept for rows, unless `exp_avg` is the one beside which it was."""
        exp_avg = state["exp_avg"]
        if self._exp_avg is not None and self._exp_avg() is exp_avg:
            return
        if self._exp_avg is not None:
            drop_kept(state)
        self.remember(exp_avg)

    def remember(self, exp_avg: Tensor) -> None:
        """Know the `exp_avg` beside which something is kept."""
        self._exp_avg = weakref.ref(exp_avg)

    def follow(self, before: ParamStepper, param: Tensor, state: dict[str, Any]) -> None:
        """Go on where the one before was, whose Parameter may be another."""
        self.stepped_in, self.framed = before.stepped_in, before.framed
        if before.param() is param:
            self._exp_avg = before._exp_avg
            return
        drop_kept(state)

    def check_rows(self, param: Tensor, state: dict[str, Any]) -> None:
        """Refuse moments of other rows than the parameter has, as a checkpoint may bring them."""
        for key in MOMENTS:
            moment = state.get(key)
            if moment is not None and moment.shape != param.shape:
                rows = f": {len(moment)} rows for {len(param)}" * (len(moment) != len(param))
                raise ValueError(
                    f"{self.call}.step: {self.name or 'a parameter'} is {tuple(param.shape)}, but "
                    f"its {key} is {tuple(moment.shape)}{rows}; load the checkpoint of these "
                    "Gaussians, or edit their moments with them"
                )


def begin_moments_anew(state: dict[str, Any]) -> None:
    """Have Adam know nothing of the steps before, and the mean nothing of their iterates."""
    state["step"].zero_()
    for key in MOMENTS:
        state[key].zero_()
    drop_means([state])
