"""Two parts of one class: each does what it does alone, and neither sees what the other keeps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from placed_training import Training, distance
from trainers import AveragedThroughout

from opt3dgs_optim import (
    Annealing,
    Averaging,
    ConstantMultiplier,
    Curvature,
    EnergyHistogram,
    Fading,
    FreshMoments,
    IsotropicNoise,
    OutOfView,
    Part,
    PositionNoise,
    SquaredLoss,
)

Made = Callable[[Any], list[Part]]


class ShortlyAveraged(Averaging):
    """`Averaging` of the last tenth."""

    share = 0.1


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


# name: (a part, the same beside one of its class that does nothing here, iterations)
BESIDE: dict[str, tuple[Made, Made, int]] = {
    "Fading": (
        lambda t: [Fading(start=0.0, stop=0.5)],
        lambda t: [Fading(start=0.0, stop=0.5), Fading(start=0.9, stop=1.0)],
        80,
    ),
    "Fading, the other first": (
        lambda t: [Fading(start=0.0, stop=0.5)],
        lambda t: [Fading(start=0.9, stop=1.0), Fading(start=0.0, stop=0.5)],
        80,
    ),
    "Fading of others": (
        lambda t: [Fading(start=0.0, names=("means",)), Fading(start=0.0, names=("sh0",))],
        lambda t: [Fading(start=0.0, names=("means", "sh0"))],
        90,
    ),
    "Curvature of others": (
        lambda t: [Curvature(3, names=("means", "scales"))],
        lambda t: [Curvature(3, names=("means",)), Curvature(3, names=("scales",))],
        90,
    ),
    "Averaging": (
        lambda t: [ShortlyAveraged()],
        lambda t: [ShortlyAveraged(), Averaging()],
        86,
    ),
    "FreshMoments": (
        lambda t: [FreshMoments()],
        lambda t: [FreshMoments(settling=10_000), FreshMoments()],
        90,
    ),
    "FreshMoments twice": (
        lambda t: [FreshMoments()],
        lambda t: [FreshMoments(), FreshMoments()],
        90,
    ),
    "OutOfView": (lambda t: [OutOfView()], lambda t: [OutOfView(), OutOfView()], 90),
    "EnergyHistogram": (
        lambda t: [EnergyHistogram(warmup=10)],
        lambda t: [EnergyHistogram(warmup=10), EnergyHistogram(warmup=10_000)],
        90,
    ),
    "ConstantMultiplier": (
        lambda t: [ConstantMultiplier(3.0)],
        lambda t: [ConstantMultiplier(1.5), ConstantMultiplier(2.0)],
        90,
    ),
    "Annealing of others": (
        lambda t: [Annealing(names=("scales", "sh0"))],
        lambda t: [Annealing(names=("scales",)), Annealing(names=("sh0",))],
        90,
    ),
    "SquaredLoss": (lambda t: [SquaredLoss()], lambda t: [SquaredLoss(), SquaredLoss()], 90),
    "IsotropicNoise": (
        lambda t: [IsotropicNoise(std=1e-3, generator=generator())],
        lambda t: [
            IsotropicNoise(std=1e-3, generator=generator()),
            IsotropicNoise(std=0.0, generator=generator()),
        ],
        90,
    ),
    "PositionNoise": (
        lambda t: [PositionNoise(lambda: t.splats, 1e2, generator=generator())],
        lambda t: [
            PositionNoise(lambda: t.splats, 1e2, generator=generator()),
            PositionNoise(lambda: t.splats, 0.0, generator=generator()),
        ],
        90,
    ),
}


def trained(made: Made, until: int) -> Training:
    return Training(made, total=90, switch=60).run(until)


@pytest.mark.parametrize("name", BESIDE)
def test_a_part_beside_another_does_what_it_does_alone(name: str) -> None:
    alone, beside, until = BESIDE[name]
    one, two = trained(alone, until), trained(beside, until)
    # A factor of two parts is a product, rounded once.
    assert distance(one.values(), two.values()) <= (1e-6 if "Constant" in name else 0.0)


RESUMED: dict[str, Made] = {
    "Fading": lambda t: [Fading(start=0.0, stop=0.7), Fading(start=0.2, stop=1.0, seed=3)],
    "Curvature": lambda t: [Curvature(3, names=("means",)), Curvature(5, names=("scales",))],
    "Curvature of the same": lambda t: [Curvature(2), Curvature(4)],
    "Averaging": lambda t: [AveragedThroughout(), ShortlyAveraged()],
    "EnergyHistogram": lambda t: [EnergyHistogram(warmup=10), EnergyHistogram.paper(warmup=20)],
    "OutOfView": lambda t: [OutOfView(), OutOfView()],
    "FreshMoments": lambda t: [FreshMoments(), FreshMoments(settling=5)],
}


@pytest.mark.parametrize("name", RESUMED)
@pytest.mark.parametrize("at", [30, 66, 85])
def test_two_of_a_class_are_resumed(name: str, at: int) -> None:
    first = trained(RESUMED[name], at)
    second = Training(RESUMED[name], total=90, switch=60).resume(first).run()
    assert distance(second.values(), first.run().values()) == 0.0


def test_two_of_a_class_keep_their_own() -> None:
    """Two histories of two sizes of one parameter; two means of two windows."""
    pairs = trained(lambda t: [Curvature(2), Curvature(4)], 70).kept()
    means = trained(lambda t: [AveragedThroughout(), ShortlyAveraged()], 88).kept()
    own = [key for key in pairs if key.startswith("means.") and "exp_avg" not in key]
    assert len(own) - 1 == 2, own  # beside torch's step
    own = [key for key in means if key.startswith("means.") and "exp_avg" not in key]
    assert len(own) - 1 == 4, own
