"""Whether a trainer removes Gaussians, as clone, split and prune does and 3DGS-MCMC does not."""

from __future__ import annotations

from collections.abc import Iterable
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim.names import gaussian_of


class RemovedRows:
    """Looks between two iterations for rows that have disappeared from the opacities.

    3DGS-MCMC writes over dead rows where they stand, and appends others. Clone, split and prune
    takes rows out, so that those behind them move up. Of all Gaussian parameters the opacities are
    the smallest, and noise does not move them.

    The opacities that density control has replaced are held until the next look. A look costs
    nothing where they are the same tensor, and a sort of them where they are not, for which it
    waits for the GPU. A copy, or what comes out of a pickle, has seen nothing yet.
    """

    def __init__(self) -> None:
        self._seen: WeakKeyDictionary[Optimizer, list[Tensor]] = WeakKeyDictionary()

    def found(self, optimizers: Iterable[Optimizer]) -> bool:
        """Whether rows were removed since the last look.

        Args:
            optimizers: those that hold the Gaussian parameters; each is compared with itself.
        """
        found = False
        for optimizer in optimizers:
            groups = [g for g in optimizer.param_groups if gaussian_of(g) == "opacities"]
            params = [param for group in groups for param in group["params"]]
            seen = self._seen.get(optimizer, [])
            if len(seen) != len(params):  # seen first, or a set of Gaussians came or went
                self._seen[optimizer] = seen = [param.detach() for param in params]
            for i, (before, param) in enumerate(zip(seen, params, strict=True)):
                if before.data_ptr() != param.data_ptr() or before.shape != param.shape:
                    seen[i] = param.detach()
                    found = were_removed(before, seen[i]) or found
        return found

    def __reduce__(self) -> tuple[type[RemovedRows], tuple[()]]:
        return RemovedRows, ()


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
