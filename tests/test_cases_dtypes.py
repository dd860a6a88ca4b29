"""Parameters of other dtypes than float32, and torch's default dtype at another value."""

from __future__ import annotations

import copy
import itertools
import warnings
from typing import Any

import pytest
import torch
from placed_training import ADAMS, ARMS, PRESETS, Training, distance
from torch.nn import Parameter

from opt3dgs_optim import DEFAULTS, Averaging, OwnFrame, Part, PhaseScheduler

DTYPES = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float64": torch.float64}
EPS: dict[str, Any] = {"adam": {"eps": 1e-4}}  # 1e-15 is 0 in float16
QUIET = [arm for arm in ARMS if "Noise" not in arm and arm != "everything"]  # draw nothing


def stop_of(arm: str) -> int:
    """Where an arm keeps most."""
    return 88 if arm in PRESETS else 40


@pytest.mark.parametrize("case", list(itertools.product(QUIET, DTYPES)))
def test_a_training_is_resumed(case: tuple[str, str]) -> None:
    """torch's load casts all floating state to the parameter's dtype; ours is cast back."""
    arm, dtype = case
    options: dict[str, Any] = {**EPS, "dtype": DTYPES[dtype]}
    first = Training(arm, **options).run(stop_of(arm))
    second = Training(arm, **options).resume(first)
    kept = {key: each for key, each in second.kept().items() if key.split(".", 1)[1] not in ADAMS}
    expected = first.kept()
    for key, each in kept.items():
        assert each.dtype == expected[key].dtype, key
        assert torch.equal(each, expected[key]), key
    second.run()
    assert distance(second.values(), first.run().values()) == 0.0


@pytest.mark.parametrize("road", ["load_state_dict", "upgrade"])
@pytest.mark.parametrize("case", list(itertools.product(QUIET, DTYPES)))
def test_a_checkpoint_that_a_stock_trainer_has_saved_again(
    case: tuple[str, str], road: str
) -> None:
    """Its load casts what parts keep to the parameter's dtype; they go on, and it is said."""
    arm, dtype = case
    options: dict[str, Any] = {**EPS, "dtype": DTYPES[dtype], "layout": "single"}
    first = Training(arm, **options).run(stop_of(arm))
    stock = Training(arm, upgrade=False, **options)
    stock.optimizers.load_state_dict(copy.deepcopy(first.optimizers.state_dict()))
    second = Training(arm, upgrade=road == "load_state_dict", **options)
    for name, value in first.values().items():
        second.splats[name].data.copy_(value)
    second.iteration = first.iteration
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        second.optimizers.load_state_dict(stock.optimizers.state_dict())
        if road == "upgrade":
            second.phases.upgrade(second.optimizers)
            second.upgraded = True
    kept = {key: each for key, each in second.kept().items() if key.split(".", 1)[1] not in ADAMS}
    expected = {key: each for key, each in first.kept().items() if key in kept}
    assert {key: each.dtype for key, each in kept.items()} == {
        key: each.dtype for key, each in expected.items()
    }
    for key, each in kept.items():
        # What the parameter's dtype holds has come: a history's pairs are of length 1.
        rounded = expected[key].to(DTYPES[dtype]).to(each.dtype)
        assert torch.equal(each, rounded) or not bool(rounded.isfinite().all()), key
    has_rounded = bool(kept) and dtype != "float64"
    assert has_rounded == any("was rounded to torch." in str(each.message) for each in said)
    second.run()
    assert all(bool(each.isfinite().all()) for each in second.values().values())
    if not has_rounded:
        assert distance(second.values(), first.run().values()) == 0.0


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("arm", ARMS)
def test_parameters_keep_their_dtype_and_stay_finite(arm: str, dtype: str) -> None:
    training = Training(arm, **EPS, dtype=DTYPES[dtype]).run()
    for value in training.values().values():
        assert value.dtype == DTYPES[dtype]
        assert bool(value.isfinite().all())


