"""Every option of every public class: bad values are refused, by call, value and what is allowed.

The signatures are walked: an option without an entry here fails.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch

import opt3dgs_optim
from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    Averaging,
    ConstantMultiplier,
    Course,
    Curvature,
    Fading,
    FreshMoments,
    IsotropicNoise,
    LQNAdam,
    OutOfView,
    OwnFrame,
    PhaseScheduler,
    PositionNoise,
    SquaredLoss,
    backend_info,
)

TORCH = "checked, or taken as truth values, by torch.optim.Adam"
FREE = "any value is meaningful, or torch raises where it is used"
NOT_NUMBERS = [math.nan, math.inf, "0.5", None, True, [0.5]]
FLAGS = [1, 0, "yes", None, 0.0]
COUNTS = [-1, 2.0, "3", None, True, math.nan]
NOT_NAMES = ["means", 3, (), ("means", "camera"), (3,), ([],)]
CHOICES = ["no such choice", 1, None, True, ["raw"]]


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
    "amsgrad": TORCH,
    "adam": TORCH,
}
CURVATURE = {
    "history_size": [*COUNTS, 0, 17],
    "min_cosine": [*NOT_NUMBERS, -0.1, 1.0],
    "graft": FLAGS,
    "backend": CHOICES,
}
TABLE: dict[str, tuple[Callable[..., Any], type, dict[str, Any]]] = {
    "AWSGLD": (
        awsgld,
        AWSGLD,
        {
            **ADAM,
            "histogram": ["histogram", 0.75, True],
            "noise": ["noise", 0.1, True],
            "preconditioner": CHOICES,
        },
    ),
    "LQNAdam": (lqnadam, LQNAdam, {**ADAM, **CURVATURE}),
    "Curvature": (Curvature, Curvature, {**CURVATURE, "names": NOT_NAMES}),
    "FreshMoments": (FreshMoments, FreshMoments, {"settling": COUNTS}),
    "Averaging": (Averaging, Averaging, {}),
    "OutOfView": (OutOfView, OutOfView, {}),
    "OwnFrame": (
        OwnFrame,
        OwnFrame,
        {
            "rate": [*NOT_NUMBERS, 0.0, -1.0],
            "final": [*NOT_NUMBERS, 0.0, -1.0],
            "min_aspect": [*NOT_NUMBERS, -0.1, 1.1],
        },
    ),
    "SquaredLoss": (SquaredLoss, SquaredLoss, {}),
    "PhaseScheduler": (
        phases,
        PhaseScheduler,
        {
            "total_steps": [*COUNTS, 0],
            "switch": [-1, 11, 1.1, -0.1, math.nan, "late", None, True],
            "parts": [[1.0], ["annealing"], [Annealing], [None], [torch.optim.Adam]],
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
            "names": NOT_NAMES,
        },
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
    "PositionNoise": (
        lambda **options: PositionNoise(**{"gaussians": {}, **options}),
        PositionNoise,
        {
            "gaussians": FREE,  # read in each step; see below
            "scale": [*NOT_NUMBERS, -1.0],
            "during": FREE,
            "generator": FREE,
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
CALLS = {"LQNAdam": "Curvature"}  # whose options they are


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
    assert isinstance(error.value, TypeError if option == "parts" else ValueError)
    assert CALLS.get(call, call) in said
    wrong = f"parts has {value[0]!r}" if option == "parts" else f"{option}={value!r}"
    assert wrong in said
    assert any(word in said for word in ("needed", "needs", "initialised", "used with")), said


OF_TORCH = "params argument given to the optimizer should be"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Annealing(0.0), "Annealing: peak=0.0, but a finite number in (0"),
        (lambda: Fading(start=0.6, stop=0.5), "(0.6, 1.0]"),
        (lambda: Fading(names=("pose",)), "means, scales"),
        (lambda: Curvature(history_size=17), "1..16"),
        (lambda: Curvature(backend="triton"), "but 'auto' or 'cuda' or 'torch'"),  # pyright: ignore
        (lambda: backend_info("cpu", backend="triton"), "but 'auto' or 'cuda' or 'torch'"),  # pyright: ignore
        (lambda: awsgld(histogram=0.75), "histogram=0.75, but EnergyHistogram"),
        (lambda: awsgld(noise=0.1), "noise=0.1, but IsotropicNoise or Pos"),
        (lambda: lqnadam(differentiable=True), "LQNAdam: differentiable=True, but curvature pairs"),
        (lambda: phases(process_group="world"), "init_process_group first"),
        (lambda: AWSGLD(torch.ones(3)), OF_TORCH),
        (lambda: LQNAdam(torch.ones(3)), OF_TORCH),
    ],
)
def test_what_is_allowed_is_said(make: Callable[[], Any], said: str) -> None:
    with pytest.raises((ValueError, TypeError), match=re.escape(said)):
        make()


def test_unknown_options_are_refused() -> None:
    for make, _, _ in TABLE.values():
        with pytest.raises(TypeError, match=r"histroy|takes no arguments"):
            make(histroy=1)


def test_a_backend_that_there_is_not() -> None:
    for value in CHOICES:
        with pytest.raises(ValueError, match="backend_info: backend="):
            backend_info("cpu", backend=value)  # pyright: ignore[reportArgumentType]


# Bases that nobody constructs, the enum, and those that have such tests of their own.
OTHERS = {"Kept", "Course", "Part", "Phase", "StepAdam", "EnergyHistogram", "RunLog"}


def test_every_public_class_is_here() -> None:
    public = {name: getattr(opt3dgs_optim, name) for name in opt3dgs_optim.__all__}
    classes = {name for name, value in public.items() if inspect.isclass(value)}
    assert classes == set(TABLE) | OTHERS
    assert PhaseScheduler.__mro__[1] is Course
