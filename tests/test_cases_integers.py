"""Integers of numpy are integers, wherever one is asked for; what is none is refused as before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import Parameter
from torch.utils._pytree import tree_leaves

from opt3dgs_optim import (
    Annealing,
    ConstantMultiplier,
    Curvature,
    EnergyHistogram,
    Fading,
    FreshMoments,
    IsotropicNoise,
    LQNAdam,
    OwnFrame,
    Part,
    PhaseScheduler,
    PositionNoise,
    paper_parts,
)
from opt3dgs_optim.lbfgs import two_loop


def points() -> Parameter:
    return Parameter(torch.ones(4, 3))


OPTIONS: dict[str, tuple[Callable[[Any], Any], int]] = {
    "total_steps": (lambda n: PhaseScheduler(n).total_steps, 60),
    "switch": (lambda n: PhaseScheduler(60, n).switch_step, 40),
    "total_steps of paper": (lambda n: PhaseScheduler.paper(n).total_steps, 60),
    "switch of paper": (lambda n: PhaseScheduler.paper(60, n).switch_step, 40),
    "paper_parts": (lambda n: len(paper_parts(n)) and n, 60),
    "warmup": (lambda n: EnergyHistogram(warmup=n).warmup, 10),
    "warmup of paper": (lambda n: EnergyHistogram.paper(warmup=n).warmup, 10),
    "num_partitions": (lambda n: EnergyHistogram(n).num_partitions, 48),
    "warmup of a constant": (lambda n: ConstantMultiplier(1.0, n).warmup, 10),
    "history_size": (lambda n: Curvature(n).history_size, 3),
    "history_size of LQNAdam": (
        lambda n: LQNAdam([points()], history_size=n) and n,
        3,
    ),
    "events": (lambda n: Fading(events=n).events, 100),
    "seed": (lambda n: Fading(seed=n).seed, 3),
    "settling": (lambda n: FreshMoments(n).settling, 10),
}
KINDS = (np.int64, np.int32, np.int16, np.uint8, np.uint64)


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_an_integer_of_numpy_is_one(option: str, kind: Any) -> None:
    make, number = OPTIONS[option]
    found = make(kind(number))
    assert found == number
    assert isinstance(found, (int, np.integer))


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("value", [True, np.True_, "3", None, [3], np.array([3]), np.nan, 2.5])
def test_what_is_no_integer_is_refused(option: str, value: Any) -> None:
    if value == 2.5 and "switch" in option:
        value = -0.5  # a share of the run
    if value is None and option == "num_partitions":
        return  # as many as usual
    with pytest.raises(ValueError, match="needed"):
        OPTIONS[option][0](value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_trainers_own_iteration_may_be_numpys(kind: Any) -> None:
    ends = []
    for count in (int, kind):
        p = points()
        phases = PhaseScheduler(count(60), count(40), parts=[Fading(start=0.0), Curvature()])
        adam = phases.upgrade(torch.optim.Adam([{"params": [p], "name": "means"}], lr=0.01))
        for i in range(60):
            p.grad = p.detach() * torch.tensor([1.0, 2.0, 3.0])
            phases.observe(0.1, iteration=count(i))
            adam.step()
        ends.append(p.detach().clone())
        # What is saved is plain, so that torch.load(weights_only=True) takes it.
        plain = tree_leaves(adam.state_dict())
        assert not any(isinstance(each, np.generic) for each in plain)
    assert torch.equal(ends[0], ends[1])


@pytest.mark.parametrize("kind", KINDS)
def test_the_recursions_history_size(kind: Any) -> None:
    grad, history = torch.ones(4, 3), torch.zeros(4, 5, 8)
    assert torch.equal(two_loop(grad, history, kind(5)), two_loop(grad, history, 5))


def parts_of(kind: Any) -> dict[str, list[Part]]:
    """Parts whose options are numbers of a kind, each with what it acts on."""
    half, one, two = kind(0.5), kind(1), kind(2)
    return {
        "Fading": [Fading(half, half, half, start=kind(0), stop=one)],
        "Annealing": [Annealing(two, half, two)],
        "OwnFrame": [OwnFrame(half, half, half)],
        "ConstantMultiplier": [ConstantMultiplier(two)],
        "IsotropicNoise of a temperature": [IsotropicNoise(one)],
        "IsotropicNoise of a deviation": [IsotropicNoise(std=half)],
        "PositionNoise": [PositionNoise(scale=two)],
        "EnergyHistogram": [
            EnergyHistogram(
                energy_range=(kind(0), two), temperature=half, zeta=half, clamp=(kind(0), two)
            )
        ],
        "Curvature": [Curvature(min_cosine=half)],
    }


NUMBERS = (np.float16, np.float32, np.float64, np.longdouble, Fraction)


def moved(parts: Sequence[Part]) -> dict[str, torch.Tensor]:
    """Where a small training with these parts ends, and the options that they then have."""
    torch.manual_seed(0)
    sizes = {"means": (4, 3), "scales": (4, 3), "quats": (4, 4), "opacities": (4,)}
    splats = {name: Parameter(1 + torch.rand(size)) for name, size in sizes.items()}
    phases = PhaseScheduler(12, 6, parts=parts)
    optimizers = phases.upgrade({n: torch.optim.Adam([p], lr=0.01) for n, p in splats.items()})
    for i in range(12):
        for p in splats.values():
            p.grad = p.detach() * (1 + i % 3)
        phases.observe(0.1 * i)
        for adam in optimizers.values():
            adam.step()
    return {name: p.detach() for name, p in splats.items()}


@pytest.mark.parametrize("kind", NUMBERS)
@pytest.mark.parametrize("name", parts_of(float))
def test_options_are_used_as_plain_numbers(name: str, kind: Any) -> None:
    """Whatever kind of number is given, the training is the same, and so is what it says."""
    plain, given = parts_of(float)[name], parts_of(kind)[name]
    assert repr(given) == repr(plain)
    expected, found = moved(plain), moved(given)
    assert all(torch.equal(found[key], expected[key]) for key in expected)


@pytest.mark.parametrize("kind", KINDS)
def test_counts_are_used_as_plain_numbers(kind: Any) -> None:
    """A generator of torch takes no other seed."""
    for make in (
        lambda n: [Fading(events=n(5), seed=n(3), start=0.0, stop=1.0)],
        lambda n: [FreshMoments(settling=n(2))],
        lambda n: [ConstantMultiplier(2.0, n(3))],
    ):
        assert repr(make(kind)) == repr(make(int))
        expected, found = moved(make(int)), moved(make(kind))
        assert all(torch.equal(found[key], expected[key]) for key in expected)


@pytest.mark.parametrize("option", ["share", "exp_avg", "events", "seed"])
def test_a_number_beyond_every_float_is_refused_in_plain_words(option: str) -> None:
    low, high = ({option: sign * 10**400} for sign in (-1, 1))
    with pytest.raises(ValueError, match=f"Fading: {option}=-1000"):
        Fading(**low)  # pyright: ignore[reportArgumentType]
    if option not in ("events", "seed"):
        with pytest.raises(ValueError, match=f"Fading: {option}=1000"):
            Fading(**high)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("kind", [np.float32, np.int64])
def test_a_number_of_numpy_is_one(kind: Any) -> None:
    assert PhaseScheduler(60, np.float64(0.5)).switch_step == 30
    assert float(Fading(exp_avg=kind(1)).exp_avg) == 1.0
    assert float(ConstantMultiplier(kind(2)).value) == 2.0
