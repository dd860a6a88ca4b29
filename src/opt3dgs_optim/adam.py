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
from opt3dgs_optim.lane import BEGAN, KEPT, MEAN, MOMENTS, Lane
from opt3dgs_optim.masked import step_around
from opt3dgs_optim.moments import CODES, NEAREST, decoded, encode
from opt3dgs_optim.names import split_name
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Hyper, Step, mixed, take_step


class StepAdam(Adam):
    """`torch.optim.Adam` whose steps have the parts of a `Course`.

    Made by `PhaseScheduler.upgrade`, `AWSGLD` and `LQNAdam`. An upgraded optimizer is an instance
    of this class *and* of the class that it had. Without parts its step is that class's own.

    What it keeps lies beside Adam's moments in `state[param]`, rows first, and as plain numbers in
    `param_groups[0]["opt3dgs"]`, so that `state_dict()` and `torch.save` carry it.
    """

    course: Course
    next_iteration = 0
    coded = False  # whether its moments are codes of 16 bits, see `moments`
    in_own_frame = False  # whether its moments of the positions are those of the own frame
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
        self._use_host_steps()

    def _use_host_steps(self) -> None:
        """Name the groups; keep Adam's count of steps on the host, which reads it in every step."""
        for group, (_, name) in zip(self.param_groups, self._slots, strict=True):
            group["gaussian"] = name  # gsplat's name of what it holds, or None
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
        group = self.param_groups[-1]
        try:
            slots = [*self._slots, split_name(group.get("name"))]
            check_supported(self, slots, self.course.moments)
        except ValueError:
            self.param_groups.pop()
            raise
        self._slots.append(split_name(group.get("name")))
        self._use_host_steps()

    # -- a step ----------------------------------------------------------------------------------

    def step(self, closure: Any = None, *masked: Any, **masks: Any) -> Any:  # pyright: ignore
        """One step of every parameter that has a gradient; return the closure's value.

        Args:
            closure: evaluates the model and returns the loss, or None. gsplat's SelectiveAdam and
                INRIA's SparseGaussianAdam get their mask, and what goes with it, unchanged.
        """
        self._opt_called = True  # what learning-rate schedulers would note by wrapping this method
        for hook in self._optimizer_step_pre_hooks.values():
            hook(self, (closure, *masked), masks)
        loss, course = None, self.course
        if callable(closure):
            with torch.enable_grad():
                loss = closure()
            if loss is not None and course.observers:
                course.observe(loss)  # pyright: ignore[reportAttributeAccessIssue]
        if not self._masked and (masked or masks or isinstance(closure, Tensor)):
            raise TypeError(
                f"{type(self).__name__}.step: a mask was given, but torch's Adam steps all rows; "
                "use gsplat's SelectiveAdam or INRIA's SparseGaussianAdam for masked steps"
            )
        iteration = course.begin(self)
        given = () if not self._masked or (closure is None and not masked) else (closure, *masked)
        if not course.acts:
            self.own_class_step(*given, **masks)
        elif self._masked:
            step_around(self, iteration, given, masks)
        else:
            with torch.no_grad():
                for lane in self.present_lanes():
                    if lane.param.grad is not None:
                        self._step_lane(lane, iteration)
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
        return lanes

    def _new_lanes(self) -> list[Lane]:
        if len(self._slots) != len(self.param_groups):
            raise ValueError(
                f"{type(self).__name__}.step: {len(self.param_groups)} parameter groups, but "
                f"{len(self._slots)} when it was upgraded; upgrade it again where they change"
            )
        old, self._lanes = self._lanes, []
        course = self.course
        for at, (group, slot) in enumerate(zip(self.param_groups, self._slots, strict=True)):
            if slot[1] is not None:
                course.members[(slot[0], slot[1])] = self, at
            for param in group["params"]:
                i = len(self._lanes)
                lane = Lane(group, param, slot).ask(course.parts)
                before = old[i] if i < len(old) else None
                if before is None:
                    lane.last = self._last[i] if i < len(self._last) else self.next_iteration - 2
                    if self.state.get(param):
                        lane.framed = self.in_own_frame and lane.name == "means"
                else:
                    lane.last, lane.framed, lane.left = before.last, before.framed, before.left
                    self._tell_fewer_rows(before.param, lane)
                new = before is not None and before.param is not param
                written = new and before is not None and before.param._version != before.version
                lane.drop_moved(self.state.get(param, {}), new, written)
                self._check_rows(lane)
                self._lanes.append(lane)
        return self._lanes

    def _tell_fewer_rows(self, old: Tensor, lane: Lane) -> None:
        if lane.name == "means" and len(lane.param) < len(old):
            self.course.rows_removed(len(old) - len(lane.param))

    def _check_rows(self, lane: Lane) -> None:
        """Refuse moments of other rows than the parameter has, as a checkpoint may bring them."""
        for key in MOMENTS:
            moment = self.state.get(lane.param, {}).get(key)
            if moment is not None and moment.shape != lane.param.shape:
                raise ValueError(
                    f"{type(self).__name__}.step: {lane.name or 'a parameter'} is "
                    f"{tuple(lane.param.shape)}, but its {key} is {tuple(moment.shape)}: "
                    f"{len(moment)} rows for {len(lane.param)}; load the checkpoint of these "
                    "Gaussians, or edit their moments with them"
                )

    def plan(self, lane: Lane, iteration: int) -> Step:
        """What the lane's step has, as its parts say."""
        param, group, course = lane.param, lane.group, self.course
        grad = cast(Tensor, param.grad)
        if grad.layout != torch.strided:
            raise ValueError(
                f"{type(self).__name__}.step: the gradient of {lane.name or 'a parameter'} is "
                f"{grad.layout}; have the trainer make dense gradients (gsplat: no sparse_grad)"
            )
        state = self.state[param]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device="cpu")
            for key in MOMENTS:
                state[key] = torch.zeros_like(
                    param, dtype=CODES if course.moments == 16 else None,
                    memory_format=torch.preserve_format,
                )  # fmt: skip
        step = Step(param, grad, lane.name, lane.set, group, state, iteration, lane.last, lane.rows)
        for part in lane.plans[course.phase]:
            part.plan(step, course)
        for part in lane.before:
            if part.during in (None, course.phase):
                step.grad = checked_gradient(part, part.before(step, course), grad)
        framed = step.frame is not None
        if framed:
            step.fade = None  # a faded step would be half a standard deviation long
        if lane.framed is not None and lane.framed != framed:
            step.fresh = True
            LOGGER.info("iteration %d: moments of the positions begin anew, in %s units", iteration,
                        "the own frame's" if framed else "world")  # fmt: skip
        if step.fresh:
            state["step"].zero_()
            for key in MOMENTS:
                state[key].zero_()
            for key in (MEAN, BEGAN):
                state.pop(key, None)
        lane.framed, lane.last = framed, iteration
        if framed or lane.name == "means":
            self.in_own_frame = framed
        return step

    def _step_lane(self, lane: Lane, iteration: int) -> None:
        step, course = self.plan(lane, iteration), self.course
        group, state = lane.group, step.state
        count = state["step"].numpy()  # torch's own addition takes as long as a launch
        count[()] += 1
        t, (beta1, beta2) = count.item(), group["betas"]
        lr, decay = group["lr"], group["weight_decay"]
        if course.moments == 16:
            take_back(state)
        hyper = Hyper(
            lr, beta1, beta2, group["eps"], 1 - beta1**t, (1 - beta2**t) ** 0.5,
            state["exp_avg"], state["exp_avg_sq"], key=mixed(int(t)) if course.moments == 16 else 0,
        )  # fmt: skip
        if decay:
            if group.get("decoupled_weight_decay"):
                hyper.shrink = 1 - lr * decay
            else:
                hyper.decay = decay
        if step.mean is not None:  # it counts the steps that are made, not the iterations
            step.mean = step.mean._replace(number=int(t))
            hyper.mean, hyper.began = self.mean_of(lane, step)
        hyper.nonfinite = course.counter_on(step.param.device)
        if triton.takes(step):
            triton.take_step(step, hyper)
        else:
            bad = take_step(step, hyper)
            if bad:
                course.count_nonfinite(bad)
        self.finish_step(lane, step)

    def own_class_step(self, *args: Any, **options: Any) -> Any:
        """The step of the class that it had, without torch's hooks, which `step` runs already."""
        step: Any = self._base.step
        return (step.__wrapped__ if getattr(step, "hooked", False) else step)(
            self, *args, **options
        )

    def finish_step(self, lane: Lane, step: Step) -> None:
        """What comes after the arithmetic: parts of one's own, and a note of what is left."""
        for part in lane.after:
            if part.during in (None, self.course.phase):
                part.after(step, self.course)
        if lane.keeps:
            lane.leave(step.state)

    def mean_of(self, lane: Lane, step: Step) -> tuple[Tensor, Tensor]:
        """The running mean, and with which count the mean of each row began."""
        param, state = step.param, step.state
        assert step.mean is not None
        began, _ = lane.rows(state, BEGAN, (len(param),))
        mean, _ = lane.rows(state, MEAN, tuple(param.shape))
        return mean, began

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
        """Put the running means in the parameters' place now; of how many parameters."""
        self.present_lanes()  # what was kept for rows that are others now is dropped
        found = 0
        for group in self.param_groups:
            for param in group["params"]:
                mean = self.state.get(param, {}).get(MEAN)
                if mean is not None and mean.shape == param.shape:
                    began = self.state[param][BEGAN] > 0
                    known = torch.isfinite(param) & torch.isfinite(mean)
                    known &= began.view(-1, *[1] * (param.dim() - 1))
                    param.copy_(torch.where(known, mean, param))
                    found += 1
        return found

    def state_dict(self) -> dict[str, Any]:
        """As torch's, with the course's numbers in `param_groups[0]["opt3dgs"]`."""
        if not self.course.acts:
            return super().state_dict()
        self.param_groups[0][STATE_KEY] = self.course.state_of(self)
        try:
            found = super().state_dict()
        finally:  # it is of this moment
            del self.param_groups[0][STATE_KEY]
        if self.coded:  # any Adam may load it; the codes of these numbers are the same again
            found["state"] = {at: as_numbers(state) for at, state in found["state"].items()}
        return found

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
        self._use_host_steps()
        self.resume()

    def resume(self) -> None:
        """Go on where the state says that the training is: after a load."""
        course, saved, missed = self.course, self.param_groups[0].pop(STATE_KEY, None), 0
        steps = [int(state["step"]) for state in self.state.values() if "step" in state]
        if saved is None:
            # One that is made anew under way steps first in the next iteration.
            iteration = max(steps) if steps else course.iteration + 1
            self.in_own_frame, self._last = False, ()
        else:
            iteration, self.in_own_frame = saved["iteration"], saved["own_frame"]
            self._last = tuple(saved["last"])
            missed = max(steps, default=0) - saved["steps"]
            if missed:  # a stock Adam has loaded it, and gone on
                iteration, self.in_own_frame = iteration + max(missed, 0), False
                self._last = ()
                course.say_once(
                    f"opt3dgs_optim: a stock Adam has gone on for {missed} steps with this "
                    "checkpoint; what was kept beside its moments begins anew"
                )
        if saved is None or missed or saved["total_steps"] != course.total_steps:
            for state in self.state.values():  # they belong to the end of another run
                for key in KEPT:
                    state.pop(key, None)
        self.next_iteration, self._lanes = iteration, []
        if saved is None and steps and not max(steps):
            course.warn_once(
                "uncounted",
                f"{type(self).__name__}: it has moments, but does not count its steps, so that the "
                "clock begins at 0; call phases.observe(iteration=...) where the training goes on",
            )
        if saved is not None or steps:  # an optimizer that steps now and then lags behind the clock
            others = [each.next_iteration for each, _ in course.members.values()]
            course.restore(saved, max([iteration, *others]))
        self._recode(tell=saved is None or saved["moments"] != course.moments)
        if self.in_own_frame and not course.acts:
            for lane in self.present_lanes():
                if lane.name == "means":
                    for key in MOMENTS:
                        self.state[lane.param][key].zero_()

    @torch.no_grad()
    def _recode(self, tell: bool) -> None:
        """Have the moments at as many bits as the course says; rounded where they had more."""
        bits, found = self.course.moments, False
        for param, state in self.state.items():
            if "exp_avg" not in state:
                continue
            found = True
            if self.coded:
                take_back(state)
            first, second = (state[key] for key in MOMENTS)
            if self.coded and bits == 32:
                first, second = (each.to(param.dtype) for each in decoded(first, second))
            elif not self.coded and bits == 16:
                codes = torch.empty_like(first, dtype=CODES), torch.empty_like(second, dtype=CODES)
                encode(first, second, *codes, key=NEAREST, at=0)
                first, second = codes
            state["exp_avg"], state["exp_avg_sq"] = first, second
        if tell and found and self.coded != (bits == 16):
            self.course.say_once(
                f"opt3dgs_optim: the moments that were there are now at {bits} bits"
            )
        self.coded = bits == 16

    def last_steps(self) -> tuple[int, ...]:
        """Of every parameter, the iteration of its last step."""
        return tuple(lane.last for lane in self._lanes) or self._last

    # -- copies ------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        kept = ("course", "_slots", "_masked", "in_own_frame", "next_iteration", "coded")
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


def take_back(state: dict[str, Any]) -> None:
    """Have codes as integers again.

    An edit of rows, and torch's loading, make them float32, with the same values.
    """
    for key in MOMENTS:
        if state[key].dtype != CODES:
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
