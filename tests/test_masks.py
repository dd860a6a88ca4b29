"""Masked steps: the rows that a camera saw go where Adam takes them, the others stand still."""

from __future__ import annotations

import copy
import re
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam
from torch.optim.lr_scheduler import ExponentialLR
from torch.utils._python_dispatch import TorchDispatchMode
from trainers import (
    AveragedThroughout,
    assert_same,
    every_one,
    everything,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    train,
    upgraded,
    values_of,
)

from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    ConstantMultiplier,
    EnergyHistogram,
    Fading,
    IsotropicNoise,
    LQNAdam,
    Part,
    PositionNoise,
)
from opt3dgs_optim.names import GAUSSIAN

ROWS, STEPS = 7, 30


class SelectiveAdam(Adam):
    """gsplat's, in Python: `step(visibility)`, moments without bias correction."""

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # type: ignore[override]
        """Adam of the visible rows; parameters without a gradient are left alone."""
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if len(state) == 0:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(p), torch.zeros_like(p)
                assert visibility.dtype == torch.bool
                assert visibility.numel() == len(p)
                m, v, g, seen = state["exp_avg"], state["exp_avg_sq"], p.grad, visibility
                m[seen] = beta1 * m[seen] + (1 - beta1) * g[seen]
                v[seen] = beta2 * v[seen] + (1 - beta2) * g[seen] ** 2
                p[seen] -= group["lr"] * m[seen] / (v[seen].sqrt() + group["eps"])


class SparseGaussianAdam(SelectiveAdam):
    """INRIA's: `step(visibility, N)`."""

    @torch.no_grad()
    def step(self, visibility: Tensor, N: int) -> None:  # type: ignore[override]
        """As SelectiveAdam's."""
        assert visibility.shape[0] == N
        SelectiveAdam.step.__wrapped__(self, visibility)  # type: ignore[attr-defined]


def gradients(x: Tensor, step: int) -> Tensor:
    return x.detach() * torch.tensor([1.0, 5.0, 20.0], dtype=x.dtype) + 0.1 * step


def masks() -> Tensor:
    return torch.rand(STEPS, ROWS, generator=torch.Generator().manual_seed(3)) < 0.5


def points(dtype: torch.dtype = torch.float32) -> Parameter:
    return Parameter(torch.randn(ROWS, 3, generator=torch.Generator().manual_seed(0)).to(dtype))


# -- what a masked step is -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"betas": (0.0, 0.9)},
        {"weight_decay": 0.1},
        {"weight_decay": 0.1, "decoupled_weight_decay": True},
        {"amsgrad": True},
        {"maximize": True, "lr": 1e-4},
        {"fused": True},
        {"foreach": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("ours", [AWSGLD, LQNAdam])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.complex64], ids=str)
def test_visible_rows_go_where_torchs_adam_takes_them(
    ours: Any, options: dict[str, Any], dtype: torch.dtype
) -> None:
    """Torch's step of the whole parameter, whose other rows are put back."""
    if dtype.is_complex and (ours is LQNAdam or "fused" in options):
        pytest.skip("no curvature pairs, and no fused step, of complex parameters")
    own: dict[str, Any] = (
        {"min_cosine": 1 - 1e-12} if ours is LQNAdam else {}
    )  # no pair is accepted: Adam
    x, y = points(dtype), points(dtype)
    given: dict[str, Any] = {"lr": 0.02, **options, **own}
    optimizer: Any = ours([x], **given)
    twin = Adam([y], **{"lr": 0.02, **options})
    for step, mask in enumerate(masks()):
        x.grad, y.grad = gradients(x, step), gradients(y, step)
        x.grad[~mask] = float("nan")  # whatever the gradient of an invisible row is
        y.grad[~mask] = 0.0
        kept = [y.detach().clone(), *(v.clone() for v in twin.state[y].values())]
        optimizer.step(visible=mask)
        twin.step()
        state = twin.state[y]
        now = [y.detach(), *state.values()]
        old = kept if len(kept) > 1 else [kept[0], *(torch.zeros_like(v) for v in now[1:])]
        for value, before in zip(now, old, strict=True):
            if value.dim():
                value[~mask] = before[~mask]
    assert torch.equal(x, y)
    for key, value in twin.state[y].items():
        assert torch.equal(optimizer.state[x][key], value), key


