"""What a part says that it keeps, and cannot be: refused at once, not when a run is resumed."""

from __future__ import annotations

import copy
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import Kept, Part, PhaseScheduler

NUMBER: dict[str, Any] = {"per": "parameter"}
TRAINING: dict[str, Any] = {"per": "training"}
WRONG_ALLOWED = [
    *(5.0, (0.0,), (0.0, 1.0, 2.0), (1.0, 0.0), (math.nan, 1.0), (0.0, math.nan), "01", (), {}),
    *(("0", "1"), (None, 1.0), (True, False), (-1j, 1.0), {0.0, 1.0}, range(2)),
]


@pytest.mark.parametrize("allowed", WRONG_ALLOWED, ids=str)
@pytest.mark.parametrize("per", ["row", "parameter", "training"])
def test_what_is_no_interval(per: Any, allowed: Any) -> None:
    with pytest.raises(ValueError, match=r"Kept: allowed=.* a pair of numbers"):
        Kept("n", per=per, allowed=allowed)


@pytest.mark.parametrize(
    "options",
    [
        *({**NUMBER, "initial": 5.0, "allowed": (0.0, 1.0)}, {"allowed": (0.5, 1.0)}),
        *({**TRAINING, "allowed": (1, 2)}, {"shape": (), "allowed": (-2.0, -1.0)}),
        *({**NUMBER, "initial": math.inf, "allowed": (0.0, 1.0)},),
        *({**NUMBER, "initial": math.nan, "allowed": (0.0, 1.0)},),
        *({**NUMBER, "initial": -1e-30, "allowed": (0.0, 1.0)},),
        *({**NUMBER, "dtype": torch.int64, "initial": 2**62 + 1, "allowed": (0, 2**62)},),
    ],
    ids=str,
)
def test_what_it_begins_with_is_allowed(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"Kept: allowed=.*, but what it begins with, initial="):
        Kept("n", **options)


def test_complex_numbers_have_no_order() -> None:
    with pytest.raises(
        ValueError, match=r"Kept: allowed=.*, but None is needed for torch\.complex"
    ):
        Kept("n", dtype=torch.complex64, allowed=(0.0, 1.0))


@pytest.mark.parametrize(
    ("dtype", "initial"),
    [
        *((torch.int64, each) for each in (0.5, math.nan, math.inf, 2**63, 10**400, 1j)),
        *((torch.uint8, each) for each in (300, 256, -1, Fraction(1, 2))),
        *((torch.int8, each) for each in (128, -129)),
        *((torch.bool, each) for each in (2, -1, 0.5)),
        *((torch.float32, each) for each in (1e39, -1e300, 1j, 10**400)),
        *((torch.float16, each) for each in (65_536.0, -70_000)),
        *((torch.bfloat16, each) for each in (3.4e38, 10**40)),
        *((torch.complex64, each) for each in (1e39j, 10**400)),
    ],
    ids=str,
)
@pytest.mark.parametrize("per", ["parameter", "training"])
def test_a_number_that_the_dtype_has_not(per: Any, dtype: torch.dtype, initial: Any) -> None:
    with pytest.raises(ValueError, match=r"Kept: initial=.*, but a number that torch.* has"):
        Kept("n", per=per, dtype=dtype, initial=initial)


@pytest.mark.parametrize(
    "shape",
    [(-1,), (3, -2), (0.5,), ("3",), (None,), (math.inf,), (math.nan,), (True,), ((3,),), 3, "3"],
    ids=str,
)
def test_what_is_no_shape(shape: Any) -> None:
    with pytest.raises(ValueError, match=r"Kept: shape=.* whole numbers"):
        Kept("n", shape=shape)
    kept = Kept("n", shape=lambda param: shape)
    with pytest.raises(ValueError, match=r"Kept: shape=.* whole numbers"):
        kept.make(torch.zeros(4, 3))


