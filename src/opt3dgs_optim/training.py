"""What the steps of a training share: its clock, its tensors by name, and what its parts know."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from typing import Any, TypeVar

from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim.checks import check_choice
from opt3dgs_optim.clock import Clock
from opt3dgs_optim.device import BadNumbers
from opt3dgs_optim.mean import drop_kept, drop_means
from opt3dgs_optim.messages import Messages

LOOK_INTERVAL = 100  # iterations between two looks at the numbers that were not finite
LAG = 3  # iterations after which a device has nearly always done what it was asked for
AnyPart = TypeVar("AnyPart")


class Training(Clock):
    """A training: parts, and what they share.

    Args:
        parts: `Part` objects, what the steps have, in order.
        total_steps, switch_step: as in `Clock`.
        moments: bits per number of each of Adam's moments, 32 or 16.

    Attributes:
        changes_steps: whether the steps differ from torch's.
        members: by set and gsplat's name, the optimizer that holds this Gaussian parameter, and its
            group's index. References are weak: what a trainer replaces is freed at once.
        all_optimizers: weak references to all that it steps, by id.
        averages: whether there is room for the mean of the last iterates.
        messages: what has been said, each thing once.
        bad_numbers: how many numbers of gradients were not finite.
        unsaved: what parts keep from step to step; `Part.read_back` puts what is saved into notes.
    """

    def __init__(
        self,
        parts: Iterable[Any],
        total_steps: int | None = None,
        switch_step: int | None = None,
        moments: int = 32,
    ) -> None:
        super().__init__(total_steps, switch_step)
        self.parts = tuple(parts)  # `part` needs this class for its own hints
        self.moments = check_choice(type(self).__name__, "moments", moments, (32, 16))
        self.changes_steps = bool(self.parts) or moments != 32
        self.members: dict[tuple[str, str], tuple[weakref.ref[Optimizer], int]] = {}
        self.all_optimizers: dict[int, weakref.ref[Any]] = {}
        self.averages = True
        self.messages, self.bad_numbers = Messages(), BadNumbers()
        self.unsaved: dict[Any, Any] = {}
        self._notes: dict[str, dict[str, Any]] = {type(part).__name__: {} for part in self.parts}
        self._look_at = LOOK_INTERVAL  # the iteration of the next look
        self.observers = [part for part in self.parts if part.overrides("observe")]
        for part in self.parts:
            if part.learns:
                if vars(part).get("_training") is not None:
                    raise ValueError(
                        f"{type(self).__name__}: {type(part).__name__} serves another training "
                        f"already, and has learnt there; make a new one, {type(part).__name__}(...)"
                    )
                object.__setattr__(part, "_training", self)  # a frozen dataclass, too

    def part(self, kind: type[AnyPart]) -> AnyPart | None:
        """The part of that class, or None."""
        return next((part for part in self.parts if isinstance(part, kind)), None)

    def notes_of(self, part: Any) -> dict[str, Any]:
        """What a part knows of this training: plain numbers by name, saved with the optimizers."""
        return self._notes[type(part).__name__]

    def take(self, optimizer: Any, slots: list[tuple[str, str | None]]) -> bool:
        """Have an optimizer of these parameters, in the place of those that held them.

        Returns whether positions are among them.
        """
        positions = False
        ref = self.all_optimizers[id(optimizer)] = weakref.ref(optimizer)
        for slot in [slot for slot, (held, _) in self.members.items() if held() is optimizer]:
            del self.members[slot]
        for at, (of_set, name) in enumerate(slots):
            if name is not None:
                other: Any = self.members.get((of_set, name), (ref,))[0]()
                if other is not None and other is not optimizer and other.training is self:
                    other.forget_steppers()  # so that it is missed here if it steps again
                self.members[of_set, name] = ref, at
                positions |= name == "means"
        self.counts_positions |= positions
        return positions

    def param_of(self, set_name: str, name: str) -> Tensor | None:
        """The present tensor of a Gaussian parameter, by gsplat's name; None if nobody holds it."""
        member = self.members.get((set_name, name))
        if member is None or (optimizer := member[0]()) is None:
            return None
        params = optimizer.param_groups[member[1]]["params"]
        return params[0] if params else None

    def claim(self, call: str, slot: tuple[str, Any], at: int, optimizer: Any) -> None:
        """Have an optimizer that steps in its place; say once if one upgraded later has that."""
        member = self.members.get(slot)
        other = None if member is None else member[0]()
        if other is None and slot[1] is not None:
            self.members[slot] = weakref.ref(optimizer), at  # the other has gone
        elif (
            other not in (None, optimizer)
            and optimizer.param_groups[at]["params"][0].grad is not None
        ):
            self.messages.warn_once(
                "second",
                f"{call}.step: another optimizer holds {slot[1]}, too, and was upgraded later; for "
                "two sets of Gaussians name the groups 'first#means', 'second#means', or make a "
                "scheduler for each",
            )

    def state_of_param(self, set_name: str, name: str) -> dict[str, Any] | None:
        """The optimizer's state of a Gaussian parameter; None before its first step."""
        param = self.param_of(set_name, name)
        optimizer = None if param is None else self.members[set_name, name][0]()
        return None if param is None or optimizer is None else optimizer.state.get(param) or None

    def optimizers(self) -> list[Any]:
        """Those that have not gone over to another training."""
        found = [each() for each in self.all_optimizers.values()]
        return [each for each in found if each is not None and each.training is self]

    def clocks(self) -> list[int]:
        """The next iteration of each optimizer of Gaussians whose steps are counted."""
        found: dict[int, Any] = {id(o := m[0]()): o for m in self.members.values()}
        held = [each for each in found.values() if each is not None]
        return [o.next_iteration for o in held if o.has_positions or not self.counts_positions]

    def numbers(self) -> dict[str, float | Tensor]:
        """What the parts say of the present iteration."""
        found: dict[str, float | Tensor] = {}
        for part in self.parts:
            found.update(part.numbers(self))
        return found

    def observe(self, loss: Any) -> None:
        """Give the loss of this iteration to the parts that read it."""
        for part in self.observers:
            part.observe(loss, self)

    def go_on(self) -> None:
        """Have no end any more, and nothing that was kept for rows on the way to it."""
        super().go_on()
        for optimizer in self.optimizers():
            for state in optimizer.state.values():
                drop_kept(state)

    def end_averaging(self) -> None:
        """Go on without the mean of the last iterates, for which a device has no room."""
        self.averages = False
        for optimizer in self.optimizers():
            drop_means(optimizer.state.values())
        self.messages.warn_once(
            "memory",
            f"opt3dgs_optim: iteration {self.iteration}: the device has no room for the mean of "
            "the last iterates, a copy of the parameters; the training goes on without it, and "
            "ends at the last iterate; moments=16 halves what is needed",
        )

    def go_to(self, iteration: int) -> None:
        """Be at that iteration; now and then look for numbers that were not finite."""
        super().go_to(iteration)
        left = 0 if self.end_step is None else self.end_step - iteration
        if iteration >= self._look_at or left in (LAG + 1, 1):  # a look tells of the one before
            self._look_at = iteration + LOOK_INTERVAL
            self.look_at_numbers()
            self.look_at_members()

    def resume(self, iteration: int, by_count: bool = False) -> None:
        """Go on at an iteration; drop what was kept from step to step before.

        `by_count`: whether Adam's count of steps has said so.
        """
        super().resume(iteration)
        self.unsaved.clear()
        self._look_at = iteration + LOOK_INTERVAL

    def look_at_numbers(self) -> None:
        """Say once that gradients have not been finite."""
        if bad := self.bad_numbers.look():
            self.messages.warn_once(
                "nonfinite",
                f"opt3dgs_optim: iteration {self.iteration}: {bad} numbers of gradients have "
                "not been finite (NaN or infinite) since the start, and counted as zero; look for "
                "the first NaN of the loss",
            )

    def look_at_members(self) -> None:
        """Say once that an optimizer has gone, while others of its Gaussians are there."""
        gone = {key for key, (held, _) in self.members.items() if held() is None}
        sets = {of_set for of_set, _ in self.members.keys() - gone}
        if names := [name for of_set, name in gone if of_set in sets]:
            self.messages.warn_once(
                "gone",
                f"opt3dgs_optim: iteration {self.iteration}: the optimizer of {sorted(names)} has "
                "gone; if another is in its place, upgrade that one, by the same scheduler",
            )

    def positions_gone(self) -> bool:
        """Whether no optimizer of positions is there any more."""
        held = [each() for (_, name), (each, _) in self.members.items() if name == "means"]
        return all(each is None for each in held)

    def read_back(self) -> None:
        """Have what is on its way from a device in the parts' notes."""
        for part in self.parts:
            part.read_back(self)

    def __getstate__(self) -> dict[str, Any]:
        # A copy of an optimizer tells its training itself that it is a member.
        self.read_back()
        return {**vars(self), "unsaved": {}, "members": {}, "all_optimizers": {}}
