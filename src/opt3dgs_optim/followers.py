"""The optimizers whose steps have the parts of one training, and where their parameters stand."""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor

from opt3dgs_optim.names import NamedGroup, gaussian_of, set_of

if TYPE_CHECKING:
    from opt3dgs_optim.stepadam import StepAdam

MAX_CACHED_PLACES = 64


class Place(NamedTuple):
    """Where a Gaussian parameter stands: which set of Gaussians, which tensor of its group."""

    set_name: str  # "" where an optimizer holds one set
    number: int  # of the tensor in its group


class Followers:
    """Knows the optimizers that follow a course, for as long as somebody else holds them.

    Attributes:
        upgrades: how often `PhaseScheduler.upgrade` was called.
        holds_twice: whether two optimizers that exist have held the same Gaussian parameter.
    """

    def __init__(self) -> None:
        # id of a tensor -> the group that holds it, and where it stands
        self._places: dict[int, tuple[weakref.ref[NamedGroup], Place]] = {}
        self._holders: list[weakref.ref[StepAdam]] | None = None  # of opacities; None: not sought
        # With what they held: a lost one is not missed where another one holds that.
        self._known: list[tuple[weakref.ref[StepAdam], frozenset[Any]]] = []
        self.upgrades, self.holds_twice = 0, False

    def register(self, optimizer: StepAdam) -> None:
        """Know an optimizer, for as long as somebody else holds it."""
        if optimizer not in [*self]:
            held = _held(optimizer)
            self.holds_twice |= any(own & held for ref, own in self._known if ref() is not None)
            self._known = [*self._known, (weakref.ref(optimizer), held)]
            self.forget_places()

    def __getstate__(self) -> dict[str, Any]:
        # Copies of the optimizers make themselves known to the copy of the course.
        return {**vars(self), "_known": [], "_places": {}, "_holders": None}

    def __iter__(self) -> Iterator[StepAdam]:
        """The optimizers that exist, the latest last."""
        return iter([each for ref, _ in self._known if (each := ref()) is not None])

    @property
    def num_lost(self) -> int:
        """How many do not exist any more, and no other one holds what they held."""
        lost = {own for ref, own in self._known if ref() is None}
        if not lost:
            return 0
        held = frozenset[Any]().union(*map(_held, self))
        return sum(not own <= held for own in lost)

    @property
    def are_sought(self) -> bool:
        """Whether the holders of opacities are known."""
        return self._holders is not None

    def holders_of_opacities(self) -> list[StepAdam]:
        """Those that hold opacities."""
        known = self._holders  # asked for in every iteration
        found = [*self] if known is None else [o for ref in known if (o := ref())]
        for optimizer in found:
            optimizer.name_groups()  # a trainer may have put other groups there
        if self._holders is None:
            found = [o for o in self if _holds_opacities(o)]
            self._holders = [weakref.ref(each) for each in found]
        return found

    def stepped_together(self, iteration: int) -> str | None:
        """A Gaussian parameter of which two optimizers have stepped one each in an iteration."""
        seen = set[Any]()
        for ref, held in self._known:
            optimizer = ref()
            if optimizer is not None and optimizer.stepped_at == iteration:
                if seen & held:
                    return "#".join(filter(None, min(seen & held)))
                seen |= held
        return None

    def place_of(self, param: Tensor) -> Place | None:
        """Where a Gaussian parameter stands; None for any other tensor."""
        known = self._places.get(id(param))
        if known is not None and (group := known[0]()) is not None:
            place, params = known[1], group["params"]
            if place.number < len(params) and params[place.number] is param:
                return place
        for group in self._groups():
            for number, each in enumerate(group["params"]):
                if each is param:
                    if len(self._places) >= MAX_CACHED_PLACES:  # of tensors that were replaced
                        self._places.clear()
                    place = Place(group.set_name, number)
                    self._places[id(param)] = weakref.ref(group), place
                    return place
        return None

    def forget_places(self) -> None:
        """Look anew for where parameters stand: groups were exchanged."""
        self._places.clear()
        self._holders = None

    def gaussians_of(self, param: Tensor) -> dict[str, Tensor]:
        """As `Course.gaussians_of`."""
        place = self.place_of(param)
        if place is None:
            return {}
        held = {
            each: {
                str(group.gaussian): group["params"][place.number]
                for group in each.gaussian_groups()
                if group.set_name == place.set_name and place.number < len(group["params"])
            }
            for each in self
        }
        own = [each for each in held if any(p is param for p in held[each].values())]
        calls = {each.upgraded_in for each in own}
        order = sorted(held, key=lambda each: (each.upgraded_in in calls, each in own))
        return {name: found for each in order for name, found in held[each].items()}

    def _groups(self) -> Iterator[NamedGroup]:
        return (group for each in self for group in each.gaussian_groups())


def _holds_opacities(optimizer: StepAdam) -> bool:
    return any(gaussian_of(group) == "opacities" for group in optimizer.param_groups)


def _held(optimizer: StepAdam) -> frozenset[Any]:
    """Which parameters of which sets of Gaussians an optimizer holds."""
    groups = optimizer.param_groups
    return frozenset((set_of(each), name) for each in groups if (name := gaussian_of(each)))
