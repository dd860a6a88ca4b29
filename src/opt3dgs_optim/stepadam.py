"""The only Adam: torch's own step, with the parts of a course before, in and after it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim import Adam

from opt3dgs_optim.checkpoint import (
    Saved,
    as_loaded,
    inspect_checkpoint,
    is_kept_by_part,
    number_of_steps,
    pack_optimizer,
    restore_records,
    take_units,
)
from opt3dgs_optim.checks import LOGGER, as_damage, energy_of
from opt3dgs_optim.course import STATE_KEY, Course, NoCourse
from opt3dgs_optim.in_step import (
    NO_PARTS,
    ActingParts,
    MovingParameter,
    NamedPart,
    StepInProgress,
    check_mask_fits,
)
from opt3dgs_optim.lbfgs.pairs import in_range_of
from opt3dgs_optim.names import (
    MOMENTS,
    NamedGroup,
    block,
    free_slot,
    gaussian_of,
    group_line,
    group_name,
    split_name,
)
from opt3dgs_optim.overrides import (
    TemporaryOverrides,
    WeightDecay,
    as_step,
    can_be_fused,
    is_moving_rate,
    own_step,
    refuse_capture,
    scale_learning_rate,
    use_fused,
    zero_nonfinite,
)
from opt3dgs_optim.part import Group, Part, Window
from opt3dgs_optim.state import (
    HeldRows,
    ParameterRecord,
    ParameterState,
    PickedRows,
    RowOwnership,
    Rows,
    are_of,
    broadcast_rows,
    check_mask,
    check_rows,
    is_finite_sum,
    records_of,
)

DEVICE_LOOK_INTERVAL = 16  # energies between two looks at a device's gradients for NaN


class StepAdam(Adam):
    """`torch.optim.Adam` whose steps have the parts of a `Course`.

    The arithmetic is torch's own `Adam.step`, bit for bit, on every path (single tensor, foreach,
    fused, capturable). A step overrides learning rates and gradients for the time of that call, and
    restores them, whatever happens. Without parts nothing of this class touches the step.

    Made by `PhaseScheduler.upgrade`, `AWSGLD` and `LQNAdam`. An upgraded optimizer is an instance
    of this class *and* of the class that it had.
    """

    course: Course = cast(Course, NoCourse())  # until `follow`
    any_group = False  # whether the parts act on groups that are no Gaussian parameter's, too
    upgraded_in = 0  # which call of `upgrade` it was, of those of the course
    _base: type[Adam] = Adam  # whose step it is that the parts surround
    _ownership: RowOwnership
    # By group: the set of Gaussians, and which parameter.
    _slots: Sequence[tuple[str, str | None]] = ()
    _known: list[NamedGroup]  # the groups at the last look
    _open_windows: dict[str, Window | None]
    stepped_at = -1  # the iteration of its last step, of whatever parameters
    clock_at = -1  # the course's iteration when this optimizer last stepped, or began
    _rewinds = 0
    _nonfinite_reported = False
    _nonfinite: Tensor | None = None  # seen on a device, and not looked at yet
    # Sought for these hooks and windows: by the Gaussian parameter, who acts on it.
    _acting: tuple[Any, Any, dict[str | None, ActingParts]] = (None, None, {})
    _gone: Sequence[NamedGroup] = ()  # groups that a trainer has taken away since the last step

    def follow(self, course: Course, base: type[Adam] = Adam) -> None:
        """Have the parts of `course` from now on, around the step of `base`.

        Another class than torch's Adam has arithmetic of its own, and its step gets the mask.
        """
        self.course, self._base, self._ownership = course, base, RowOwnership()
        self._known, self._gone, self._open_windows = [], (), {}
        self.name_groups()
        self._patch_step_function()  # of a class that was given to a made optimizer
        if base is Adam and course.parts and can_be_fused(self):
            use_fused(self)
        self._claim_rows()
        self.clock_at = course.current
        course.followers.register(self)

    def hold(self, slots: list[tuple[str, str | None]]) -> None:
        """Say which set of Gaussians, and which of its parameters, each group holds."""
        self._slots = list(slots)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As torch's; notes which Gaussian parameter the group's name says that it holds."""
        super().add_param_group(param_group)
        if "course" in vars(self):
            self.name_groups()

    def name_groups(self) -> None:
        """Know what each group holds: what was said of it, or else what its name says.

        A group that takes the place of another goes on with what was kept for that one. It is the
        one that stood where it stands, if that had the same name, or else the one of its name,
        which may have gone since the last step: a trainer may empty the list, and fill it again.
        """
        groups = self.param_groups
        if len(groups) == len(self._known):
            for group in groups:
                if type(group) is not NamedGroup or not are_of(group.records, group["params"]):
                    break
            else:
                return
        gone = [*self._gone, *self._known]
        gone = [old for old in gone if all(old is not group for group in groups)]
        for i, group in enumerate(groups):
            if type(group) is NamedGroup:
                continue
            slot = split_name(group.get("name"))
            place = self._known[i] if i < len(self._known) else None
            heir = next((old for old in gone if old is place), None)
            if heir and (slot[1] is None or slot == split_name(heir.get("name"))):
                slot = heir.set_name, heir.gaussian
            elif i < len(self._slots):
                slot, heir = self._slots[i], None
            else:
                heir = next((o for o in gone if slot[1] and (o.set_name, o.gaussian) == slot), None)
            slot = slot if heir else free_slot(slot, groups, self.course.warn_once)
            groups[i] = NamedGroup(group, *slot, () if heir is None else heir.records)
            gone = [old for old in gone if old is not heir]
            self._acting = (None, None, {})
            if self._known and heir is None:
                taken = slot[1] or "left alone"
                LOGGER.info("a group was added: %s, %s", group_name(i, group), taken)
        self.course.followers.forget_places()
        self._known, self._slots, self._gone = cast(list[NamedGroup], list(groups)), (), gone
        every = [record for group in self._known for record in group.records]
        for group in self._known:
            if not are_of(group.records, group["params"]):
                group.records = records_of(group["params"], group.records, every)

    def gaussian_groups(self) -> list[NamedGroup]:
        """Those that hold Gaussian parameters, also where a trainer has exchanged them just now."""
        if not all(type(group) is NamedGroup for group in self.param_groups):
            self.name_groups()
        return [g for g in cast(list[NamedGroup], self.param_groups) if g.gaussian is not None]

    @property
    def _records(self) -> list[list[ParameterRecord]]:
        """By group, and by parameter in it."""
        return [getattr(group, "records", []) for group in self.param_groups]

    def acts_on(self, part: Part, group: Group) -> bool:
        """Whether a part acts on a group."""
        name = gaussian_of(group)
        return part.names is None or name in part.names or (name is None and self.any_group)

    # -- a step ----------------------------------------------------------------------------------

    # Under torch.compile a step runs as it is, like those of torch's own optimizers.
    @as_step
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        closure: Callable[[], Any] | Tensor | None = None,
        num_points: int | None = None,
        *,
        visible: Tensor | None = None,
        visibility: Tensor | None = None,
    ) -> Any:
        """One step: of all rows, or only of those that a camera saw; return the closure's value.

        With a mask, the other rows keep parameters and state, whatever the parts do. A GPU and a
        fused step take a copy of both for it. The bias correction is the whole parameter's.
        Parameters without a gradient are left alone, as in INRIA's and gsplat's masked steps.

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
        refuse_capture(self)
        masks: list[Any] = [each for each in (visible, visibility) if each is not None]
        if isinstance(closure, Tensor):
            masks, closure = [closure, *masks], None
        mask = check_mask(self.call_name, masks, num_points) if masks else None
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        with torch.set_grad_enabled(self.defaults["differentiable"]):
            # torch's distributed checkpoints make a step of length zero, to have Adam's moments.
            begun = not self.course.needs_energies or self.course.num_observed > 0
            idle = not begun and loss is None and self._stands_still()
            # Without parts a closure may return whatever it does in the trainer's own Adam.
            told = loss if self.course.parts or loss is None else energy_of(loss)
            acting = not idle and self.course.stepping(told, self)
            self.stepped_at = self.clock_at = self.course.current
            if mask is None and not self.course.parts:
                self._step_base(None)
            else:
                self._step(mask, acting)
            self._gone = ()
        return loss

    def _stands_still(self) -> bool:
        """Whether no learning rate moves anything."""
        return not any(is_moving_rate(group["lr"]) for group in self.param_groups)

    # Learning-rate schedulers, which would wrap `step` on the instance, need not: `step` tells.
    step._wrapped_by_lr_sched = True  # pyright: ignore[reportFunctionMemberAccess]

    def _counts(self, mask: Tensor | None) -> Tensor | bool:
        """Whether this step counts; a 0-d tensor where the device knows, and can be told.

        The loss must be finite, and a GradScaler, if there is one, must have found no overflow.
        """
        counts, overflow = self.course.valid, getattr(self, "found_inf", None)
        if overflow is not None:
            clean = overflow.reshape(()) == 0
            if isinstance(counts, Tensor):
                counts = clean.to(counts.device, non_blocking=True) & counts
            elif clean.is_cpu:
                counts = bool(clean) and counts
            elif counts:
                counts = clean
        if not isinstance(counts, Tensor):
            return counts
        groups = self.param_groups
        # Only torch's fused step can be told on the device not to be made, or another base's own,
        # which can be given an empty mask.
        fused = all(group["fused"] for group in groups)
        droppable = fused if self._base is Adam else mask is not None
        tensors = chain.from_iterable(group["params"] for group in groups)
        if droppable and all(counts.is_cpu or not param.is_cpu for param in tensors):
            return counts
        return self.course.valid_on_host() if overflow is None else bool(counts)

    def _step(self, mask: Tensor | None, acting: bool) -> None:
        """Override what the base's step reads by what the parts say, and restore it."""
        course, counts = self.course, self._counts(mask)
        self.name_groups()
        if acting:
            self._follow_windows()
        if mask is not None:
            check_mask_fits(self.call_name, self.param_groups, mask, self._takes_mask)
        with TemporaryOverrides() as temporary:
            step = StepInProgress(mask, acting, counts, temporary)
            try:
                for group in self.param_groups:
                    parts = self._parts_of(group).ready_for(group, course) if acting else NO_PARTS
                    moved = self._prepare_group(step, cast(NamedGroup, group), parts)
                    if parts.factor:
                        given = temporary, group, moved, parts.factors(group, course), counts
                        scale_learning_rate(*given, step.decays, course.on_host)
            except BaseException:
                step.take_back()
                raise
            step.put_in_place()
            self._make(step)
        for moving in step.moving:
            self._finish(moving, course)
        # What a part keeps for several parameters: the first of them has saved what it was.
        for moving in reversed(step.moving):
            if moving.guarded and moving.parts.any:
                moving.state.settle(moving.rows, moving.counts)
            self._ownership.claim(moving.param, moving.state.adam, course.row_keys)
            moving.state.let_go()

    def _parts_of(self, group: Group) -> ActingParts:
        """The parts that act on a group in this step; sought when they change."""
        hooks, windows, slot = self.course.hooks, self._open_windows, gaussian_of(group)
        if self._acting[0] is not hooks or self._acting[1] is not windows:
            self._acting = hooks, windows, {}
        known = self._acting[2].get(slot)
        if known is None:
            known = ActingParts.sought(lambda hook: self._named_parts(hooks[hook], group))
            self._acting[2][slot] = known
        return known

    def _named_parts(self, parts: list[Part], group: Group) -> list[NamedPart]:
        """Those of the parts that act on a group, in whose windows the step is."""
        named = [(self.course.name_of(part), part) for part in parts if self.acts_on(part, group)]
        return [
            (name, part) for name, part in named if self._open_windows.get(name, ()) is not None
        ]

    def _make(self, step: StepInProgress) -> None:
        """Have the base make the step, if that counts, of the rows that the mask lets move."""
        try:
            if step.counts is False:
                return
            for decay in step.decays:  # once no hook can refuse any more
                decay.make()
            if isinstance(step.counts, Tensor) and self._base is Adam:
                # As a GradScaler tells torch's fused step not to be made.
                step.overrides.attribute(self, "found_inf", (~step.counts).to(torch.float32))
            self._step_base(step.mask)
        finally:  # also where it fails in one of several groups
            for moving in step.moving:
                if moving.masked is not None:
                    moving.masked.put_back()

    def _step_base(self, mask: Tensor | None) -> None:
        step, takes_number = own_step(self._base)
        if mask is None or self._base is Adam:
            step(self)
            return
        if isinstance(self.course.valid, Tensor):
            mask = mask & self.course.valid.to(mask.device)
        step(self, mask, mask.numel()) if takes_number else step(self, mask)

    def _prepare_group(
        self, step: StepInProgress, group: NamedGroup, parts: ActingParts
    ) -> list[Tensor]:
        """Ask the parts what the base's step is to read; return the tensors that it is to move."""
        masked = step.mask is not None and self._takes_mask(group, step.mask.numel())
        # Another base's own step knows its mask; what the parts do does not.
        rows = step.mask if masked and (self._base is Adam or parts.any) else None
        if parts.displacement and group["weight_decay"] and group.get("decoupled_weight_decay"):
            # Of the parameter itself, not of the buffer that Adam will move.
            step.decays.append(WeightDecay(group, group["params"], step.counts, rows))
            step.overrides.item(group, "weight_decay", 0.0)
        params, counts = list(group["params"]), step.counts
        guarded = rows is not None or counts is not True
        needed = rows is not None or parts.any  # whether more than the gradient's check is
        now = max(self.course.current, 0)  # a course may have no clock
        moves = is_moving_rate(group["lr"])
        plain = not (guarded or parts.displacement or parts.after or group["maximize"])
        plain = plain and getattr(self, "grad_scale", None) is None
        for i, (param, record) in enumerate(zip(params, group.records, strict=True)):
            grad = param.grad
            if grad is None or grad.is_sparse:
                continue
            if not (grad.is_cpu and is_finite_sum(grad)):
                self._zero_nonfinite(param)
            if record.units != parts.units:
                held = self.state.get(param)
                step.remember(record, held)
                take_units(group, record, held, parts.units, self.course)
            if needed and plain:
                self._feed(step, group, param, record, parts)
            elif needed:
                own, known = rows, counts
                if own is not None:
                    own = own.to(param.device)
                if isinstance(known, Tensor):
                    known = known.to(param.device, non_blocking=True)
                view = self._view_of(group, param, record)
                moving = MovingParameter(group, param, view, parts, own, known, guarded)
                params[i] = self._prepare(step, moving)
                step.moving.append(moving)
            if step.acting:
                record.last_step = now
                if moves and param.requires_grad:
                    record.last_moved = now
        if parts.displacement or rows is not None:
            step.moved.append((group, params))
        return params

    def _feed(
        self,
        step: StepInProgress,
        group: Group,
        param: Tensor,
        record: ParameterRecord,
        parts: ActingParts,
    ) -> None:
        """Do what `_prepare` and `_finish` do where nothing is masked, scaled, undone or moved.

        Most steps are of this kind, and take less time so.
        """
        course, view = self.course, self._view_of(group, param, record)
        grad = cast(Tensor, param.grad)
        fed = parts.feed(group, param, grad, view, course)
        if fed is not grad:
            step.fed.append((param, fed))
        self._ownership.claim(param, view.adam, course.row_keys)
        view.let_go()

    def _view_of(self, group: Group, param: Tensor, record: ParameterRecord) -> ParameterState:
        """What the hooks see of a parameter's state, without what is of other rows."""
        state, course = self.state[param], self.course
        if not state:  # torch makes its moments only where there is nothing else yet
            self._init_group({**group, "params": [param]}, [], [], [], [], [], [])
        self._ownership.drop_foreign(param, state, course.row_keys)
        return record.view(param, state, course.declared, course.kept_numbers)

    def _prepare(self, step: StepInProgress, moving: MovingParameter) -> Tensor:
        """Have Adam fed with what the parts say; return what it moves in the parameter's place."""
        group, param, parts = moving.group, moving.param, moving.parts
        fed, view, course = cast(Tensor, param.grad), moving.state, self.course
        if moving.rows is not None:
            fed = torch.where(broadcast_rows(moving.rows, fed), fed, 0.0)
        if moving.guarded and parts.any:
            view.guard(moments=moving.rows is not None)
            if moving.counts is not True:  # a step that does not count has no gradient
                fed = moving.where_it_moves(fed, 0.0)
        # Parts see the gradient of what is minimised, without AMP's scale.
        scale, unit = getattr(self, "grad_scale", None), None
        if parts.shaping and (scale is not None or group["maximize"]):
            unit = (-1.0 if group["maximize"] else 1.0) * (1.0 if scale is None else scale)
            # Without the scale half precision would lose small gradients.
            fed = fed.to(torch.promote_types(fed.dtype, torch.float32)) / unit
        if parts.displacement and group["weight_decay"]:
            fed = fed.add(param.detach(), alpha=group["weight_decay"])
        fed = parts.feed(group, param, fed, view, course)
        if unit is not None:
            dtype = cast(Tensor, param.grad).dtype
            fed = in_range_of(dtype, fed * unit).to(dtype)
        if moving.rows is not None and self._base is Adam:
            if moving.rows.is_cpu and not (group["fused"] or parts.displacement):
                moving.masked = PickedRows(moving.rows, param, fed, view.adam)
                step.overrides.extra_item(self.state, moving.masked.tensor, moving.masked.state)
                return moving.masked.tensor
            moving.masked = HeldRows(moving.rows, param, view.adam)
        if parts.displacement:  # Adam moves a buffer, whose state is the parameter's
            parts.check_options(self.call_name, group)
            moving.buffer = torch.zeros_like(param, requires_grad=False)
            moving.buffer.grad = fed
            step.overrides.extra_item(self.state, moving.buffer, view.adam)
            return moving.buffer
        if fed is not param.grad:
            step.fed.append((param, fed))
        return param

    def _finish(self, moving: MovingParameter, course: Course) -> None:
        """Move the parameter by what the parts make of Adam's step; have them act after it."""
        group, param, parts, view = moving.group, moving.param, moving.parts, moving.state
        if moving.buffer is not None:
            step = parts.displace(group, param, moving.buffer, view, course)
            param.add_(moving.where_it_moves(step, 0.0) if moving.guarded else step)
        if parts.after:
            before = param.detach().clone() if moving.guarded else None
            for name, part in parts.after:
                part.after(group, param, view.of(name), course)
            if before is not None:
                # .data: no write that a part should notice by the version counter.
                param.data.copy_(moving.where_it_moves(param.data, before))

    def _zero_nonfinite(self, param: Tensor) -> None:
        """Take what is not finite in a gradient as zero, and say so once."""
        found = zero_nonfinite(cast(Tensor, param.grad))
        if isinstance(found, Tensor):
            if self.course.num_observed % DEVICE_LOOK_INTERVAL == 0:
                known = self._nonfinite
                self._nonfinite = found if known is None else known.to(found.device) | found
            return
        if found:
            self._report_nonfinite(f"a gradient of shape {tuple(param.shape)}")

    def _report_nonfinite(self, what: str) -> None:
        if not self._nonfinite_reported:
            self._nonfinite_reported = True
            message = "iteration %d: %s is not finite; such numbers count as zero"
            LOGGER.warning(message, self.course.current, what)

    def record_of(self, param: Tensor) -> ParameterRecord | None:
        """What is known of the parameter at its place; None where it is none of these."""
        for group, records in zip(self.param_groups, self._records, strict=False):
            for each, record in zip(group["params"], records, strict=False):
                if each is param:
                    return record
        return None

    # -- whose state it is -----------------------------------------------------------------------

    def _follow_windows(self) -> None:
        """Drop what parts have kept for a window that is over, or that begins."""
        course = self.course
        now = course.open_windows()
        if now is self._open_windows and self._rewinds == course.rewinds:
            return
        rewound, self._rewinds = self._rewinds != course.rewinds, course.rewinds
        if rewound:
            for record in chain.from_iterable(self._records):
                record.forget_after(course.current)
        for name, window in now.items():
            if rewound or window is None or self._open_windows.get(name) != window:
                self._drop_kept(name)
        self._open_windows = now

    def _drop_kept(self, part: str) -> None:
        """Forget all that a part keeps for these parameters, and give its memory back."""
        prefix = f"{part}."
        numbers = [record.numbers for records in self._records for record in records]
        for store in (*self.state.values(), *numbers):
            for key in [key for key in store if str(key).startswith(prefix)]:
                del store[key]

    @torch.no_grad()
    def reset_rows(self, param: Tensor, rows: Rows) -> None:
        """Zero Adam's moments, and what the parts keep, of rows that the trainer has written.

        For trainers that move points *in place* (`param.data[dead] = ...`): one call, instead of
        zeroing `exp_avg` and `exp_avg_sq` by hand. Those that exchange the `Parameter` need not.

        Args:
            param: a parameter of this optimizer, [N, ..].
            rows: their indices, or an [N] bool mask; a tensor, an array of numpy, or a list.

        Raises:
            ValueError: the parameter is not one of this optimizer's, or there are no such rows.
        """
        call = f"{self.call_name}.reset_rows"
        if not any(param is each for group in self.param_groups for each in group["params"]):
            shown = f"of shape {tuple(param.shape)}" if isinstance(param, Tensor) else repr(param)
            raise ValueError(f"{call}: a parameter {shown} is none of these")
        index, state = check_rows(call, rows, param), self.state.get(param, {})
        self._ownership.drop_foreign(param, state, self.course.row_keys)
        for key in (*MOMENTS, *self.course.row_keys):
            if key in state:
                state[key][index] = 0

    def _takes_mask(self, group: Group, rows: int) -> bool:
        """Whether a mask of so many rows is about this group."""
        if gaussian_of(group) is not None:
            return True
        return self.any_group and any(p.shape[:1] == (rows,) for p in group["params"])

    def _drop_foreign(self) -> None:
        """Forget what parts have kept of other rows than the parameters' present ones."""
        for param, state in self.state.items():
            self._ownership.drop_foreign(param, state, self.course.row_keys)

    def _claim_rows(self) -> None:
        """Take what the parts have kept as that of the parameters' present rows."""
        for param, state in self.state.items():
            self._ownership.claim(param, state, self.course.row_keys)

    # -- copies and checkpoints ------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        names = ("course", "upgraded_in", "_base", "_slots", "_open_windows", "_rewinds")
        self._drop_foreign()  # what is of other rows must not be the copy's own
        state = {**super().__getstate__(), **{name: getattr(self, name) for name in names}}
        state.pop("_ownership", None)  # a base of the trainer's own may give all attributes
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if "course" in state:  # a copy: the parameters are other objects, the rows the same
            self._ownership, self._known = RowOwnership(), []
            self.name_groups()
            self._claim_rows()
            self.clock_at = self.course.current
            self.course.followers.register(self)

    def state_dict(self) -> dict[str, Any]:
        """torch's, with the course's inside `param_groups[0]`, and nothing of foreign rows."""
        self._drop_foreign()
        if self._nonfinite is not None and bool(self._nonfinite):
            self._report_nonfinite("a gradient")
        self._nonfinite = None
        if not self.course.keeps_state:
            return super().state_dict()
        self.name_groups()
        if self.course.parts:
            self._follow_windows()  # the clock may have been set back since the last step
        own = pack_optimizer(self, self._records, self._open_windows)
        with TemporaryOverrides() as temporary:
            shared = {**self.course.state_dict(), "optimizer": own}
            temporary.extra_item(self.param_groups[0], STATE_KEY, shared)
            return super().state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; also takes the `state_dict()` of a plain Adam.

        Raises:
            ValueError: it does not fit; then nothing has been loaded.
        """
        names = "state", "param_groups", "_known", "_gone", "_open_windows", "stepped_at"
        before = {name: getattr(self, name) for name in names}
        call, found = f"{self.call_name}.load_state_dict", list[Saved]()

        def inspect(_: Any, loaded: dict[str, Any]) -> dict[str, Any]:
            # torch would cast what parts keep to the parameters' dtype.
            with as_damage(call):
                saved, rest = inspect_checkpoint(self, loaded)
            found.append(saved)
            return rest

        handle = self.register_load_state_dict_pre_hook(inspect)  # after those of others
        try:
            with self.course.undone_on_error():
                super().load_state_dict(state_dict)
                with as_damage(call):
                    # A base class with a load_state_dict of its own may have called no hook.
                    self._restore(found[0] if found else None)
                    if self._base is Adam and self.defaults["fused"]:
                        use_fused(self)
        except BaseException:
            vars(self).update(before)
            self._acting = (None, None, {})
            raise
        finally:
            handle.remove()

    def _restore(self, saved: Saved | None) -> None:
        """Take the clock and what parts have kept, once torch has loaded the moments.

        Args:
            saved: what was found in a checkpoint; None: it lies in the state and in the groups,
                where a stock optimizer has loaded it.
        """
        if saved is None:
            saved = inspect_checkpoint(self, as_loaded(self))[0]
            self.param_groups[0].pop(STATE_KEY, None)
        self._acting = (None, None, {})
        self.name_groups()
        for group in self._known:
            group.records = records_of(group["params"], [])
        known, self.stepped_at = self.course.named().keys(), -1
        params = chain.from_iterable(group["params"] for group in self.param_groups)
        for param, rows in zip(params, saved.rows, strict=True):
            own = self.state.get(param)
            for key in [key for key in own or () if is_kept_by_part(key, known | saved.parts)]:
                del self.state[param][key]
            for key, value in rows.items():
                self.state[param][key] = value.detach().to(param.device, copy=True)
        if saved.course is None:
            self.course.expect(number_of_steps(self.state.values()))
        restore_records(self, self._records, saved)
        for group, records in zip(self.param_groups, self._records, strict=True):
            for param, record in zip(group["params"], records, strict=True):
                if not known >= set(record.units or ()):  # without parts no step would notice
                    take_units(group, record, self.state.get(param), (), self.course)
        self._open_windows = dict(saved.windows)
        self._rewinds = self.course.rewinds
        self.clock_at = self.course.current
        self._claim_rows()

    def take_loaded(self) -> None:
        """Take what a checkpoint of ours has left in a stock optimizer, before it was upgraded.

        Raises:
            ValueError: it is damaged. The optimizer and its course are half changed then.
        """
        with as_damage(f"{self.call_name}: a checkpoint that was loaded before the upgrade"):
            self._restore(None)

    @property
    def call_name(self) -> str:
        """How messages call it."""
        own = (cls.__name__ for cls in type(self).__mro__ if "_made_of" not in vars(cls))
        return next(own)

    def __repr__(self) -> str:
        groups = (group_line(i, group) for i, group in enumerate(self.param_groups))
        return block(type(self).__name__, [*self.course.lines(), *groups])
