"""Annealing and fading: longer steps early, shorter ones late; faded moments."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest
import torch
from trainers import (
    NOTHING,
    check_resume,
    edit_rows,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    train,
)

from opt3dgs_optim import Annealing, Fading, PhaseScheduler

TOTAL = 60


@pytest.mark.parametrize(
    ("progress", "factor"),
    [(0.0, 8.0), (1.0, 0.5), (0.5, 2.0), (0.25, 4.0), (-1.0, 8.0), (3.0, 0.5)],
)
def test_factor_falls_geometrically(progress: float, factor: float) -> None:
    assert Annealing(8.0, 0.5).factor("means", progress) == pytest.approx(factor)


def test_peaks_by_parameter_take_every_trainers_names() -> None:
    annealing = Annealing({"xyz": 4.0, "scaling": 2.0}, 1.0)
    assert annealing.factor("means", 0.0) == annealing.factor("xyz", 0.0) == 4.0
    assert annealing.factor("scales", 0.5) == pytest.approx(2**0.5)
    assert annealing.factor("opacities", 0.0) == 1.0  # left out
    assert annealing.factor("camera_opt", 0.0) == Annealing().factor(None, 0.0) == 1.0


def test_opacities_have_a_peak_of_their_own() -> None:
    annealing = Annealing(8.0, 0.5)
    assert annealing.factor("opacities", 0.0) == annealing.factor("opacity", 0.0) == 1.0
    assert annealing.factor("opacities", 1.0) == annealing.factor("means", 1.0) == 0.5
    assert Annealing(8.0, 0.5, opacity_peak=2.0).factor("opacities", 0.5) == pytest.approx(1.0)
    assert Annealing({"means": 8.0}, 0.5, opacity_peak=2.0).factor("opacities", 0.5) == 1.0


def test_every_step_is_adams_times_the_factor() -> None:
    """The same gradients with learning rates set by hand give the same bits."""
    annealing = Annealing(8.0, 0.4)
    ours, theirs = make_splats(), make_splats()
    phases = only(TOTAL, annealing=annealing)
    optimizers, plain = phases.upgrade(gsplat_optimizers(ours)), gsplat_optimizers(theirs)
    rates = {name: opt.param_groups[0]["lr"] for name, opt in plain.items()}
    for i in range(TOTAL):
        for name, optimizer in plain.items():
            optimizer.param_groups[0]["lr"] = rates[name] * annealing.factor(name, i / TOTAL)
        train(theirs, plain, None, i, i + 1)
        train(ours, optimizers, phases, i, i + 1)
    for name in ours:
        assert torch.equal(ours[name], theirs[name]), name
        assert optimizers[name].param_groups[0]["lr"] == rates[name]  # never written


def test_annealing_multiplies_nu_and_goes_on_after_the_switch() -> None:
    phases = PhaseScheduler(
        TOTAL, 30, **NOTHING | {"multiplier": 1.5, "annealing": Annealing(8.0, 0.5)}
    )
    optimizer: Any = phases.upgrade(gsplat_optimizers(make_splats()))["means"]
    group = optimizer.param_groups[0]
    phases.observe(0.1, iteration=15)
    assert float(optimizer._factor(group)) == pytest.approx(1.5 * 4.0)
    phases.observe(0.1, iteration=30)
    assert float(optimizer._factor(group)) == pytest.approx(2.0)


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_resume_is_bit_exact(make: Any) -> None:
    options: dict[str, Any] = {"annealing": Annealing(), "fading": Fading(share=0.5, events=20)}
    check_resume(make, lambda: only(TOTAL, **options), TOTAL, 23)


# -- fading ----------------------------------------------------------------------------------------


def test_events_are_spread_evenly_and_each_happens_once() -> None:
    fading = Fading(events=300, start=0.03, stop=0.5)
    counts = [fading.events_before(i, 30_000) for i in range(30_001)]
    assert counts[900] == 0
    assert counts[-1] == counts[15_000] == 300
    steps = [b - a for a, b in itertools.pairwise(counts)]
    assert set(steps) == {0, 1}
    assert Fading(events=300).events_before(100, 100) == 300  # a short run has several at once


def test_the_same_points_fade_in_all_parameters_and_the_share_is_right() -> None:
    splats = make_splats(400)
    phases = only(TOTAL, fading=Fading(share=0.25, events=1, start=0.0, stop=0.5))
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 29)
    before = {
        name: {key: value.clone() for key, value in opt.state[splats[name]].items()}
        for name, opt in optimizers.items()
    }
    phases.observe(0.1)  # iteration 29: the event is before its step
    chosen = []
    for name, optimizer in optimizers.items():
        optimizer._begin_step(None)  # pyright: ignore[reportAttributeAccessIssue]
        state = optimizer.state[splats[name]]
        faded = _ratio(state, before[name], "exp_avg") < 0.5
        chosen.append(faded)
        for key, factor in (("exp_avg", 0.2), ("exp_avg_sq", 0.04)):
            expected = torch.where(faded, factor, 1.0)
            torch.testing.assert_close(_ratio(state, before[name], key), expected)
    assert all(torch.equal(rows, chosen[0]) for rows in chosen)
    assert 60 <= int(chosen[0].sum()) <= 140  # 100 expected, deviation 8.7


def _ratio(after: dict[str, Any], before: dict[str, Any], key: str) -> torch.Tensor:
    """By what each point's moments were multiplied, [N]."""
    old = before[key].reshape(len(before[key]), -1)
    return (after[key].reshape(old.shape) * old).sum(1) / (old * old).sum(1)


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_only_the_named_parameters_fade(make: Any) -> None:
    after: list[dict[str, torch.Tensor]] = []
    every_parameter = Fading(1.0, events=1, start=0.0)
    named_ones = replace(every_parameter, names=("opacities", "scaling"))  # INRIA's: the scales
    for fading in (None, named_ones, every_parameter):
        splats = make_splats(40)
        phases = only(TOTAL, fading=fading)
        optimizers = phases.upgrade(make(splats))
        train(splats, optimizers, phases, 0, 31)
        states = [
            o.state for o in (optimizers.values() if isinstance(optimizers, dict) else [optimizers])
        ]
        moments = {p: s["exp_avg_sq"] for state in states for p, s in state.items()}
        after.append({name: moments[param].clone() for name, param in splats.items()})
    plain, some, every = after
    for name in plain:
        assert not torch.equal(plain[name], every[name]), name
        named = name in ("opacities", "scales")
        assert torch.equal(some[name], every[name] if named else plain[name]), name


