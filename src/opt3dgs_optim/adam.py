"""The optimizer: `torch.optim.Adam` whose steps have the parts of a course."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.optim import Adam

from opt3dgs_optim import triton
from opt3dgs_optim.checkpoint import check_tensors
from opt3dgs_optim.checks import LOGGER
from opt3dgs_optim.contract import Slots, check_supported, own_step
from opt3dgs_optim.course import STATE_KEY, Course
from opt3dgs_optim.lane import BEGAN, KEPT, MEAN, MOMENTS, OF_MEAN, RESIDUE, Lane
from opt3dgs_optim.masked import check_arguments, step_around
from opt3dgs_optim.moments import CODES, NEAREST, decoded, encode
from opt3dgs_optim.names import split_name
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Hyper, Step, like_rows, mean_of_residue, mixed, take_step


class StepAdam(Adam):
    """`torch.optim.Adam` whose steps have the parts of a `Course`.

    Made by `PhaseScheduler.upgrade`, `AWSGLD` and `LQNAdam`. An upgraded optimizer is an instance
    of this class *and* of the class that it had. Without parts its step is that class's own.

    What it keeps lies beside Adam's moments in `state[param]`, rows first, and as plain numbers in
    `param_groups[0]["opt3dgs"]`, so that `state_dict()` and `torch.save` carry it.
    """

    course: Course
    next_iteration = 0
    has_means = False  # whether it holds positions: its steps are counted by the course's clock
    coded = False  # whether its moments are codes of 16 bits, see `moments`
    in_own_frame: frozenset[str] = frozenset()  # sets whose positions' moments are the own frame's
    _base: type[Adam] = Adam  # the class whose optimizer it was
    _lanes: list[Lane] = []  # noqa: RUF012  (made anew, never changed)
    _slots: Slots
    _last: tuple[int, ...] = ()  # of every parameter, the iteration of its last step before a load

    def follow(self, course: Course, slots: Slots) -> None:
        """Have the parts of `course` from now on; slots are, by group, set and name."""
        self._last = self.last_steps()
        self.course, self._slots, self._lanes = course, slots, []
        self._masked = own_step(self._base) is not None
        self._step_supports_amp_scaling = False  # a GradScaler unscales, and leaves steps out
        self._name_groups()
        self._count_on_host()

    def _name_groups(self) -> None:
        """Say in each group which Gaussian parameter it holds, by gsplat's name, or None."""
        for at, (which, name) in enumerate(self._slots):
            self.param_groups[at]["gaussian"] = name
            if name is not None:
                self.course.members[which, name] = self, at
        self.has_means = any(name == "means" for _, name in self._slots)
        self.course.has_means |= self.has_means

    def _count_on_host(self) -> None:
        """Keep Adam's count of steps on the host, which reads it in every step of ours."""
        if not self.course.acts:
            return
        for group in self.param_groups:
            group["fused"], group["foreach"] = False, False
        for state in self.state.values():
            if isinstance(state.get("step"), Tensor):
                state["step"] = state["step"].to("cpu", torch.float32)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As torch's; refuses what `upgrade` would, with nothing changed."""
        super().add_param_group(param_group)
        if "course" not in vars(self):
            return
        slots = [*self._slots, split_name(self.param_groups[-1].get("name"))]
        try:
            check_supported(self, slots, self.course.moments)
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
        loss, course = None, self.course
        if callable(closure):
            with torch.enable_grad():
                loss = closure()
            if loss is not None and course.observers:
                course.observe(loss)  # pyright: ignore[reportAttributeAccessIssue]
        iteration = course.begin(self)
        if not course.acts:
            self.own_class_step(*given, **masks)
        elif self._masked:
            step_around(self, iteration, given, masks)
        else:
            with_grad = torch.is_grad_enabled()
            torch._C._set_grad_enabled(False)  # in a tenth of the time of `with torch.no_grad()`
            try:
                for lane in self.present_lanes():
                    if lane.param.grad is not None:
                        self._step_lane(lane, iteration)
            finally:
                torch._C._set_grad_enabled(with_grad)
        for hook in self._optimizer_step_post_hooks.values():
            hook(self, (closure, *masked), masks)
        return loss

    # Learning-rate schedulers, which would wrap `step` on the instance, need not: `step` tells.
    step._wrapped_by_lr_sched = True  # pyright: ignore[reportFunctionMemberAccess]
    # torch's own wrapper, for hooks and profiles, takes longer than all else that Python does here.
    step.hooked = True  # pyright: ignore[reportFunctionMemberAccess]

    def present_lanes(self) -> list[Lane]:
        """The lanes of all parameters; looked up again when groups or Parameters are new."""
        lanes, i = self._lanes, 0
        for group in self.param_groups:
            for param in group["params"]:
                if i == len(lanes) or lanes[i].param is not param or lanes[i].group is not group:
                    return self._new_lanes()
                i += 1
        return lanes if i == len(lanes) else self._new_lanes()

    def _new_lanes(self) -> list[Lane]:
        if len(self._slots) != len(self.param_groups):
            raise ValueError(
                f"{type(self).__name__}.step: {len(self.param_groups)} parameter groups, but "
                f"{len(self._slots)} when it was upgraded; upgrade it again where they change"
            )
        old, made, course = self._lanes, [], self.course
        for group, slot in zip(self.param_groups, self._slots, strict=True):
            for param in group["params"]:
                i = len(made)
                lane = Lane(group, param, slot, course.parts, course.counter_on(param.device))
                state = self.state.get(param, {})
                if i < len(old):
                    self._succeed(lane, old[i], state)
                else:
                    # One that has not stepped yet counts as having stepped in the iteration before
                    # the present one: events of earlier ones are not made up for.
                    now = self.next_iteration - 1
                    lane.stepped_in = self._last[i] if i < len(self._last) else now - 1
                    if state:
                        lane.framed = lane.name == "means" and lane.set in self.in_own_frame
                    lane.drop_moved(state, False, False)
                self._check_rows(lane, state)
                made.append(lane)
        self._lanes = made
        return made

    def _succeed(self, lane: Lane, before: Lane, state: dict[str, Any]) -> None:
        """Have a lane go on where the one before it was, whose Parameter may be another."""
        lane.stepped_in, lane.framed, lane.noted = before.stepped_in, before.framed, before.noted
        new = before.param is not lane.param
        lane.drop_moved(state, new, new and before.param._version != before.version)
        if lane.name == "means" and len(lane.param) < len(before.param):
            self.course.rows_removed(len(before.param) - len(lane.param))

    def _check_rows(self, lane: Lane, state: dict[str, Any]) -> None:
        """Refuse moments of other rows than the parameter has, as a checkpoint may bring them."""
        for key in MOMENTS:
            moment = state.get(key)
            if moment is not None and moment.shape != lane.param.shape:
                raise ValueError(
                    f"{type(self).__name__}.step: {lane.name or 'a parameter'} is "
                    f"{tuple(lane.param.shape)}, but its {key} is {tuple(moment.shape)}: "
                    f"{len(moment)} rows for {len(lane.param)}; load the checkpoint of these "
                    "Gaussians, or edit their moments with them"
                )

    def plan(self, lane: Lane, iteration: int) -> Step:
        """What the lane's step has, as its parts say."""
        param, course, state = lane.param, self.course, self.state[lane.param]
        grad = cast(Tensor, param.grad)
        rows = param.numel()  # shapes take five times as long to compare
        if grad.layout is not torch.strided or grad.numel() != rows:
            raise ValueError(
                f"{type(self).__name__}.step: the gradient of {lane.name or 'a parameter'} "
                f"{tuple(param.shape)} is {tuple(grad.shape)}, {grad.layout}; have the trainer "
                "make dense gradients of these rows (gsplat: no sparse_grad)"
            )
        if not state:
            self._begin_state(param, state)
        elif state["exp_avg"].numel() != rows or state["exp_avg_sq"].numel() != rows:
            self._check_rows(lane, state)
        step = Step(
            param, grad, lane.name, lane.set, lane.group, state, iteration, lane.stepped_in,
            lane.keep,
        )  # fmt: skip
        plans, befores, _ = lane.acting[course.exploiting]
        for part in plans:
            part.plan(step, course)
        for part in befores:
            step.grad = checked_gradient(part, part.before(step, course), grad)
        if step.plain:
            step.frame = None  # the rate of a plain step is the trainer's
        framed = step.frame is not None
        if framed:
            step.fade = None  # a faded step would be half a standard deviation long
        if framed is not lane.framed:
            self._change_units(lane, step, framed)
        if step.fresh:
            state["step"].zero_()
            for key in MOMENTS:
                state[key].zero_()
            for key in OF_MEAN:
                state.pop(key, None)
        lane.stepped_in = iteration
        return step

    def _begin_state(self, param: Tensor, state: dict[str, Any]) -> None:
        state["step"] = torch.zeros((), dtype=torch.float32, device="cpu")
        for key in MOMENTS:
            state[key] = torch.zeros_like(
                param, dtype=CODES if self.course.moments == 16 else None,
                memory_format=torch.preserve_format,
            )  # fmt: skip

    def _change_units(self, lane: Lane, step: Step, framed: bool) -> None:
        """Have the moments in the own frame's units from now on, or in the world's."""
        if lane.framed is not None:
            step.fresh = True
            LOGGER.info("iteration %d: moments of the positions begin anew, in %s units",
                        step.iteration, "the own frame's" if framed else "world")  # fmt: skip
        lane.framed = framed
        if lane.name == "means":
            others = self.in_own_frame - {lane.set}
            self.in_own_frame = others | {lane.set} if framed else others

    def _step_lane(self, lane: Lane, iteration: int) -> None:
        step, course = self.plan(lane, iteration), self.course
        group, state = lane.group, step.state
        count = state["step"].numpy()  # torch's own addition takes as long as a launch
        count[()] += 1
        t, (beta1, beta2) = count.item(), group["betas"]
        lr, decay = group["lr"], group["weight_decay"]
        if course.moments == 16:
            as_codes(state)
        hyper = Hyper(
            lr, beta1, beta2, group["eps"], 1 - beta1**t, (1 - beta2**t) ** 0.5,
            state["exp_avg"], state["exp_avg_sq"], nonfinite=lane.counter,
            key=mixed(int(t)) if course.moments == 16 else 0,
        )  # fmt: skip
        if decay:
            if group.get("decoupled_weight_decay"):
                hyper.shrink = 1 - lr * decay
            else:
                hyper.decay = decay
        if step.mean is not None:
            hyper.count = int(t)  # the steps that are made, not the iterations
            hyper.mean, hyper.began = lane.mean_of(state)
            hyper.grid = lane.grid or 1.0
        if lane.counter is not None and triton.takes(step):
            triton.take_step(step, hyper)
        elif bad := take_step(step, hyper):
            course.count_nonfinite(bad)
        if lane.keeps or lane.acting[course.exploiting][2]:
            lane.finish(step, course)

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

        Of those that have not gone on since the end of the course. Inside it once more where a
        step has put it: 3DGS-MCMC's trainers add noise to positions after the step.
        """
        found, end = 0, self.course.total_steps
        for lane in self.present_lanes():
            if end is not None and lane.stepped_in > end:  # trainers that count from 1 end there
                continue
            param, state = lane.param, self.state.get(lane.param, {})
            mean, residue = state.get(MEAN), state.get(RESIDUE)
            if residue is not None and lane.grid is not None and residue.shape == param.shape:
                mean = mean_of_residue(param, residue.to(CODES), lane.grid)
            if mean is not None and mean.shape == param.shape:
                known = torch.isfinite(param) & torch.isfinite(mean)
                known &= like_rows(state[BEGAN] > 0, param)
                param.copy_(torch.where(known, mean, param))
                found += 1
        return found

    def state_dict(self) -> dict[str, Any]:
        """As torch's, with the course's numbers in `param_groups[0]["opt3dgs"]`."""
        if not self.course.acts:
            return super().state_dict()
        self._drop_moved()
        self.param_groups[0][STATE_KEY] = self.course.state_of(self)
        try:
            found = super().state_dict()
        finally:  # it is of this moment
            del self.param_groups[0][STATE_KEY]
        if self.coded:  # any Adam may load it; the codes of these numbers are the same again
            found["state"] = {at: as_numbers(state) for at, state in found["state"].items()}
        return found

    def _drop_moved(self) -> None:
        """Drop what was kept for rows that are others since the last step: a copy knows no more."""
        if self._lanes:
            self.present_lanes()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; the course goes on where the checkpoint was.

        Of a checkpoint of a stock Adam, the place is the number of Adam's own steps.

        Raises:
            ValueError: it is damaged, or of another version; nothing has been changed.
        """
        call = f"{type(self).__name__}.load_state_dict"
        check_tensors(call, state_dict, self.param_groups)
        groups = state_dict["param_groups"]
        if groups and STATE_KEY in groups[0]:
            self.course.check_state(call, groups[0][STATE_KEY])
            self.course.restore_parts(groups[0][STATE_KEY])
        own = [dict(group) for group in self.param_groups]
        super().load_state_dict(state_dict)
        self.coded = False  # unless the course's numbers say so
        for group, was in zip(self.param_groups, own, strict=True):
            for key, value in was.items():
                group.setdefault(key, value)  # an option that older versions of torch did not have
        self._count_on_host()
        self.resume()

    def resume(self) -> None:
        """Go on where the state says that the training is: after a load."""
        course, saved = self.course, self.param_groups[0].pop(STATE_KEY, None)
        counts = [int(state["step"]) for state in self.state.values() if "step" in state]
        missed = 0 if saved is None else max(counts, default=0) - saved["steps"]
        if missed:
            course.say_once(
                f"opt3dgs_optim: a stock Adam has gone on for {missed} steps with this checkpoint; "
                "what was kept beside its moments begins anew"
            )
        ours = None if missed else saved  # what it says of the moments holds
        self.in_own_frame = frozenset(() if ours is None else ours["own_frame"])
        self._last = () if ours is None else tuple(ours["last"])
        dropped = KEPT if ours is None or ours["total_steps"] != course.total_steps else ()
        if ours is not None and ours["moments"] != course.moments:
            dropped = dropped or OF_MEAN
            if any(BEGAN in state for state in self.state.values()):
                bits = f"at {course.moments} bits"
                course.say_once(f"opt3dgs_optim: the mean of the last iterates begins anew, {bits}")
        for state in self.state.values():  # of the end of another run, or in another form
            for key in dropped:
                state.pop(key, None)
        if saved is not None:
            iteration = saved["iteration"] + max(missed, 0)
        else:
            iteration = self._iteration_by_counts(counts)
        self._lanes, self.next_iteration = [], iteration
        clocks = course.clocks()
        if saved is not None or (counts and (self.has_means or not any(clocks))):
            course.restore(saved, max([iteration, *clocks]))  # one that steps now and then lags
        self._recode(tell=saved is None or saved["moments"] != course.moments)
        if self.in_own_frame and not course.acts:
            for lane in self.present_lanes():
                if lane.framed:
                    for key in MOMENTS:
                        self.state[lane.param][key].zero_()

    def _iteration_by_counts(self, counts: list[int]) -> int:
        """The iteration that comes next, by Adam's own counts of steps."""
        if not counts:  # one that is made anew under way steps first in the next iteration
            return self.course.iteration + 1
        if not any(counts):
            self.course.warn_once(
                "uncounted",
                f"{type(self).__name__}: it has moments, but does not count its steps, so that the "
                "clock begins at 0; call phases.observe(iteration=...) where the training goes on",
            )
        return max(counts)

    @torch.no_grad()
    def _recode(self, tell: bool) -> None:
        """Have the moments at as many bits as the course says; rounded where they had more."""
        bits, found = self.course.moments, False
        for param, state in self.state.items():
            if "exp_avg" not in state:
                continue
            found = True
            if self.coded:
                as_codes(state)
            first, second = (state[key] for key in MOMENTS)
            if self.coded and bits == 32:
                first, second = (each.to(param.dtype) for each in decoded(first, second))
            elif not self.coded and bits == 16:
                codes = torch.empty_like(first, dtype=CODES), torch.empty_like(second, dtype=CODES)
                encode(first, second, *codes, NEAREST)
                first, second = codes
            state["exp_avg"], state["exp_avg_sq"] = first, second
        if tell and found and self.coded != (bits == 16):
            self.course.say_once(
                f"opt3dgs_optim: the moments that were there are now at {bits} bits"
            )
        self.coded = bits == 16

    def last_steps(self) -> tuple[int, ...]:
        """Of every parameter, the iteration of its last step."""
        return tuple(lane.stepped_in for lane in self._lanes) or self._last

    # -- copies ------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        self._drop_moved()
        kept = (
            "course", "_slots", "_masked", "has_means", "in_own_frame", "next_iteration", "coded",
        )  # fmt: skip
        own = {key: getattr(self, key) for key in kept}
        return {**super().__getstate__(), **own, "_lanes": [], "_last": self.last_steps()}

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


def as_numbers(state: dict[str, Any]) -> dict[str, Any]:
    """A parameter's state with float32 moments in the place of codes."""
    if "exp_avg" not in state:
        return state
    codes = [state[key].to(CODES) for key in MOMENTS]
    return {**state, **dict(zip(MOMENTS, decoded(codes[0], codes[1]), strict=True))}


def as_codes(state: dict[str, Any]) -> None:
    """Have the codes of a parameter's moments, and its mean of 16 bits, as integers again.

    An edit of rows, and torch's loading, make them float32, with the same values.
    """
    for key in (*MOMENTS, RESIDUE):
        if key in state and state[key].dtype != CODES:
            state[key] = state[key].to(CODES)


def checked_gradient(part: Part, found: Any, grad: Tensor) -> Tensor:
    """What a part returned as the gradient; ValueError unless it has the gradient's shape."""
    if not isinstance(found, Tensor) or found.shape != grad.shape:
        got = tuple(found.shape) if isinstance(found, Tensor) else repr(found)
        raise ValueError(
            f"{type(part).__name__}.before: returned {got}, but a tensor of {tuple(grad.shape)} is "
            "needed, as the gradient has"
        )
    return found
