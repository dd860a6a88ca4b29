"""`step(visible)`: every row goes where it would go alone, and the others stand still."""

from __future__ import annotations

import copy
import io
import re
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from trainers import (
    edit_rows,
    everything,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    train,
)

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam, PhaseScheduler
from opt3dgs_optim.noise import IsotropicNoise

ROWS, STEPS = 7, 30
# The same float32 arithmetic in another order (torch divides by the bias corrections elsewhere).
CLOSE: Any = {"rtol": 2e-5, "atol": 1e-6}


class OwnMask(torch.optim.Adam):
    """What gsplat's SelectiveAdam and INRIA's SparseGaussianAdam are: no bias correction."""

    def step(self, visibility: Tensor, N: int | None = None) -> None:  # type: ignore[override]
        """Adam of the visible rows."""
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for p in group["params"]:
                state = self.state[p]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(p), torch.zeros_like(p)
                seen = visibility.bool()
                m, v, g = state["exp_avg"], state["exp_avg_sq"], p.grad
                assert g is not None
                m[seen] = beta1 * m[seen] + (1 - beta1) * g[seen]
                v[seen] = beta2 * v[seen] + (1 - beta2) * g[seen] ** 2
                with torch.no_grad():
                    p[seen] -= group["lr"] * m[seen] / (v[seen].sqrt() + group["eps"])


def gradients(x: Tensor, step: int) -> Tensor:
    return x.detach() * torch.tensor([1.0, 5.0, 20.0]) + 0.1 * step


def masks() -> Tensor:
    return torch.rand(STEPS, ROWS, generator=torch.Generator().manual_seed(3)) < 0.5


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"betas": (0.0, 0.9)},
        {"weight_decay": 0.1},
        {"amsgrad": True},
        {"maximize": True, "lr": 1e-4},
    ],
    ids=str,
)
@pytest.mark.parametrize("ours", [AWSGLD, LQNAdam])
def test_rows_go_where_torchs_adam_takes_them_alone(ours: Any, options: dict) -> None:
    if ours is LQNAdam:
        options = {**options, "min_cosine": 1 - 1e-12}  # no pair is accepted: Adam in rows
    start = torch.randn(ROWS, 3, generator=torch.Generator().manual_seed(0))
    x = Parameter(start.clone())
    optimizer = ours([x], **{"lr": 0.02, **options})
    options.pop("min_cosine", None)
    alone = [Parameter(row.clone()) for row in start]
    twins = [torch.optim.Adam([row], **{"lr": 0.02, **options}) for row in alone]
    for step, mask in enumerate(masks()):
        x.grad = gradients(x, step)
        x.grad[~mask] = float("nan")  # whatever the gradient of an invisible row is
        optimizer.step(visible=mask)
        for i in mask.nonzero()[:, 0].tolist():
            alone[i].grad = gradients(alone[i], step)
            twins[i].step()
    torch.testing.assert_close(x.detach(), torch.stack([r.detach() for r in alone]), **CLOSE)
    assert optimizer.state[x]["row_steps"].tolist() == masks().sum(0).tolist()


def test_pairs_of_rows_are_those_of_rows_alone() -> None:
    """Curvature between two visible steps of a point, whatever happened in between."""
    start = torch.randn(ROWS, 3, generator=torch.Generator().manual_seed(0))
    x = Parameter(start.clone())
    optimizer = LQNAdam([x], lr=0.01, history_size=3)
    alone = [Parameter(row.clone().reshape(1, 3)) for row in start]
    twins = [LQNAdam([row], lr=0.01, history_size=3) for row in alone]
    for mask in masks():
        x.grad = gradients(x, 1)
        before = optimizer.state[x]["history"].clone() if optimizer.state else None
        optimizer.step(mask)
        if before is not None:
            assert torch.equal(optimizer.state[x]["history"][~mask], before[~mask])
        for i in mask.nonzero()[:, 0].tolist():
            alone[i].grad = gradients(alone[i], 1)
            twins[i].step(visible=torch.ones(1))
    torch.testing.assert_close(x.detach(), torch.cat([r.detach() for r in alone]), **CLOSE)
    assert optimizer.accepted_share is not None


