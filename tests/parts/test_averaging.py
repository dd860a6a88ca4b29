"""Averaging: a training ends at the mean of its last thirtieth, of the rows that stayed."""

from __future__ import annotations

from typing import Any

import pytest
import row_edits
import torch
from gaussians import adam_of, adams_of, parameters, steps
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import Parameter

from opt3dgs_optim import Averaging, PhaseScheduler
from opt3dgs_optim.mean import GRIDS

TOTAL, ROWS = 300, 6


def averaged(params: Any, count: int, moments: Any) -> tuple[PhaseScheduler, Any]:
    """One optimizer of all after so many iterations."""
    phases = PhaseScheduler(TOTAL, parts=[Averaging()], moments=moments)
    optimizer = phases.upgrade(adam_of(params))
    steps({"all": optimizer}, params, count)
    return phases, optimizer


@given(total=st.integers(1, 100_000))
def test_where_the_mean_begins_and_where_it_is_put(total: int) -> None:
    start, put = Averaging.start(total), Averaging.put_from(total)
    assert total - start == int(1 / 30 * total)
    assert total - put == min(total - start, max(2, int((total - start) / 10)))


@settings(max_examples=20)
@given(total=st.integers(90, 700), moments=st.sampled_from([32, 16]))
def test_the_end_is_the_mean_of_the_last_iterates(total: int, moments: Any) -> None:
    """Of those before the mean is put; after it, Adam still moves by its momentum."""
    params = parameters(ROWS, "sh0")
    phases = PhaseScheduler(total, parts=[Averaging()], moments=moments)
    optimizers = phases.upgrade(adams_of(params))
    put, last = Averaging.put_from(total), []
    for iteration in range(put):
        steps(optimizers, params, 1, seed=iteration)
        if iteration >= Averaging.start(total):
            last.append(params["sh0"].detach().double())
    if last:
        phases.finish()
        mean, found = torch.stack(last).mean(0), params["sh0"].double()
        way = 0.0 if moments == 32 else 20 * GRIDS["sh0"]
        assert torch.allclose(found, mean, atol=1e-5 + way)
        phases.finish()
        assert torch.allclose(found, params["sh0"].double(), atol=way)


@pytest.mark.parametrize("moments", [32, 16])
def test_a_long_run_averages_every_so_many_th_iterate(moments: Any) -> None:
    """Of 30,000 iterations every fourth of a parameter's own steps, which come in every third."""
    params, total = parameters(ROWS, "sh0"), 30_000
    phases = PhaseScheduler(total, parts=[Averaging()], moments=moments)
    optimizer = phases.upgrade(adams_of(params))["sh0"]
    kept: list[Any] = []
    for iteration in range(28_990, Averaging.put_from(total)):
        phases.observe(iteration=iteration)
        if iteration % 3 == 0:
            steps({"sh0": optimizer}, params, 1, seed=iteration)
            if (
                iteration >= Averaging.start(total)
                and int(optimizer.state_dict()["state"][0]["step"]) % 4 == 0
            ):
                kept.append(params["sh0"].detach().double())
    assert len(kept) == pytest.approx(75, abs=1)
    phases.finish()
    away = (params["sh0"].double() - torch.stack(kept).mean(0)).abs().max()
    assert away < (1e-5 if moments == 32 else 20 * GRIDS["sh0"])


def test_rows_that_were_reset_stay_as_they_are_at_an_early_end() -> None:
    params = parameters(ROWS, "sh0")
    phases = PhaseScheduler(TOTAL, parts=[Averaging()])
    optimizers = phases.upgrade(adams_of(params))
    steps(optimizers, params, Averaging.start(TOTAL) + 2)
    optimizers["sh0"].reset_rows(params["sh0"], torch.tensor([1]))
    before = params["sh0"].detach().clone()
    phases.finish()
    same = (params["sh0"] == before).flatten(1).all(1)
    assert same.tolist() == [row == 1 for row in range(ROWS)]


def test_a_training_that_counts_from_one_ends_at_its_mean() -> None:
    params = parameters(ROWS, "sh0")
    phases = PhaseScheduler(TOTAL, parts=[Averaging()])
    optimizers = phases.upgrade(adams_of(params))
    for iteration in range(1, TOTAL + 1):
        phases.observe(iteration=iteration)
        steps(optimizers, params, 1, seed=iteration)
    phases.finish()
    assert torch.equal(optimizers["sh0"].state[params["sh0"]]["averaging.mean"], params["sh0"])