class RowsRooted(TorchDispatchMode):
    """Notes of how many rows Adam takes a root of the second moments."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[int] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.ops.aten.sqrt.default:
            self.rows.append(args[0].shape[0])
        return func(*args, **(kwargs or {}))


def test_adam_is_given_the_visible_rows_alone() -> None:
    """On a CPU, where it is known how many they are: the time of a step is that of these rows."""
    x = points()
    optimizer: Any = AWSGLD([x], lr=0.1)
    for step, mask in enumerate([*masks(), torch.zeros(ROWS, dtype=torch.bool)]):
        x.grad = gradients(x, step)
        with RowsRooted() as rooted:
            optimizer.step(visible=mask)
        assert rooted.rows == [int(mask.sum())]
    assert optimizer.state[x]["step"] == STEPS + 1


def test_pairs_are_kept_between_two_visible_steps_of_a_point() -> None:
    """Whatever happened in between: LQNAdam of each row alone, stepped when it is seen."""
    x = points()
    optimizer = LQNAdam([x], lr=0.01, history_size=3)
    alone = [Parameter(row.detach().clone().reshape(1, 3)) for row in x]
    twins = [LQNAdam([row], lr=0.01, history_size=3) for row in alone]
    for mask in masks():
        x.grad = gradients(x, 1)
        before = optimizer.state[x]["Curvature.history"].clone() if optimizer.state else None
        optimizer.step(mask)
        if before is not None:
            assert torch.equal(optimizer.state[x]["Curvature.history"][~mask], before[~mask])
        for i, (row, twin) in enumerate(zip(alone, twins, strict=True)):
            row.grad = gradients(row, 1)
            twin.step(visible=mask[i : i + 1])
    # the same float32 arithmetic in rows of another number
    torch.testing.assert_close(
        x.detach(), torch.cat([row.detach() for row in alone]), rtol=2e-5, atol=1e-6
    )
    assert optimizer.accepted_share is not None


@pytest.mark.parametrize("kind", [gsplat_optimizers, inria_optimizer])
@pytest.mark.parametrize("exploiting", [False, True])
@pytest.mark.parametrize("call", ["visible", "positional", "sparse_adam", "visibility"])
def test_invisible_rows_stand_still_in_both_phases(kind: Any, exploiting: bool, call: str) -> None:
    splats = make_splats()
    others = (
        Annealing(names=GAUSSIAN),
        Fading(1.0, events=40, start=0.0, stop=1.0),
        AveragedThroughout(),
    )
    noise = PositionNoise(splats, scale=1.0)
    phases = everything(40, 10, *others, noise, nu=EnergyHistogram(warmup=4), settling=0)
    optimizers: Any = phases.upgrade(kind(splats))
    train(splats, optimizers, phases, 0, 15 if exploiting else 5)
    every = every_one(optimizers)
    mask = torch.arange(12) % 2 == 0
    sums = values_of(splats)
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
    assert any("Curvature.history" in state for state in after) == exploiting
    averaged = state_of(optimizers, splats["means"])["AveragedThroughout.count"]
    assert averaged[mask].tolist() == [averaged[1] + 1] * 6


def test_a_mask_before_the_first_energy() -> None:
    """Plain Adam's step, of the visible rows only."""
    splats = make_splats()
    optimizers: Any = only(40, Annealing(names=GAUSSIAN)).upgrade(gsplat_optimizers(splats))
    before, mask = splats["means"].detach().clone(), torch.arange(12) % 3 == 0
    splats["means"].grad = torch.ones(12, 3)
    optimizers["means"].step(mask)
    moved = (splats["means"] != before).all(1)
    assert torch.equal(moved, mask)
    torch.testing.assert_close(splats["means"][mask], before[mask] - 0.01)  # not annealed


def test_a_mask_of_ones_is_the_step_without() -> None:
    x, y = points(), points()
    theirs = Adam([y], lr=0.1)
    ours: Any = AWSGLD([x], lr=0.1)
    for step in range(9):
        x.grad, y.grad = gradients(x, step), gradients(y, step)
        ours.step(*([torch.ones(ROWS)] if step % 3 == 1 else []))
        theirs.step()
    assert torch.equal(x, y)


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


