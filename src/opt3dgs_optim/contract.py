"""What is taken: one function that refuses the rest, in a sentence that says what to do."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, AdamW, Optimizer

OWN_STEPS = ("SelectiveAdam", "SparseGaussianAdam")  # gsplat's and 3DGRUT's, and INRIA's
Slots = list[tuple[str, str | None]]  # by group: the set of Gaussians, which parameter of it
REFUSED = ("amsgrad", "maximize", "differentiable", "capturable")


def own_step(kind: type) -> type | None:
    """The class of a step that is not torch's: gsplat's SelectiveAdam, INRIA's; else None."""
    owner = next(each for each in kind.__mro__ if "step" in vars(each) and issubclass(each, Adam))
    return None if owner in (Adam, AdamW) else owner


def check_supported(optimizer: Any, slots: Slots, moments: int = 32) -> None:
    """Refuse an optimizer that is outside of the contract, before anything has been changed.

    Args:
        optimizer: what is to be upgraded.
        slots: by group, the set of Gaussians and which of its parameters it holds, or None.
        moments: bits of each of Adam's moments of a number.

    Raises:
        TypeError: it is no Adam of torch's, nor gsplat's or INRIA's masked one.
        ValueError: an option or a tensor is not taken.
    """
    kind = type(optimizer)
    if not isinstance(optimizer, Optimizer):
        raise TypeError(
            f"upgrade: {kind.__name__} is no optimizer; pass the trainer's own, or a dict or list "
            "of them"
        )
    owner = (
        own_step(kind._base if hasattr(kind, "_base") else kind)
        if isinstance(optimizer, Adam)
        else kind
    )
    if owner is not None and owner.__name__ not in OWN_STEPS:
        raise TypeError(
            f"upgrade: {kind.__name__} has a step of its own; have the trainer make a "
            "torch.optim.Adam (or, from torch 2.7 on, AdamW) with the same groups, or gsplat's "
            "SelectiveAdam"
        )
    _check_bits(optimizer, owner, slots, moments)
    held = [slot for slot in slots if slot[1] is not None]
    if len(set(held)) < len(held):
        raise ValueError(
            f"upgrade: two groups hold the same of {sorted({str(n) for _, n in held})}; for two "
            "sets of Gaussians name the groups 'first#means', 'second#means'"
        )
    for group, (_, name) in zip(optimizer.param_groups, slots, strict=True):
        shown = group.get("name") or name or "a group"
        for option in REFUSED:
            if group.get(option):
                raise ValueError(f"upgrade: {shown} has {option}=True; make the Adam without it")
        if isinstance(group["lr"], Tensor):
            raise ValueError(f"upgrade: {shown} has a tensor as lr; give a float")
        if name is not None and len(group["params"]) != 1:
            raise ValueError(
                f"upgrade: {shown} holds {len(group['params'])} tensors; give each Gaussian "
                "parameter one group with one tensor"
            )
        for param in group["params"]:
            if param.dtype not in (torch.float32, torch.float64) or param.layout != torch.strided:
                raise ValueError(
                    f"upgrade: {shown} is {param.dtype}, {param.layout}; dense float32 is needed "
                    "(or float64, which is stepped in plain torch)"
                )
            if name == "means" and param.shape[1:] != (3,):
                raise ValueError(f"upgrade: {shown} is {tuple(param.shape)}; positions are [N, 3]")
    devices = {str(p.device) for g in optimizer.param_groups for p in g["params"]}
    if len(devices) > 1:
        raise ValueError(f"upgrade: its parameters lie on {sorted(devices)}; one device is needed")


def _check_bits(optimizer: Any, owner: type | None, slots: Slots, moments: int) -> None:
    """ValueError where moments of 16 bits are not for an optimizer."""
    if moments == 32:
        return
    if owner is not None:
        raise ValueError(
            f"upgrade: moments=16, but {type(optimizer).__name__} makes its own step, on moments "
            "of 32 bits; take torch.optim.Adam, or moments=32"
        )
    others = [at for at, (_, name) in enumerate(slots) if name is None]
    if 0 < len(others) < len(slots):
        shown = optimizer.param_groups[others[0]].get("name")
        raise ValueError(
            f"upgrade: moments=16, but the group {shown!r} beside the Gaussians is "
            "none of theirs; give it an optimizer of its own, or take moments=32"
        )
    dtypes = {param.dtype for group in optimizer.param_groups for param in group["params"]}
    if dtypes - {torch.float32}:
        raise ValueError(f"upgrade: moments=16 with {sorted(map(str, dtypes))}; use float32")
