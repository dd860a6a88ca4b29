"""The doctor's self-test: this installation against identities and slow references, in seconds.

The references are written out here, in float64 and with dense matrices, and share no code with what
they check.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.awsgld import AWSGLD
from opt3dgs_optim.backend import Backend, backend_info
from opt3dgs_optim.covariance import add_covariance_noise, covariance_noise
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, two_loop
from opt3dgs_optim.lqnadam import LQNAdam
from opt3dgs_optim.parts.histogram import EnergyHistogram

HISTORY_SIZE = 5
ROWS = 1000
EXACT = 1e-10  # float64, sums of a few dozen products
ROUNDED = 1e-4  # float32 twice, in another order of the operations
PROBE = "sm_80"  # an architecture to compile for where there is no device


@dataclass(frozen=True)
class Check:
    """One line of the self-test. "skipped" is no failure; `detail` says what was not tried."""

    name: str
    outcome: Literal["ok", "failed", "skipped"]
    detail: str


class CannotCheckError(Exception):
    """A check cannot be made here."""


def run_checks(device: torch.device) -> list[Check]:
    """All checks on `device`."""
    done = []
    for name, check in CHECKS.items():
        try:
            done.append(Check(name, "ok", check(device)))
        except CannotCheckError as reason:
            done.append(Check(name, "skipped", str(reason)))
        except Exception as error:  # whatever a broken installation raises is the finding
            done.append(Check(name, "failed", f"{type(error).__name__}: {error}"))
    return done


def _draw(*shape: int, device: torch.device, seed: int = 0) -> Tensor:
    # Drawn on the CPU, so that every device gets the same numbers.
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, dtype=torch.float64, generator=generator).to(device)


def _pairs(device: torch.device) -> tuple[Tensor, Tensor]:
    """Parameter and gradient differences [K, N, 3] of quadratics, so that s.y > 0."""
    s = _draw(HISTORY_SIZE, ROWS, 3, device=device, seed=1)
    half = _draw(ROWS, 3, 3, device=device, seed=2)
    hessian = half @ half.mT + torch.eye(3, dtype=s.dtype, device=device)
    return s, torch.einsum("nij,knj->kni", hessian, s)


def _gaussians(device: torch.device) -> list[Tensor]:
    """Log scales, quaternions, logits around the gate's threshold, and normal numbers."""
    shapes = ((ROWS, 3), (ROWS, 4), (ROWS,), (ROWS, 3))
    drawn = [_draw(*shape, device=device, seed=10 + i) for i, shape in enumerate(shapes)]
    drawn[2] -= 5
    return drawn


def _within(found: Tensor, expected: Tensor, limit: float, what: str) -> str:
    """The relative difference in words; ArithmeticError if it is over `limit`."""
    difference = float((found - expected).abs().max() / expected.abs().max())
    said = f"relative difference {difference:.1e} to {what} (limit {limit:.0e})"
    if not difference <= limit:  # NaN too
        raise ArithmeticError(said)
    return said


def dense_bfgs(s: Tensor, y: Tensor) -> Tensor:
    """Inverse Hessians [N, 3, 3] after the pairs [K, N, 3]; Nocedal and Wright (2006), eq. 7.16."""
    eye = torch.eye(3, dtype=s.dtype, device=s.device)
    gamma = (s[-1] * y[-1]).sum(-1) / (y[-1] * y[-1]).sum(-1)
    matrix = gamma[:, None, None] * eye
    for s_k, y_k in zip(s, y, strict=True):
        rho = 1 / (s_k * y_k).sum(-1)[:, None, None]
        left = eye - rho * s_k[:, :, None] * y_k[:, None, :]
        matrix = left @ matrix @ left.mT + rho * s_k[:, :, None] * s_k[:, None, :]
    return matrix


def recursion_against_dense_matrices(device: torch.device) -> str:
    """The recursion equals the product with the dense matrix."""
    (s, y), grad = _pairs(device), _draw(ROWS, 3, device=device, seed=3)
    found = two_loop(grad, history_from_pairs(s, y), HISTORY_SIZE)
    expected = torch.einsum("nij,nj->ni", dense_bfgs(s, y), grad)
    return _within(found, expected, EXACT, "dense BFGS matrices, float64")