def test_a_step_after_fading_is_no_longer_than_before() -> None:
    """0.2 / sqrt(0.04) = 1: what the defaults are chosen for."""
    param = torch.nn.Parameter(torch.zeros(500, 3))
    adam = torch.optim.Adam([param], lr=1.0)
    for i in range(200):
        param.grad = torch.randn(500, 3, generator=torch.Generator().manual_seed(i))
        adam.step()
    state = adam.state[param]
    length = (state["exp_avg"] / state["exp_avg_sq"].sqrt()).abs()
    Fading().fade(adam.state, range(0, 1))
    faded = (state["exp_avg"] / state["exp_avg_sq"].sqrt()).abs()
    torch.testing.assert_close(faded, length)


def test_fading_survives_density_control() -> None:
    splats = make_splats()
    phases = only(TOTAL, fading=Fading(share=1.0, events=60, start=0.0, stop=1.0))
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    for i in range(0, TOTAL, 10):
        train(splats, optimizers, phases, i, i + 10)
        edit_rows(splats, optimizers, torch.arange(len(splats["means"])) % 4 != 1, 2)  # pyright: ignore[reportArgumentType]
    assert all(bool(p.isfinite().all()) for p in splats.values())


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: Annealing(0.0), r"Annealing: peak=0.0, but a finite number in \(0"),
        (lambda: Annealing(8.0, -1.0), r"Annealing: final=-1.0"),
        (lambda: Annealing({"means": -1.0}), r"Annealing: peak\['means'\]=-1.0"),
        (lambda: Annealing({"pose": 2.0}), r"'pose', which is no Gaussian.*means, scales"),
        (lambda: Annealing(float("nan")), r"Annealing: peak=nan"),
        (lambda: Fading(share=0.0), r"Fading: share=0.0"),
        (lambda: Fading(exp_avg=1.5), r"Fading: exp_avg=1.5"),
        (lambda: Fading(exp_avg_sq=-0.1), r"Fading: exp_avg_sq=-0.1"),
        (lambda: Fading(events=0), r"Fading: events=0"),
        (lambda: Fading(start=0.6, stop=0.5), r"Fading: stop=0.5.*\(0.6, 1.0\]"),
        (lambda: Fading(seed=-1), r"Fading: seed=-1"),
        (lambda: Fading(names=("pose",)), r"Fading: names=\('pose',\).*means, scales"),
        (lambda: Fading(names=()), r"Fading: names=\(\)"),
        (lambda: PhaseScheduler(10, annealing=2.0), r"annealing=2.0, but Annealing"),  # pyright: ignore
        (lambda: PhaseScheduler(10, fading=True), r"fading=True, but Fading"),  # pyright: ignore
    ],
)
def test_bad_options_are_named(call: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        call()
