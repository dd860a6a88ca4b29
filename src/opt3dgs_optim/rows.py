"""Whose rows they are: what parts keep per row, against trainers that add, drop and move rows."""

import weakref
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from opt3dgs_optim.checks import check_keys, warn_user

MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq")  # torch's names of Adam's, the last amsgrad's


class Ledger:
    """Remembers to which rows of which parameter the tensors under the parts' keys belong.

    Some trainers edit every tensor of the state by rows, others (INRIA, 3dgs-mcmc) the two moments
    only. The rule that is safe with all: what was not seen with this parameter object, at this
    number of rows, is dropped. The number alone is not enough: pruning and splitting between two
    steps can bring it back to what it was.
    """

    def __init__(self) -> None:
        self._seen: Any = WeakIdKeyDictionary()  # a part's tensor -> (weak parameter, rows)

    def drop_strangers(self, param: Tensor, state: dict[str, Any], keys: Iterable[str]) -> None:
        """Remove the tensors under `keys` that are of other rows than the parameter's present."""
        for key in [key for key in keys if key in state]:
            owner, rows = self._seen.get(state[key], (None, 0))
            if owner is None or owner() is not param or rows != rows_of(param):
                del state[key]

    def remember(self, param: Tensor, state: dict[str, Any], keys: Iterable[str]) -> None:
        """Take the tensors under `keys` as those of the parameter's present rows."""
        for key in keys:
            if key in state:
                self._seen[state[key]] = weakref.ref(param), rows_of(param)


class Frozen:
    """Rows of a parameter [N, ..] that a step is to leave as they are: put back after it.

    `moving` are the others, [N] bool, or 0-d: all or none; `step` is kept only by the latter.
    """

    def __init__(self, moving: Tensor, param: Tensor, state: dict[str, Any]) -> None:
        tensors = {key: value for key, value in state.items() if isinstance(value, Tensor)}
        if moving.dim() > 0:
            tensors.pop("step", None)
        # .data: putting back is no write that a part should notice by the version counter.
        kept = [param.data, *tensors.values()]
        self._kept = [(each, each.clone(), shaped(moving, each)) for each in kept]

    @torch.no_grad()
    def put_back(self) -> None:
        """Give the rows that were not to move what they had."""
        for tensor, saved, moving in self._kept:
            tensor.copy_(torch.where(moving, tensor, saved))


def rows_of(param: Tensor) -> int:
    """The number of points of a parameter; a number alone is one."""
    return param.shape[0] if param.dim() else 1


def shaped(rows: Tensor, like: Tensor) -> Tensor:
    """[N] as [N, 1, ..] for broadcasting over `like` [N, ..]; 0-d as it is."""
    return rows.reshape(-1, *[1] * (like.dim() - 1)) if rows.dim() else rows


def check_mask(call: str, masks: list[Any], num_points: int | None) -> Tensor:
    """The only mask as a flat bool tensor [N]; ValueError where there is another number of them."""
    if len(masks) != 1:
        raise ValueError(f"{call}.step: {len(masks)} masks, but one is needed")
    mask = masks[0]
    if not isinstance(mask, Tensor) or mask.dim() == 0 or mask.is_complex():
        raise ValueError(f"{call}.step: visible={mask!r}, but a mask of shape [N] is needed")
    mask = mask.detach().reshape(-1)
    if num_points is not None and num_points != mask.numel():
        raise ValueError(
            f"{call}.step: num_points={num_points}, but the mask has {mask.numel()} rows"
        )
    return mask if mask.dtype == torch.bool else mask != 0


def check_rows(call: str, params: list[Tensor], keys: Iterable[str], state: Any) -> None:
    """ValueError unless loaded moments fit the parameters; what parts kept of other rows goes.

    The number of rows may differ: some trainers load the optimizer first, the points afterwards.
    """
    for param in params:
        own = state.get(param)
        if not own and isinstance(own, (Mapping, type(None))):
            continue
        check_keys(call, own, ("step", "exp_avg", "exp_avg_sq"))
        for key in ("exp_avg", "exp_avg_sq"):
            value = own[key]
            if not isinstance(value, Tensor) or value.shape[1:] != param.shape[1:]:
                shape = tuple(value.shape) if isinstance(value, Tensor) else value
                raise ValueError(
                    f"{call}: {key} has shape {shape}, but the parameter has {tuple(param.shape)}"
                )
        for key in keys:
            if key in own and own[key].shape[0] != rows_of(param):
                warn_user(
                    f"{call}: {key} of {own[key].shape[0]} rows for a parameter of "
                    f"{rows_of(param)}: dropped, and collected anew"
                )
                del own[key]
