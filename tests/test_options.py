"""Every option of every public class: bad values are refused, by call, value and what is allowed.

The signatures are walked: an option without an entry here fails.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from opt3dgs_optim.curvature import history_from_pairs
from opt3dgs_optim.multiplier import ConstantMultiplier
from opt3dgs_optim.noise import CovarianceNoise, IsotropicNoise

from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    EnergyHistogram,
    Fading,
    LQNAdam,
    PhaseScheduler,
    Pooling,
    backend_info,
    two_loop,
)
from opt3dgs_optim.lqnadam import CurvatureOptions

TORCH = "checked, or taken as truth values, by torch.optim.Adam"
FREE = "any value is meaningful, or torch raises where it is used"
NOT_NUMBERS = [math.nan, math.inf, "0.5", None, True, [0.5]]
FLAGS = [1, 0, "yes", None, 0.0]
COUNTS = [-1, 2.0, "3", None, True, math.nan]
NOT_NAMES = ["means", 3, (), ("means", "camera"), (3,), ([],)]
CHOICES = ["no such choice", 1, None, True, ["raw"]]
INTERVALS = [(1.0, 0.0), (0.0, 0.0), (0.0,), (0.0, math.inf), (math.nan, 1.0), 0.5, "wide"]


def point() -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.ones(2, 3))


def awsgld(**options: Any) -> AWSGLD:
    return AWSGLD([point()], **options)


def lqnadam(**options: Any) -> LQNAdam:
    return LQNAdam([point()], **options)


def phases(**options: Any) -> PhaseScheduler:
    return PhaseScheduler(**{"total_steps": 10, **options})


def isotropic(**options: Any) -> IsotropicNoise:
    return IsotropicNoise(**({"temperature": None, **options} if options else {}))


ADAM = {
    "params": [[], [1.0], "means"],
    "lr": [-1.0],
    "betas": [(1.0, 0.9), (0.9, 1.0), (-0.1, 0.9)],
    "eps": [-1.0],
    "weight_decay": [-1.0],
    **dict.fromkeys(("amsgrad", "maximize", "capturable", "differentiable"), TORCH),
    "foreach": TORCH,
    "fused": TORCH,
}
CURVATURE = {
    "history_size": [*COUNTS, 0, 17],
    "pairs": CHOICES,
    "epoch_steps": [5],  # without pairs="epoch"; with it, below
    "min_cosine": [*NOT_NUMBERS, -0.1, 1.0],
    "powell": FLAGS,
    "graft": FLAGS,
    "gamma_clamp": [*INTERVALS, (-1.0, 1.0)],
    "pair_dtype": CHOICES,
    "backend": CHOICES,
}
TABLE: dict[str, tuple[Callable[..., Any], type, dict[str, Any]]] = {
    "EnergyHistogram": (
        EnergyHistogram,
        EnergyHistogram,
        {
            "num_partitions": [*COUNTS, 0, 2],
            "energy_range": INTERVALS,
            "zeta": [*NOT_NUMBERS, -0.1, 1.1, 0.0],  # 0.0: with an automatic temperature
            "temperature": [math.nan, math.inf, None, True, -1.0, "hot"],
            "warmup": [*COUNTS, 3],  # 3: with an automatic range
            "step_size": [math.nan, math.inf, None, True, 0.0, 1.0, -1.0, "fast"],
            "slope": CHOICES,
            "slope_radius": [*COUNTS, 0],
            "clamp": INTERVALS,
            "energy": CHOICES,
            "ema_decay": [*NOT_NUMBERS, -0.1, 1.0],
            "floor": [*NOT_NUMBERS, 0.0, -1.0, 0.006],
            "process_group": ["world", 3],
        },
    ),
    "AWSGLD": (
        awsgld,
        AWSGLD,
        {
            **ADAM,
            "histogram": ["histogram", 0.75, True],
            "noise": ["noise", 0.1, True],
            "preconditioner": CHOICES,
            "skip_nonfinite": FLAGS,
        },
    ),
    "LQNAdam": (lqnadam, LQNAdam, {**ADAM, **CURVATURE, "skip_nonfinite": FLAGS}),
    "CurvatureOptions": (CurvatureOptions, CurvatureOptions, CURVATURE),
    "PhaseScheduler": (
        phases,
        PhaseScheduler,
        {
            "total_steps": [*COUNTS, 0],
            "switch": [-1, 11, 1.1, -0.1, math.nan, "late", None, True],
            "multiplier": ["nu", True, [1.5], math.nan],
            "curvature": [5, True, {"history_size": 5}],
            "squared_loss": FLAGS,
            "reset_moments": ["always", None, 1],
            "noise_scale": [*NOT_NUMBERS, -1.0],
            "noise_in_exploitation": FLAGS,
            "annealing": [2.0, True, "annealing", {"peak": 2.0}],
            "fading": [0.2, True, {"share": 0.2}],
            "pooling": [True, "means", ("means",)],
            "adaptive": FLAGS,
            "log": ["run.jsonl", 1],
            "process_group": ["world", 3],
        },
    ),
    "Annealing": (
        Annealing,
        Annealing,
        {
            "peak": [*NOT_NUMBERS, 0.0, -1.0],
            "opacity_peak": [*NOT_NUMBERS, 0.0, -1.0],
            "final": [*NOT_NUMBERS, 0.0, -1.0],
        },
    ),
    "Pooling": (
        Pooling,
        Pooling,
        {"names": NOT_NAMES},
    ),
    "Fading": (
        Fading,
        Fading,
        {
            "share": [*NOT_NUMBERS, 0.0, 1.1],
            "exp_avg": [*NOT_NUMBERS, -0.1, 1.1],
            "exp_avg_sq": [*NOT_NUMBERS, -0.1, 1.1],
            "events": [*COUNTS, 0],
            "start": [*NOT_NUMBERS, -0.1, 1.1],
            "stop": [*NOT_NUMBERS, 0.03, 1.1],
            "seed": COUNTS,
            "names": NOT_NAMES,
        },
    ),
    "ConstantMultiplier": (
        lambda **options: ConstantMultiplier(**{"value": 1.5, **options}),
        ConstantMultiplier,
        {"value": NOT_NUMBERS, "warmup": COUNTS},
    ),
    "IsotropicNoise": (
        isotropic,
        IsotropicNoise,
        {
            "temperature": [*NOT_NUMBERS, -1.0],
            "std": [*NOT_NUMBERS, -1.0],
            "generator": FREE,
        },
    ),
    "CovarianceNoise": (
        lambda **options: CovarianceNoise(**{"gaussians": {}, **options}),
        CovarianceNoise,
        {
            "gaussians": FREE,  # read in each step; see below
            "scale": [*NOT_NUMBERS, -1.0],
            "generator": FREE,
            "backend": CHOICES,
        },
    ),
}
BAD = [
    pytest.param(call, option, value, id=f"{call}({option}={value!r})")
    for call, (_, _, options) in TABLE.items()
    for option, values in options.items()
    if isinstance(values, list)
    for value in values
]
# What torch says itself, in its own words and error types.
TORCHS = {"params", "lr", "betas", "eps", "weight_decay"}
CALLS = {"CurvatureOptions": "LQNAdam"}  # the class that a user knows


@pytest.mark.parametrize("call", TABLE)
def test_every_option_has_an_entry(call: str) -> None:
    _, cls, options = TABLE[call]
    assert set(inspect.signature(cls).parameters) == set(options)


@pytest.mark.parametrize(("call", "option", "value"), BAD)
def test_bad_value(call: str, option: str, value: Any) -> None:
    make = TABLE[call][0]
    with pytest.raises((ValueError, TypeError)) as error:
        make(**{option: value})
    if option in TORCHS:
        return
    said = str(error.value)
    assert isinstance(error.value, ValueError)
    assert CALLS.get(call, call) in said
    assert option in said
    assert any(text in said for text in (repr(value), *map(repr, pieces(value)))), said
    assert any(word in said for word in ("needed", "needs", "initialised", "used with")), said


def pieces(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (tuple, list)) else []


@pytest.mark.parametrize("value", [0, -1, 2.5, None, True, "30"])
def test_epoch_pairs_need_their_steps(value: Any) -> None:
    for make in (CurvatureOptions, lqnadam):
        with pytest.raises(ValueError, match="LQNAdam: epoch_steps") as error:
            make(pairs="epoch", epoch_steps=value)
        assert repr(value) in str(error.value)


def test_unknown_options_are_refused() -> None:
    for make, _, _ in TABLE.values():
        with pytest.raises(TypeError, match="histroy"):
            make(histroy=1)


def test_gaussians_that_do_not_fit_are_named() -> None:
    means = torch.ones(2, 3)
    with pytest.raises(ValueError, match=r"CovarianceNoise.*scales.*quats.*opacities"):
        CovarianceNoise({}).add_to(means, 0.1)
    short = {"scales": torch.ones(1, 3), "quats": torch.ones(1, 4), "opacities": torch.ones(1)}
    with pytest.raises(ValueError, match="CovarianceNoise: 1 scales for 2 means"):
        CovarianceNoise(lambda: short).add_to(means, 0.1)


def test_functions() -> None:
    for value in CHOICES:
        with pytest.raises(ValueError, match="backend_info: backend="):
            backend_info("cpu", backend=value)  # pyright: ignore[reportArgumentType]
    history = history_from_pairs(torch.ones(2, 4, 3), torch.ones(2, 4, 3))
    with pytest.raises(ValueError, match="two_loop: history has shape"):
        two_loop(torch.ones(5, 3), history, 2)
    with pytest.raises(ValueError, match="two_loop: history has shape"):
        two_loop(torch.ones(4, 3), history, 5)


def test_every_public_name_is_here() -> None:
    import opt3dgs_optim

    classes = {
        name for name in opt3dgs_optim.__all__ if inspect.isclass(getattr(opt3dgs_optim, name))
    }
    assert classes - set(TABLE) == {"BackendInfo", "Phase", "RunLog"}  # RunLog: tests/runs
