"""The optimizer: `torch.optim.Adam` whose steps have the parts of a course."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, cast

import torch
from torch import Tensor
from torch.optim import Adam

from opt3dgs_optim import triton
from opt3dgs_optim.checks import LOGGER, check_count, check_number
from opt3dgs_optim.contract import REFUSED, Slots, check_supported, own_step
from opt3dgs_optim.course import STATE_KEY, Course
from opt3dgs_optim.moments import CODES, NEAREST, decoded, encode
from opt3dgs_optim.names import split_name
from opt3dgs_optim.part import Part, Phase, overrides
from opt3dgs_optim.step import (
    Hyper,
    Step,
    axes_of,
    chosen_rows,
    into_frame,
    like_rows,
    mixed,
    out_of_frame,
    take_into_mean,
    take_step,
)

MOMENTS = ("exp_avg", "exp_avg_sq")  # torch's names
MEAN, BEGAN = "averaging.mean", "averaging.began"  # ours, of the rows
KEPT = (MEAN, BEGAN, "curvature.history")  # what a checkpoint may hold for rows beside moments


class Lane:
    """One parameter of an optimizer: what acts on it, and what was left for it at the last step.

    Attributes:
        name, set: which Gaussian parameter it is, and of which set of Gaussians.
        last: the iteration of its last step; -1: none.
        framed: whether its moments are those of the own frame; None: it has none yet.
    """

    def __init__(self, group: dict[str, Any], param: Tensor, slot: tuple[str, str | None]) -> None:
        self.group, self.param = group, param
        self.set, self.name = slot
        self.last = -1
        self.framed: bool | None = None
        self.keeps = False  # whether parts keep something for its rows
        self.left: dict[str, tuple[Tensor, int]] = {}
        self.plans: dict[Phase, list[Part]] = {}
        self.before: list[Part] = []
        self.after: list[Part] = []

    def ask(self, parts: tuple[Part, ...]) -> Lane:
        """Take the parts that act on this parameter."""
        mine = [p for p in parts if p.names is None or (self.name and self.name in p.names)]
        for phase in Phase:
            self.plans[phase] = [
                p for p in mine if overrides(p, "plan") and p.during in (None, phase)
            ]
        self.before = [p for p in mine if overrides(p, "before")]
        self.after = [p for p in mine if overrides(p, "after")]
        return self

    def rows(self, state: dict[str, Any], key: str, shape: tuple[int, ...]) -> tuple[Tensor, bool]:
        """What is kept for the rows under a name, and whether rows may be new since the last step.

        A row of zeros is one for which nothing is kept.
        """
        tensor, was, self.keeps = state.get(key), self.left.get(key), True
        if tensor is None or tensor.shape != shape:
            tensor = state[key] = torch.zeros(
                shape, dtype=self.param.dtype, device=self.param.device
            )
            return tensor, True
        if was is None:  # loaded
            return tensor, True
        if tensor is not was[0] or tensor._version != was[1]:
            return tensor, True
        return tensor, False

    def drop_moved(self, state: dict[str, Any], new: bool) -> None:
        """Drop what is kept for rows that are others now, if the Parameter is new.

        Trainers that edit rows edit every tensor of the state so (gsplat's family), or none but
        Adam's moments (INRIA's): what they have left as it was belongs to other rows.
        """
        rows = len(self.param) if self.param.dim() else 1
        for key in KEPT:
            now, was = state.get(key), self.left.get(key)
            if now is None:
                continue
            as_it_was = was is not None and now is was[0] and now._version == was[1]
            if len(now) != rows or (new and as_it_was):
                del state[key]

    def leave(self, state: dict[str, Any]) -> None:
        """Note what the step has left, by which edits of rows show at the next one."""
        self.left = {key: (state[key], state[key]._version) for key in KEPT if key in state}


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
    _lanes: list[Lane]
    _slots: Slots
    _last: tuple[int, ...] = ()  # of every parameter, the iteration of its last step before a load

    def follow(self, course: Course, slots: Slots) -> None:
        """Have the parts of `course` from now on; slots are, by group, set and name."""
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
            _unhooked(self._base)(self, *given, **masks)
        elif self._masked:
            self._step_around(iteration, given, masks)
        else:
            with torch.no_grad():
                for lane in self._present_lanes():
                    if lane.param.grad is not None:
                        self._step_lane(lane, iteration)
        for hook in self._optimizer_step_post_hooks.values():
            hook(self, (closure, *masked), masks)
        return loss

    # Learning-rate schedulers, which would wrap `step` on the instance, need not: `step` tells.
    step._wrapped_by_lr_sched = True  # pyright: ignore[reportFunctionMemberAccess]
    # torch's own wrapper, for hooks and profiles, takes longer than all else that Python does here.
    step.hooked = True  # pyright: ignore[reportFunctionMemberAccess]

    def _present_lanes(self) -> list[Lane]:
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
                lane.drop_moved(self.state.get(param, {}), new)
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

    def _plan(self, lane: Lane, iteration: int) -> Step:
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
        lane.framed, lane.last = framed, iteration
        if framed or lane.name == "means":
            self.in_own_frame = framed
        return step

    def _step_lane(self, lane: Lane, iteration: int) -> None:
        step, course = self._plan(lane, iteration), self.course
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
        if step.mean is not None:
            hyper.mean, hyper.began = self._mean_of(lane, step)
        hyper.nonfinite = course.counter_on(step.param.device)
        if triton.takes(step):
            triton.take_step(step, hyper)
        else:
            bad = take_step(step, hyper)
            if bad:
                course.count_nonfinite(bad)
        for part in lane.after:
            if part.during in (None, course.phase):
                part.after(step, course)
        if lane.keeps:
            lane.leave(state)

    def _mean_of(self, lane: Lane, step: Step) -> tuple[Tensor, Tensor]:
        """The running mean, and with which count the mean of each row began."""
        param, state = step.param, step.state
        assert step.mean is not None
        began, _ = lane.rows(state, BEGAN, (len(param),))
        mean, _ = lane.rows(state, MEAN, tuple(param.shape))
        return mean, began

    # -- optimizers that have a step of their own --------------------------------------------------

    def _step_around(self, iteration: int, args: tuple[Any, ...], masks: dict[str, Any]) -> None:
        """The parts around the step of gsplat's SelectiveAdam, or INRIA's SparseGaussianAdam."""
        steps: list[tuple[Lane, Step, Tensor, Any]] = []
        rates = [(group, group["lr"]) for group in self.param_groups]
        with torch.no_grad():
            for lane in self._present_lanes():
                if lane.param.grad is None:
                    continue
                own = lane.param.grad
                step = self._plan(lane, iteration)
                steps.append((lane, step, own, self._prepare(step)))
            try:
                _unhooked(self._base)(self, *args, **masks)
            finally:
                for group, lr in rates:
                    group["lr"] = lr
                for lane, _, own, framed in steps:
                    lane.param.grad = own
                    if framed is not None:
                        position, axes = framed
                        moved, lane.param.data = lane.param.data, position
                        lane.param.add_(out_of_frame(axes, moved))
            for lane, step, _, _ in steps:
                self._finish(lane, step)

    def _prepare(self, step: Step) -> Any:
        """Have the base's step find what the parts say; what is to be undone in an own frame."""
        param, state = step.param, step.state
        grad = torch.nan_to_num(step.grad, 0.0, 0.0, 0.0)
        if step.fade is not None:
            chosen = like_rows(chosen_rows(step.fade, len(param), param.device), param)
            for key, factor in zip(MOMENTS, step.fade[2:], strict=True):
                state[key].copy_(torch.where(chosen, state[key] * factor, state[key]))
        framed = None
        if step.frame is not None:
            axes = axes_of(step.frame)
            grad = into_frame(axes, grad)
            framed = param.data, axes
            param.data = torch.zeros_like(param.data)
            step.group["lr"] = step.frame.rate * step.factor
        elif not (isinstance(step.factor, float) and step.factor == 1.0):
            step.group["lr"] = step.group["lr"] * float(step.factor)
        param.grad = grad
        return framed

    def _finish(self, lane: Lane, step: Step) -> None:
        if step.mean is not None:
            mean, began = self._mean_of(lane, step)
            take_into_mean(step.mean, step.param, mean, began)
        for part in lane.after:
            if part.during in (None, self.course.phase):
                part.after(step, self.course)
        if lane.keeps:
            lane.leave(step.state)

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
            return super().state_dict()
        finally:  # it is of this moment
            del self.param_groups[0][STATE_KEY]

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
        course, saved = self.course, self.param_groups[0].pop(STATE_KEY, None)
        steps = [int(state["step"]) for state in self.state.values() if "step" in state]
        if saved is None:
            # One that is made anew under way steps first in the next iteration.
            iteration = max(steps) if steps else course.iteration + 1
            self.in_own_frame, self._last = False, ()
        else:
            iteration, self.in_own_frame = saved["iteration"], saved["own_frame"]
            self.coded = saved["moments"] == 16
            self._last = tuple(saved["last"])
        if saved is None or saved["total_steps"] != course.total_steps:
            for state in self.state.values():  # they belong to the end of another run
                for key in KEPT:
                    state.pop(key, None)
        self.next_iteration, self._lanes = iteration, []
        if saved is not None or steps:  # an optimizer that steps now and then lags behind the clock
            others = [each.next_iteration for each, _ in course.members.values()]
            course.restore(saved, max([iteration, *others]))
        self._recode()

    @torch.no_grad()
    def _recode(self) -> None:
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
        if found and self.coded != (bits == 16):
            LOGGER.info("opt3dgs_optim: the moments that were there are now at %d bits", bits)
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