@pytest.mark.parametrize("kind", ["gsplat", "inria"])
@pytest.mark.parametrize("exploiting", [False, True])
@pytest.mark.parametrize("call", ["visible", "positional", "sparse_adam", "visibility"])
def test_invisible_rows_stand_still_in_both_phases(kind: str, exploiting: bool, call: str) -> None:
    splats = make_splats()
    phases = everything(40, 10, multiplier=EnergyHistogram(warmup=4), noise_scale=1.0)
    make: Any = gsplat_optimizers if kind == "gsplat" else inria_optimizer
    optimizers: Any = phases.upgrade(make(splats), splats)
    train(splats, optimizers, phases, 0, 15 if exploiting else 5)
    every = list(optimizers.values()) if kind == "gsplat" else [optimizers]
    mask = torch.arange(12) % 2 == 0
    sums = {name: p.detach().clone() for name, p in splats.items()}
    states = [copy.deepcopy(dict(o.state[p])) for o in every for p in o.state]
    for p in splats.values():
        p.grad = torch.full_like(p, 0.3)
    phases.observe(0.1)
    for optimizer in every:
        if call == "sparse_adam":
            optimizer.step(mask, 12)
        elif call == "positional":
            optimizer.step(mask.float())
        else:
            optimizer.step(**{call: mask})
    for name, p in splats.items():
        assert torch.equal(p[~mask], sums[name][~mask]), name
        assert bool((p[mask] != sums[name][mask]).any()), name
    after = [o.state[p] for o in every for p in o.state]
    for old, new in zip(states, after, strict=True):
        for key in set(old) - {"step"}:
            assert torch.equal(old[key][~mask], new[key][~mask]), key
    assert ("history" in after[0]) == exploiting


def test_without_a_mask_nothing_is_stored() -> None:
    splats, phases = make_splats(), everything(20)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 5)
    assert set(optimizers["means"].state[splats["means"]]) == {"step", "exp_avg", "exp_avg_sq"}


def test_masked_and_whole_steps_mix() -> None:
    x, y = Parameter(torch.ones(4, 3)), Parameter(torch.ones(4, 3))
    ours: Any = AWSGLD([x], lr=0.1)
    theirs = torch.optim.Adam([y], lr=0.1)
    for step in range(9):
        x.grad, y.grad = gradients(x, step), gradients(y, step)
        ours.step(*([torch.ones(4)] if step % 3 == 1 else []))
        theirs.step()
    torch.testing.assert_close(x, y, **CLOSE)


def test_nu_and_a_non_finite_loss_and_noise() -> None:
    histogram = EnergyHistogram(warmup=4)
    x = Parameter(torch.ones(4, 3))
    optimizer = AWSGLD([x], lr=0.1, histogram=histogram, noise=IsotropicNoise(std=0.1))
    mask = torch.tensor([1.0, 0, 1, 0])
    histogram.observe(float("nan"))
    x.grad = torch.ones(4, 3)
    optimizer.step(mask)
    assert torch.equal(x, torch.ones(4, 3))
    histogram.observe(0.1)
    optimizer.step(mask)
    assert (x != 1).any(dim=1).tolist() == [True, False, True, False]


def test_plain_drift_with_a_mask() -> None:
    x = Parameter(torch.ones(4, 3))
    optimizer = AWSGLD([x], lr=0.1, preconditioner="none")
    x.grad = torch.ones(4, 3)
    optimizer.step(torch.tensor([True, False, True, False]))
    assert x[:, 0].tolist() == pytest.approx([0.9, 1, 0.9, 1])


def test_a_non_finite_row_stands_still_and_is_counted() -> None:
    x = Parameter(torch.ones(4, 3))
    optimizer = AWSGLD([x], lr=0.1)
    x.grad = torch.ones(4, 3)
    x.grad[1, 2], x.grad[3, 0] = float("inf"), float("nan")
    optimizer.step(torch.tensor([1, 1, 1, 0]))
    assert (x == 1).all(dim=1).tolist() == [False, True, False, True]
    assert int(optimizer.skipped_rows) == 1  # row 3 was not visible anyway
    assert optimizer.state[x]["row_steps"].tolist() == [1, 0, 1, 0]


def test_counts_follow_gsplats_row_edits_and_checkpoints() -> None:
    splats, phases = make_splats(), everything(60)
    optimizers: Any = phases.upgrade(gsplat_optimizers(splats))

    def step(mask: Tensor) -> None:
        phases.observe(0.1)
        for name, optimizer in optimizers.items():
            splats[name].grad = torch.ones_like(splats[name])
            optimizer.step(mask)

    step(torch.arange(12) % 2)
    step(torch.ones(12))
    edit_rows(splats, optimizers, torch.arange(6), 2)
    counts = optimizers["means"].state[splats["means"]]["row_steps"]
    assert counts.tolist() == [1, 2, 1, 2, 1, 2, 0, 0]
    buffer = io.BytesIO()
    torch.save(optimizers["means"].state_dict(), buffer)
    buffer.seek(0)
    optimizers["means"].load_state_dict(torch.load(buffer, weights_only=True))
    step(torch.ones(8))
    counts = optimizers["means"].state[splats["means"]]["row_steps"]
    assert counts.tolist() == [2, 3, 2, 3, 2, 3, 1, 1]


