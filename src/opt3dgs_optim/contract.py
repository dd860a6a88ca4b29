"""What is taken; the rest is refused, in sentences that say what to do."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam, AdamW, Optimizer

from opt3dgs_optim.checks import check_choice
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.names import GAUSSIAN, GAUSSIAN_NAMES, split_name
from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.curvature import Curvature
from opt3dgs_optim.parts.own_frame import OwnFrame

OWN_STEPS = ("SelectiveAdam", "SparseGaussianAdam")  # gsplat's and 3DGRUT's, and INRIA's
Slots = list[tuple[str, str | None]]  # by group: the set of Gaussians, which parameter of it
HOOKS = ("plan", "after", "observe", "pixel_loss", "numbers")  # a part has one of them at least
REFUSED = ("amsgrad", "maximize", "differentiable", "capturable")


@functools.cache
def own_step(kind: type) -> type | None:
    """The class of a step that is not torch's: gsplat's SelectiveAdam, INRIA's; else None."""
    for owner in kind.__mro__:
        if "step" in vars(owner):
            # torch wraps, for hooks, the step of the class of the first optimizer in a process.
            if bare(vars(owner)["step"]) in (bare(Adam.step), bare(AdamW.step)):
                return None
            return owner
    return None


def bare(step: Any) -> Any:
    """A step without what torch puts around it, for hooks and profiles."""
    return step.__wrapped__ if getattr(step, "hooked", False) else step


def check_supported(call: str, optimizer: Any, slots: Slots, moments: int = 32) -> None:
    """Refuse an optimizer that is outside of the contract, before anything has been changed.

    Args:
        call: what the user called.
        optimizer: what is to be upgraded.
        slots: by group, the set of Gaussians and which of its parameters it holds, or None.
        moments: bits of each of Adam's moments of a number.

    Raises:
        TypeError: it is not torch's Adam, nor gsplat's or INRIA's masked one.
        ValueError: an option or a tensor is not taken.
    """
    kind = type(optimizer)
    if not isinstance(optimizer, Optimizer):
        raise TypeError(
            f"{call}: {kind.__name__} is no optimizer; pass the one that the trainer has made "
            "(gaussians.optimizer, say), or a dict or list of them"
        )
    _check_bare(call, optimizer)
    owner = (
        own_step(kind._base if hasattr(kind, "_base") else kind)
        if isinstance(optimizer, Adam)
        else kind
    )
    if owner is not None and owner.__name__ not in OWN_STEPS:
        raise TypeError(
            f"{call}: {kind.__name__} has a step of its own; have the trainer make a "
            "torch.optim.Adam (or, from torch 2.7 on, AdamW) with the same groups, or gsplat's "
            "SelectiveAdam"
        )
    _check_bits(call, optimizer, owner, slots, moments)
    held = [slot for slot in slots if slot[1] is not None]
    if len(set(held)) < len(held):
        raise ValueError(
            f"{call}: two groups hold the same of {sorted({str(n) for _, n in held})}; for two "
            "sets of Gaussians name the groups 'first#means', 'second#means'"
        )
    for group, (_, name) in zip(optimizer.param_groups, slots, strict=True):
        shown = group.get("name") or name or "a group"
        for option in REFUSED:
            if group.get(option):
                raise ValueError(f"{call}: {shown} has {option}=True; make the Adam without it")
        if isinstance(group["lr"], Tensor):
            raise ValueError(f"{call}: {shown} has a tensor as lr; give a float")
        check_tensors(call, group, name)
    devices = {str(p.device) for g in optimizer.param_groups for p in g["params"]}
    if len(devices) > 1:
        raise ValueError(f"{call}: its parameters lie on {sorted(devices)}; one device is needed")


def check_tensors(call: str, group: dict[str, Any], name: str | None) -> None:
    """ValueError where a group's tensors are not taken; `name`: which Gaussian parameter it is."""
    shown = group.get("name") or name or "a group"
    if name is not None and len(group["params"]) != 1:
        raise ValueError(
            f"{call}: {shown} holds {len(group['params'])} tensors; give each Gaussian "
            "parameter one group with one tensor, and a group of something else another name"
        )
    for param in group["params"]:
        if param.dtype not in (torch.float32, torch.float64) or param.layout != torch.strided:
            raise ValueError(
                f"{call}: {shown} is {param.dtype}, {param.layout}; dense float32 is needed "
                "(or float64, which is stepped in plain torch)"
            )
        if (name and not param.dim()) or (name == "means" and param.shape[1:] != (3,)):
            raise ValueError(
                f"{call}: {shown} is {tuple(param.shape)}; Gaussian parameters have a row for "
                "each Gaussian, and positions are [N, 3]; upgrade when they are"
            )


