"""Adam's moments at 16 bits a number: what a code means, and how a number becomes one.

    first moment    the upper half of its float32: sign, 8 bits of exponent, 7 of mantissa
    second moment   8 bits of exponent and 8 of mantissa of its float32, which has no sign

Both reach as far as float32 does, and need no scale of a row or of a tensor, so that rows can be
cut, copied and appended by trainers that know nothing of it. A code of 0 is the number 0. Where the
second moment is 0 the first one is, too: the row has no history.

A number lies between two codes, of which it takes the upper one with the chance that makes the mean
right (stochastic rounding): Adam changes its averages by a thousandth in a step, a quarter of the
way between two codes. The chances are an integer hash of the number's place and of Adam's step, so
that a resumed run repeats them, and every device and execution has the same.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

CODES = torch.int16
MOMENTS = ("exp_avg", "exp_avg_sq")  # torch's names
NEAREST = 0x80004000  # in the place of chances: a half, for both moments


def decoded(exp_avg: Tensor, exp_avg_sq: Tensor) -> tuple[Tensor, Tensor]:
    """The moments, float32, of their codes [N, ...] int16."""
    second = (exp_avg_sq.to(torch.int32) & 0xFFFF) << 15
    first = (exp_avg.to(torch.int32) << 16).mul_(second != 0)
    return first.view(torch.float32), second.view(torch.float32)


def encode(
    first: Tensor, second: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, chance: Tensor | int
) -> None:
    """Write the codes of moments.

    Args:
        first, second: [n, ...] float32.
        exp_avg, exp_avg_sq: [n, ...] int16, written.
        chance: of each number, as of `chances`; `NEAREST`: to the nearest code.
    """
    codes = (second.contiguous().view(torch.int32) + (chance & 0x7FFF)) >> 15
    exp_avg_sq.copy_(codes)  # the upper half of 16 bits wraps around to negative ones
    exp_avg.copy_((first.contiguous().view(torch.int32) + ((chance >> 16) & 0xFFFF)) >> 16)


def chances(like: Tensor, key: int, at: int) -> Tensor:
    """`step.mixed` of the places of numbers, in 32 bits with a sign.

    Args:
        like: [n, ...], the numbers.
        key: 32 bits, another in each step.
        at: the place of the first number in its parameter.
    """
    x = torch.arange(like.numel(), dtype=torch.int32, device=like.device)
    x = x.add_(signed(at)).bitwise_xor_(signed(key))
    x = x.bitwise_xor_((x >> 16) & 0xFFFF).mul_(0x7FEB352D)
    x = x.bitwise_xor_((x >> 15) & 0x1FFFF).mul_(signed(0x846CA68B))
    return x.bitwise_xor_((x >> 16) & 0xFFFF).view(like.shape)


def signed(number: int) -> int:
    """32 bits as an int32, which has a sign."""
    return (number + 2**31) % 2**32 - 2**31


# -- the state of a parameter ----------------------------------------------------------------------


def as_numbers(state: dict[str, Any]) -> dict[str, Any]:
    """A parameter's state with float32 moments, on the host, in the place of codes.

    A checkpoint is written from the host; on a device they would need four times the codes' memory.
    """
    if "exp_avg" not in state:
        return state
    codes = [state[key].to("cpu", CODES) for key in MOMENTS]
    return {**state, **dict(zip(MOMENTS, decoded(codes[0], codes[1]), strict=True))}


def as_codes(state: dict[str, Any]) -> None:
    """Have the codes of a parameter's moments as integers again.

    An edit of rows, and torch's loading, make them float32, with the same values.
    """
    for key in MOMENTS:
        if state[key].dtype != CODES:
            state[key] = state[key].to(CODES)


@torch.no_grad()
def recode(state: dict[str, Any], coded: bool, bits: int, dtype: torch.dtype) -> bool:
    """Have moments, which are codes or not, at so many bits; whether there are any."""
    if "exp_avg" not in state:
        return False
    if coded:
        as_codes(state)
    first, second = (state[key] for key in MOMENTS)
    if coded and bits == 32:
        first, second = (each.to(dtype) for each in decoded(first, second))
    elif not coded and bits == 16:
        codes = torch.empty_like(first, dtype=CODES), torch.empty_like(second, dtype=CODES)
        encode(first, second, *codes, NEAREST)
        first, second = codes
    state["exp_avg"], state["exp_avg_sq"] = first, second
    return True
