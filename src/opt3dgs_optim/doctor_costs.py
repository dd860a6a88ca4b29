"""What a step costs on this machine: time and bytes per Gaussian, measured."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import curvature, ops
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.phases import PhaseScheduler

HISTORY_SIZE = 5
NOISE_SCALE = 5e5
WARM_UP, ROUNDS = 3, 7
SHAPES = {
    "means": (3,),
    "scales": (3,),
    "quats": (4,),
    "opacities": (),
    "sh0": (1, 3),
    "shN": (15, 3),
}


@dataclass(frozen=True)
class Cost:
    """Of one thing, per Gaussian.

    Attributes:
        ns_per_point: nanoseconds, the median; also milliseconds per million Gaussians.
        bytes_kept: optimizer state between steps, or None for a part of a step.
        bytes_moved: the least that has to be read and written: each tensor once a way.
    """

    name: str
    ns_per_point: float
    bytes_kept: float | None
    bytes_moved: float


@dataclass(frozen=True)
class _Subject:
    call: Callable[[], Any]
    count: Callable[[], tuple[int | None, int]]  # bytes kept (or None) and moved, once warmed up


def measure(device: torch.device, points: int, show: Callable[[str], None]) -> list[Cost]:
    """The costs of steps and of their parts, for that many Gaussians with degree-3 colours.

    One subject after the other, so that no more than one scene is in memory (1.2 kB per Gaussian).
    """
    costs = []
    for name, make in SUBJECTS.items():
        show(name)
        subject = make(points, device)
        for _ in range(WARM_UP):
            subject.call()
        seconds = statistics.median(_timed(subject.call, device) for _ in range(ROUNDS))
        kept, moved = subject.count()
        costs.append(
            Cost(
                name,
                seconds / points * 1e9,
                None if kept is None else kept / points,
                moved / points,
            )
        )
    return costs


def _timed(call: Callable[[], Any], device: torch.device) -> float:
    """Seconds of one call; on a GPU until its work is done."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    begin = time.perf_counter()
    call()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() - begin


def _draw(points: int, device: torch.device) -> dict[str, torch.nn.Parameter]:
    generator = torch.Generator(device=device).manual_seed(0)
    return {
        name: torch.nn.Parameter(torch.randn(points, *shape, device=device, generator=generator))
        for name, shape in SHAPES.items()
    }


def _adams(splats: dict[str, torch.nn.Parameter], device: torch.device) -> dict[str, Any]:
    fused = True if device.type == "cuda" else None
    return {
        name: torch.optim.Adam(
            [{"params": [param], "lr": 1e-4, "name": name}], eps=1e-15, fused=fused
        )
        for name, param in splats.items()
    }


def _nbytes(tensors: Iterable[Tensor | None]) -> int:
    return sum(tensor.nbytes for tensor in tensors if tensor is not None)


def _state_bytes(optimizers: dict[str, Any]) -> int:
    states = (state for optimizer in optimizers.values() for state in optimizer.state.values())
    # 0-d: Adam's step counts, which are not per Gaussian.
    return _nbytes(value for state in states for value in state.values() if value.dim() > 0)


def _step(points: int, device: torch.device, *, exploit: bool | None) -> _Subject:
    """A step of six optimizers: torch's (None), ours with nu and noise, ours with curvature too."""
    splats = _draw(points, device)
    optimizers = _adams(splats, device)
    scheduler: PhaseScheduler | None = None
    if exploit is not None:
        scheduler = _paper_parts(exploit)
        optimizers = scheduler.upgrade(optimizers, splats)
    for param in splats.values():
        param.grad = 1e-4 * torch.randn_like(param)
    # New gradients of the positions in every step: a curvature pair is a difference of two.
    grads = [1e-4 * torch.randn_like(splats["means"]) for _ in range(4)]
    losses = list(torch.rand(16, device=device).unbind())
    count = 0

    def call() -> None:
        nonlocal count
        count += 1
        splats["means"].grad = grads[count % 4]
        if scheduler is not None:
            scheduler.observe(losses[count % 16])
        for optimizer in optimizers.values():
            optimizer.step()

    def bytes_of() -> tuple[int, int]:
        params, kept = splats.values(), _state_bytes(optimizers)
        moved = 2 * _nbytes(params) + _nbytes(p.grad for p in params) + 2 * kept
        return kept, moved + (0 if exploit is None else _noise_bytes(splats))

    return _Subject(call, bytes_of)


def _paper_parts(exploit: bool) -> PhaseScheduler:
    """All parts of the paper and the noise, in one of the two phases for good."""
    steps = 1_000_000
    return PhaseScheduler(
        steps,
        switch=0 if exploit else steps,
        multiplier=EnergyHistogram(energy_range=(0.0, 1.0), temperature=0.1, warmup=0),
        curvature=CurvatureOptions(),
        squared_loss=True,
        noise_scale=NOISE_SCALE,
    )


def _noise_bytes(splats: dict[str, torch.nn.Parameter]) -> int:
    """Read by the noise: eta and what shapes it; the means are read and written."""
    shaping = [splats[name] for name in ("scales", "quats", "opacities")]
    return _nbytes(shaping) + 3 * splats["means"].nbytes


def _noise(points: int, device: torch.device) -> _Subject:
    splats = _draw(points, device)
    tensors = [splats[name].detach() for name in ("means", "scales", "quats", "opacities")]
    lr = torch.tensor(1e-4, device=device)

    def call() -> None:
        eta = torch.randn_like(tensors[0])
        ops.add_covariance_noise(*tensors, eta=eta, lr=lr, noise_scale=NOISE_SCALE)

    return _Subject(call, lambda: (None, _noise_bytes(splats)))


def _history(points: int, device: torch.device) -> Tensor:
    s = torch.randn(HISTORY_SIZE, points, 3, device=device)
    y = s * torch.tensor([1.0, 2.0, 3.0], device=device)
    return curvature.laid_out(curvature.history_from_pairs(s, y), contiguous=device.type == "cuda")


def _record_and_direction(points: int, device: torch.device) -> _Subject:
    history = _history(points, device)
    positions = [torch.randn(points, 3, device=device) for _ in range(4)]
    scaling = torch.tensor([1.0, 2.0, 3.0], device=device)  # of one quadratic: pairs are accepted
    moves = [(position, position * scaling) for position in positions]
    count = 0

    def call() -> None:
        nonlocal count
        count += 1
        position, grad = moves[count % 4]
        ops.lqn_direction(
            position,
            grad,
            history,
            HISTORY_SIZE,
            min_cosine=1e-6,
            powell=False,
            graft=True,
            gamma_clamp=None,
        )

    return _Subject(call, lambda: (None, 2 * history.nbytes + 3 * positions[0].nbytes))


def _two_loop(points: int, device: torch.device) -> _Subject:
    history = _history(points, device)
    grad = torch.randn(points, 3, device=device)
    return _Subject(
        lambda: curvature.two_loop(grad, history, HISTORY_SIZE),
        lambda: (None, history.nbytes + 2 * grad.nbytes),
    )


SUBJECTS: dict[str, Callable[[int, torch.device], _Subject]] = {
    "six torch Adams": lambda n, d: _step(n, d, exploit=None),
    "exploration step": lambda n, d: _step(n, d, exploit=False),
    "exploitation step": lambda n, d: _step(n, d, exploit=True),
    "noise": _noise,
    "pair and two-loop": _record_and_direction,
    "two-loop, pure torch": _two_loop,
}
