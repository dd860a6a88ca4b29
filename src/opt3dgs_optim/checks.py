"""Option checks whose messages name the call, the value and what is allowed."""

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import torch


def as_float(value: Any) -> float:
    """A real number as a float; infinity for one beyond all floats, NaN for what is no number."""
    if not isinstance(value, Real) or isinstance(value, bool):  # numpy's scalars are numbers, too
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf


def check_number(
    call: str,
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    open_low: bool = False,
    open_high: bool = False,
) -> float:
    """Return `value` as a float, or raise ValueError if it lies outside the interval."""
    found = as_float(value)
    outside = not low <= found <= high or not math.isfinite(found)
    if outside or (open_low and found == low) or (open_high and found == high):
        if high == math.inf:
            allowed = "" if low == -math.inf else f" {'above' if open_low else 'at least'} {low}"
        else:
            allowed = f" in {'(' if open_low else '['}{low}, {high}{')' if open_high else ']'}"
        raise ValueError(f"{call}: {name}={value!r}, but a finite number{allowed} is needed")
    return found


def check_count(call: str, name: str, value: Any, low: int, high: int | None = None) -> int:
    """Return `value` as an int, or raise ValueError unless it is an integer in low..high."""
    # An int is known at once; the other question, numpy's integers, takes a microsecond.
    whole = type(value) is int or (isinstance(value, Integral) and not isinstance(value, bool))
    count = int(value) if whole else low - 1
    if count < low or (high is not None and count > high):
        allowed = f"at least {low}" if high is None else f"in {low}..{high}"
        raise ValueError(f"{call}: {name}={value!r}, but an integer {allowed} is needed")
    return count


def check_energy(
    call: str, name: str, value: Any, dtype: torch.dtype = torch.float32
) -> torch.Tensor:
    """Return a loss as a detached tensor, 0-d, or raise ValueError unless it is one real number.

    A tensor keeps its dtype and its device. Any other number gets `dtype` and the CPU, whatever
    torch's defaults are.
    """
    if isinstance(value, torch.Tensor):
        if value.numel() == 1 and not value.is_complex():
            value = value.reshape(()) if value.dim() else value
            return value.detach() if value.requires_grad else value
        got = f"a tensor of shape {tuple(value.shape)} and {value.dtype}"
    else:
        got = repr(value)
        try:
            if not isinstance(value, (str, bytes)):  # numpy's scalars, too
                return torch.tensor(float(value), dtype=dtype, device="cpu")
        except (TypeError, ValueError):
            pass
    raise ValueError(f"{call}: {name}={got}, but one real number is needed")


def check_choice(call: str, name: str, value: Any, allowed: Sequence[Any] = (True, False)) -> Any:
    """Return `value`, or raise ValueError unless it is one of `allowed`, and of its type."""
    if not any(isinstance(value, type(each)) and value == each for each in allowed):
        listed = " or ".join(map(repr, allowed))
        raise ValueError(f"{call}: {name}={value!r}, but {listed} is needed")
    return value


def set_options(part: Any, **checked: Any) -> None:
    """Put checked options in the place of those that were given, in a frozen dataclass, too.

    What is checked may be a number of numpy, a fraction or another kind, which torch does not take
    everywhere.
    """
    for name, value in checked.items():
        object.__setattr__(part, name, value)


def check_interval(call: str, name: str, value: Any) -> tuple[float, float]:
    """Return `value` as (low, high) floats, or raise ValueError unless low < high, finite."""
    pair = isinstance(value, (tuple, list)) and len(value) == 2
    if not pair:
        raise ValueError(f"{call}: {name}={value!r}, but a pair (low, high) is needed")
    low, high = (check_number(call, f"{name}[{i}]", value[i]) for i in (0, 1))
    if low >= high or not math.isfinite(high - low):
        raise ValueError(f"{call}: {name}={value!r}, but low < high, a finite way apart, is needed")
    return low, high