def _unhooked(base: type[Adam]) -> Callable[..., Any]:
    """The step of a class without torch's hooks, which the step around it runs already."""
    step: Any = base.step
    return step.__wrapped__ if getattr(step, "hooked", False) else step


_CLASSES: dict[type[Adam], type[StepAdam]] = {}


def upgraded_class(base: type[Adam]) -> type[StepAdam]:
    """A class that is `StepAdam` and `base`."""
    if base not in _CLASSES:
        made = type(base.__name__, (StepAdam, base), {"_base": base, "__module__": base.__module__})
        _CLASSES[base] = cast(type[StepAdam], made)
    return _CLASSES[base]


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


def check_tensors(call: str, state_dict: Any, groups: list[dict[str, Any]]) -> None:
    """ValueError unless a state dict has torch's form, for these groups, and fitting tensors."""
    if not isinstance(state_dict, Mapping) or not {"state", "param_groups"} <= set(state_dict):
        raise ValueError(
            f"{call}: needs a dict with 'state' and 'param_groups', as state_dict() has"
        )
    saved, states = state_dict["param_groups"], state_dict["state"]
    if not isinstance(saved, list) or len(saved) != len(groups):
        raise ValueError(
            f"{call}: {len(saved) if isinstance(saved, list) else repr(saved)} parameter groups "
            f"were saved, but this optimizer has {len(groups)}"
        )
    known: set[int] = set()
    for at, (group, own) in enumerate(zip(saved, groups, strict=True)):
        check_group(f"{call}: group {at}", group, len(own["params"]))
        known.update(group["params"])
    if not isinstance(states, Mapping) or not set(states) <= known:
        raise ValueError(f"{call}: the state is not of the parameters {sorted(known)}")
    for index, state in states.items():
        check_moments(f"{call}: parameter {index}", state)