# -- masks as hosts make them ----------------------------------------------------------------------


def sparse_optimizer(splats: dict[str, Parameter]) -> Adam:
    """INRIA's other optimizer, with steps of its own."""
    groups = inria_optimizer(splats).param_groups
    return SparseGaussianAdam([{k: g[k] for k in ("params", "lr", "name")} for g in groups])


EVERY = torch.ones(12, dtype=torch.bool)
MAKERS = pytest.mark.parametrize("make", [inria_optimizer, sparse_optimizer])


def pulled(splats: dict[str, Parameter], *left_out: str) -> None:
    for name, param in splats.items():
        param.grad = None if name in left_out else torch.ones_like(param)


@MAKERS
def test_a_stale_mask_with_nothing_to_step_is_nothing(make: Any) -> None:
    """INRIA after an edit: the mask has the old rows, the new Parameters no gradient yet."""
    splats, phases, optimizer = upgraded(
        40, Annealing(names=GAUSSIAN), AveragedThroughout(), make=make
    )
    pulled(splats)
    phases.observe(0.1)
    optimizer.step(EVERY, 12)
    before = values_of(splats)
    pulled(splats, *splats)
    phases.observe(0.1)
    optimizer.step(torch.ones(19, dtype=torch.bool), 19)
    assert_same(before, splats)


@MAKERS
def test_only_the_opacities_have_no_gradient(make: Any) -> None:
    """INRIA's reset of the opacities: their new Parameter has none, the others go on."""
    splats, phases, optimizer = upgraded(40, Annealing(names=GAUSSIAN), make=make)
    for left_out in ((), ("opacities",)):
        before = values_of(splats)
        pulled(splats, *left_out)
        phases.observe(0.1)
        optimizer.step(EVERY, 12)
        moved = {name for name in splats if not torch.equal(before[name], splats[name])}
        assert moved == set(splats) - set(left_out)


def test_other_groups_ride_along_without_the_mask() -> None:
    """INRIA's optimizer with an exposure: plain Adam on all of it, as without a mask."""
    splats, exposure = make_splats(), Parameter(torch.ones(3, 4))
    optimizer = inria_optimizer(splats)
    optimizer.add_param_group({"params": [exposure], "lr": 0.1, "name": "exposure"})
    phases = only(10, Annealing(names=GAUSSIAN), AveragedThroughout())
    whole: Any = phases.upgrade(optimizer)
    twin = Parameter(torch.ones(3, 4))
    plain = Adam([twin], lr=0.1, eps=1e-15)
    for p in (*splats.values(), exposure, twin):
        p.grad = torch.ones_like(p)
    phases.observe(0.1)
    whole.step(torch.arange(12) % 2, 12)
    plain.step()
    assert torch.equal(exposure, twin)
    with pytest.raises(ValueError, match="the mask has 3 rows"):
        whole.step(torch.ones(3))


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((torch.ones(5),), {}, "the mask has 5 rows, but the parameters have shapes [(4, 3)]"),
        ((torch.ones(4), 5), {}, "num_points=5, but the mask has 4 rows"),
        ((torch.ones(4),), {"visible": torch.ones(4)}, "2 masks"),
        ((torch.tensor(1.0),), {}, "a mask of shape [N]"),
        ((torch.ones(4, dtype=torch.complex64),), {}, "a mask of shape [N]"),
        ((), {"visible": [1, 0, 0, 1]}, "a mask of shape [N]"),
    ],
)
def test_bad_masks(arguments: tuple, options: dict[str, Any], message: str) -> None:
    x = Parameter(torch.ones(4, 3))
    x.grad = torch.ones(4, 3)
    optimizer: Any = AWSGLD([x], lr=0.1)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        optimizer.step(*arguments, **options)
    assert "AWSGLD.step" in str(error.value)
    assert torch.equal(x, torch.ones(4, 3))


def test_a_mask_and_a_differentiable_step() -> None:
    x = Parameter(torch.ones(4, 3))
    x.grad = torch.ones(4, 3)
    kept = AWSGLD([x], lr=torch.tensor(0.01), differentiable=True)
    with pytest.raises(ValueError, match="differentiable=True is not possible"):
        kept.step(visible=torch.ones(4, dtype=torch.bool))


# -- optimizers with masked steps of their own -----------------------------------------------------


