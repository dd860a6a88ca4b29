"""The only Adam: torch's own step, with the parts of a course before, in and after it."""

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor
from torch._compile import _disable_dynamo
from torch.optim import Adam

from opt3dgs_optim.course import STATE_KEY, Course
from opt3dgs_optim.lending import Lent, guard, own_step, refuse_capture, use_fused
from opt3dgs_optim.names import SLOT, block, canonical_name, group_name
from opt3dgs_optim.part import Group, Part
from opt3dgs_optim.rows import Frozen, Ledger, check_mask, check_rows, shaped


class StepAdam(Adam):
    """`torch.optim.Adam` whose steps have the parts of a `Course`.

    The arithmetic is torch's own `Adam.step`, bit for bit, on every path (single tensor, foreach,
    fused, capturable): a step lends it scaled learning rates and other gradients, and takes them
    back, whatever happens. Made by `PhaseScheduler.upgrade`, `AWSGLD` and `LQNAdam`.
    """

    course: Course
    any_group = False  # whether the parts act on groups that are no Gaussian parameter's, too
    base: type[Adam] = Adam  # whose step it is that the parts surround
    _ledger: Ledger
    _told = False  # of a gradient that is not finite
    _split: tuple[Any, dict[str | None, list[list[Part]]]] = (None, {})  # hooks, by groups' slots

    def follow(self, course: Course, base: type[Adam] = Adam) -> None:
        """Have the parts of `course` from now on, around the step of `base`.

        Another class than torch's Adam has arithmetic of its own, and its step gets the mask.
        """
        self.course, self.base, self._ledger = course, base, Ledger()
        self._patch_step_function()  # torch's, for a class that was given to a made optimizer
        groups = self.param_groups
        asked = any(g["capturable"] or (g["fused"], g["foreach"]) != (None, None) for g in groups)
        tensors = [p for group in groups for p in group["params"]]
        if base is Adam and not asked and tensors and all(p.is_cuda for p in tensors):
            use_fused(self)
        self.trust_rows()

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As torch's; notes which Gaussian parameter the group's name says that it holds."""
        super().add_param_group(param_group)
        group, self._split = self.param_groups[-1], (None, {})
        group.setdefault(SLOT, canonical_name(group.get("name")))

    def acts_on(self, part: Part, group: Group) -> bool:
        """Whether a part acts on a group."""
        name = group.get(SLOT)
        return part.names is None or name in part.names or (name is None and self.any_group)

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
        """One step: of all rows, or only of those that a camera saw; return the closure's value.

        With a mask, the other rows keep parameters and state, whatever the parts do, for a copy of
        both; the bias correction is the whole parameter's. Parameters without a gradient are left
        alone, whatever the mask, as in INRIA's and gsplat's own masked steps.

        Args:
            closure: evaluates the model and returns the loss; or the mask, as gsplat
                (`step(mask)`) and INRIA (`step(mask, N)`) pass it.
            num_points: number of rows, which must be the mask's.
            visible, visibility: [N] mask; anything but 0 is visible.

        Raises:
            ValueError: several masks, or one that fits no parameter with a gradient.
            RuntimeError: a CUDA graph is being captured, and there are parts.
        """
        self._opt_called = True  # what learning-rate schedulers would note by wrapping this method
        refuse_capture(type(self).__name__, self.course)
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
            found, valid = getattr(self, "found_inf", None), self.course.valid
            if found is not None and isinstance(valid, Tensor):  # a GradScaler's word counts, too
                self.course.valid = (found.reshape(()) == 0) & valid
            try:
                if valid is not False and (isinstance(valid, Tensor) or not found):
                    self._step(mask, acting)
            finally:
                self.course.valid = valid
        return loss

    # Learning-rate schedulers, which would wrap `step` on the instance, need not: `step` tells.
    step._wrapped_by_lr_sched = True  # pyright: ignore[reportFunctionMemberAccess]

    def _step(self, mask: Tensor | None, acting: bool) -> None:
        """Lend the base's step what the parts say, if they act, and take it back."""
        course, moved = self.course, []
        if mask is not None:
            self._check_mask(mask)
        unknown = isinstance(course.valid, Tensor)  # only the device knows whether the step counts
        drops = unknown and self.base is Adam and all(g["fused"] for g in self.param_groups)
        back = unknown and not drops and (self.base is Adam or mask is None)
        with Lent() as lent:
            for group in self.param_groups:
                befores, factors, afters = self._parts_of(group) if acting else ([], [], [])
                masked = mask is not None and self._takes_mask(group, mask.numel())
                # Another base's own step knows its mask; the parts' doing it does not.
                own = mask if masked and (self.base is Adam or befores or afters) else None
                for param in group["params"]:
                    if param.grad is None or param.grad.is_sparse:
                        continue
                    self._told |= guard(param.grad, course, self._told)
                    if own is not None or befores or back or course.keys:
                        self._lend_gradient(group, param, befores, lent, own, back)
                    moved.append((group, param, afters))
                said = [part.factor(group, course) for part in factors]
                lent.rate(group, [factor for factor in said if factor is not None], course.valid)
            if drops:  # as a GradScaler tells torch's step not to be made
                lent.attribute(self, "found_inf", (~cast(Tensor, course.valid)).to(torch.float32))
            self._step_base(mask)
        for group, param, parts in moved:
            for part in parts:
                part.after(group, param, self.state[param], course)
            if course.keys:
                self._ledger.remember(param, self.state[param], course.keys)
        for rows in reversed(lent.frozen):
            rows.put_back()

    def _parts_of(self, group: Group) -> list[list[Part]]:
        """The parts that act on a group before, in and after its step; sought when they change."""
        hooks, slot = self.course.hooks, group.get(SLOT)
        if self._split[0] is not hooks:
            self._split = hooks, {}
        found = self._split[1]
        if slot not in found:
            acting = [hooks[name] for name in ("before", "factor", "after")]
            found[slot] = [[part for part in each if self.acts_on(part, group)] for each in acting]
        return found[slot]

    def _step_base(self, mask: Tensor | None) -> None:
        step, takes_number = own_step(self.base)
        if mask is None or self.base is Adam:
            step(self)
            return
        if isinstance(self.course.valid, Tensor):
            mask = mask & self.course.valid.to(mask.device)
        step(self, mask, mask.numel()) if takes_number else step(self, mask)

    def _lend_gradient(
        self, group: Group, param: Tensor, parts: list[Part], lent: Lent, mask: Any, back: bool
    ) -> None:
        """Put what Adam is to be fed into `param.grad`: zero in rows that a mask holds still.

        `back`: whether the step is to be put back where it does not count.
        """
        fed, state = cast(Tensor, param.grad), self.state[param]
        if not state:  # torch makes its moments only where there is nothing else yet
            self._init_group({**group, "params": [param]}, [], [], [], [], [], [])
        if self.course.keys:
            self._ledger.drop_strangers(param, state, self.course.keys)
        if mask is not None:
            moving = mask.to(param.device)
            lent.frozen.append(Frozen(moving, param, state))
            fed = torch.where(shaped(moving, fed), fed, 0.0)
        # Parts see the gradient of what is minimised, without AMP's scale.
        scale = getattr(self, "grad_scale", None) if parts else None
        unit = (-1.0 if group["maximize"] else 1.0) * (1.0 if scale is None else scale)
        plain = not parts or (scale is None and unit == 1.0)
        fed = fed if plain else fed / unit
        for part in parts:
            fed = part.before(group, param, fed, state, self.course)
        fed = fed if plain else fed * unit
        if back:  # what Adam does; the parts' doing is not the step's
            lent.frozen.append(Frozen(cast(Tensor, self.course.valid), param, state))
        if fed is not param.grad:
            lent.attribute(param, "grad", fed)

    def _takes_mask(self, group: Group, rows: int) -> bool:
        """Whether a mask of so many rows is about this group."""
        if group.get(SLOT) is not None:
            return True
        return self.any_group and any(p.shape[:1] == (rows,) for p in group["params"])

    def _check_mask(self, mask: Tensor) -> None:
        """ValueError unless it fits the parameters that it is about, and there are any.

        Only those with a gradient: the others are not stepped, and it may be older than they are.
        """
        call, rows = f"{type(self).__name__}.step", mask.numel()
        if self.defaults["differentiable"]:
            raise ValueError(f"{call}: a mask with differentiable=True is not possible")
        every = [(group, p) for group in self.param_groups for p in group["params"]]
        present = [(group, p) for group, p in every if p.grad is not None]
        shapes = [tuple(p.shape) for group, p in present if self._takes_mask(group, rows)]
        if present and (not shapes or any(shape[:1] != (rows,) for shape in shapes)):
            shapes = shapes or [tuple(p.shape) for _, p in present]
            raise ValueError(
                f"{call}: the mask has {rows} rows, but the parameters have shapes {shapes}; a "
                "mask of their first dimension is needed"
            )

    def trust_rows(self) -> None:
        """Take what the parts have kept as that of the parameters' present rows."""
        for param, state in self.state.items():
            self._ledger.remember(param, state, self.course.keys)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "course": self.course, "base": self.base}

    def __setstate__(self, state: dict[str, Any]) -> None:
        is_copy = "course" in state
        if not is_copy:  # called by torch's load_state_dict, after its hooks
            call = f"{type(self).__name__}.load_state_dict"
            params = [p for group in state["param_groups"] for p in group["params"]]
            check_rows(call, params, self.course.keys, state["state"])
        super().__setstate__(state)
        if is_copy:  # the parameters are other objects, the rows the same
            self._ledger = Ledger()
            self.trust_rows()

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
        super().load_state_dict(state_dict)
        try:
            self.course.take_loaded(self)
        except ValueError:
            self.state, self.param_groups = before
            raise
        for group, old in zip(self.param_groups, before[1], strict=True):
            group[SLOT] = old.get(SLOT)  # a plain Adam's checkpoint does not say it
        if self.base is Adam and self.defaults["fused"]:
            use_fused(self)
        self.trust_rows()

    def __repr__(self) -> str:
        lines = [str(part) for part in self.course.parts]
        for i, group in enumerate(self.param_groups):
            sizes = [list(param.shape) for param in group["params"]]
            size = sizes[0] if len(sizes) == 1 else f"{len(sizes)} tensors"
            lines.append(f"{group_name(i, group)} {size}: lr {float(group['lr']):.4g}")
        return block(type(self).__name__, lines)
