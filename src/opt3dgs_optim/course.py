"""The course of a training: its clock, and what its parts share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from opt3dgs_optim.checks import as_float, check_choice, check_count, say, warn_user
from opt3dgs_optim.part import Part, Phase, overrides

if TYPE_CHECKING:
    from opt3dgs_optim.adam import StepAdam

STATE_KEY = "opt3dgs"  # in `param_groups[0]`: what a checkpoint needs beside tensors
FORMAT = 3
LOOK_INTERVAL = 100  # iterations between two looks at the numbers that were not finite
AnyPart = TypeVar("AnyPart", bound=Part)


class Course:
    """The clock of a training, its parts, and which optimizer holds which of its tensors.

    Optimizers count their own steps: an iteration begins with the first of them that steps again.

    Args:
        parts: what the steps have, in order.
        total_steps: iterations of the training; None: it has no end.
        switch_step: the iteration in which exploitation starts; None: never.
        moments: bits of each of Adam's moments of a number, 32 or 16.

    Attributes:
        iteration: the present one, from 0; -1 before the first step.
    """

    def __init__(
        self,
        parts: Iterable[Part],
        total_steps: int | None = None,
        switch_step: int | None = None,
        moments: int = 32,
    ) -> None:
        self.parts = tuple(parts)
        self.total_steps, self.switch_step = total_steps, switch_step
        self.moments = check_choice(type(self).__name__, "moments", moments, (32, 16))
        self.acts = bool(self.parts) or moments != 32  # whether the steps are others than torch's
        self._switch = math.inf if switch_step is None else switch_step
        self.iteration, self.exploiting, self.exploits_next = -1, False, self._switch <= 0
        self._notes: dict[str, dict[str, Any]] = {type(part).__name__: {} for part in self.parts}
        self.members: dict[tuple[str, str], tuple[StepAdam, int]] = {}
        self.has_means = False  # whether one of the optimizers holds positions: it counts
        self.progress = 0.0  # the share of the run that is over, 0..1; 0 where it has no end
        self._means_at = -1  # the iteration of its last step
        self._means_open = False  # whether it stepped first there
        self._begun = -1  # the iteration of the last step: `observe` puts the clock beyond it
        self.scratch: dict[Any, Any] = {}  # what parts keep from step to step, and never save
        self._resumed = False  # whether the present iteration is over, for all optimizers
        self.finished = False  # whether the run has been ended early
        self._said: set[str] = set()
        self._look_at = LOOK_INTERVAL  # the iteration of the next look
        self._bad = 0  # numbers of gradients that were not finite
        self._counters: dict[torch.device, Reading] = {}
        self.observers = [part for part in self.parts if overrides(part, "observe")]
        for part in self.parts:
            if part.learns:
                if vars(part).get("_course") is not None:
                    raise ValueError(
                        f"{type(self).__name__}: {type(part).__name__} serves another training "
                        f"already, and has learnt there; make a new one, {type(part).__name__}(...)"
                    )
                part._course = self  # pyright: ignore[reportAttributeAccessIssue]

    # -- where the training is -------------------------------------------------------------------

    @property
    def phase(self) -> Phase:
        """Of the present iteration."""
        return Phase.EXPLOITATION if self.exploiting else Phase.EXPLORATION

    def begin(self, optimizer: StepAdam) -> int:
        """The iteration of a step that an optimizer is about to make.

        Another optimizer than that of the positions may step first in an iteration, never or
        several times: it begins one only if the positions have been stepped in the one before.
        """
        present = self.iteration + self._resumed
        iteration = max(optimizer.next_iteration, present, 0)
        if optimizer.has_means:
            if iteration > self._means_at:  # of two sets' optimizers the first
                self._means_open = iteration > self._begun
            self._means_at = iteration
        elif self.has_means and iteration > present:  # it has stepped in the present one
            begins = self._means_at >= present and not self._means_open
            iteration = max(present + begins, 0)
        self._resumed, self._begun = False, iteration
        optimizer.next_iteration = iteration + 1
        if iteration > self.iteration:
            self._go_to(iteration)
            self._advance()
        return iteration

    def _go_to(self, iteration: int) -> None:
        """Put the clock there."""
        self.iteration, self.exploiting = iteration, iteration >= self._switch
        self.exploits_next = iteration + 1 >= self._switch
        if self.total_steps:
            self.progress = min(max(iteration / self.total_steps, 0.0), 1.0)
        if iteration >= self._look_at or iteration + 1 == self.total_steps:
            self._look_at = iteration + LOOK_INTERVAL
            self._look()

    def _advance(self) -> None:
        """Called once in each iteration, before its first step."""

    # -- what the parts share --------------------------------------------------------------------

    def part(self, kind: type[AnyPart]) -> AnyPart | None:
        """The part of that class, or None."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def notes_of(self, part: Part) -> dict[str, Any]:
        """What a part knows of this training: plain numbers by name, saved with the optimizers."""
        return self._notes[type(part).__name__]

    def param_of(self, set_name: str, name: str) -> Tensor | None:
        """The present tensor of a Gaussian parameter, by gsplat's name; None if nobody holds it."""
        member = self.members.get((set_name, name))
        return None if member is None else member[0].param_groups[member[1]]["params"][0]

    def state_of_param(self, set_name: str, name: str) -> dict[str, Any] | None:
        """The optimizer's state of a Gaussian parameter; None before its first step."""
        member, param = self.members.get((set_name, name)), self.param_of(set_name, name)
        return None if member is None or param is None else member[0].state.get(param) or None

    def clocks(self) -> list[int]:
        """Of each optimizer whose steps are counted, the iteration that it steps next."""
        found = [each for each, _ in self.members.values()]
        return [each.next_iteration for each in found if each.has_means or not self.has_means]

    def rows_removed(self, count: int) -> None:
        """Gaussians have disappeared since the last step."""

    def numbers(self) -> dict[str, float | Tensor]:
        """What the parts say of the present iteration."""
        found: dict[str, float | Tensor] = {}
        for part in self.parts:
            found.update(part.numbers(self))
        return found

    def warn_once(self, kind: str, message: str) -> None:
        """Say something that is wrong, once in a training."""
        if kind not in self._said:
            self._said.add(kind)
            warn_user(message)

    def say_once(self, message: str) -> None:
        """Say what has happened, once in a training, where six optimizers have the same to say."""
        if message not in self._said:
            self._said.add(message)
            say(message)

    # -- numbers that are not finite -------------------------------------------------------------

    def count_nonfinite(self, numbers: int) -> None:
        """Take a number that the host knows."""
        self._bad += numbers

    def counter_on(self, device: torch.device) -> Tensor | None:
        """[1] int32 to which a device adds how many numbers were not finite; None for a CPU."""
        if device.type == "cpu":
            return None
        if device not in self._counters:
            self._counters[device] = Reading(torch.zeros(1, dtype=torch.int32, device=device))
        return self._counters[device].source

    def _look(self) -> None:
        """Say once that gradients have not been finite, without a wait for a device."""
        for reading in self._counters.values():
            self._bad = max(self._bad, abs(int(reading.take() or 0)))  # int32 may wrap
            reading.ask()
        if self._bad:
            self.warn_once(
                "nonfinite",
                f"opt3dgs_optim: iteration {self.iteration}: {self._bad} numbers of gradients have "
                "not been finite (NaN or infinite) since the start, and counted as zero; look for "
                "the first NaN of the loss",
            )

    # -- checkpoints -----------------------------------------------------------------------------

    def state_of(self, optimizer: StepAdam) -> dict[str, Any]:
        """What a checkpoint of an optimizer has beside tensors: plain numbers and lists."""
        for part in self.parts:
            part.settle(self)
        self._look()
        check_notes("state_dict", self._notes)
        return {
            "format": FORMAT,
            "iteration": max(optimizer.next_iteration, self.iteration),  # it may have been put on
            "total_steps": self.total_steps,
            "own_frame": sorted(optimizer.in_own_frame),
            "steps": max(
                (int(s["step"]) for s in optimizer.state.values() if "step" in s), default=0
            ),
            "moments": self.moments,
            "last": list(optimizer.last_steps()),
            "notes": {name: dict(notes) for name, notes in self._notes.items()},
            "parts": {type(p).__name__: p.state_dict() for p in self.parts if p.learns},
        }

    def check_state(self, call: str, state: Any) -> None:
        """ValueError unless `state` is what `state_of` gives; the one check of what is loaded."""
        needed = {"format", "iteration", "total_steps", "own_frame", "moments", "last", "notes"}
        needed |= {"parts", "steps"}
        if not isinstance(state, Mapping) or set(state) != needed or state["format"] != FORMAT:
            raise ValueError(
                f"{call}: param_groups[0][{STATE_KEY!r}] is not of this version (format {FORMAT}); "
                f"load a checkpoint that it has written, or remove the key to begin with Adam's "
                "moments alone"
            )
        check_count(call, "iteration", state["iteration"], 0)
        if state["total_steps"] is not None:
            check_count(call, "total_steps", state["total_steps"], 1)
        check_count(call, "steps", state["steps"], 0)
        check_choice(call, "moments", state["moments"], (32, 16))
        for key, kind in (("last", int), ("own_frame", str)):
            found = state[key]
            if not isinstance(found, list) or any(type(each) is not kind for each in found):
                raise ValueError(f"{call}: {key}={found!r}, but a list of {kind} is needed")
        for kind in ("notes", "parts"):
            if not isinstance(state[kind], Mapping) or not all(
                isinstance(each, Mapping) for each in state[kind].values()
            ):
                raise ValueError(f"{call}: {kind}={state[kind]!r}, but a dict of dicts is needed")
        check_notes(call, state["notes"])

    def restore_parts(self, state: Mapping[str, Any]) -> None:
        """Give parts that learn what they had learnt; they refuse what is damaged."""
        for part in self.parts:
            if part.learns and type(part).__name__ in state["parts"]:
                part.load_state_dict(state["parts"][type(part).__name__])

    def restore(self, state: Mapping[str, Any] | None, iteration: int) -> None:
        """Go on at an iteration, with what was noted there."""
        self._go_to(iteration - 1)
        self._means_at = self._begun = iteration - 1
        self._means_open, self._resumed = False, True
        for name, notes in () if state is None else state["notes"].items():
            if name in self._notes:
                self._notes[name].clear()
                self._notes[name].update(notes)

    def __getstate__(self) -> dict[str, Any]:
        for part in self.parts:  # what is on its way from a device does not reach a copy
            part.settle(self)
        return {**vars(self), "_counters": {}, "scratch": {}}


def check_notes(call: str, notes: Mapping[str, Mapping[str, Any]]) -> None:
    """ValueError unless what parts have noted is finite numbers, as a checkpoint holds them."""
    for name, found in notes.items():
        if not all(type(v) is bool or math.isfinite(as_float(v)) for v in found.values()):
            raise ValueError(
                f"{call}: notes of {name} are {dict(found)!r}, but finite numbers are needed"
            )


class Reading:
    """A number of a device that the host reads some iterations later, without a wait."""

    def __init__(self, source: Tensor) -> None:
        self.source = source  # [1]
        self._host: Tensor | None = None
        self._ready: Any = None

    def ask(self) -> None:
        """Have a copy of the present number made."""
        if self.source.is_cuda and torch.cuda.is_available():
            self._host = torch.empty(
                self.source.shape, dtype=self.source.dtype, pin_memory=True
            ).copy_(self.source, non_blocking=True)
            self._ready = torch.cuda.Event()
            self._ready.record()
        else:
            self._host = self.source.clone()

    def take(self) -> float | None:
        """The number that was asked for last; None while it is on its way, or was never asked."""
        if self._host is None or (self._ready is not None and not self._ready.query()):
            return None
        return self._host.item()
