"""The optimizer: `torch.optim.Adam` whose steps have the parts of a training.

What torch does around a step stays torch's: hooks, the range in profiles, what wraps `step` on the
instance, load hooks. Where there is nothing of it, none of it is paid for.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from opt3dgs_optim.checkpoint import (
    STATE_KEY,
    check_loaded,
    complete_groups,
    drop_other_means,
    forget_own_frames,
    iteration_by_counts,
    note_in_groups,
    numbers_of,
    recode_all,
    restore_parts,
    restore_training,
    steps_of_a_stock_adam,
    take_from_groups,
)
from opt3dgs_optim.contract import (
    Slots,
    bare,
    check_held,
    check_slots,
    check_supported,
    check_tensors,
    indices_of,
    own_step,
)
from opt3dgs_optim.mean import kept_in, put_mean
from opt3dgs_optim.moments import MOMENTS, as_numbers
from opt3dgs_optim.names import split_name
from opt3dgs_optim.sparse_adam import check_arguments, refuse_capture, refuse_mask, step_around
from opt3dgs_optim.stepper import ParamStepper
from opt3dgs_optim.training import Training


class StepAdam(Adam):
    """`torch.optim.Adam` whose steps have the parts of a `Training`.

    Made by `PhaseScheduler.upgrade`, `AWSGLD` and `LQNAdam`. An upgraded optimizer is an instance
    of this class *and* of its former class. Without parts it steps as its former class does. What
    it keeps lies beside Adam's moments in `state[param]`, rows first.
    """

    training: Training
    next_iteration = 0  # the one that it steps next
    has_positions = False  # whether it holds positions, whose steps count
    coded = False  # whether its moments are codes of 16 bits, see `moments`
    _base: type[Adam] = Adam  # the class whose optimizer it was
    _masked = False  # whether that class has a step of its own
    _steppers: list[ParamStepper] = []  # noqa: RUF012  (made anew, never changed)
    _in_order: list[ParamStepper] = []  # noqa: RUF012  (the same, as they step)
    _slots: Slots
    _last: tuple[int, ...] = ()  # what `last_steps` and `framed_sets` say until the first step
    _framed: frozenset[str] = frozenset()

    def follow(self, training: Training, slots: Slots) -> None:
        """Use `training`'s parts from now on; `slots` has each group's set and name."""
        if vars(self).get("training") is not training:
            self.forget_steppers()
        self.training, self._slots = training, slots
        if not self.state:
            self.coded = training.moments == 16
        self._step_supports_amp_scaling = False  # a GradScaler unscales, and leaves steps out
        self._on_gpu = any(p.is_cuda for group in self.param_groups for p in group["params"])
        self._name_groups()
        self._remember_rows()

    def _name_groups(self) -> None:
        """Tell the training which Gaussian parameters it holds, and in which groups."""
        for group in self.param_groups:
            # Always there, since flattened states are loaded by the keys that a group has.
            group.setdefault(STATE_KEY, "")
        self.has_positions = self.training.take(self, self._slots)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As torch's; refuses what `upgrade` would, with nothing changed."""
        ours, call = "training" in vars(self), f"{type(self).__name__}.add_param_group"
        if ours:
            check_slots(call, self.param_groups, self._slots)
        super().add_param_group(param_group)
        if not ours:
            return
        slots = [*self._slots, split_name(self.param_groups[-1].get("name"))]
        try:
            check_supported(call, self, slots, self.training.moments)
        except ValueError:
            self.param_groups.pop()
            raise
        self._slots = slots
        self._name_groups()

    def step(self, *args: Any, **options: Any) -> Any:
        """One step of every parameter that has a gradient; return the value of `closure`, if given.

        gsplat's SelectiveAdam and INRIA's SparseGaussianAdam get their own arguments, unchanged.
        """
        self._opt_called = True  # what learning-rate schedulers would note by wrapping this method
        if torch.compiler.is_compiling():
            return _uncompiled_step(self, *args, **options)
        if (
            self._optimizer_step_pre_hooks or self._optimizer_step_post_hooks
            or _global_optimizer_pre_hooks or _global_optimizer_post_hooks
            or torch.autograd._profiler_enabled()  # pyright: ignore
        ):  # fmt: skip
            return _hooked_step(self, *args, **options)
        return self._step(*args, **options)

    # Learning-rate schedulers, which would wrap `step` on the instance, need not: `step` tells.
    step._wrapped_by_lr_sched = True  # pyright: ignore[reportFunctionMemberAccess]
    # torch's own wrapper, for hooks and profiles, takes longer than all else that Python does here.
    step.hooked = True  # pyright: ignore[reportFunctionMemberAccess]

    def _step(self, closure: Any = None, *masked: Any, **masks: Any) -> Any:
        loss, training, given = None, self.training, ()
        if self._masked:
            given = () if closure is None and not masked else (closure, *masked)
            check_arguments(type(self).__name__, self._base.step, (self, *given), masks)
        elif masked or masks or not (closure is None or callable(closure)):
            refuse_mask(type(self).__name__)
        if callable(closure):
            with torch.enable_grad():
                loss = closure()
            if loss is not None and training.observers:
                training.observe(loss)
        if self._on_gpu and torch.cuda.is_current_stream_capturing():
            refuse_capture(type(self).__name__)
        iteration = training.begin(self)
        if not training.changes_steps:
            self.own_class_step(*given, **masks)
        elif self._masked:
            itself = functools.partial(self.own_class_step, *given, **masks)
            self.steppers()
            step_around(self._in_order, self.state, iteration, itself)
        else:
            with_grad = torch.is_grad_enabled()
            torch._C._set_grad_enabled(False)  # in a tenth of the time of `with torch.no_grad()`
            try:
                self.steppers()
                for stepper in self._in_order:
                    param = stepper.param()
                    if param is not None and param.grad is not None:
                        stepper.step(param, self.state[param], iteration)
            finally:
                torch._C._set_grad_enabled(with_grad)
        return loss

    def steppers(self) -> list[ParamStepper]:
        """The steppers of all parameters; looked up again when groups or Parameters are new."""
        steppers, i = self._steppers, 0
        for group in self.param_groups:
            for param in group["params"]:
                known = steppers[i] if i < len(steppers) else None
                if known is None or known.param() is not param or known.group is not group:
                    return self._new_steppers()
                i += 1
        return steppers if i == len(steppers) else self._new_steppers()

    def notice_edits(self) -> None:
        """Drop what is kept for rows replaced since the last step; a copy could not tell."""
        if self._steppers:
            self.steppers()

    def _remember_rows(self) -> None:
        """Know whose rows the state is of, so that an edit before the first step shows."""
        if (self.state or self._steppers) and len(self._slots) == len(self.param_groups):
            self._new_steppers(check=False)
            self.training.read_back()

    def forget_steppers(self) -> None:
        """Have none, but know when they stepped last."""
        self._last, self._framed = self.last_steps(), self.framed_sets()
        self._steppers, self._in_order = [], []

    def _new_steppers(self, check: bool = True) -> list[ParamStepper]:
        made, call, last = [], type(self).__name__, dict(enumerate(self._last))
        old: dict[Any, ParamStepper] = {each.place: each for each in self._steppers}
        old |= {id(param): each for each in self._steppers if (param := each.param()) is not None}
        check_slots(f"{call}.step", self.param_groups, self._slots)
        for at, (group, slot) in enumerate(zip(self.param_groups, self._slots, strict=True)):
            if check:
                check_tensors(f"{call}.step", group, slot[1])
                self.training.claim(call, slot, at, self)
            for j, param in enumerate(group["params"]):
                stepper = ParamStepper(call, self.training, group, param, slot)
                stepper.place = (slot if slot[1] else at, j)
                state = self.state.get(param, {})
                before = old.get(id(param)) or old.get(stepper.place)
                if before is not None:
                    stepper.follow(before, param, state)
                else:
                    stepper.stepped_in = last.get(len(made))
                    if "exp_avg" in state:
                        stepper.framed = stepper.name == "means" and stepper.set in self._framed
                        stepper.remember(state["exp_avg"])
                if check:
                    stepper.check_rows(param, state)
                made.append(stepper)
        self._on_gpu = any(p.is_cuda for group in self.param_groups for p in group["params"])
        self._steppers = made
        # Positions first: they step in frames of the shapes that the gradient is of.
        self._in_order = sorted(made, key=lambda stepper: stepper.name != "means")
        return made

    def own_class_step(self, *args: Any, **options: Any) -> Any:
        """The step of the class that it had, without torch's hooks, which `step` runs already."""
        return bare(self._base.step)(self, *args, **options)

    @torch.no_grad()
    def reset_rows(self, param: Tensor, rows: Tensor) -> None:
        """Forget what is kept for some rows, of a trainer that writes into a Parameter in place.

        Args:
            param: one of the optimizer's parameters [N, ...].
            rows: their indices, or an [N] bool mask.
        """
        call = f"{type(self).__name__}.reset_rows"
        check_held(call, self, param)
        rows = indices_of(call, param, rows)
        self.notice_edits()
        state = self.state.get(param, {})
        for key in state.keys() & {*MOMENTS, *kept_in(state)}:
            state[key][rows] = 0

    @torch.no_grad()
    def put_means(self) -> int:
        """Put the running means in the parameters' place, also after noise; return how many.

        Parameters stepped after the end of the training stay as they are.
        """
        found, end = 0, self.training.end_step
        for stepper in self.steppers():
            if end is not None and (stepper.stepped_in or 0) > end:  # one may count from 1
                continue
            param = stepper.param()
            if param is not None and (state := self.state.get(param)):
                stepper.begin_edited_rows_anew(state)
                found += put_mean(param, state, stepper.name)
        return found

    def state_dict(self) -> dict[str, Any]:
        """As torch's, with a line of JSON of ours in each group, under `"opt3dgs"`.

        Any Adam may load it. Moments of 16 bits are float32 in it, on the host.
        """
        if not self.training.changes_steps:
            return super().state_dict()
        try:
            self.note_in_groups()
            found = super().state_dict()
        finally:  # it is of this moment
            for group in self.param_groups:
                group[STATE_KEY] = ""
        if self.coded:
            found["state"] = {at: as_numbers(state) for at, state in found["state"].items()}
        return found

    def note_in_groups(self) -> None:
        """Put into each group what a checkpoint has beside tensors."""
        self.notice_edits()
        counts = (int(state["step"]) for state in self.state.values() if "step" in state)
        kept = sum(bool(kept_in(state)) for state in self.state.values())
        common = numbers_of(self.training, self.next_iteration, max(counts, default=0), kept)
        last, now = self.last_steps(), self.next_iteration - 1
        note_in_groups(self.param_groups, self._slots, common, last, now, self.framed_sets())

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; training goes on where the checkpoint was (a stock one: by Adam's count).

        Load hooks run first: they may reorder or drop groups.

        Raises:
            ValueError: it is damaged, or of another version; nothing has been changed.
        """
        call, own = f"{type(self).__name__}.load_state_dict", [{**g} for g in self.param_groups]
        if not isinstance(state_dict, Mapping):
            raise ValueError(f"{call}: {state_dict!r:.100}, but what state_dict() gives is needed")

        def check(_: Any, given: dict[str, Any]) -> None:
            saved = check_loaded(call, given, own)
            if saved is not None:
                restore_parts(self.training, [saved])
            self._steppers, self._in_order = [], []  # what is loaded is no edit of their rows

        def go_on(_: Any) -> None:
            self.coded = False  # what is loaded is numbers
            complete_groups(self.training, self.param_groups, own)
            self.resume()

        handles = [
            self.register_load_state_dict_pre_hook(check),
            self.register_load_state_dict_post_hook(go_on, prepend=True),
        ]
        try:
            super().load_state_dict(state_dict)
        finally:
            for handle in handles:
                handle.remove()

    def resume(self) -> None:
        """Go on where the state says that the training is: after a load."""
        training = self.training
        if not self.state and not any(map(operator.itemgetter(STATE_KEY), self.param_groups)):
            self.next_iteration = training.iteration + 1  # made anew, perhaps under way
            return
        saved, last, framed = take_from_groups(self.param_groups, self._slots)
        counts = [int(state["step"]) for state in self.state.values() if "step" in state]
        missed = steps_of_a_stock_adam(counts, saved, training)
        ours = None if missed else saved  # what it says of the moments holds
        self._last, self._framed = ((), frozenset()) if ours is None else (last, framed)
        if saved is not None:
            restore_training(training, saved)
            iteration = saved["iteration"] + missed
        else:
            iteration = iteration_by_counts(type(self).__name__, counts, training)
        drop_other_means(self.state.values(), ours, training)
        self._steppers, self._in_order, self.next_iteration = [], [], iteration
        clocks = training.clocks()  # one that steps now and then lags
        if saved is not None or (counts and (self.has_positions or not any(clocks))):
            training.resume(max([iteration, *clocks]), saved is None and any(counts))
        recode_all(self.state, self.coded, saved, training)
        self.coded = training.moments == 16
        if not training.changes_steps:
            forget_own_frames(self.param_groups, self._slots, self._framed, self.state)
        self._remember_rows()

    def last_steps(self) -> tuple[int, ...]:
        """Of every parameter, the iteration of its last step."""
        now = self.next_iteration - 1 if self._steppers else 0
        made = [now if each.stepped_in is None else each.stepped_in for each in self._steppers]
        return tuple(made) or self._last

    def framed_sets(self) -> frozenset[str]:
        """The sets whose positions have moments in the own frame."""
        framed = frozenset(each.set for each in self._steppers if each.framed)
        return framed if self._steppers else self._framed

    def __copy__(self) -> StepAdam:
        raise TypeError(f"{type(self).__name__}: two optimizers of one state; use copy.deepcopy")

    def __getstate__(self) -> dict[str, Any]:
        self.notice_edits()
        kept = ("training", "next_iteration", "has_positions", "_slots", "coded")
        own = {key: getattr(self, key) for key in (*kept, "_on_gpu")}
        own |= {"_steppers": [], "_last": self.last_steps(), "_framed": self.framed_sets()}
        return {**super().__getstate__(), **own}

    def __reduce__(self) -> Any:
        # The class of an upgraded optimizer is made when it is needed, and has no name to find.
        made = type(self) is upgraded_class(self._base)
        return _made_again, (None if made else type(self), self._base), self.__getstate__()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._step_supports_amp_scaling = False
        if "training" in vars(self):  # a copy, whose training does not know it, or a load
            self._name_groups()
            self._remember_rows()


_hooked_step: Any = Optimizer.profile_hook_step(StepAdam._step)
_uncompiled_step: Any = torch._disable_dynamo(StepAdam.step)  # pyright: ignore  (it reads numbers)


def _made_again(kind: type[StepAdam] | None, base: type[Adam]) -> StepAdam:
    kind = upgraded_class(base) if kind is None else kind
    return kind.__new__(kind)


@functools.cache
def upgraded_class(base: type[Adam]) -> type[StepAdam]:
    """A class that is `StepAdam` and `base`."""
    own = {"_base": base, "_masked": own_step(base) is not None, "__module__": base.__module__}
    return cast(type[StepAdam], type(base.__name__, (StepAdam, base), own))
