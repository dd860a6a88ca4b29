"""The optimizer: `torch.optim.Adam` whose steps have the parts of a training."""

from __future__ import annotations

import functools
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim import Adam

from opt3dgs_optim.checkpoint import (
    STATE_KEY,
    check_loaded,
    numbers_of,
    restore_notes,
    restore_parts,
)
from opt3dgs_optim.clock import Ticket
from opt3dgs_optim.contract import Slots, check_supported, own_step
from opt3dgs_optim.mean import BEGAN, OF_MEAN, put_mean
from opt3dgs_optim.moments import MOMENTS, as_numbers, recode
from opt3dgs_optim.names import split_name
from opt3dgs_optim.sparse_adam import check_arguments, step_around
from opt3dgs_optim.stepper import KEPT, ParamStepper
from opt3dgs_optim.training import Member, Training


class StepAdam(Adam):
    """`torch.optim.Adam` whose steps have the parts of a `Training`.

    Made by `PhaseScheduler.upgrade`, `AWSGLD` and `LQNAdam`. An upgraded optimizer is an instance
    of this class *and* of the class that it had. Without parts its step is that class's own.

    What it keeps lies beside Adam's moments in `state[param]`, rows first, and as plain numbers in
    `param_groups[0]["opt3dgs"]`, so that `state_dict()` and `torch.save` carry it.
    """

    training: Training
    ticket: Ticket
    coded = False  # whether its moments are codes of 16 bits, see `moments`
    _base: type[Adam] = Adam  # the class whose optimizer it was
    _steppers: list[ParamStepper] = []  # noqa: RUF012  (made anew, never changed)
    _slots: Slots
    # Where it has not stepped since a load: of every parameter, the iteration of its last step, and
    # the sets whose positions' moments are those of the own frame.
    _last: tuple[int, ...] = ()
    _own_frame: frozenset[str] = frozenset()

    def follow(self, training: Training, slots: Slots) -> None:
        """Have the parts of `training` from now on; slots are, by group, set and name."""
        self._last, self._own_frame = self.last_steps(), self.own_frame()
        self.training, self._slots, self._steppers = training, slots, []
        if "ticket" not in vars(self):
            self.ticket = Ticket()
        self._masked = own_step(self._base) is not None
        self._step_supports_amp_scaling = False  # a GradScaler unscales, and leaves steps out
        self._name_groups()
        self._count_on_host()

    def _name_groups(self) -> None:
        """Say in each group which Gaussian parameter it holds, by gsplat's name, or None."""
        for at, (which, name) in enumerate(self._slots):
            self.param_groups[at]["gaussian"] = name
            if name is not None:
                self.training.members[which, name] = Member(self, at, self.ticket)
        self.ticket.has_means = any(name == "means" for _, name in self._slots)
        self.training.counts_means |= self.ticket.has_means

    def _count_on_host(self) -> None:
        """Keep Adam's count of steps on the host, which reads it in every step of ours."""
        if not self.training.changes_steps:
            return
        for group in self.param_groups:
            group["fused"], group["foreach"] = False, False
        for state in self.state.values():
            if isinstance(state.get("step"), Tensor):
                state["step"] = state["step"].to("cpu", torch.float32)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As torch's; refuses what `upgrade` would, with nothing changed."""
        super().add_param_group(param_group)
        if "training" not in vars(self):
            return
        slots = [*self._slots, split_name(self.param_groups[-1].get("name"))]
        try:
            check_supported(self, slots, self.training.moments)
        except ValueError:
            self.param_groups.pop()
            raise
        self._slots = slots
        self._name_groups()
        self._count_on_host()

    # -- a step ----------------------------------------------------------------------------------

    def step(self, closure: Any = None, *masked: Any, **masks: Any) -> Any:  # pyright: ignore
        """One step of every parameter that has a gradient; return the closure's value.

        Args:
            closure: evaluates the model and returns the loss, or None. gsplat's SelectiveAdam and
                INRIA's SparseGaussianAdam get their mask, and what goes with it, unchanged.
        """
        given: tuple[Any, ...] = ()
        if self._masked:
            given = () if closure is None and not masked else (closure, *masked)
            check_arguments(type(self).__name__, self._base.step, self, *given, masks)
        elif masked or masks or isinstance(closure, Tensor):
            raise TypeError(
                f"{type(self).__name__}.step: a mask was given, but torch's Adam steps all rows; "
                "use gsplat's SelectiveAdam or INRIA's SparseGaussianAdam for masked steps"
            )
        self._opt_called = True  # what learning-rate schedulers would note by wrapping this method
        for hook in self._optimizer_step_pre_hooks.values():
            hook(self, (closure, *masked), masks)
        loss, training = None, self.training
        if callable(closure):
            with torch.enable_grad():
                loss = closure()
            if loss is not None and training.observers:
                training.observe(loss)
        iteration = training.begin(self.ticket)
        if not training.changes_steps:
            self.own_class_step(*given, **masks)
        elif self._masked:
            itself = functools.partial(self.own_class_step, *given, **masks)
            step_around(self.steppers(), self.state, iteration, itself)
        else:
            with_grad = torch.is_grad_enabled()
            torch._C._set_grad_enabled(False)  # in a tenth of the time of `with torch.no_grad()`
            try:
                for stepper in self.steppers():
                    if stepper.param.grad is not None:
                        stepper.step(self.state[stepper.param], iteration)
            finally:
                torch._C._set_grad_enabled(with_grad)
        for hook in self._optimizer_step_post_hooks.values():
            hook(self, (closure, *masked), masks)
        return loss

    # Learning-rate schedulers, which would wrap `step` on the instance, need not: `step` tells.
    step._wrapped_by_lr_sched = True  # pyright: ignore[reportFunctionMemberAccess]
    # torch's own wrapper, for hooks and profiles, takes longer than all else that Python does here.
    step.hooked = True  # pyright: ignore[reportFunctionMemberAccess]

    def steppers(self) -> list[ParamStepper]:
        """The steppers of all parameters; looked up again when groups or Parameters are new."""
        steppers, i = self._steppers, 0
        for group in self.param_groups:
            for param in group["params"]:
                if (
                    i == len(steppers)
                    or steppers[i].param is not param
                    or steppers[i].group is not group
                ):
                    return self._new_steppers()
                i += 1
        return steppers if i == len(steppers) else self._new_steppers()

    def _new_steppers(self) -> list[ParamStepper]:
        if len(self._slots) != len(self.param_groups):
            raise ValueError(
                f"{type(self).__name__}.step: {len(self.param_groups)} parameter groups, but "
                f"{len(self._slots)} when it was upgraded; upgrade it again where they change"
            )
        old, made, call = self._steppers, [], type(self).__name__
        for group, slot in zip(self.param_groups, self._slots, strict=True):
            for param in group["params"]:
                i = len(made)
                stepper = ParamStepper(call, self.training, group, param, slot)
                state = self.state.get(param, {})
                if i < len(old):
                    stepper.follow(old[i], state)
                else:
                    # One that has not stepped yet counts as having stepped in the iteration before
                    # the present one: events of earlier ones are not made up for.
                    now = self.ticket.next_iteration - 1
                    stepper.stepped_in = self._last[i] if i < len(self._last) else now - 1
                    if state:
                        stepper.framed = stepper.name == "means" and stepper.set in self._own_frame
                    stepper.drop_moved(state, False, False)
                stepper.check_rows(state)
                made.append(stepper)
        self._steppers = made
        return made

    def own_class_step(self, *args: Any, **options: Any) -> Any:
        """The step of the class that it had, without torch's hooks, which `step` runs already."""
        step: Any = self._base.step
        return (step.__wrapped__ if getattr(step, "hooked", False) else step)(
            self, *args, **options
        )

    # -- rows and checkpoints ----------------------------------------------------------------------

    @torch.no_grad()
    def reset_rows(self, param: Tensor, rows: Tensor) -> None:
        """Forget what is kept for some rows, of a trainer that writes into a Parameter in place.

        Args:
            param: one of the optimizer's parameters [N, ...].
            rows: their indices, or an [N] bool mask.
        """
        for key in (*MOMENTS, *KEPT):
            if key in self.state[param]:
                self.state[param][key][rows] = 0

    @torch.no_grad()
    def put_means(self) -> int:
        """Put the running means in the parameters' place now; of how many parameters.

        Of those that have not gone on since the end of the training. Inside it once more where a
        step has put it: 3DGS-MCMC's trainers add noise to positions after the step.
        """
        found, end = 0, self.training.total_steps
        for stepper in self.steppers():
            if end is not None and stepper.stepped_in > end:  # trainers that count from 1 end there
                continue
            state = self.state.get(stepper.param, {})
            found += put_mean(stepper.param, state, stepper.grid)
        return found

    def state_dict(self) -> dict[str, Any]:
        """As torch's, with the training's numbers in `param_groups[0]["opt3dgs"]`."""
        if not self.training.changes_steps:
            return super().state_dict()
        self._drop_moved()
        self.param_groups[0][STATE_KEY] = self.numbers()
        try:
            found = super().state_dict()
        finally:  # it is of this moment
            del self.param_groups[0][STATE_KEY]
        if self.coded:  # any Adam may load it; the codes of these numbers are the same again
            found["state"] = {at: as_numbers(state) for at, state in found["state"].items()}
        return found

    def numbers(self) -> dict[str, Any]:
        """What a checkpoint has beside tensors."""
        counts = (int(state["step"]) for state in self.state.values() if "step" in state)
        steps = max(counts, default=0)
        return numbers_of(self.training, self.ticket, steps, self.last_steps(), self.own_frame())

    def _drop_moved(self) -> None:
        """Drop what was kept for rows that are others since the last step: a copy knows no more."""
        if self._steppers:
            self.steppers()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; the training goes on where the checkpoint was.

        Of a checkpoint of a stock Adam, the place is the number of Adam's own steps.

        Raises:
            ValueError: it is damaged, or of another version; nothing has been changed.
        """
        call = f"{type(self).__name__}.load_state_dict"
        saved = check_loaded(call, state_dict, self.param_groups)
        if saved is not None:
            restore_parts(self.training, saved)
        own = [dict(group) for group in self.param_groups]
        super().load_state_dict(state_dict)
        self.coded = False  # unless the training's numbers say so
        for group, was in zip(self.param_groups, own, strict=True):
            for key, value in was.items():
                group.setdefault(key, value)  # an option that older versions of torch did not have
        self._count_on_host()
        self.resume()

    def resume(self) -> None:
        """Go on where the state says that the training is: after a load."""
        training, saved = self.training, self.param_groups[0].pop(STATE_KEY, None)
        counts = [int(state["step"]) for state in self.state.values() if "step" in state]
        missed = 0 if saved is None else max(counts, default=0) - saved["steps"]
        if missed:
            training.messages.say_once(
                f"opt3dgs_optim: a stock Adam has gone on for {missed} steps with this checkpoint; "
                "what was kept beside its moments begins anew"
            )
        ours = None if missed else saved  # what it says of the moments holds
        self._own_frame = frozenset(() if ours is None else ours["own_frame"])
        self._last = () if ours is None else tuple(ours["last"])
        dropped = KEPT if ours is None or ours["total_steps"] != training.total_steps else ()
        if ours is not None and ours["moments"] != training.moments:
            dropped = dropped or OF_MEAN
            if any(BEGAN in state for state in self.state.values()):
                bits = f"at {training.moments} bits"
                training.messages.say_once(
                    f"opt3dgs_optim: the mean of the last iterates begins anew, {bits}"
                )
        for state in self.state.values():  # of the end of another run, or in another form
            for key in dropped:
                state.pop(key, None)
        if saved is not None:
            iteration = saved["iteration"] + max(missed, 0)
        else:
            iteration = self._iteration_by_counts(counts)
        self._steppers, self.ticket.next_iteration = [], iteration
        clocks = training.clocks()
        if saved is not None or (counts and (self.ticket.has_means or not any(clocks))):
            training.resume(max([iteration, *clocks]))  # one that steps now and then lags
        if saved is not None:
            restore_notes(training, saved)
        self._recode(tell=saved is None or saved["moments"] != training.moments)
        if self._own_frame and not training.changes_steps:
            for stepper in self.steppers():
                if stepper.framed:
                    for key in MOMENTS:
                        self.state[stepper.param][key].zero_()

    def _iteration_by_counts(self, counts: list[int]) -> int:
        """The iteration that comes next, by Adam's own counts of steps."""
        if not counts:  # one that is made anew under way steps first in the next iteration
            return self.training.iteration + 1
        if not any(counts):
            self.training.messages.warn_once(
                "uncounted",
                f"{type(self).__name__}: it has moments, but does not count its steps, so that the "
                "clock begins at 0; call phases.observe(iteration=...) where the training goes on",
            )
        return max(counts)

    def _recode(self, tell: bool) -> None:
        """Have the moments at as many bits as the training says; rounded where they had more."""
        bits = self.training.moments
        found = [recode(s, self.coded, bits, p.dtype) for p, s in self.state.items()]
        if tell and any(found) and self.coded != (bits == 16):
            self.training.messages.say_once(
                f"opt3dgs_optim: the moments that were there are now at {bits} bits"
            )
        self.coded = bits == 16

    def last_steps(self) -> tuple[int, ...]:
        """Of every parameter, the iteration of its last step."""
        return tuple(stepper.stepped_in for stepper in self._steppers) or self._last

    def own_frame(self) -> frozenset[str]:
        """The sets whose positions' moments are those of the own frame."""
        if not self._steppers:
            return self._own_frame
        return frozenset(each.set for each in self._steppers if each.framed)

    # -- copies ------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        self._drop_moved()
        own = {
            key: getattr(self, key) for key in ("training", "ticket", "_slots", "_masked", "coded")
        }
        own |= {"_steppers": [], "_last": self.last_steps(), "_own_frame": self.own_frame()}
        return {**super().__getstate__(), **own}

    def __reduce__(self) -> Any:
        # The class of an upgraded optimizer is made when it is needed, and has no name to find.
        made = type(self) is _CLASSES.get(self._base)
        return _made_again, (None if made else type(self), self._base), self.__getstate__()

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._step_supports_amp_scaling = False


def _made_again(kind: type[StepAdam] | None, base: type[Adam]) -> StepAdam:
    kind = upgraded_class(base) if kind is None else kind
    return kind.__new__(kind)


_CLASSES: dict[type[Adam], type[StepAdam]] = {}


def upgraded_class(base: type[Adam]) -> type[StepAdam]:
    """A class that is `StepAdam` and `base`."""
    if base not in _CLASSES:
        made = type(base.__name__, (StepAdam, base), {"_base": base, "__module__": base.__module__})
        _CLASSES[base] = cast(type[StepAdam], made)
    return _CLASSES[base]