def check_held(call: str, optimizer: Optimizer, param: Tensor) -> None:
    """ValueError unless a tensor is one of the optimizer's parameters."""
    if not any(param is each for group in optimizer.param_groups for each in group["params"]):
        raise ValueError(
            f"{call}: a tensor {tuple(param.shape)} that is none of this optimizer's parameters; "
            "call it on the optimizer that steps it, with its present Parameter"
        )


def indices_of(call: str, param: Tensor, rows: Any) -> Tensor:
    """The indices [n] of some rows of a parameter; ValueError for what names none."""
    try:
        if rows is not None:
            return torch.arange(len(param), device=param.device)[rows].reshape(-1)
    except (IndexError, TypeError):
        pass
    given = f"{rows.dtype} {[*rows.shape]}" if isinstance(rows, Tensor) else f"{rows!r:.100}"
    raise ValueError(
        f"{call}: rows={given}, but indices below {len(param)}, or a bool mask [{len(param)}], "
        "are needed"
    )


def check_slots(call: str, groups: list[dict[str, Any]], slots: Slots) -> None:
    """ValueError unless there are as many groups as slots were found for."""
    if len(groups) != len(slots):
        raise ValueError(
            f"{call}: {len(groups)} parameter groups, but {len(slots)} when it was upgraded; "
            "upgrade it again, by the same scheduler, where they change"
        )


def _check_bare(call: str, optimizer: Any) -> None:
    """Refuse a wrapper around an optimizer, and a function over its step."""
    kind = type(optimizer)
    within = getattr(optimizer, "optimizer", None) or getattr(optimizer, "_optimizer", None)
    if isinstance(within, Optimizer):
        raise TypeError(
            f"{call}: {kind.__name__} is a wrapper around a {type(within).__name__}, whose own "
            "step would be left out; give what is within, `.optimizer`, or upgrade it before the "
            "trainer prepares (Lightning, Fabric, Accelerate) its optimizers"
        )
    wrapped = vars(optimizer).get("step")
    if wrapped is not None and not hasattr(kind, "_base") and not of_scheduler(wrapped, kind):
        raise ValueError(
            f"{call}: a function has been put over this {kind.__name__}'s step, and it calls "
            "torch's; upgrade the optimizer first, and wrap its step then"
        )


def of_scheduler(step: Any, kind: type) -> bool:
    """Whether it is what a learning-rate scheduler puts over a step, to see that it is called."""
    if not hasattr(step, "_wrapped_by_lr_sched"):
        return False
    within = getattr(step, "__wrapped__", None)
    if within is None:  # torch 2.4 has it in the closure alone
        within = inspect.getclosurevars(step).nonlocals.get("func")
    return bare(within) is bare(getattr(kind, "step", None))


def _check_bits(call: str, optimizer: Any, owner: type | None, slots: Slots, moments: int) -> None:
    """ValueError where moments of 16 bits are not for an optimizer."""
    if moments == 32:
        return
    if owner is not None:
        raise ValueError(
            f"{call}: moments=16, but {type(optimizer).__name__} makes its own step, on moments "
            "of 32 bits; take torch.optim.Adam, or moments=32"
        )
    others = [at for at, (_, name) in enumerate(slots) if name is None]
    if 0 < len(others) < len(slots):
        shown = optimizer.param_groups[others[0]].get("name")
        raise ValueError(
            f"{call}: moments=16, but the group {shown!r} beside the Gaussians is "
            "none of theirs; give it an optimizer of its own, or take moments=32"
        )
    dtypes = {param.dtype for group in optimizer.param_groups for param in group["params"]}
    if dtypes - {torch.float32}:
        raise ValueError(f"{call}: moments=16 with {sorted(map(str, dtypes))}; use float32")


# -- parts, and the names of groups ----------------------------------------------------------------


