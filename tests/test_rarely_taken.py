"""Paths that no training on a healthy machine takes: odd devices, masks, files and processes."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from opt3dgs_optim._evidence import largest_noise
from opt3dgs_optim._nonfinite import CAPACITY, FrozenRows
from opt3dgs_optim._ranks import RankMean
from opt3dgs_optim._visible import masked_adam
from torch import Tensor
from trainers import everything, gsplat_optimizers, make_splats, train

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam, PhaseScheduler, cuda, ops


class OnGpu(Tensor):
    """A tensor that says that it lies on a GPU: takes the paths without a synchronisation."""

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return torch.device("cuda", 0)


def noise(rows: int, seed: int = 0) -> Tensor:
    return torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))


# -- broken rows in a list of fixed size -----------------------------------------------------------


@pytest.mark.parametrize("broken", [[], [0], [3, 700], [0, 1, 2, 9_999]])
def test_the_list_of_fixed_size_saves_the_same_rows(broken: list[int]) -> None:
    ends = []
    for gpu in (False, True):
        x, grad = noise(10_000), noise(10_000, 1)
        grad[broken, 1] = math.nan
        given = grad.as_subclass(OnGpu) if gpu else grad
        frozen = FrozenRows.find(given, [x])
        assert (frozen is None) == (not gpu and not broken)
        x += 1.0
        if frozen is not None:
            assert int(frozen.count) == len(broken)
            frozen.restore()
            overflow = frozen.overflow
            assert (overflow is not None) == gpu
            assert overflow is None or float(overflow) == 0.0
        ends.append((x, grad))
    assert torch.equal(ends[0][0], ends[1][0])
    assert torch.equal(ends[0][1], ends[1][1])
    assert bool(torch.isfinite(ends[1][1]).all())
    assert torch.equal(ends[1][0][broken], noise(10_000)[broken])


def test_more_broken_rows_than_places_are_told() -> None:
    grad = noise(CAPACITY + 10)
    grad[:, 0] = math.inf
    frozen = FrozenRows.find(grad.as_subclass(OnGpu), [noise(CAPACITY + 10)])
    assert frozen is not None
    assert float(frozen.overflow if frozen.overflow is not None else 0.0) == 1.0
    assert int(frozen.count) == CAPACITY + 10


# -- the kernels' door -----------------------------------------------------------------------------


def gaussians(rows: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return noise(rows), torch.ones(rows, 4), torch.zeros(rows, 1), noise(rows, 1)


def test_the_noise_kernel_gets_what_it_can_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Opacities as [N], everything in the means' dtype and on their device, or an error."""
    seen: list[Any] = []
    monkeypatch.setattr(ops, "uses_kernel", lambda *_: True)
    monkeypatch.setattr(cuda, "add_covariance_noise", lambda *given: seen.append(given))
    options: dict[str, Any] = {"noise_scale": 2.0, "backend": "cuda"}
    lr, (scales, quats, opacities, eta) = torch.tensor(0.1), gaussians(5)

    def add(means: Tensor, scales: Tensor, quats: Tensor) -> None:
        ops.add_covariance_noise(means, scales, quats, opacities, eta=eta, lr=lr, **options)

    add(torch.zeros(5, 3), scales, quats)
    ((means, *_, flat, _, _, scale, sharpness, threshold),) = seen
    assert means.shape == (5, 3)
    assert flat.shape == (5,)
    assert (scale, sharpness, threshold) == (2.0, 100.0, 0.005)
    with pytest.raises(ValueError, match=r"add_covariance_noise: scales is \(5, 3\) torch.float64"):
        add(torch.zeros(5, 3), scales.double(), quats)
    with pytest.raises(ValueError, match=r"shape \(5, 2\), but \[N, 3\] is needed"):
        add(torch.zeros(5, 2), scales, quats)
    with pytest.raises(ValueError, match="quats is"):
        add(torch.zeros(5, 3), scales, quats[:4])
    assert len(seen) == 1


