"""The one check of what is loaded, before anything is changed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor

from opt3dgs_optim.checks import check_count, check_number
from opt3dgs_optim.contract import REFUSED
from opt3dgs_optim.lane import BEGAN, KEPT, MEAN, MOMENTS, RESIDUE
from opt3dgs_optim.moments import CODES


def check_tensors(call: str, state_dict: Any, groups: list[dict[str, Any]]) -> None:
    """ValueError unless a state dict has torch's form, for these groups, and fitting tensors."""
    if not isinstance(state_dict, Mapping) or not {"state", "param_groups"} <= set(state_dict):
        raise ValueError(
            f"{call}: needs a dict with 'state' and 'param_groups', as state_dict() has"
        )
    saved, states = state_dict["param_groups"], state_dict["state"]
    if not isinstance(saved, list) or len(saved) != len(groups):
        raise ValueError(
            f"{call}: {len(saved) if isinstance(saved, list) else repr(saved)} parameter groups "
            f"were saved, but this optimizer has {len(groups)}"
        )
    known: set[int] = set()
    for at, (group, own) in enumerate(zip(saved, groups, strict=True)):
        check_group(f"{call}: group {at}", group, len(own["params"]))
        known.update(group["params"])
    if not isinstance(states, Mapping) or not set(states) <= known:
        raise ValueError(f"{call}: the state is not of the parameters {sorted(known)}")
    for index, state in states.items():
        check_moments(f"{call}: parameter {index}", state)


def check_group(call: str, group: Any, count: int) -> None:
    """ValueError unless a saved group has so many parameters, and options that Adam here takes."""
    params = group.get("params") if isinstance(group, Mapping) else None
    if not isinstance(params, list) or len(params) != count:
        raise ValueError(f"{call} has params={params!r}, but a list of {count} is needed")
    if not all(type(each) is int for each in params):
        raise ValueError(f"{call} has params={params!r}, but integers are needed")
    for option in REFUSED:
        if group.get(option):
            raise ValueError(f"{call} has {option}={group[option]!r}, which is not taken")
    betas = group.get("betas")
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise ValueError(f"{call} has betas={betas!r}, but two numbers are needed")
    numbers = {name: group.get(name) for name in ("lr", "eps", "weight_decay")}
    for name, value in {**numbers, "betas[0]": betas[0], "betas[1]": betas[1]}.items():
        check_number(call, name, value, 0.0, 1.0 if "betas" in name else math.inf)


def check_moments(call: str, state: Any) -> None:
    """ValueError unless the state of a parameter is empty, or Adam's with what is kept for rows."""
    if not isinstance(state, Mapping):
        raise ValueError(f"{call} has the state {state!r}, but a dict is needed")
    if not state:
        return
    missing = [key for key in ("step", *MOMENTS) if key not in state]
    if missing:
        raise ValueError(f"{call} has no {missing[0]}, but {sorted(map(str, state))}")
    check_count(call, "step", whole(state["step"]), 0)
    shapes: dict[str, tuple[int, ...]] = {}
    for key in (*MOMENTS, *KEPT):
        value: Any = state.get(key)
        if value is None and key in KEPT:
            continue
        if not isinstance(value, Tensor) or not (
            value.is_floating_point() or (key in (*MOMENTS, RESIDUE) and value.dtype == CODES)
        ):
            raise ValueError(f"{call} has {key}={value!r}, but a tensor of real numbers is needed")
        shapes[key] = tuple(value.shape)
    one = shapes["exp_avg"]
    if any(shapes.get(key, one) != one for key in ("exp_avg_sq", MEAN, RESIDUE)) or any(
        shapes.get(key, one)[:1] != one[:1] for key in KEPT
    ):
        raise ValueError(f"{call} has shapes {shapes}, but the same rows are needed in all")
    means = (MEAN in shapes) + (RESIDUE in shapes)
    if means != (BEGAN in shapes) or shapes.get(BEGAN, one[:1]) != one[:1]:
        raise ValueError(f"{call} has shapes {shapes}, but {BEGAN} needs a number for each row")


def whole(step: Any) -> Any:
    """Adam's count of steps, a tensor or a number, as an int; anything else as it is."""
    value = step.item() if isinstance(step, Tensor) and step.numel() == 1 else step
    return int(value) if isinstance(value, float) and value.is_integer() else value