def adam_when_all_is_off(device: torch.device) -> str:
    """nu and noise off is torch's Adam, bit for bit; so is a first step without pairs."""
    for make, steps in ((AWSGLD, 5), (LQNAdam, 1)):
        ours = torch.nn.Parameter(_draw(ROWS, 3, device=device).float())
        theirs = torch.nn.Parameter(ours.detach().clone())
        optimizers = make([ours], lr=0.01), torch.optim.Adam([theirs], lr=0.01)
        for step in range(steps):
            for x, optimizer in zip((ours, theirs), optimizers, strict=True):
                x.grad = _draw(ROWS, 3, device=device, seed=step).float()
                optimizer.step()
        if not torch.equal(ours, theirs):
            raise ArithmeticError(f"{make.__name__} with nothing on differs from torch.optim.Adam")
    return "AWSGLD with nu and noise off, LQNAdam without pairs: bit for bit"


def covariance_of_the_noise(device: torch.device) -> str:
    """The noise equals the gated product with R diag(exp(2 s)) R^T."""
    scales, quats, opacities, eta = _gaussians(device)
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    rotation = torch.stack([torch.stack(row, -1) for row in rows], -2)
    sigma = rotation @ torch.diag_embed((2 * scales).exp()) @ rotation.mT
    gate = torch.sigmoid(-100 * (torch.sigmoid(opacities) - 0.005))
    expected = gate[:, None] * torch.einsum("nij,nj->ni", sigma, eta)
    found = covariance_noise(scales, quats, opacities, eta)
    return _within(found, expected, EXACT, "R S S R^T, float64")


def histogram_weights(device: torch.device) -> str:
    """Weights stay positive with sum 1; nu is 1 in the warm-up and moves after it."""
    histogram = EnergyHistogram(20, (0.0, 1.0), temperature=0.1, warmup=50)
    energies = (0.5 + 0.1 * _draw(200, device=device, seed=4)).clamp(0.01, 0.99)
    nus = torch.stack([histogram.observe(energy) for energy in energies]).cpu()
    total, least = float(histogram.weights.sum()), float(histogram.weights.min())
    if abs(total - 1) > EXACT or least <= 0:
        raise ArithmeticError(f"the weights sum to {total!r}, the least is {least!r}")
    if bool((nus[:50] != 1).any()) or not bool((nus[50:] != 1).any()):
        raise ArithmeticError("nu must be 1 in the warm-up, and only there")
    return f"sum 1, all positive; nu 1 in the warm-up, {nus.min():.2g} to {nus.max():.2g} after it"


def kernels_against_torch(device: torch.device) -> str:
    """The CUDA kernels against the same in torch; without a GPU they are compiled at most."""
    info = backend_info(device)
    if info.backend == "cuda":
        return (
            f"{_kernels(device, torch.float64, EXACT)}; {_kernels(device, torch.float32, ROUNDED)}"
        )
    try:
        for name in sorted(set(cuda.KERNELS.values())):
            size = HISTORY_SIZE if name == "lqn.cu" else None
            cuda.compile_cubin(name, torch.float32, PROBE, history_size=size)
    except Exception as error:  # no cuda.core, an incomplete NVRTC: no harm where nothing launches
        tried = f"not compiled ({type(error).__name__}: {error})"
    else:
        tried = f"compiled for {PROBE}"
    raise CannotCheckError(f"{tried}, not launched: {info.reason}")


def _kernels(device: torch.device, dtype: torch.dtype, limit: float) -> str:
    s, y = (tensor.to(dtype) for tensor in _pairs(device))
    position, grad = (_draw(ROWS, 3, device=device, seed=i).to(dtype) for i in (5, 6))
    *gaussians, eta = (tensor.to(dtype) for tensor in _gaussians(device))
    found = []
    backends: tuple[Backend, ...] = ("cuda", "torch")
    for backend in backends:
        means, history = torch.zeros_like(position), history_from_pairs(s, y)
        fed, *_ = lqn_direction(
            position, grad, history, HISTORY_SIZE, min_cosine=1e-6, graft=True, backend=backend
        )
        add_covariance_noise(means, *gaussians, eta=eta, lr=1.0, noise_scale=1.0, backend=backend)
        found.append((fed, means))
    kind = str(dtype).removeprefix("torch.")
    _within(found[0][1], found[1][1], limit, f"the torch noise, {kind}")
    return _within(found[0][0], found[1][0], limit, f"torch, {kind}")


CHECKS: dict[str, Callable[[torch.device], str]] = {
    "two-loop recursion": recursion_against_dense_matrices,
    "Adam with all off": adam_when_all_is_off,
    "covariance noise": covariance_of_the_noise,
    "energy histogram": histogram_weights,
    "CUDA kernels": kernels_against_torch,
}