def test_counts_are_estimated_where_a_trainer_edits_the_moments_only() -> None:
    """INRIA: `row_steps` keeps its old rows. No row may get another one's bias correction."""
    x = Parameter(torch.randn(6, 3))
    optimizer = AWSGLD([{"params": [x], "name": "xyz"}], lr=0.1)
    for _ in range(5):
        x.grad = torch.ones(6, 3)
        optimizer.step(torch.tensor([1, 1, 1, 1, 1, 0]))
    # prune row 0 and append one: six rows again, but other ones
    state = optimizer.state.pop(x)
    for key in ("exp_avg", "exp_avg_sq"):
        state[key] = torch.cat([state[key][1:], torch.zeros(1, 3)])
    y = Parameter(torch.cat([x.detach()[1:], torch.ones(1, 3)]))
    optimizer.param_groups[0]["params"][0] = y
    optimizer.state[y] = state
    y.grad = torch.ones(6, 3)
    optimizer.step(torch.ones(6), 6)
    assert optimizer.state[y]["row_steps"].tolist() == [6, 6, 6, 6, 1, 1]
    # relocation: in place, a new Parameter object, the moments of row 2 zeroed
    state = optimizer.state.pop(y)
    state["exp_avg"][2], state["exp_avg_sq"][2] = 0, 0
    z = Parameter(y.detach())
    optimizer.param_groups[0]["params"][0] = z
    optimizer.state[z] = state
    z.grad = torch.ones(6, 3)
    optimizer.step(torch.ones(6), 6)
    assert optimizer.state[z]["row_steps"].tolist() == [7, 7, 1, 7, 2, 2]


@pytest.mark.parametrize("steps_before", [0, 5])
def test_an_optimizer_with_a_mask_of_its_own_is_upgraded(steps_before: int) -> None:
    """Its moments have no bias correction: it goes on without, and new rows get theirs."""
    twin, own = Parameter(torch.ones(4, 3)), Parameter(torch.ones(4, 3))
    stock = OwnMask([{"params": [own], "lr": 0.1, "name": "means"}], eps=1e-15)
    other = OwnMask([{"params": [twin], "lr": 0.1, "name": "means"}], eps=1e-15)
    mask = torch.tensor([1, 1, 0, 0])
    for step in range(steps_before):
        own.grad, twin.grad = gradients(own, step), gradients(twin, step)
        stock.step(mask)
        other.step(mask)
    phases = everything(100, multiplier=None, curvature=None, reset_moments=False)
    ours = phases.upgrade({"means": stock})["means"]
    own.grad, twin.grad = gradients(own, 9), gradients(twin, 9)
    phases.observe(0.1)
    ours.step(torch.ones(4))  # type: ignore[arg-type]
    other.step(torch.ones(4))
    if steps_before:
        torch.testing.assert_close(own[:2], twin[:2], **CLOSE)
    # a first step is one learning rate long; without bias correction it is 3.2
    assert torch.allclose((1 - own[2:]).abs(), torch.tensor(0.1), rtol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((torch.ones(5),), {}, "the mask has 5 rows, but the parameters have shapes [(4, 3)]"),
        ((torch.ones(4), 5), {}, "num_points=5, but the mask has 4 rows"),
        ((torch.ones(4),), {"visible": torch.ones(4)}, "2 masks"),
        ((torch.tensor(1.0),), {}, "a mask of shape [N]"),
    ],
)
def test_bad_masks(arguments: tuple, options: dict, message: str) -> None:
    optimizer: Any = AWSGLD([Parameter(torch.ones(4, 3))], lr=0.1)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        optimizer.step(*arguments, **options)
    assert "AWSGLD.step" in str(error.value)


def test_other_groups_ride_along_without_the_mask() -> None:
    """INRIA's optimizer with an exposure: plain Adam on all of it, as without a mask."""
    splats, exposure = make_splats(), Parameter(torch.ones(3, 4))
    optimizer = inria_optimizer(splats)
    optimizer.add_param_group({"params": [exposure], "lr": 0.1, "name": "exposure"})
    phases = everything(10, multiplier=None)
    upgraded: Any = phases.upgrade(optimizer)
    twin = Parameter(torch.ones(3, 4))
    plain = torch.optim.Adam([twin], lr=0.1, eps=1e-15)
    for p in (*splats.values(), exposure, twin):
        p.grad = torch.ones_like(p)
    phases.observe(0.1)
    upgraded.step(torch.arange(12) % 2, 12)
    plain.step()
    assert torch.equal(exposure, twin)
    with pytest.raises(ValueError, match="the mask has 3 rows"):
        upgraded.step(torch.ones(3))


