"""The course of a training: its clock, its parts, and the energy observed last."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from opt3dgs_optim.checks import (
    LOGGER,
    as_damage,
    as_float,
    check_choice,
    check_count,
    check_energy,
    check_keys,
    warn_user,
)
from opt3dgs_optim.declarations import (
    check_attributes,
    check_units,
    declared_by,
    parts_by_name,
)
from opt3dgs_optim.followers import Followers, Place
from opt3dgs_optim.learnt import are_same, begin_anew, learnt_by, put_back
from opt3dgs_optim.part import Kept, Part, Phase, Window, overrides
from opt3dgs_optim.state import check_kept_number, key_of

if TYPE_CHECKING:
    from opt3dgs_optim.stepadam import StepAdam

HOOKS = ("observe", "pixel_loss", "factor", "before", "displacement", "after", "numbers")
EVIDENCE_INTERVAL = 100  # iterations between two looks at the parts' evidence
FORMAT = 3  # of a checkpoint
READABLE_FORMATS = (2, 3)
STATE_KEY = "opt3dgs"  # in param_groups[0] of an optimizer's state_dict: the course's state
NEVER = 2**62  # an iteration that no training reaches
MAX_STEPS_WITHOUT_CLOCK = 120  # twenty iterations of six optimizers
# What a line of the run log has of each iteration, and what `RunLog.step` is called with.
COLUMNS_OF_THE_LOG = frozenset(
    ("self", "kind", "iteration", "seconds", "phase", "event", "energy", "metadata")
)
P = TypeVar("P", bound=Part)


class Change(NamedTuple):
    """A part that was switched off or on again."""

    event: str  # "switched_off" or "switched_on"
    part: str
    reason: str


class Course:
    """The clock, the parts and the energy of one training; several optimizers may follow one.

    Args:
        parts: what the steps have, in the order in which it is applied.
        total_steps: iterations of the training.
        switch_step: the first iteration of exploitation; None: no phases, all parts always act.
        adaptive: whether parts are switched off that this training shows no need of. Whoever tells
            the course of losses calls `judge` for it, as `PhaseScheduler.observe` does.

    Raises:
        TypeError: one of the parts is none.
        ValueError: a part occurs twice, or declares what it keeps in a way that cannot be; or a
            number is outside what is allowed.
    """

    def __init__(
        self,
        parts: Iterable[Part] = (),
        *,
        total_steps: int = 1,
        switch_step: int | None = None,
        adaptive: bool = False,
    ) -> None:
        call = type(self).__name__
        if not isinstance(parts, Iterable) or isinstance(parts, (str, Mapping)):
            raise TypeError(f"{call}: parts={parts!r}, but a list of parts is needed")
        self._parts = tuple(parts)
        for part in self._parts:
            if not isinstance(part, Part):
                raise TypeError(f"{call}: parts has {part!r}, but a Part is needed")
            if sum(part is other for other in self._parts) > 1:
                raise ValueError(f"{call}: parts has {part!r} twice, but each acts once per step")
            check_attributes(call, part)
        check_units(call, self._parts)
        self.total_steps = check_count(call, "total_steps", total_steps, 1)
        self.switch_step = 0
        if switch_step is not None:
            self.switch_step = check_count(call, "switch_step", switch_step, 0, total_steps)
        self._has_phases = switch_step is not None
        self.keeps_state = self._has_phases or bool(self._parts)  # for a checkpoint
        self.adaptive = check_choice(call, "adaptive", adaptive)
        self.switched_off: dict[str, str] = {}  # part's name -> why
        self._current = -1
        self._windows: tuple[int | None, dict[str, Window | None]] = (None, {})  # at an iteration
        self.num_observed = 0
        self.steps = 0  # of all optimizers
        self.rewinds = self._rewinds_followed = 0  # how often the clock has been set back
        self.valid: Tensor | bool = True  # whether the last energy was finite
        self.energy_device = torch.device("cpu")
        self.needs_energies = False  # whether the parts stand still before the first energy
        self.kept_numbers: dict[str, Tensor] = {}  # what parts keep per training
        self._numbers_read: dict[int, tuple[int, weakref.ref[Tensor], float]] = {}
        self._reported: set[str] = set()  # kinds of mistakes that were said
        self._published: dict[tuple[str, Place], tuple[int, Any]] = {}
        self.followers = Followers()
        self._named = parts_by_name(self._parts)
        self.declared = {name: declared_by(call, part) for name, part in self._named.items()}
        self.row_keys = tuple(
            key_of(name, kept)
            for name, entries in self.declared.items()
            for kept in entries.values()
            if kept.per == "row"
        )
        self._unlearnt = {name: learnt_by(part) for name, part in self._named.items()}
        self._windowed = [
            name
            for name, part in self._named.items()
            if self.declared[name] or overrides(part, "window")
        ]
        for part in self._parts:
            self.window_of_part(part)
        self._plan()

    def _plan(self) -> None:
        """Which parts have which hooks in which phase; a hook that nobody has is never called."""
        on = [part for name, part in self._named.items() if name not in self.switched_off]
        self._hooks: dict[Phase | None, dict[str, list[Part]]] = {}
        for phase in (None, *Phase):
            acting = [part for part in on if phase is None or part.during in (None, phase)]
            having = {hook: [part for part in acting if overrides(part, hook)] for hook in HOOKS}
            self._hooks[phase] = having
        self._choose_hooks(self._current)

    # -- the clock -------------------------------------------------------------------------------

    @property
    def parts(self) -> tuple[Part, ...]:
        """What the steps have, in order; chosen when the course is made."""
        return self._parts

    @property
    def current(self) -> int:
        """The iteration observed last, whose step comes next; -1 before any."""
        return self._current

    @current.setter
    def current(self, iteration: int) -> None:
        self._current = iteration
        if self._asks_windows or (iteration >= self.switch_step) != self._hooks_are_late:
            self._choose_hooks(iteration)

    def _choose_hooks(self, iteration: int) -> None:
        """Note which hooks the step has that comes next, and which parts the pixel loss after it.

        Noted, because every optimizer asks, and so that a compiled loss does not depend on the
        iteration but at the switch.
        """
        self.hooks = self._hooks[self.phase_of(iteration)]
        having = self._hooks[self.phase_of(iteration + 1)]["pixel_loss"]
        self.pixel_parts = [part for part in having if self._in_window(part, iteration + 1)]
        # They hold until the switch; windows of a pixel loss may be anywhere.
        self._hooks_are_late = iteration >= self.switch_step
        self._asks_windows = any(hooks["pixel_loss"] for hooks in self._hooks.values())

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
    def evidence_interval(self) -> int:
        """Iterations between looks at the evidence: a tenth of a short exploitation."""
        left = self.total_steps - self.switch_step
        return min(EVIDENCE_INTERVAL, max(left // 10, 10)) if self.exploiting else EVIDENCE_INTERVAL

    def phase_of(self, iteration: int) -> Phase | None:
        """The phase of an iteration; None where there are no phases."""
        if not self._has_phases:
            return None
        return Phase.EXPLOITATION if iteration >= self.switch_step else Phase.EXPLORATION

    def window_of(self, phase: Phase | None) -> Window | None:
        """The iterations of a phase; None for both phases, or where there are none."""
        if phase is None or not self._has_phases:
            return None
        # Trainers that go on beyond total_steps stay in exploitation.
        exploring = phase is Phase.EXPLORATION
        return (0, self.switch_step) if exploring else (self.switch_step, NEVER)

    def window_of_part(self, part: Part) -> Window | None:
        """`part.window`, as two integers of Python's, which a checkpoint can hold.

        Raises:
            ValueError: it is neither None nor two iterations, the first not after the second.
        """
        window: Any = part.window(self)
        if window is None or (
            type(window) is tuple and [*map(type, window)] == [int, int] and window[0] <= window[1]
        ):
            return window
        pair = window if isinstance(window, (tuple, list)) and len(window) == 2 else ()
        whole = [int(each) for each in pair if as_float(each).is_integer()]
        if len(whole) != 2 or whole[0] > whole[1]:
            raise ValueError(
                f"{type(part).__name__}.window: {window!r}, but None or two iterations, the first "
                "and the one after the last, are needed"
            )
        return whole[0], whole[1]

    def open_windows(self) -> dict[str, Window | None]:
        """The window of each part that has one, None while it is closed."""
        if self._windows[0] == self._current:  # each optimizer asks
            return self._windows[1]
        found: dict[str, Window | None] = {}
        for name in self._windowed:
            window = self.window_of_part(self._named[name])
            if window is not None:
                found[name] = window if window[0] <= self.current < window[1] else None
        known, rewound = self._windows[1], self._rewinds_followed != self.rewinds
        if found == known:
            found = known  # the same object: nothing has changed
        for name, window in found.items():  # once, whichever optimizer asks first
            if rewound or window is None or known.get(name) != window:
                for key in [key for key in self.kept_numbers if key.startswith(f"{name}.")]:
                    del self.kept_numbers[key]
        self._windows, self._rewinds_followed = (self._current, found), self.rewinds
        return found

    def _in_window(self, part: Part, iteration: int) -> bool:
        """Whether an iteration is in the window of a part, if that has one."""
        if not overrides(part, "window"):  # the plan knows the phases
            return True
        window = self.window_of_part(part)
        return window is None or window[0] <= iteration < window[1]

    # -- the parts -------------------------------------------------------------------------------

    def part(self, kind: type[P]) -> P | None:
        """The first part of a class, or None."""
        return next((part for part in self._parts if isinstance(part, kind)), None)

    def named(self) -> dict[str, Part]:
        """The parts by their classes' names, as in checkpoints; "#2" is the second of a class."""
        return dict(self._named)

    def name_of(self, part: Part) -> str:
        """The name of one of the parts."""
        return next(name for name, known in self._named.items() if known is part)

    def lines(self) -> list[str]:
        """What the parts say of themselves, one line each, and which are switched off, and why."""
        why = {name: f": switched off, {said}" for name, said in self.switched_off.items()}
        return [f"{part}{why.get(name, '')}" for name, part in self._named.items()]

    # -- what parts know of each other, and of the Gaussians --------------------------------------

    def place_of(self, param: Tensor) -> Place | None:
        """Where a Gaussian parameter stands; None for any other tensor."""
        return self.followers.place_of(param)

    def gaussians_of(self, param: Tensor) -> dict[str, Tensor]:
        """The present tensors of the set of Gaussians that a parameter belongs to.

        They are looked up in the optimizers' groups, because density control replaces them:
        `means, scales, quats, opacities, sh0, shN` as far as optimizers of this course hold them,
        raw, as the trainer keeps them. Empty for any other tensor. Of several optimizers that hold
        one of these names, that of the parameter comes first, then those that were upgraded by the
        same call, and then the latest.

        Args:
            param: a Gaussian parameter, of shape [N, ..].
        """
        return self.followers.gaussians_of(param)

    def number_kept(self, part: Part, name: str, param: Tensor) -> Tensor | None:
        """What a part keeps per parameter for another parameter than that of the present hook.

        Args:
            part: one of the parts.
            name: as the part declares it.
            param: of shape [N, ..]; None is returned where nothing is kept for it yet.
        """
        key = f"{self.name_of(part)}.{name}"
        found = (each.record_of(param) for each in self.followers)
        return next((record.numbers.get(key) for record in found if record is not None), None)

    def publish(self, name: str, param: Tensor, value: Any) -> None:
        """Tell other parts something about the set of Gaussians that a parameter belongs to.

        Args:
            name: what it is called among the parts.
            param: one of their parameters, of shape [N, ..].
            value: anything; it is replaced by the next one under that name.
        """
        place = self.place_of(param)
        if place is not None:
            self._published[name, place] = self.current, value

    def published(self, name: str, param: Tensor, *, earlier: bool = False) -> Any:
        """What a part has published about a set of Gaussians in this iteration, or None.

        Args:
            name: what it is called among the parts.
            param: one of their parameters, of shape [N, ..].
            earlier: whether one of an iteration before will do.
        """
        place = self.place_of(param)
        if place is None:
            return None
        iteration, value = self._published.get((name, place), (self.current, None))
        return value if earlier or iteration == self.current else None

    def set_back(self) -> None:
        """Begin anew what is kept for a time: the clock goes back to an earlier iteration."""
        self.rewinds += 1
        self._published = {}

    def last_published(self, name: str) -> Any:
        """What a part has published last under a name, about whichever Gaussians; or None."""
        found = [entry for (key, _), entry in self._published.items() if key == name]
        return max(found, key=lambda entry: entry[0])[1] if found else None

    def warn_once(self, kind: str, message: str) -> None:
        """Say something to the user, once of each kind."""
        if kind not in self._reported:
            self._reported.add(kind)
            warn_user(message)

    # -- energies --------------------------------------------------------------------------------

    def take(self, energy: Tensor) -> None:
        """Tell the parts that act of the energy of the iteration `current`, 0-d, detached."""
        self.num_observed += 1
        self.energy_device = energy.device
        self.valid = math.isfinite(energy.item()) if energy.is_cpu else torch.isfinite(energy)
        for part in self.hooks["observe"]:
            if self._in_window(part, self.current):
                part.observe(energy, self.valid, self)

    def stepping(self, closure_value: Any, optimizer: StepAdam) -> bool:
        """Called at the begin of every step of every optimizer: whether the parts act.

        `closure_value` is the loss that a closure has returned, or None.
        """
        energy = None
        if closure_value is not None:
            energy = check_energy(
                f"{optimizer.call_name}.step", "the closure's value", closure_value
            )
        self.steps += 1
        if energy is None:
            self.valid = True  # of this step nothing is known
            if self.total_steps > 1 and self.current < 0 and self.steps > MAX_STEPS_WITHOUT_CLOCK:
                self.warn_once(
                    "no clock",
                    f"{type(self).__name__}: {self.steps} steps without a closure that returns the "
                    "loss, so that the clock stands still and parts that follow it do nothing; "
                    "give step() one, or use a PhaseScheduler",
                )
        else:
            self.current += 1
            self.take(energy)
        return True

    def valid_on_host(self) -> bool:
        """Whether the last energy was finite, as the host knows it: one synchronisation an energy.

        For steps that cannot be told on the device that they do not count.
        """
        if isinstance(self.valid, Tensor):
            self.valid = bool(self.valid)
        return self.valid

    def on_host(self, number: Tensor) -> float:
        """A 0-d tensor as the host knows it: read once an energy, whoever asks."""
        if number.device.type == "cpu":
            return number.item()
        known = self._numbers_read.get(id(number))
        if known is None or known[0] != self.num_observed or known[1]() is not number:
            known = self.num_observed, weakref.ref(number), number.item()
            kept = {i: e for i, e in self._numbers_read.items() if e[0] == self.num_observed}
            self._numbers_read = {**kept, id(number): known}
        return known[2]

    def expect(self, steps: int) -> None:
        """Called where Adam's moments come without our state: they have made so many steps."""

    def numbers(self) -> dict[str, float | Tensor]:
        """What the parts that act say of themselves: columns of the run log.

        Raises:
            ValueError: those of a part are no dict of numbers, or have a name of the log's own.
        """
        columns: dict[str, float | Tensor] = {}
        for part in self.hooks["numbers"]:
            own, name = part.numbers(self), self.name_of(part)
            if not isinstance(own, Mapping) or not COLUMNS_OF_THE_LOG.isdisjoint(own):
                raise ValueError(
                    f"{name}.numbers: {own!r}, but a dict is needed, without the log's own "
                    f"columns {sorted(COLUMNS_OF_THE_LOG)}"
                )
            for key, value in own.items():
                size = math.prod(getattr(value, "shape", ()))
                if size != 1 or not (isinstance(value, Real) or hasattr(value, "item")):
                    raise ValueError(
                        f"{name}.numbers: {key}={value!r}, but a number, or a tensor of one "
                        "element, is needed"
                    )
            # Of two parts of one class the second's columns are "faded#2", as in checkpoints.
            mark = name.partition("#")[2]
            for key, value in own.items():
                column = f"{key}#{mark}" if mark else key
                # Of parts of two classes with one name for a column, the second's is told apart.
                columns[f"{name}.{key}" if column in columns else column] = value
        return columns

    def judge(self, over_ranks: Any = None) -> list[Change]:
        """Switch parts off and on by their evidence: one transfer from the device.

        `over_ranks` averages a tensor over the ranks, so that all decide alike.
        """
        shown = [(name, part, part.evidence(self)) for name, part in self._named.items()]
        known = [(name, part, seen) for name, part, seen in shown if seen is not None]
        for name, _, seen in known:
            if not isinstance(seen, Tensor) or seen.dim() != 1 or seen.is_complex():
                raise ValueError(
                    f"{name}.evidence: {seen!r}, but a tensor [k] of real numbers, or None, is "
                    "needed"
                )
        if not known:
            return []
        # What a part has not begun to count yet lies on the host, which NCCL does not take.
        device = self.energy_device
        widest = torch.float32 if device.type == "mps" else torch.float64
        packed = torch.cat([seen.detach().to(device, widest) for _, _, seen in known])
        numbers = (packed if over_ranks is None else over_ranks(packed)).tolist()
        said = list[tuple[str, str | None]]()
        for name, part, seen in known:
            own, numbers = numbers[: seen.numel()], numbers[seen.numel() :]
            why = part.useless(own, self)
            if not (why is None or isinstance(why, str)):
                raise ValueError(f"{name}.useless: {why!r}, but a reason, or None, is needed")
            said.append((name, why))
        changes = []
        for name, why in said:
            if why is not None and name not in self.switched_off:
                self.switched_off[name] = why
                changes.append(Change("switched_off", name, why))
            elif why is None and self.switched_off.pop(name, None) is not None:
                changes.append(Change("switched_on", name, "it is of use again"))
        if changes:
            self._plan()
        for event, name, why in changes:
            LOGGER.info("iteration %d: %s %s: %s", self.current, name, event.replace("_", " "), why)
        return changes

    # -- checkpoints -----------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Clock, parts and what is switched off, as plain numbers, strings, lists and dicts."""
        self.open_windows()  # the clock may have been set back since the last step
        return {
            "format": FORMAT,
            "iteration": self.iteration,
            "num_observed": self.num_observed,
            "switched_off": dict(self.switched_off),
            "kept": {key: value.item() for key, value in self.kept_numbers.items()},
            "windows": {name: list(w) for name, w in self._windows[1].items() if w is not None},
            "parts": {
                name: state for name, part in self._named.items() if (state := part.state_dict())
            },
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; parts that it does not know begin anew.

        Raises:
            ValueError: it is damaged, or of another format; then nothing is changed.
        """
        call = f"{type(self).__name__}.load_state_dict"
        check_keys(call, state, ("iteration", "num_observed", "switched_off", "parts"))
        check_format(call, state.get("format"))
        counts = [check_count(call, n, state[n], 0, NEVER) for n in ("iteration", "num_observed")]
        for name in ("parts", "switched_off"):
            check_keys(f"{call}: {name}", state[name], ())
        kept = state.get("kept", {})
        check_keys(f"{call}: kept", kept, ())
        saved_windows = state.get("windows", {})  # earlier versions did not say
        check_keys(f"{call}: windows", saved_windows, ())
        entries = self.number_entries("training")
        numbers = {
            key: restored_number(check_kept_number(call, key, entry, kept[key]), entry)
            for key, entry in entries.items()
            if key in kept
        }
        with self.undone_on_error(), as_damage(call):
            for name, part in self._named.items():
                if name in state["parts"]:
                    part.load_state_dict(state["parts"][name])
                elif not are_same(part.state_dict(), self._unlearnt[name]):
                    begin_anew(name, part, self._unlearnt[name])
            if counts[0] - 1 < self.current:
                self.set_back()
            self.current, self.num_observed = counts[0] - 1, counts[1]
            self._rewinds_followed = self.rewinds
            self._windows = (None, {})  # they may follow what a part has learnt, too
            self._published = {}
            windows = self.open_windows()
            self.kept_numbers.clear()
            for key, number in numbers.items():
                name = key.rpartition(".")[0]
                window, saved = windows.get(name), saved_windows.get(name)
                if name not in windows or (window and saved in (None, list(window), window)):
                    self.kept_numbers[key] = number
            off = state["switched_off"]
            self.switched_off = {name: str(off[name]) for name in off if name in self._named}
            self._plan()

    @contextmanager
    def undone_on_error(self) -> Iterator[None]:
        """Undo what happens within to the clock, to the parts and to the followers, if it fails."""
        known, numbers = dict(vars(self)), dict(self.kept_numbers)
        followers = dict(vars(self.followers))
        parts = [(part, {**vars(part)}, part.state_dict()) for part in self._parts]
        reported = set(self._reported)
        try:
            yield
        except BaseException:
            vars(self).update(known)
            self._reported &= reported
            self.kept_numbers.clear()
            self.kept_numbers.update(numbers)
            vars(self.followers).update(followers)
            self.followers.forget_places()
            for part, attributes, state in parts:
                put_back(part, attributes, state)
            raise

    def number_entries(self, per: str) -> dict[str, Kept]:
        """What the parts keep as numbers, `per` "parameter" or "training", by its keys."""
        return {
            key_of(name, kept): kept
            for name, entries in self.declared.items()
            for kept in entries.values()
            if kept.per == per
        }

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_published": {}, "_numbers_read": {}}


class NoCourse:
    """In the place of the course of an optimizer that follows none yet."""

    def __get__(self, optimizer: Any, kind: type) -> Any:
        raise AttributeError(
            f"{kind.__name__} has no parts yet: call follow(Course([...])) first, or have a "
            "PhaseScheduler upgrade an Adam"
        )


def restored_number(value: float, kept: Kept) -> Tensor:
    """A number of a checkpoint, as wide as it may be until a parameter says how wide it is."""
    dtype = torch.float64 if kept.dtype.is_floating_point else kept.dtype
    return torch.tensor(value, dtype=dtype, device="cpu")


def check_format(call: str, value: Any) -> None:
    """ValueError unless it is the number of a format of checkpoints that can be read."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or value not in READABLE_FORMATS:
        raise ValueError(f"{call}: format={value!r}, but one of {READABLE_FORMATS} is needed")