def check_parts(call: str, parts: Any) -> Sequence[Part]:
    """The parts; TypeError for what is none, ValueError for two of one class."""
    if not isinstance(parts, (list, tuple)):
        raise TypeError(
            f"{call}: parts={parts!r}, but a list of parts is needed, parts=[Averaging()]"
        )
    for part in parts:
        if not isinstance(part, Part):
            cure = f"; write parts=[{part.__name__}()]" if isinstance(part, type) else ""
            if isinstance(part, (list, tuple)):
                cure = "; write a star before it, parts=[*DEFAULTS, Harmonics()]"
            raise TypeError(f"{call}: {part!r} in parts is no Part object{cure}")
        _check_part(f"{call}: {type(part).__name__}", part)
    kinds = [type(part) for part in parts]
    if all(any(isinstance(part, kind) for part in parts) for kind in (OwnFrame, Curvature)):
        raise ValueError(
            f"{call}: OwnFrame and Curvature cannot be combined, since Curvature's pairs are in "
            "world units and OwnFrame's steps are not; leave one of the two out"
        )
    for kind in kinds:  # what they note is saved by the class's name
        own = kind.__module__.startswith(f"{__package__}.")
        if sum(k.__name__ == kind.__name__ or (own and issubclass(k, kind)) for k in kinds) > 1:
            raise ValueError(
                f"{call}: {kind.__name__} is there twice in parts; give one part of each class"
            )
    return parts


def _check_part(call: str, part: Part) -> None:
    """Refuse a part that would never act, or not be saved."""
    check_choice(call, "during", part.during, (None, *Phase))
    names = part.names
    if names is not None and not (names and set(names) <= set(GAUSSIAN)):
        raise ValueError(f"{call}: names={names!r}, but a tuple of {', '.join(GAUSSIAN)} is needed")
    if not any(map(part.overrides, HOOKS)):
        raise ValueError(f"{call} has none of {', '.join(HOOKS)}, so that it would never act")
    if part.overrides("state_dict") and not part.learns:
        raise ValueError(f"{call} has a state_dict, but is not saved; set learns = True in it")


def named(optimizers: Any) -> list[tuple[str | None, Any]]:
    """The optimizers, each with its key in a dict."""
    if isinstance(optimizers, Mapping):
        return [(str(key), each) for key, each in optimizers.items()]
    if isinstance(optimizers, (list, tuple)):
        return [(None, each) for each in optimizers]
    return [(None, optimizers)]


def slots_of(key: str | None, optimizer: Any) -> Slots:
    """By group: the set of Gaussians and which of its parameters it holds."""
    groups = getattr(optimizer, "param_groups", [])
    found = [split_name(group.get("name")) for group in groups]
    if key is not None and len(groups) == 1 and found[0][1] is None:
        found = [split_name(key)]
    return found


def check_held_together(
    call: str, given: list[tuple[Any, Any]], slots: list[Slots], moments: int
) -> None:
    """ValueError unless optimizers, with their keys, hold Gaussians, each parameter once."""
    held = [slot for each in slots for slot in each if slot[1] is not None]
    if not held:
        names = [g.get("name") or key for key, o in given for g in o.param_groups]
        raise ValueError(
            f"{call}: no Gaussians among the groups {names}; name the groups, or the "
            f"keys of a dict, as one of {', '.join(GAUSSIAN_NAMES)} (other trainers' names too)"
        )
    for (_, optimizer), its in zip(given, slots, strict=True):
        if moments == 16 and not any(name for _, name in its):
            raise ValueError(
                f"{call}: moments=16, but the {type(optimizer).__name__} of "
                f"{len(optimizer.param_groups)} other groups holds no Gaussians; upgrade those "
                "of the Gaussians alone, or take moments=32"
            )
    doubled = sorted({name for name in held if held.count(name) > 1})
    if doubled:
        raise ValueError(
            f"{call}: {doubled[0][1]!r} is held twice; for two sets of Gaussians name "
            "the groups 'first#means', 'second#means', or make a scheduler for each"
        )


def line_of_unknown_groups(
    call: str, given: list[tuple[Any, Any]], slots: list[Slots]
) -> str | None:
    """What to say of groups that have a row for each Gaussian, under names that are not known."""
    groups = [
        (group["params"], group.get("name") or key, name)
        for (key, optimizer), its in zip(given, slots, strict=True)
        for group, (_, name) in zip(optimizer.param_groups, its, strict=True)
    ]
    rows = {len(params[0]) for params, _, name in groups if name and params}
    found = [
        str(shown)
        for params, shown, name in groups
        if name is None and any(p.dim() and len(p) > 1 and len(p) in rows for p in params)
    ]
    if not found:
        return None
    return (
        f"{call}: the groups {found} have a row for each Gaussian, but names that are not known, "
        f"so that plain Adam steps them; name them as one of {', '.join(GAUSSIAN_NAMES)} (other "
        "trainers' names too) if they hold these"
    )