# -- reset_points -----------------------------------------------------------------------------


def exploited(steps: int = 8) -> tuple[dict, Any, PhaseScheduler]:
    splats, phases = make_splats(), everything(40, 0, squared_loss=True)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, steps)
    return splats, optimizers, phases


def exchange(splats: dict, optimizers: Any) -> None:
    edit_rows(splats, optimizers, torch.arange(12), 0)


@pytest.mark.parametrize("rows", [torch.arange(12) == 4, torch.tensor([4])], ids=["mask", "index"])
def test_reset_points_keeps_the_pairs_of_the_others(rows: Tensor) -> None:
    splats, optimizers, phases = exploited()
    held = optimizers["means"].state[splats["means"]]["history"].clone()
    exchange(splats, optimizers)  # a new Parameter: unknown rows
    phases.reset_points(rows)
    train(splats, optimizers, phases, 8, 9)
    counters = optimizers["means"].state[splats["means"]]["history"]
    assert bool(held[4].any())
    others = torch.arange(12) != 4
    kept = (counters[others] != 0).flatten(1).sum(1) >= (held[others] != 0).flatten(1).sum(1)
    assert bool(kept.all())
    splats2, optimizers2, phases2 = exploited()
    exchange(splats2, optimizers2)  # nothing said: all pairs are dropped
    train(splats2, optimizers2, phases2, 8, 9)
    dropped = optimizers2["means"].state[splats2["means"]]["history"]
    assert int((dropped != 0).sum()) < int((counters != 0).sum())


def test_reset_points_moments_too() -> None:
    splats, optimizers, phases = exploited()
    phases.reset_points(torch.arange(12) == 4, moments=True)
    for name, optimizer in optimizers.items():
        state = optimizer.state[splats[name]]
        assert not bool(state["exp_avg"][4].any())
        assert bool(state["exp_avg"][5].any())
    assert not bool(optimizers["means"].state[splats["means"]]["history"][4].any())


def test_reset_points_of_another_number() -> None:
    _, optimizers, phases = exploited()
    with pytest.raises(ValueError, match=re.escape("rows has shape (5,)")):
        phases.reset_points(torch.zeros(5, dtype=torch.bool))
    with pytest.raises(ValueError, match="reset_points"):
        optimizers["means"].reset_points(torch.zeros(5, dtype=torch.bool))


class Scene:
    """The hooks of gsplat 1.6's Scene; `seen` is what its own side data would get."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def on_duplicate(self, sel: Tensor) -> None:
        self.seen.append("duplicate")

    def on_split(self, sel: Tensor, rest: Tensor) -> None:
        self.seen.append("split")

    def on_remove(self, remove_mask: Tensor) -> None:
        self.seen.append("remove")

    def on_relocate(self, dead_indices: Tensor, sampled_indices: Tensor) -> None:
        self.seen.append("relocate")

    def on_sample_add(self, sampled_indices: Tensor) -> None:
        self.seen.append("sample_add")

    def on_permute(self, order: Tensor) -> None:
        self.seen.append("permute")


def test_scene_hooks_keep_the_pairs_of_rows_that_did_not_move() -> None:
    splats, optimizers, phases = exploited()
    scene = Scene()
    phases.follow_scene(scene)
    held = optimizers["means"].state[splats["means"]]["history"].clone()
    edit_rows(splats, optimizers, torch.arange(1, 12), 0)  # remove row 0
    scene.on_remove(torch.arange(12) == 0)
    exchange_after(splats, optimizers)
    scene.on_relocate(dead_indices=torch.tensor([2]), sampled_indices=torch.tensor([5]))
    history = optimizers["means"].state[splats["means"]]["history"]
    others = torch.arange(11) != 2
    assert torch.equal(history[others], held[1:][others])
    assert not bool(history[2].any())
    train(splats, optimizers, phases, 8, 9)
    assert bool((optimizers["means"].state[splats["means"]]["history"][others] != 0).any())
    assert scene.seen == ["remove", "relocate"]


def exchange_after(splats: dict, optimizers: Any) -> None:
    edit_rows(splats, optimizers, torch.arange(len(splats["means"])), 0)


def test_an_object_without_hooks_is_refused() -> None:
    with pytest.raises(TypeError, match=r"gsplat 1\.6"):
        everything(10).follow_scene(object())