@pytest.mark.parametrize(("total", "said"), [(20, []), (40, [40]), (300, [299])])
def test_the_line_says_where_the_mean_is_put(total: int, said: list[int], caplog: Any) -> None:
    """A trial of fewer than 30 iterations has none, and one of fewer than 60 a mean of one."""
    caplog.set_level("INFO")
    params = parameters(ROWS, "sh0")
    phases = PhaseScheduler(total, parts=[Averaging()])
    optimizers, put = phases.upgrade(adams_of(params)), []
    for iteration in range(total):
        steps(optimizers, params, 1, seed=iteration)
        mean = optimizers["sh0"].state[params["sh0"]].get("averaging.mean")
        if mean is not None and torch.equal(mean, params["sh0"]):
            put.append(iteration + 1)
    lines = [r.getMessage() for r in caplog.records if "are the mean" in r.getMessage()]
    assert [int(line.split("iteration ")[1].split()[0]) for line in lines] == said
    assert put[-2:][: len(said)] == said
    phases.finish()
    assert "finish()" not in caplog.text


def test_the_line_is_not_said_after_an_early_finish(caplog: Any) -> None:
    """As where a trainer calls it at every save: there is no mean any more, which is warned of."""
    caplog.set_level("INFO")
    params = parameters(ROWS, "sh0")
    phases = PhaseScheduler(TOTAL, parts=[Averaging()])
    optimizers = phases.upgrade(adams_of(params))
    phases.finish()
    with pytest.warns(UserWarning, match=r"iteration 0 comes after finish\(\): .* no mean"):
        steps(optimizers, params, TOTAL)
    assert "averaging.mean" not in optimizers["sh0"].state[params["sh0"]]
    assert not any("are the mean" in record.getMessage() for record in caplog.records)


@pytest.mark.parametrize("moments", [32, 16])
@pytest.mark.parametrize("name", ["sh0", "shN"])
def test_rows_of_the_same_parameter_begin_anew_where_their_number_changes(
    name: str, moments: Any
) -> None:
    """A trainer that puts other rows into `data`, and into Adam's moments; harmonics of degree 0.

    The mean that there was is put by nobody.
    """
    params = parameters(ROWS, name)
    if name == "shN":
        params[name] = Parameter(torch.zeros(ROWS, 0, 3))
    _, optimizer = averaged(params, 293, moments)
    state = optimizer.state[params[name]]
    kept = params[name].data[1:].clone()
    params[name].data = kept.clone()
    for key in ("exp_avg", "exp_avg_sq"):
        state[key] = state[key][1:]
    assert optimizer.put_means() == 0
    assert torch.equal(params[name], kept)
    steps({"all": optimizer}, params, 1)
    assert state["averaging.began"].tolist() == [294.0] * (ROWS - 1)


@pytest.mark.parametrize("moments", [32, 16])
def test_without_a_mean_of_these_rows_the_last_iterate_stays(moments: Any) -> None:
    """Of an edit after the last step before `finish`."""
    params = parameters(ROWS, "sh0")
    phases, optimizer = averaged(params, 295, moments)
    row_edits.apply(row_edits.added(torch.tensor([0, 3])), params, [optimizer], ["sh0"], False)
    before = params["sh0"].detach().clone()
    phases.finish()
    assert torch.equal(params["sh0"], before)


@pytest.mark.parametrize("moments", [32, 16])
def test_a_trainer_that_edits_what_has_the_parameters_shape(moments: Any) -> None:
    """It leaves what there is one of a row, and so the mean begins anew."""
    params = parameters(ROWS, "sh0")
    _, optimizer = averaged(params, 293, moments)
    old = params["sh0"]
    state = optimizer.state.pop(old)
    state = {key: v[1:] if v.shape == old.shape else v for key, v in state.items()}
    params["sh0"] = Parameter(old.detach()[1:].clone())
    optimizer.param_groups[0]["params"] = [params["sh0"]]
    optimizer.state[params["sh0"]] = state
    saved = optimizer.state_dict()
    assert optimizer.put_means() == 0
    optimizer.load_state_dict(saved)
    steps({"all": optimizer}, params, 1)
    state = optimizer.state[params["sh0"]]
    assert state["averaging.began"].tolist() == [294.0] * (ROWS - 1)


