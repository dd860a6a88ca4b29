"""Whether a trainer removes Gaussians, as clone, split and prune does and 3DGS-MCMC does not."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim.names import gaussian_of

# The methods of a scene that gsplat's strategies (main, 2026-08) call after an edit of rows, and
# whether the edit removes some.
EDITS = {
    "on_duplicate": False,
    "on_split": True,
    "on_remove": True,
    "on_relocate": False,
    "on_sample_add": False,
    "on_permute": False,
}


class Look(NamedTuple):
    """Where opacities were: in which group of an optimizer, and where in memory, how many."""

    optimizer: weakref.ref[Optimizer]
    place: int
    group: weakref.ref[Any]
    memory: list[tuple[int, torch.Size]]


class RemovedRows:
    """Looks between two iterations for rows that have disappeared from the opacities.

    3DGS-MCMC writes over dead rows where they stand, and appends others. Clone, split and prune
    takes rows out, so that those behind them move up. Of all Gaussian parameters the opacities are
    the smallest, and noise does not move them.

    The opacities that density control has replaced are held until the next look. A look costs
    nothing where they are the same tensor, and a sort of them where they are not, for which it
    waits for the GPU. Where a scene tells of the edits, nothing is sorted. A copy, or what comes
    out of a pickle, has seen nothing yet, and listens to no scene.
    """

    def __init__(self) -> None:
        self._seen: WeakKeyDictionary[Optimizer, list[Tensor]] = WeakKeyDictionary()
        self._told: set[bool] = set()  # of the edits since the last look: whether they remove rows
        self._looked_at: list[Look] = []  # what must be as it was for nothing to be new

    def listen(self, scene: Any) -> None:
        """Be told of the edits that a strategy tells `scene` of.

        Its methods for this, as many as it has, are replaced by others that call them. Listening
        twice is once.
        """
        for name, removes in EDITS.items():
            method = getattr(scene, name, None)
            while isinstance(method, _Telling) and method.watch() in (None, self):
                method = method.method  # of a scheduler that is gone
            if callable(method):
                setattr(scene, name, _Telling(method, removes, self))

    def listens_to(self, scene: Any) -> bool:
        """Whether it is told of the edits of a scene already."""
        methods = [getattr(scene, name, None) for name in EDITS]
        return any(isinstance(each, _Telling) and each.watch() is self for each in methods)

    def leave(self, scene: Any) -> None:
        """Listen no more to a scene."""
        for name in EDITS:
            method = getattr(scene, name, None)
            if isinstance(method, _Telling) and method.watch() is self:
                setattr(scene, name, method.method)

    def tell(self, removes: bool) -> None:
        """Note an edit of rows, and whether it removes some."""
        self._told.add(removes)

    def forget(self) -> None:
        """Begin anew, as after a rewind: what was seen and told holds no more."""
        self._seen.clear()
        self._told.clear()
        self._looked_at = []

    def are_known(self) -> bool:
        """Whether the opacities are where they were at the last look; asked in every iteration."""
        if self._told or not self._looked_at:
            return False
        for optimizer, place, group, memory in self._looked_at:
            holder, held = optimizer(), group()
            groups = [] if holder is None else holder.param_groups
            if held is None or place >= len(groups) or groups[place] is not held:
                return False
            if [(p.data_ptr(), p.shape) for p in held["params"]] != memory:
                return False
        return True

    def found(self, optimizers: Iterable[Optimizer]) -> bool:
        """Whether rows were removed since the last look.

        Args:
            optimizers: those that hold the Gaussian parameters; each is compared with itself.
        """
        found, was_told = any(self._told), bool(self._told)
        self._told.clear()
        self._looked_at = []
        for optimizer in optimizers:
            groups = [
                (i, group)
                for i, group in enumerate(optimizer.param_groups)
                if gaussian_of(group) == "opacities"
            ]
            params = [param for _, group in groups for param in group["params"]]
            for i, group in groups:
                memory = [(param.data_ptr(), param.shape) for param in group["params"]]
                self._looked_at.append(Look(weakref.ref(optimizer), i, weakref.ref(group), memory))
            seen = self._seen.get(optimizer, [])
            if len(seen) != len(params):  # seen first, or a set of Gaussians came or went
                self._seen[optimizer] = seen = [param.detach() for param in params]
            for i, (before, param) in enumerate(zip(seen, params, strict=True)):
                if before.data_ptr() != param.data_ptr() or before.shape != param.shape:
                    seen[i] = param.detach()
                    # A scene has one set of Gaussians, and what it tells explains one exchange.
                    explained = was_told and len(seen) == 1 and len(param) >= len(before)
                    found = found or (not explained and were_removed(before, seen[i]))
        return found

    def __reduce__(self) -> tuple[type[RemovedRows], tuple[()]]:
        return RemovedRows, ()


def is_told_of_edits(scene: Any) -> bool:
    """Whether a trainer's object has a method that a strategy calls after its row edits."""
    return any(callable(getattr(scene, name, None)) for name in EDITS)


class _Telling:
    """A method of a scene that also tells that it was called."""

    def __init__(self, method: Callable[..., Any], removes: bool, watch: RemovedRows) -> None:
        self.method, self.removes = method, removes
        self.watch: Callable[[], RemovedRows | None] = weakref.ref(watch)

    def __call__(self, *args: Any, **options: Any) -> Any:
        watch = self.watch()
        if watch is not None:
            watch.tell(self.removes)
        return self.method(*args, **options)

    def __reduce__(self) -> tuple[Any, ...]:
        return _plain, (self.method,)  # a copy of the scene is not listened to


def _plain(method: Callable[..., Any]) -> Callable[..., Any]:
    return method


def were_removed(before: Tensor, after: Tensor) -> bool:
    """Whether rows of `before` [N, ..] are missing in `after` [M, ..], so that others moved.

    Half or more of the rows that are known by their value, a tenth of all at least, must stand at
    another place than before. Either they are in their old order: what is left, then the children
    of what was split. Or they are sorted anew, as fVDB's are, and more than one in a hundred has a
    copy. Relocation moves no row that it keeps, and changes the opacity of what it copies.
    """
    before, after = before.flatten(), after.flatten().to(before)
    count = len(before)
    if len(after) < count:
        return True
    values, rows = before.sort()
    place = torch.searchsorted(values, after[:count].contiguous()).clamp(max=count - 1)
    twice = torch.zeros_like(values, dtype=torch.bool)  # as of rows that no view has seen yet
    twice[1:] = values[1:] == values[:-1]
    twice[:-1] |= twice[1:].clone()
    known = (values[place] == after[:count]) & ~twice[place]
    was, now = rows[place][known], known.nonzero()[:, 0]
    moved, in_order = (was != now).sum(), (was.diff() > 0).sum()
    if 10 * len(was) < count or not bool((moved > 0) & (2 * moved >= len(was))):
        return False
    if 10 * in_order >= 9 * (len(was) - 1):
        return True
    now_sorted = after.sort().values
    last = torch.searchsorted(now_sorted, values, right=True)
    copied = (last - torch.searchsorted(now_sorted, values) > 1) & ~twice
    return bool(100 * copied.sum() > count)