# -- masks -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", [AWSGLD, LQNAdam])
def test_masks_that_cannot_be_meant(cls: Any) -> None:
    x = torch.nn.Parameter(noise(4))
    x.grad = torch.ones(4, 3)
    optimizer = cls([x], lr=0.01)
    optimizer.step(visible=torch.tensor([True, False, True, True]))
    with pytest.raises(ValueError, match=r"mask has 5 rows, but the parameters have shapes"):
        optimizer.step(visible=torch.ones(5, dtype=torch.bool))
    kept = cls([x], lr=torch.tensor(0.01), differentiable=True)
    with pytest.raises(ValueError, match="differentiable=True is not possible"):
        kept.step(visible=torch.ones(4, dtype=torch.bool))


def test_a_mask_where_broken_rows_are_not_looked_for() -> None:
    """`skip_nonfinite=False`: a broken row that is seen becomes NaN, one that is not does not."""
    x = torch.nn.Parameter(noise(3))
    before = x.detach().clone()
    optimizer = AWSGLD([x], lr=0.01, skip_nonfinite=False)
    x.grad = torch.full((3, 3), math.nan)
    x.grad[0] = 1.0
    optimizer.step(visible=torch.tensor([True, True, False]))
    assert bool(x[1].isnan().all())
    assert torch.equal(x[2], before[2])
    assert bool((x[0] < before[0]).all())


def test_a_mask_before_any_gradient() -> None:
    x = torch.nn.Parameter(noise(3))
    before = x.detach().clone()
    AWSGLD([x], lr=0.01).step(visible=torch.ones(3, dtype=torch.bool))
    assert torch.equal(x, before)


def test_coupled_weight_decay_of_seen_rows() -> None:
    """As torch.optim.Adam with weight_decay, for the rows that are seen."""
    x, y = torch.nn.Parameter(noise(4)), torch.nn.Parameter(noise(4))
    theirs = torch.optim.Adam([y], lr=0.01, weight_decay=0.1)
    state = {"exp_avg": torch.zeros(4, 3), "exp_avg_sq": torch.zeros(4, 3), "step": torch.zeros(())}
    counts, visible = torch.zeros(4), torch.tensor([True, True, False, True])
    for seed in range(3):
        y.grad = noise(4, seed)
        theirs.step()
        with torch.no_grad():
            masked_adam(
                x,
                noise(4, seed),
                state,
                counts,
                visible,
                lr=0.01,
                beta1=0.9,
                beta2=0.999,
                eps=1e-8,
                weight_decay=0.1,
                decoupled=False,
                amsgrad=False,
                maximize=False,
            )
    torch.testing.assert_close(x[visible], y[visible])  # another order of the same operations
    assert torch.equal(x[2], noise(4)[2])


# -- ranks -----------------------------------------------------------------------------------------


def test_a_process_that_is_not_in_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    from torch import distributed

    monkeypatch.setattr(distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(distributed, "get_rank", lambda group: -1)
    with pytest.raises(ValueError, match="call: this process does not belong to 'others'"):
        RankMean("call", "others")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_half_precision_energies_are_summed_in_float32(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two ranks of 40,000: their sum is beyond float16."""
    from torch import distributed

    monkeypatch.setattr(distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(distributed, "get_rank", lambda group: 0)
    monkeypatch.setattr(distributed, "get_world_size", lambda group: 2)
    monkeypatch.setattr(distributed, "all_reduce", lambda total, group: total.mul_(2))
    energy = torch.tensor(40_000.0, dtype=dtype)
    mean = RankMean("call", "all")(energy)
    assert mean.shape == ()
    assert float(mean) == float(energy)
    assert mean.dtype == (dtype if dtype.itemsize > 2 else torch.float32)


# -- the rest --------------------------------------------------------------------------------------


def test_no_gaussian_has_no_noise() -> None:
    assert float(largest_noise(torch.zeros(0, 3), torch.zeros(0), 5e5)) == 0.0


def test_a_loss_given_to_step_is_observed() -> None:
    splats = make_splats()
    phases = PhaseScheduler(40, 20, multiplier=EnergyHistogram(warmup=4))
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    closure: Any = lambda: torch.tensor(0.5)  # noqa: E731
    optimizers["means"].step(closure)
    assert phases.num_observed == 1


def test_losses_that_move_to_another_device() -> None:
    phases = everything(40, 20, multiplier=None)
    splats = make_splats()
    train(splats, phases.upgrade(gsplat_optimizers(splats)), phases, 0, 3)
    phases.observe(torch.zeros((), device="meta"))
    assert phases.last_finite.device.type == "meta"