OWN = [(SelectiveAdam, ()), (SparseGaussianAdam, (ROWS,))]


@pytest.mark.parametrize(("cls", "rest"), OWN, ids=["gsplat", "INRIA"])
@pytest.mark.parametrize("before", [0, 5])
@pytest.mark.parametrize("parts", ["none", "annealing", "nu, fading"])
def test_an_optimizer_with_masked_steps_keeps_its_arithmetic(
    cls: Any, rest: tuple, before: int, parts: str
) -> None:
    """No bias correction, as without us: its own steps, at the rate that the parts say."""
    ours, theirs = points(), points()
    mine, stock = (
        cls([{"params": [p], "lr": 0.1, "name": "xyz"}], eps=1e-15) for p in (ours, theirs)
    )
    steps = list(enumerate(masks()))
    for step, mask in steps[:before]:
        ours.grad, theirs.grad = gradients(ours, step), gradients(theirs, step)
        mine.step(mask, *rest)
        stock.step(mask, *rest)
    annealing = Annealing(8.0, 0.5, names=GAUSSIAN)
    chosen = {
        "none": [],
        "annealing": [annealing],
        "nu, fading": [ConstantMultiplier(2.0), Fading(0.5, events=3, start=0.9, stop=1.0)],
    }[parts]
    phases = only(STEPS, *chosen, switch=STEPS)
    optimizer: Any = phases.upgrade(mine)
    assert optimizer is mine
    decay, step = ExponentialLR(optimizer, 0.99), before
    for step, mask in steps[before:]:
        ours.grad, theirs.grad = gradients(ours, step), gradients(theirs, step)
        phases.observe(0.1, iteration=step)
        optimizer.step(mask, *rest)
        lr = mine.param_groups[0]["lr"]
        factor = {"none": 1.0, "annealing": annealing.at("means", step / STEPS)}.get(parts, 2.0)
        stock.param_groups[0]["lr"] = lr * factor
        stock.step(mask, *rest)
        decay.step()
        if parts == "nu, fading" and step >= 26:
            break  # its first event; until then it is a factor
        assert torch.equal(ours, theirs), step
    assert mine.param_groups[0]["lr"] == pytest.approx(0.1 * 0.99 ** (step + 1 - before))


class PooledMoments(Part):
    """One second moment for the coordinates of a point: a part that writes into all rows."""

    def after(self, group: Any, param: Tensor, state: dict[str, Any], course: Any) -> None:
        moment = state["exp_avg_sq"]
        moment.copy_(moment.mean(1, keepdim=True).expand_as(moment))


@pytest.mark.parametrize(
    ("cls", "options"), [(SelectiveAdam, {}), (Adam, {}), (Adam, {"fused": True})], ids=str
)
def test_parts_that_write_into_all_moments_after_a_masked_step(
    cls: type[Adam], options: dict[str, Any]
) -> None:
    """Those of invisible rows are put back, whosever step it is."""
    x = points()
    phases = only(STEPS, PooledMoments(), Annealing(names=GAUSSIAN))
    optimizer: Any = phases.upgrade(cls([{"params": [x], "lr": 0.1, "name": "means"}], **options))
    for step, mask in enumerate(masks()):
        x.grad = gradients(x, step)
        before = [x.detach().clone(), *(v.clone() for v in optimizer.state[x].values())]
        phases.observe(0.1)
        optimizer.step(mask)
        after = [x.detach(), *optimizer.state[x].values()]
        for old, new in zip(before[1:], after[1:], strict=False):
            if new.dim():
                assert torch.equal(old[~mask], new[~mask])
        assert torch.equal(before[0][~mask], x[~mask])
    moment = optimizer.state[x]["exp_avg_sq"]
    assert bool((moment == moment[:, :1]).all())


def test_its_broken_loss_skips_the_step_too() -> None:
    x = points()
    phases = only(STEPS, Annealing(names=GAUSSIAN))
    optimizer: Any = phases.upgrade(SelectiveAdam([{"params": [x], "lr": 0.1, "name": "means"}]))
    phases.observe(float("nan"))
    x.grad = torch.ones(ROWS, 3)
    optimizer.step(torch.ones(ROWS, dtype=torch.bool))
    assert torch.equal(x, points())