@pytest.mark.filterwarnings("ignore:PhaseScheduler")
@pytest.mark.parametrize("moments", [32, 16])
def test_what_comes_after_the_mean_is_not_taken_back(moments: Any, caplog: Any) -> None:
    """By `finish`, in a run that has gone on past its end, or past an earlier `finish`."""
    for ends_at, goes_on in ((300, 20), (295, 3)):
        params = parameters(ROWS, "sh0")
        phases = PhaseScheduler(TOTAL, parts=[Averaging()], moments=moments)
        optimizers = phases.upgrade(adams_of(params))
        steps(optimizers, params, ends_at, seed=1)
        if ends_at < TOTAL:
            phases.finish()
        steps(optimizers, params, goes_on, seed=2)
        before = params["sh0"].detach().clone()
        phases.finish()
        assert torch.equal(params["sh0"], before)
    assert "finish() at iteration" not in caplog.text


@pytest.mark.parametrize("moments", [32, 16])
@pytest.mark.parametrize("count", [295, TOTAL])
def test_a_number_that_is_lost_is_not_hidden_by_its_mean(count: int, moments: Any) -> None:
    """As the step that puts the mean leaves it: a trainer has to see it."""
    params = parameters(ROWS, "sh0")
    phases, _ = averaged(params, count, moments)
    with torch.no_grad():
        params["sh0"][2, 0, 1] = torch.nan
    phases.finish()
    assert torch.isnan(params["sh0"]).sum() == 1


def test_finish_takes_away_the_noise_that_came_after_the_last_step() -> None:
    """3DGS-MCMC's, where the step had put the mean."""
    params = parameters(ROWS, "sh0")
    phases, optimizer = averaged(params, TOTAL, 32)
    mean = optimizer.state[params["sh0"]]["averaging.mean"]
    assert torch.equal(params["sh0"], mean)
    with torch.no_grad():
        params["sh0"].add_(torch.randn(params["sh0"].shape))
    phases.finish()
    assert torch.equal(params["sh0"], mean)


def test_it_costs_nothing_before_the_last_thirtieth() -> None:
    params = parameters(ROWS, "sh0")
    optimizers = PhaseScheduler(TOTAL, parts=[Averaging()]).upgrade(adams_of(params))
    steps(optimizers, params, 290)
    assert set(optimizers["sh0"].state[params["sh0"]]) == {"step", "exp_avg", "exp_avg_sq"}
    steps(optimizers, params, 1)
    assert optimizers["sh0"].state[params["sh0"]]["averaging.began"].shape == (ROWS,)


@pytest.mark.parametrize("began", [None, torch.ones(ROWS - 1)], ids=["gone", "of fewer rows"])
@pytest.mark.parametrize("moments", [32, 16])
def test_a_saved_mean_needs_to_know_when_each_row_began(began: Any, moments: Any) -> None:
    _, optimizer = averaged(parameters(ROWS, "sh0"), 293, moments)
    saved = optimizer.state_dict()
    del saved["state"][0]["averaging.began"]
    if began is not None:
        saved["state"][0]["averaging.began"] = began
    with pytest.raises(ValueError, match=r"load_state_dict: .*(a number for each row|same rows)"):
        optimizer.load_state_dict(saved)


def test_whatever_the_optimizers_hold_is_averaged() -> None:
    """The groups of Scaffold-GS, whose anchors are no Gaussians, and an exposure of one number."""
    draw = torch.Generator().manual_seed(0)
    shapes = {"anchor": (8, 3), "offset": (8, 10, 3), "anchor_feat": (8, 32), "opacity": (8, 1)}
    shapes |= {"scaling": (8, 6), "rotation": (8, 4), "mlp_color": (32, 35), "exposure": ()}
    params = {n: Parameter(torch.randn(s, generator=draw)) for n, s in shapes.items()}
    phases = PhaseScheduler(TOTAL, parts=[Averaging(names=None)])
    optimizer = phases.upgrade(adam_of(params))
    last: dict[str, list[Any]] = {name: [] for name in params}
    for iteration in range(Averaging.put_from(TOTAL)):
        steps({"all": optimizer}, params, 1, seed=iteration)
        if iteration >= Averaging.start(TOTAL):
            for name, param in params.items():
                last[name].append(param.detach().clone())
    phases.finish()
    for name, param in params.items():
        assert torch.allclose(param, torch.stack(last[name]).mean(0), atol=1e-5)
        assert not torch.allclose(param, last[name][-1], atol=1e-5)
