"""Checks of a checkpoint before anything of it is loaded: all of it is taken, or nothing."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

from torch import Tensor
from torch.optim import Optimizer

ADAM_KEYS = ("step", "exp_avg", "exp_avg_sq")
ROW_KEYS = ("history", "epoch")  # curvature pairs, which must be of the parameter's own rows


def check_optimizer_state(call: str, state_dict: Any, groups: list[dict[str, Any]]) -> None:
    """ValueError unless `state_dict` is that of an Adam over parameters like those in `groups`.

    The number of rows may differ: some trainers load the optimizer first, the points afterwards.
    """
    for key, kind in (("state", Mapping), ("param_groups", list)):
        if not isinstance(state_dict, Mapping) or not isinstance(state_dict.get(key), kind):
            found = list(state_dict) if isinstance(state_dict, Mapping) else state_dict
            raise ValueError(
                f"{call}: {found!r}, but an optimizer's state_dict with 'state' and "
                "'param_groups' is needed"
            )
    saved = state_dict["param_groups"]
    if not all(isinstance(g, Mapping) and isinstance(g.get("params"), list) for g in saved):
        raise ValueError(f"{call}: a param_group without 'params'")
    ours, theirs = [[len(g["params"]) for g in each] for each in (groups, saved)]
    if ours != theirs:
        raise ValueError(
            f"{call}: groups of {theirs} parameters, but this optimizer has groups of {ours}"
        )
    for group, other in zip(groups, saved, strict=True):
        for param, key in zip(group["params"], other["params"], strict=True):
            _check_param_state(call, param, state_dict["state"].get(key, {}))


def _check_param_state(call: str, param: Tensor, state: Any) -> None:
    if not isinstance(state, Mapping):
        raise ValueError(f"{call}: the state of a parameter is {state!r}, but a dict is needed")
    missing = [key for key in ADAM_KEYS if key not in state] if state else []
    if missing:
        raise ValueError(
            f"{call}: keys {missing} are missing among {list(state)}; the state of an Adam is "
            "needed"
        )
    for key in ADAM_KEYS[1:] if state else ():
        value = state[key]
        if not isinstance(value, Tensor) or value.shape[1:] != param.shape[1:]:
            shape = tuple(value.shape) if isinstance(value, Tensor) else value
            raise ValueError(
                f"{call}: {key} has shape {shape}, but the parameter has {tuple(param.shape)}"
            )


def drop_foreign_rows(call: str, optimizer: Optimizer) -> None:
    """Drop curvature pairs of another number of rows than their parameter's, and say so."""
    for group in optimizer.param_groups:
        for param in group["params"]:
            state, rows = optimizer.state.get(param, {}), param.shape[0] if param.dim() else 1
            foreign = [k for k in ROW_KEYS if k in state and state[k].shape[0] != rows]
            if not foreign:
                continue
            warnings.warn(
                f"{call}: curvature pairs of {state[foreign[0]].shape[0]} rows for a parameter of "
                f"{rows}: dropped, and collected anew",
                stacklevel=3,
            )
            for key in ROW_KEYS:
                state.pop(key, None)


def check_keys(call: str, state: Any, needed: tuple[str, ...]) -> None:
    """ValueError unless `state` is a mapping with at least the keys `needed`."""
    if not isinstance(state, Mapping):
        raise ValueError(f"{call}: {state!r}, but a dict is needed")
    missing = sorted(set(needed) - set(state))
    if missing:
        raise ValueError(f"{call}: keys {missing} are missing")


def check_whole(call: str, name: str, value: Any) -> int:
    """`value` as an int; ValueError unless it is a whole number from 0 on."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value >= 0:
        raise ValueError(f"{call}: {name}={value!r}, but a whole number from 0 on is needed")
    if math.isinf(value) or value != int(value):
        raise ValueError(f"{call}: {name}={value!r}, but a whole number from 0 on is needed")
    return int(value)


def check_floats(call: str, name: str, value: Any, length: int | None = None) -> list[float]:
    """`value`; ValueError unless it is a list of numbers, not NaN, of this length."""
    good = isinstance(value, list) and all(
        isinstance(v, (int, float)) and not math.isnan(v) for v in value
    )
    if not good or (length is not None and len(value) != length):
        many = "" if length is None else f"{length} "
        raise ValueError(f"{call}: {name}={value!r}, but a list of {many}numbers is needed")
    return value


def check_histogram_state(call: str, state: Any, num_partitions: int) -> None:
    """ValueError unless `state` is an EnergyHistogram's, of this or an older version."""
    check_keys(call, state, ("num_observed", "weights", "scalars"))
    check_whole(call, "num_observed", state["num_observed"])
    weights = state["weights"]
    if not isinstance(weights, list) or len(weights) != num_partitions:
        found = len(weights) if isinstance(weights, list) else repr(weights)
        raise ValueError(
            f"{call}: {found} weights, but this histogram has num_partitions={num_partitions}"
        )
    positive = all(isinstance(w, float) and math.isfinite(w) and w > 0 for w in weights)
    if not positive or abs(math.fsum(weights) - 1) > 1e-6:
        raise ValueError(f"{call}: weights must be positive with sum 1")
    low, width, tau, count, nu = check_floats(call, "scalars", state["scalars"], 5)
    if not all(map(math.isfinite, (low, nu))) or not (0 < width < math.inf and count >= 0):
        raise ValueError(f"{call}: scalars={state['scalars']}, but finite ones are needed")
    if not 0 <= tau < math.inf:
        raise ValueError(f"{call}: temperature={tau}, but a finite one from 0 on is needed")
    for name in ("recent", "nu_moments", "smooth"):
        if name in state:
            check_floats(call, name, state[name], 4)
    if "views" in state:
        check_keys(f"{call}: views", state["views"], ("views", "means", "weights"))
        many = len(state["views"]["views"])
        for name in ("means", "weights"):
            check_floats(call, f"views[{name!r}]", state["views"][name], many)
