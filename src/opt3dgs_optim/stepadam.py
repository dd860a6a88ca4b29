"""The only Adam: torch's own step, with the parts of a course before, in and after it."""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Callable, Mapping
from typing import Any, TypedDict

import torch
from torch import Tensor
from torch._compile import _disable_dynamo
from torch.optim import Adam

from opt3dgs_optim.course import Course
from opt3dgs_optim.describe import block, group_lines
from opt3dgs_optim.lending import Lent
from opt3dgs_optim.names import SLOT, slot
from opt3dgs_optim.part import Group, Part
from opt3dgs_optim.rows import Frozen, Ledger, check_mask, check_rows, shaped

# Unwrapped: torch's step hooks and its profiler are around our step already.
ADAM_STEP = inspect.unwrap(Adam.step)
STATE_KEY = "opt3dgs"  # in param_groups[0] of a state_dict: the course's state
LOGGER = logging.getLogger("opt3dgs_optim")


class AdamOptions(TypedDict, total=False):
    """torch.optim.Adam's keyword-only options."""

    foreach: bool | None
    maximize: bool
    capturable: bool
    differentiable: bool
    fused: bool | None
    decoupled_weight_decay: bool


class StepAdam(Adam):
    """`torch.optim.Adam` whose steps have the parts of a `Course`.

    The arithmetic is torch's own `Adam.step`, bit for bit, on every path (single tensor, foreach,
    fused, capturable): a step lends it scaled learning rates and other gradients, and takes them
    back, whatever happens. Made by `PhaseScheduler.upgrade`, `AWSGLD` and `LQNAdam`.
    """

    course: Course
    any_group = False  # whether the parts act on groups that are no Gaussian parameter's, too
    _base: type[Adam] = Adam  # whose step it is that the parts surround
    _ledger: Ledger
    _told = False  # of a gradient that is not finite

    def follow(self, course: Course, base: type[Adam] = Adam) -> None:
        """Have the parts of `course` from now on.

        Args:
            course: the training's.
            base: the class whose step the parts surround: torch's Adam, or one with arithmetic of
                its own, whose step then gets the mask.
        """
        self.course, self._base, self._ledger = course, base, Ledger()
        self._patch_step_function()  # torch's, for a class that was given to a made optimizer
        groups = self.param_groups
        own_path = any(g[k] is not None for g in groups for k in ("fused", "foreach"))
        own_path = own_path or any(g["capturable"] for g in groups)
        tensors = [p for group in groups for p in group["params"]]
        if base is Adam and not own_path and tensors and all(p.is_cuda for p in tensors):
            self._use_fused()
        self._trust_rows()

    def _use_fused(self) -> None:
        """Only torch's fused path takes a factor, and drops a step, on the device."""
        self.defaults["fused"] = True
        self._step_supports_amp_scaling = True
        for group in self.param_groups:
            group["fused"] = True
            for param in group["params"]:
                state = self.state.get(param)
                if state:
                    state["step"] = state["step"].to(param.device, torch.float32)

    def acts_on(self, part: Part, group: Group) -> bool:
        """Whether a part acts on a group."""
        name = slot(group)
        return part.names is None or name in part.names or (name is None and self.any_group)

    # -- the step ------------------------------------------------------------------------------

    # Under torch.compile a step runs as it is, like those of torch's own optimizers.
    @_disable_dynamo
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        closure: Callable[[], Any] | Tensor | None = None,
        num_points: int | None = None,
        *,
        visible: Tensor | None = None,
        visibility: Tensor | None = None,
    ) -> Any:
        """One step: of all rows, or only of those that a camera saw.

        With a mask, the other rows keep parameters and state, whatever the parts do; the bias
        correction is that of the whole parameter. It costs a copy of both. Parameters without a
        gradient are left alone, whatever the mask, as in INRIA's and gsplat's own masked steps.

        Args:
            closure: evaluates the model and returns the loss; or the mask, as gsplat
                (`step(mask)`) and INRIA (`step(mask, N)`) pass it.
            num_points: number of rows, which must be the mask's.
            visible: [N] mask; anything but 0 is visible.
            visibility: another name of `visible`, gsplat's.

        Returns:
            The closure's value, or None.

        Raises:
            ValueError: several masks, or one that fits no parameter with a gradient.
            RuntimeError: a CUDA graph is being captured, and there are parts.
        """
        self._opt_called = True  # what learning-rate schedulers would note by wrapping this method
        if self.course.parts and _is_captured():
            raise RuntimeError(
                f"{type(self).__name__}.step: a CUDA graph is being captured, but its replays would "
                "repeat this iteration's factors and phase; leave the optimizers' steps out of it"
            )
        masks: list[Any] = [each for each in (visible, visibility) if each is not None]
        if isinstance(closure, Tensor):
            masks, closure = [closure, *masks], None
        mask = check_mask(type(self).__name__, masks, num_points) if masks else None
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        with torch.set_grad_enabled(self.defaults["differentiable"]):
            acting = self.course.stepping(loss)
            if not acting and mask is None:
                self._step_base(None)
            elif self.course.valid is not False and not self._overflowed_on_host():
                self._step_parts(mask, acting)
        return loss

    # Learning-rate schedulers, which would wrap `step` on the instance, need not: `step` tells.
    step._wrapped_by_lr_sched = True  # pyright: ignore[reportFunctionMemberAccess]

    def _overflowed_on_host(self) -> bool:
        """Whether a GradScaler has told a fused optimizer on a CPU that the step is not made."""
        found = getattr(self, "found_inf", None)
        return found is not None and found.device.type == "cpu" and bool(found)

    def _step_parts(self, mask: Tensor | None, acting: bool) -> None:
        """A step with the parts, unless they do not act yet, of the rows of a mask."""
        if mask is not None:
            self._check_mask(mask)
        course, shared = self.course, Lent()
        found = getattr(self, "found_inf", None)
        if found is not None:  # a GradScaler's, of which parts know nothing
            fits = found.reshape(()) == 0
            shared.attribute(course, "valid", fits & course.valid)
        try:
            moved, frozen = self._step_lent(mask, acting)
            for group, param in moved if acting else ():
                self._finish(group, param)
            for rows in frozen:
                rows.put_back()
        finally:
            shared.take_back()

    def _step_lent(
        self, mask: Tensor | None, acting: bool
    ) -> tuple[list[tuple[Group, Tensor]], list[Frozen]]:
        """The step of torch's Adam; what has moved, and what is to be put back."""
        course, lent = self.course, Lent()
        frozen: list[Frozen] = []
        moved: list[tuple[Group, Tensor]] = []
        befores = course.hooks("before") if acting else []
        factors = course.hooks("factor") if acting else []
        try:
            for group in self.param_groups:
                parts = [part for part in befores if self.acts_on(part, group)]
                for param in group["params"]:
                    if param.grad is not None and not param.grad.is_sparse:
                        self._prepare(group, param, mask, parts, lent, frozen)
                        moved.append((group, param))
                factor = None
                for part in factors:
                    if self.acts_on(part, group):
                        factor = _times(factor, part.factor(group, course))
                if factor is not None:
                    lent.rate(group, factor, course.valid)
            if isinstance(course.valid, Tensor) and self._drops_on_device():
                lent.flag(self, course.valid)
            self._step_base(mask)
        finally:
            lent.take_back()
        return moved, frozen

    def _step_base(self, mask: Tensor | None) -> None:
        if self._base is Adam:
            ADAM_STEP(self)
            return
        step = inspect.unwrap(self._base.step)
        if mask is None:
            step(self)
            return
        if isinstance(self.course.valid, Tensor):
            mask = mask & self.course.valid.to(mask.device)
        takes_number = len(inspect.signature(step).parameters) > 2  # INRIA's: step(mask, N)
        step(self, mask, mask.numel()) if takes_number else step(self, mask)

    def _prepare(
        self,
        group: Group,
        param: Tensor,
        mask: Tensor | None,
        parts: list[Part],
        lent: Lent,
        frozen: list[Frozen],
    ) -> None:
        """Put what Adam is to be fed into `param.grad`."""
        grad = param.grad
        assert grad is not None
        fed = grad
        self._guard(grad)
        moving = self._moving(group, param, mask)
        if moving is None and not parts:
            return
        state = self.state[param]
        if not state:  # torch makes its moments only where there is nothing else yet
            self._init_group({**group, "params": [param]}, [], [], [], [], [], [])
        if moving is not None:
            frozen.append(Frozen(moving, param, state))
            fed = torch.where(shaped(moving, grad), grad, 0.0)
        if parts:
            self._ledger.drop_strangers(param, state, self.course.keys)
            # Parts get the gradient of what is minimised, in unscaled units.
            scale = getattr(self, "grad_scale", None)
            unit = (-1.0 if group["maximize"] else 1.0) * (1.0 if scale is None else scale)
            plain = scale is None and unit == 1.0
            fed = fed if plain else fed / unit
            for part in parts:
                fed = part.before(group, param, fed, state, self.course)
            fed = fed if plain else fed * unit
        if fed is not grad:
            lent.attribute(param, "grad", fed)

    def _guard(self, grad: Tensor) -> None:
        """Take a gradient that is not finite as zero, number by number, in place."""
        if grad.device.type == "cpu":
            # The sum is finite unless a summand is not, or it overflows.
            if math.isfinite(abs(grad.sum().item())):
                return
            if not self._told:
                self._told = True
                LOGGER.warning(
                    "iteration %d: a gradient of shape %s is not finite; such numbers are taken "
                    "as zero, here and later", self.course.current, tuple(grad.shape)
                )  # fmt: skip
        grad.nan_to_num_(0.0, 0.0, 0.0)

    def _moving(self, group: Group, param: Tensor, mask: Tensor | None) -> Tensor | None:
        """The rows that this step may move, [N] or 0-d bool; None: all."""
        if mask is not None and self._takes_mask(group, mask.numel()):
            if self._base is not Adam and not self.course.hooks("after"):
                return None  # its own masked step leaves the others alone
            rows = mask.to(param.device)
            return rows & self.course.valid if isinstance(self.course.valid, Tensor) else rows
        dropped = isinstance(self.course.valid, Tensor) and not self._drops_on_device()
        return self.course.valid if dropped else None  # pyright: ignore[reportReturnType]

    def _drops_on_device(self) -> bool:
        """Whether torch's own step can be told on the device not to be made."""
        return self._base is Adam and all(group["fused"] for group in self.param_groups)

    def _finish(self, group: Group, param: Tensor) -> None:
        """After the parameter has moved and the group's rate is its own again."""
        state = self.state[param]
        for part in self.course.hooks("after"):
            if self.acts_on(part, group):
                part.after(group, param, state, self.course)
        if self.course.keys:
            self._ledger.remember(param, state, self.course.keys)

    # -- masks ---------------------------------------------------------------------------------

    def _takes_mask(self, group: Group, rows: int) -> bool:
        """Whether a mask of so many rows is about this group."""
        if slot(group) is not None:
            return True
        return self.any_group and any(p.shape[:1] == (rows,) for p in group["params"])

    def _check_mask(self, mask: Tensor) -> None:
        """Only against parameters with a gradient: a mask may be older than the others' rows."""
        call, rows = f"{type(self).__name__}.step", mask.numel()
        present = [
            (self._takes_mask(group, rows), param)
            for group in self.param_groups
            for param in group["params"]
            if param.grad is not None
        ]
        shapes = [tuple(param.shape) for takes, param in present if takes]
        if present and (not shapes or any(shape[:1] != (rows,) for shape in shapes)):
            shapes = shapes or [tuple(param.shape) for _, param in present]
            raise ValueError(
                f"{call}: the mask has {rows} rows, but the parameters have shapes {shapes}; a "
                "mask of their first dimension is needed"
            )
        if self.defaults["differentiable"]:
            raise ValueError(f"{call}: a mask with differentiable=True is not possible")

    def reset_points(self, rows: Tensor, *, moments: bool = False) -> None:
        """Say which points have moved by other means than `step()`; see `reset_points`."""
        mask = rows.dtype == torch.bool
        groups = [g for g in self.param_groups if self.any_group or slot(g) is not None]
        every = [p for group in groups for p in group["params"]]
        fitting = [p for p in every if p.dim() > 0 and (not mask or rows.shape == p.shape[:1])]
        if every and not fitting:
            raise ValueError(
                f"{type(self).__name__}.reset_points: rows has shape {tuple(rows.shape)}, but a "
                f"mask of the first dimension of {[tuple(p.shape) for p in every]} is needed"
            )
        for param in fitting:
            state = self.state.get(param, {})
            for key in [key for key in self.course.keys if key in state]:
                if self._ledger.edited_along(param, state, key):
                    state[key][rows.to(param.device)] = 0
                    self._ledger.remember(param, state, (key,))
                else:
                    del state[key]
            for key in ("exp_avg", "exp_avg_sq", "max_exp_avg_sq") if moments else ():
                if key in state and state[key].shape[0] == param.shape[0]:
                    state[key][rows.to(param.device)] = 0

    # -- copies and checkpoints ----------------------------------------------------------------

    def _trust_rows(self) -> None:
        """Take what the parts have kept as that of the parameters' present rows."""
        for param, state in self.state.items():
            self._ledger.remember(param, state, self.course.keys)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "course": self.course, "_base": self._base}

    def __setstate__(self, state: dict[str, Any]) -> None:
        is_copy = "course" in state
        if not is_copy:  # called by torch's load_state_dict, after its hooks
            call = f"{type(self).__name__}.load_state_dict"
            params = [p for group in state["param_groups"] for p in group["params"]]
            check_rows(call, params, self.course.keys, state["state"])
        super().__setstate__(state)
        if is_copy:  # the parameters are other objects, the rows the same
            self._ledger = Ledger()
            self._trust_rows()

    def state_dict(self) -> dict[str, Any]:
        """torch's, with the course's inside `param_groups[0]`, and nothing of strangers' rows."""
        for param, state in self.state.items():
            self._ledger.drop_strangers(param, state, self.course.keys)
        if not self.course.keeps_state:
            return super().state_dict()
        group = self.param_groups[0]
        group[STATE_KEY] = self.course.state_dict()
        try:
            return super().state_dict()
        finally:
            del group[STATE_KEY]

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; also takes the `state_dict()` of a plain Adam.

        Raises:
            ValueError: it does not fit; then nothing has been loaded.
        """
        before = self.state, self.param_groups
        names = [group.get(SLOT) for group in self.param_groups]
        super().load_state_dict(state_dict)
        try:
            self.take_loaded()
        except ValueError:
            self.state, self.param_groups = before
            raise
        for group, name in zip(self.param_groups, names, strict=True):
            if name is not None:
                group[SLOT] = name
        if self._base is Adam and self.defaults["fused"]:
            self._use_fused()
        self._trust_rows()

    def take_loaded(self) -> None:
        """Take the course's state out of the groups, where a checkpoint has put it."""
        shared = self.param_groups[0].pop(STATE_KEY, None)
        if shared is not None:
            self.course.load_state_dict(shared)
        else:
            steps = [float(state["step"]) for state in self.state.values() if "step" in state]
            self.course.expect(int(max(steps, default=0)))

    def __repr__(self) -> str:
        lines = [str(part) for part in self.course.parts] + group_lines(self.param_groups)
        return block(type(self).__name__, lines)


def _is_captured() -> bool:
    return torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing()


def _times(factor: float | Tensor | None, other: float | Tensor | None) -> float | Tensor | None:
    if factor is None or other is None:
        return other if factor is None else factor
    return factor * other


def reset_points(optimizers: Any, rows: Tensor, *, moments: bool = False) -> None:
    """Say which points have moved by other means than the optimizers: what parts kept of them goes.

    For a trainer that knows what its density control did. Call it after each edit of the
    parameters: curvature pairs of all other points stay in use, where they would otherwise be
    dropped with the exchanged Parameter object. The state's rows must have been edited along
    (gsplat does; INRIA's edits leave the pairs behind, and they are dropped).

    Args:
        optimizers: an upgraded optimizer, or a dict of them (others in it are left alone).
        rows: [N] bool mask or a vector of indices, of the points as they are now.
        moments: whether to start their Adam moments anew too.

    Raises:
        ValueError: a mask fits no parameter.
    """
    every = optimizers.values() if isinstance(optimizers, Mapping) else [optimizers]
    for optimizer in every:
        if isinstance(optimizer, StepAdam):
            optimizer.reset_points(rows, moments=moments)
