"""The course of a training: its clock, its parts, and the energy observed last."""

import math
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor

from opt3dgs_optim.checks import LOGGER, check_count, check_keys
from opt3dgs_optim.part import Part, Phase, overrides

HOOKS = ("observe", "pixel_loss", "factor", "before", "after", "numbers")
CHECK_STEPS = 100  # iterations between two looks at the parts' evidence
FORMAT = 2  # of a checkpoint
STATE_KEY = "opt3dgs"  # in param_groups[0] of an optimizer's state_dict: the course's state
P = TypeVar("P", bound=Part)


class Course:
    """The clock, the parts and the energy of one training; several optimizers may follow one.

    Args:
        parts: what the steps have, in the order in which it is applied.
        total_steps: iterations of the training.
        switch_step: the first iteration of exploitation; None: no phases, all parts always act.
        adaptive: whether parts are switched off that this training shows no need of.

    Raises:
        TypeError: one of the parts is none.
    """

    def __init__(
        self,
        parts: Iterable[Part] = (),
        *,
        total_steps: int = 1,
        switch_step: int | None = None,
        adaptive: bool = False,
    ) -> None:
        self.parts = list(parts)
        for part in self.parts:
            if not isinstance(part, Part):
                raise TypeError(f"{type(self).__name__}: parts has {part!r}, but a Part is needed")
        self.total_steps, self.switch_step = total_steps, switch_step or 0
        self._has_phases = switch_step is not None
        self.keeps_state = self._has_phases or bool(self.parts)  # for a checkpoint
        self.adaptive = adaptive
        self.switched_off: dict[str, str] = {}  # part's name -> why
        self.current = -1  # the iteration observed last, whose step comes next
        self.num_observed = 0
        self.steps = 0  # of all optimizers
        self.valid: Tensor | bool = True  # whether the last energy was finite
        self.unseen: Any = (-1, None, 1.0)  # `OutOfView`: iteration, points out of view, seen share
        self._plan()

    def _plan(self) -> None:
        """Which parts have which hooks in which phase; a hook that nobody has is never called."""
        on = [part for name, part in self.named().items() if name not in self.switched_off]
        self._hooks: dict[Phase | None, dict[str, list[Part]]] = {}
        for phase in (None, *Phase):
            acting = [part for part in on if phase is None or part.during in (None, phase)]
            having = {hook: [part for part in acting if overrides(part, hook)] for hook in HOOKS}
            self._hooks[phase] = having
        self.keys = tuple({key: None for part in self.parts for key in part.keys})

    @property
    def iteration(self) -> int:
        """The iteration whose loss comes next, from 0."""
        return self.current + 1

    @property
    def progress(self) -> float:
        """Share of the run before the iteration observed last, from 0."""
        return max(self.current, 0) / self.total_steps

    @property
    def exploiting(self) -> bool:
        """Whether the iteration observed last, whose step comes next, is exploitation."""
        return self.phase_of(self.current) is Phase.EXPLOITATION

    @property
    def check_steps(self) -> int:
        """Iterations between looks at the evidence: a tenth of a short exploitation."""
        left = self.total_steps - self.switch_step
        return min(CHECK_STEPS, max(left // 10, 10)) if self.exploiting else CHECK_STEPS

    def phase_of(self, iteration: int) -> Phase | None:
        """The phase of an iteration; None where there are no phases."""
        if not self._has_phases:
            return None
        return Phase.EXPLOITATION if iteration >= self.switch_step else Phase.EXPLORATION

    @property
    def hooks(self) -> dict[str, list[Part]]:
        """The parts that act in the step that comes next, by the hooks that they have."""
        return self._hooks[self.phase_of(self.current)]

    def part(self, kind: type[P]) -> P | None:
        """The first part of a class, or None."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def named(self) -> dict[str, Part]:
        """The parts by their classes' names, as in checkpoints; "#2" is the second of a class."""
        named: dict[str, Part] = {}
        for part in self.parts:
            kind = type(part).__name__
            again = sum(name.split("#")[0] == kind for name in named)
            named[f"{kind}#{again + 1}" if again else kind] = part
        return named

    def take(self, energy: Tensor) -> None:
        """Tell the parts that act of the energy of the iteration `current`, 0-d, detached."""
        self.num_observed += 1
        is_finite = math.isfinite if energy.device.type == "cpu" else torch.isfinite
        self.valid = is_finite(energy)
        for part in self.hooks["observe"]:
            part.observe(energy, self.valid, self)

    def stepping(self, closure_value: Any) -> bool:
        """Called at the begin of every step of every optimizer: whether the parts act.

        `closure_value` is the loss that a closure has returned, or None.
        """
        self.steps += 1
        if closure_value is not None:
            self.current += 1
            self.take(torch.as_tensor(closure_value).detach().reshape(()))
        return True

    def expect(self, steps: int) -> None:
        """Called where Adam's moments come without our state: they have made so many steps."""

    def numbers(self) -> dict[str, float | Tensor]:
        """What the parts that act say of themselves: columns of the run log."""
        columns: dict[str, float | Tensor] = {}
        for part in self.hooks["numbers"]:
            columns.update(part.numbers(self))
        return columns

    def judge(self, over_ranks: Any = None) -> list[tuple[str, str, str]]:
        """Switch parts off and on by their evidence: one transfer from the device.

        `over_ranks` averages a tensor over the ranks, so that all decide alike. Returns (event,
        part's name, reason) of each change.
        """
        shown = [(name, part, part.evidence(self)) for name, part in self.named().items()]
        known = [(name, part, seen) for name, part, seen in shown if seen is not None]
        if not known:
            return []
        device = known[-1][2].device
        widest = torch.float32 if device.type == "mps" else torch.float64
        packed = torch.cat([seen.detach().to(device, widest) for _, _, seen in known])
        numbers = (packed if over_ranks is None else over_ranks(packed)).tolist()
        changes = []
        for name, part, seen in known:
            own, numbers = numbers[: seen.numel()], numbers[seen.numel() :]
            why = part.useless(own, self)
            if why is not None and name not in self.switched_off:
                self.switched_off[name] = why
                changes.append(("switched_off", name, why))
            elif why is None and self.switched_off.pop(name, None) is not None:
                changes.append(("switched_on", name, "it is of use again"))
        if changes:
            self._plan()
        for event, name, why in changes:
            LOGGER.info("iteration %d: %s %s: %s", self.current, name, event.replace("_", " "), why)
        return changes

    def state_dict(self) -> dict[str, Any]:
        """Clock, parts and what is switched off, as plain numbers, strings, lists and dicts."""
        return {
            "format": FORMAT,
            "iteration": self.iteration,
            "num_observed": self.num_observed,
            "switched_off": dict(self.switched_off),
            "parts": {n: state for n, part in self.named().items() if (state := part.state_dict())},
        }

    def take_loaded(self, optimizer: Any) -> None:
        """Take the state out of an optimizer's groups, where a checkpoint has put it."""
        shared = optimizer.param_groups[0].pop(STATE_KEY, None)
        if shared is not None:
            self.load_state_dict(shared)
        else:
            steps = [float(state["step"]) for state in optimizer.state.values() if "step" in state]
            self.expect(int(max(steps, default=0)))

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; parts that it does not know begin anew.

        Raises:
            ValueError: it is damaged, or of another format; then nothing is changed.
        """
        call = f"{type(self).__name__}.load_state_dict"
        check_keys(call, state, ("iteration", "num_observed", "switched_off", "parts"))
        if state.get("format") != FORMAT:
            raise ValueError(f"{call}: format={state.get('format')!r}, but {FORMAT} is needed")
        for name in ("iteration", "num_observed"):
            check_count(call, name, state[name], 0)
        for name in ("parts", "switched_off"):
            check_keys(f"{call}: {name}", state[name], ())
        named = self.named()
        old = {name: part.state_dict() for name, part in named.items()}
        try:
            for name in [name for name in named if name in state["parts"]]:
                named[name].load_state_dict(state["parts"][name])
        except (ValueError, LookupError, TypeError, AttributeError) as error:
            for name in [name for name in named if old[name]]:
                named[name].load_state_dict(old[name])
            raise ValueError(f"{call}: {error}") from None
        self.current, self.num_observed = state["iteration"] - 1, state["num_observed"]
        self.switched_off = {k: str(v) for k, v in state["switched_off"].items() if k in named}
        self._plan()