@pytest.fixture(scope="module")
def plain() -> dict[str, Training]:
    """Trainings with float32 as the default, which torch has."""
    return {arm: Training(arm).run() for arm in ARMS}


@pytest.mark.parametrize("arm", ARMS)
def test_nothing_follows_the_default_dtype(arm: str, plain: dict[str, Training]) -> None:
    expected = plain[arm]
    torch.set_default_dtype(torch.float64)
    try:
        training = Training(arm).run()
    finally:
        torch.set_default_dtype(torch.float32)
    kept = training.kept()
    for key, each in expected.kept().items():
        if not key.endswith(".step"):  # torch's own follows it
            assert kept[key].dtype == each.dtype, key
    assert distance(training.values(), expected.values()) == 0.0


@pytest.mark.parametrize("arm", QUIET)
def test_with_a_learning_rate_of_zero_nothing_moves(arm: str) -> None:
    """Georeferenced positions (sparkjsdev/spark #356) have more digits than float32 has."""
    training = Training(arm, dtype=torch.float64)
    start = torch.tensor([500000.123456789, 4500000.987654321, 12.3], dtype=torch.float64)
    with torch.no_grad():
        training.splats["means"].copy_(start.expand(12, 3))
    for optimizer in training.every:
        for group in optimizer.param_groups:
            group["lr"] = 0.0
    before = training.values()
    training.run()
    assert distance(training.values(), before) == 0.0


def test_the_mean_of_float64_positions_has_their_digits() -> None:
    p = Parameter(torch.full((4, 3), 4500000.987654321, dtype=torch.float64))
    phases = PhaseScheduler(300, parts=[Averaging()])
    adam = phases.upgrade(torch.optim.Adam([{"params": [p], "name": "xyz"}], lr=1e-6, eps=1e-15))
    for _ in range(300):
        p.grad = torch.ones_like(p)
        phases.observe(0.1)
        adam.step()
    # 300 steps of 1e-6, the last of which are averaged.
    assert float((p.detach() - 4500000.987654321).abs().max()) < 301e-6 + 1e-8


class Enlarging(Part):
    """Feeds so much more that half precision has no number for it once AMP has scaled it."""

    names = ("means",)

    def before(self, group: Any, param: Any, grad: Any, state: Any, course: Any) -> Any:
        return grad * 100.0


SCALED: dict[str, list[Part]] = {
    "defaults": [*DEFAULTS],
    "own frame": [OwnFrame(), *DEFAULTS],
    "a part that feeds more": [Enlarging()],
}


@pytest.mark.parametrize("parts", SCALED)
@pytest.mark.parametrize("grad", [2e-8, 1e-5, 0.1, 0.9])
def test_half_precision_under_a_scale(parts: str, grad: float) -> None:
    """The scale keeps small gradients, and nothing that parts feed overflows by it."""
    moved = []
    for each in ([], SCALED[parts]):
        values = {
            "means": torch.zeros(4, 3),
            "scales": torch.zeros(4, 3),
            "quats": torch.ones(4, 4),
        }
        values["scales"] += 3.0 if grad > 0.01 else 0.0
        splats = {name: Parameter(value.half()) for name, value in values.items()}
        adams = {
            n: torch.optim.Adam([p], lr=0.1, eps=1e-15 if grad < 1e-6 else 1e-4, fused=True)
            for n, p in splats.items()
        }
        phases = PhaseScheduler(100, parts=each)
        phases.upgrade(adams)
        scaler = torch.amp.GradScaler("cpu", init_scale=65536.0)  # pyright: ignore
        loss = splats["means"].float().sum() * grad
        scaler.scale(loss).backward()
        phases.observe(loss)
        scaler.step(adams["means"])
        scaler.update()
        state = adams["means"].state[splats["means"]]
        assert all(state[key].isfinite().all() for key in ("exp_avg", "exp_avg_sq"))
        moved.append(splats["means"].detach())
    assert moved[1].isfinite().all()
    assert moved[1].any() == moved[0].any()
    if parts == "defaults":
        assert torch.equal(moved[1], moved[0])