@pytest.mark.parametrize("shape", [(3,), (), [2], lambda param: ()], ids=["3", "()", "list", "fn"])
@pytest.mark.parametrize("per", ["parameter", "training"])
def test_a_number_has_no_shape(per: Any, shape: Any) -> None:
    with pytest.raises(ValueError, match=f"Kept: shape=.* and per='{per}', but None"):
        Kept("n", per=per, shape=shape)


# -- what can be -----------------------------------------------------------------------------------


def seen_and_resumed(kept: Kept) -> list[Any]:
    """What a part has kept, before and after its own checkpoint is loaded by another optimizer."""

    class Keeping(Part):
        names, keeps = ("means",), (kept,)
        seen: Tensor

        def before(self, group: Any, param: Tensor, grad: Tensor, state: Any, course: Any) -> Any:
            self.seen = state[kept.name].clone()
            return grad

    found, saved = list[Any](), None
    for _ in range(2):
        part, param = Keeping(), Parameter(torch.ones(4, 3))
        phases = PhaseScheduler(50, parts=[part])
        adam = phases.upgrade(Adam([{"params": [param], "name": "means"}]))
        if saved is not None:
            adam.load_state_dict(saved)
        param.grad = torch.ones_like(param)
        phases.observe(0.1)
        adam.step()
        saved = copy.deepcopy(adam.state_dict())
        found.append(part.seen)
    return found


def rest_of(param: Tensor) -> tuple[int, ...]:
    return tuple(param.shape[1:])


POSSIBLE: list[dict[str, Any]] = [
    *({}, {"shape": ()}, {"shape": (0,)}, {"shape": [2, 3]}, {"shape": (np.int64(2),)}),
    *({"allowed": (0.0, math.inf)}, {"allowed": (0, 0)}, {"allowed": [-math.inf, 0]}),
    *({**NUMBER, "initial": 0.1}, {**NUMBER, "initial": math.inf, "allowed": (0.0, math.inf)}),
    *({**TRAINING, "initial": -math.inf}, {**TRAINING, "initial": math.nan}),
    *({**NUMBER, "initial": np.float32(0.5), "allowed": (np.float32(0.5), np.int32(1))},),
    *({**NUMBER, "initial": Fraction(1, 2), "allowed": (Fraction(1, 3), Fraction(2, 3))},),
    *({**NUMBER, "dtype": torch.int64, "initial": 5.0, "allowed": (0, 2**62)},),
    *({**NUMBER, "dtype": torch.int64, "initial": -(2**63)},),
    *({**NUMBER, "dtype": torch.uint8, "initial": 255}, {**NUMBER, "dtype": torch.bool}),
    *({**NUMBER, "dtype": torch.bool, "initial": True},),
    *({**NUMBER, "dtype": torch.float16, "initial": -65_504},),
    *({**TRAINING, "dtype": torch.complex64, "initial": 1 - 2j},),
    *({"dtype": torch.int32, "shape": (), "allowed": (0, 9)}, {"shape": rest_of}),
]


@pytest.mark.parametrize("options", POSSIBLE, ids=[f"{i}" for i in range(len(POSSIBLE))])
def test_what_can_be_is_kept_and_resumed(options: dict[str, Any]) -> None:
    kept = Kept("n", **options)
    first, second = seen_and_resumed(kept)
    assert first.dtype == second.dtype == kept.dtype
    assert torch.equal(first, second) or bool(first.isnan() & second.isnan())
    if kept.per != "row":
        initial = options.get("initial", 0.0)
        assert torch.equal(first, kept.make(torch.ones(4, 3))) or math.isnan(initial)
        assert abs(first.item() - complex(initial)) < 1e-6 or not math.isfinite(abs(initial))


def test_a_declaration_is_plain() -> None:
    """Numbers of numpy's are Python's own from there on, and lists are tuples."""
    given: dict[str, Any] = {"shape": [np.int64(2), 3], "allowed": [np.float32(0), np.int16(4)]}
    kept = Kept("n", **given)
    assert kept.shape == (2, 3)
    assert kept.allowed == (0.0, 4)
    assert [*map(type, kept.allowed or ())] == [float, int]
    assert hash(kept) == hash(Kept("n", shape=(2, 3), allowed=(0.0, 4)))