def check_group(call: str, group: Any, count: int) -> None:
    """ValueError unless a saved group has so many parameters, and options that Adam here takes."""
    params = group.get("params") if isinstance(group, Mapping) else None
    if not isinstance(params, list) or len(params) != count:
        raise ValueError(f"{call} has params={params!r}, but a list of {count} is needed")
    if not all(type(each) is int for each in params):
        raise ValueError(f"{call} has params={params!r}, but integers are needed")
    for option in REFUSED:
        if group.get(option):
            raise ValueError(f"{call} has {option}={group[option]!r}, which is not taken")
    betas = group.get("betas")
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise ValueError(f"{call} has betas={betas!r}, but two numbers are needed")
    numbers = {name: group.get(name) for name in ("lr", "eps", "weight_decay")}
    for name, value in {**numbers, "betas[0]": betas[0], "betas[1]": betas[1]}.items():
        check_number(call, name, value, 0.0, 1.0 if "betas" in name else math.inf)


def check_moments(call: str, state: Any) -> None:
    """ValueError unless the state of a parameter is empty, or Adam's with what is kept for rows."""
    if not isinstance(state, Mapping):
        raise ValueError(f"{call} has the state {state!r}, but a dict is needed")
    if not state:
        return
    missing = [key for key in ("step", *MOMENTS) if key not in state]
    if missing:
        raise ValueError(f"{call} has no {missing[0]}, but {sorted(map(str, state))}")
    check_count(call, "step", whole(state["step"]), 0)
    shapes: dict[str, tuple[int, ...]] = {}
    for key in (*MOMENTS, *KEPT):
        value: Any = state.get(key)
        if value is None and key in KEPT:
            continue
        if not isinstance(value, Tensor) or not (
            value.is_floating_point() or (key in MOMENTS and value.dtype == CODES)
        ):
            raise ValueError(f"{call} has {key}={value!r}, but a tensor of real numbers is needed")
        shapes[key] = tuple(value.shape)
    one = shapes["exp_avg"]
    if any(shapes.get(key, one) != one for key in ("exp_avg_sq", MEAN)) or any(
        shapes.get(key, one)[:1] != one[:1] for key in KEPT
    ):
        raise ValueError(f"{call} has shapes {shapes}, but the same rows are needed in all")
    if (MEAN in shapes) != (BEGAN in shapes) or shapes.get(BEGAN, one[:1]) != one[:1]:
        raise ValueError(f"{call} has shapes {shapes}, but {BEGAN} needs a number for each row")


def whole(step: Any) -> Any:
    """Adam's count of steps, a tensor or a number, as an int; anything else as it is."""
    value = step.item() if isinstance(step, Tensor) and step.numel() == 1 else step
    return int(value) if isinstance(value, float) and value.is_integer() else value
