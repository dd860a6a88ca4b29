"""A histogram of energies that are maximised: nu would act the wrong way round, and is refused."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import (
    AWSGLD,
    DEFAULTS,
    EnergyHistogram,
    IsotropicNoise,
    Part,
    PhaseScheduler,
    paper_parts,
)

WHAT = "maximize=True, .* minimise the negated loss"


def points() -> Parameter:
    return Parameter(torch.ones(4, 3))


@pytest.mark.parametrize("preconditioner", ["adam", "none"])
@pytest.mark.parametrize("histogram", [EnergyHistogram(), EnergyHistogram.paper()])
def test_the_optimizer_is_not_made(histogram: EnergyHistogram, preconditioner: Any) -> None:
    options: dict[str, Any] = {"histogram": histogram, "preconditioner": preconditioner}
    for params in ([points()], [{"params": [points()]}]):
        with pytest.raises(ValueError, match=f"AWSGLD: {WHAT}"):
            AWSGLD(params, 0.1, maximize=True, **options)
    with pytest.raises(ValueError, match=f"AWSGLD: {WHAT}"):
        AWSGLD([{"params": [points()], "maximize": True}], 0.1, **options)


def test_a_group_is_not_added() -> None:
    walk = AWSGLD([points()], 0.1, histogram=EnergyHistogram())
    with pytest.raises(ValueError, match=f"AWSGLD: {WHAT}"):
        walk.add_param_group({"params": [points()], "maximize": True})
    assert len(walk.param_groups) == 1
    walk.add_param_group({"params": [points()]})
    with pytest.raises(TypeError, match="param_group must be a dict"):
        walk.add_param_group([points()])  # pyright: ignore[reportArgumentType]


def test_without_a_histogram_it_is_torchs() -> None:
    ours, theirs = points(), points()
    options: dict[str, Any] = {"lr": 0.1, "maximize": True}
    pair = AWSGLD([ours], noise=IsotropicNoise(std=0.0), **options), Adam([theirs], **options)
    for optimizer, param in zip(pair, (ours, theirs), strict=True):
        for i in range(5):
            param.grad = torch.full_like(param, i + 1.0)
            optimizer.step()
    assert torch.equal(ours, theirs)


def parts_with_a_histogram() -> dict[str, list[Part]]:
    return {
        "alone": [EnergyHistogram()],
        "in its warm-up": [EnergyHistogram(warmup=1000)],
        "of a range": [EnergyHistogram(8, (0.0, 1.0), temperature=0.1, warmup=0)],
        "the paper's": paper_parts(100),
        "beside the defaults": [*DEFAULTS, EnergyHistogram()],
    }


@pytest.mark.parametrize("layout", ["dict", "single"])
@pytest.mark.parametrize("which", [("means",), ("scales",), ("means", "scales")], ids=str)
@pytest.mark.parametrize("case", list(parts_with_a_histogram()))
def test_a_step_is_refused_before_anything_moves(
    case: str, which: tuple[str, ...], layout: str
) -> None:
    """Whichever groups are to maximise, and whenever that is set: torch reads it in each step."""
    params = {name: points() for name in ("means", "scales")}
    groups = {n: {"params": [p], "lr": 0.1, "name": n} for n, p in params.items()}
    phases = PhaseScheduler(100, parts=parts_with_a_histogram()[case])
    made: Any = Adam(groups.values())
    if layout == "dict":
        made = {name: Adam([group]) for name, group in groups.items()}
    phases.upgrade(made)
    every = list(made.values()) if layout == "dict" else [made]

    def step() -> None:
        for param in params.values():
            param.grad = torch.ones_like(param)
        phases.observe(0.1)
        for optimizer in every:
            optimizer.step()

    step()
    before = {name: param.detach().clone() for name, param in params.items()}
    moved = [each for optimizer in every for each in optimizer.param_groups]
    for group in moved:
        group["maximize"] = group["name"] in which
    refused = [o for o in every if any(group["maximize"] for group in o.param_groups)]
    for optimizer in refused:
        with pytest.raises(ValueError, match=f"EnergyHistogram: {WHAT}"):
            optimizer.step()
        for group in optimizer.param_groups:
            (param,) = group["params"]
            assert torch.equal(param, before[group["name"]])
            assert optimizer.state[param]["step"] == 1
            assert group["lr"] == 0.1
    for group in moved:
        group["maximize"] = False
    step()


def test_where_it_is_over_a_group_may_maximise() -> None:
    param, phases = points(), PhaseScheduler(100, 50, [EnergyHistogram()])
    group = {"params": [param], "name": "means"}
    adam = phases.upgrade(Adam([group], lr=0.1, maximize=True))
    param.grad = torch.ones_like(param)
    phases.observe(0.1, iteration=60)
    adam.step()
    assert bool((param > 1).all())


def test_a_checkpoint_cannot_make_it_maximise() -> None:
    x, y = points(), points()
    saved = AWSGLD([x], 0.1, maximize=True)
    x.grad = torch.ones_like(x)
    saved.step()
    walk = AWSGLD([y], 0.1, histogram=EnergyHistogram())
    walk.load_state_dict(saved.state_dict())
    y.grad = torch.ones_like(y)

    def closure() -> Tensor:
        return torch.tensor(0.1)

    with pytest.raises(ValueError, match=f"EnergyHistogram: {WHAT}"):
        walk.step(closure)
    assert torch.equal(y, points())
