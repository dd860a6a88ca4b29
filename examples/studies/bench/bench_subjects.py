"""What `bench_step.py` times: steps of optimizers, and their parts alone."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import (
    DEFAULTS,
    Curvature,
    EnergyHistogram,
    Part,
    PhaseScheduler,
    PositionNoise,
    SquaredLoss,
    two_loop,
)
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history
from opt3dgs_optim.lbfgs.history import laid_out

HISTORY_SIZE = 5
NOISE_LR = 5e5
SETTLING = 200  # steps after which `OutOfView` knows that views see a tenth
LEARNING_RATES = {
    "means": 1.6e-4,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}


class Case:
    """Gaussians of gsplat's shapes with gradients, on a device."""

    def __init__(self, points: int, device: torch.device) -> None:
        self.points, self.device = points, device
        self.generator = torch.Generator(device=device).manual_seed(0)

    def draw(self, *shape: int) -> Tensor:
        return torch.randn(self.points, *shape, device=self.device, generator=self.generator)

    def splats(self) -> dict[str, Parameter]:
        """Fresh parameters with gradients; 59 numbers per point."""
        raw = {
            "means": self.draw(3),
            "scales": 0.5 * self.draw(3) - 4,
            "quats": self.draw(4),
            "opacities": self.draw() - 1,
            "sh0": self.draw(1, 3),
            "shN": self.draw(15, 3),
        }
        params = {name: Parameter(tensor) for name, tensor in raw.items()}
        for param in params.values():
            param.grad = 1e-4 * torch.randn_like(param)
        return params

    def adams(self, splats: dict[str, Parameter]) -> dict[str, torch.optim.Adam]:
        """gsplat's optimizers; on a GPU they are fused, as gsplat's."""
        fused = self.device.type == "cuda"
        return {
            name: torch.optim.Adam(
                [{"params": [param], "lr": LEARNING_RATES[name], "name": name}],
                eps=1e-15,
                fused=fused,
            )
            for name, param in splats.items()
        }


def gsplat_noise(splats: dict[str, Parameter], lr: float) -> None:
    """gsplat's `inject_noise_to_position` in the torch operations that it consists of."""
    with torch.no_grad():
        opacities, scales = torch.sigmoid(splats["opacities"]), torch.exp(splats["scales"])
        w, x, y, z = torch.nn.functional.normalize(splats["quats"], dim=-1).unbind(-1)
        rotation = torch.stack(
            [
                1 - 2 * (y * y + z * z),
                2 * (x * y - w * z),
                2 * (x * z + w * y),
                2 * (x * y + w * z),
                1 - 2 * (x * x + z * z),
                2 * (y * z - w * x),
                2 * (x * z - w * y),
                2 * (y * z + w * x),
                1 - 2 * (x * x + y * y),
            ],
            dim=-1,
        ).reshape(-1, 3, 3)
        shape = rotation * scales[:, None, :]
        covars = torch.bmm(shape, shape.transpose(1, 2))
        gate = 1 / (1 + torch.exp(-100 * ((1 - opacities) - 0.995)))
        noise = torch.randn_like(splats["means"]) * gate.unsqueeze(-1) * lr
        splats["means"].add_(torch.einsum("bij,bj->bi", covars, noise))


def six_adams(case: Case) -> Callable[[], None]:
    splats = case.splats()
    optimizers = case.adams(splats)

    def step() -> None:
        for optimizer in optimizers.values():
            optimizer.step()

    return step


def gsplat_noise_alone(case: Case) -> Callable[[], None]:
    splats = case.splats()
    return lambda: gsplat_noise(splats, LEARNING_RATES["means"] * NOISE_LR)


def upgraded(
    case: Case,
    parts: list[Part],
    *,
    exploit: bool = False,
    seen: float = 1.0,
    at: float = 0.25,
    masked: bool = False,
) -> Callable[[], None]:
    """Six upgraded optimizers with these parts, and `observe`; views see that share of points.

    At a quarter of the run events of fading are as frequent as they get. `masked`: every step is
    one of the visible points alone.
    """
    splats, steps = case.splats(), 1_000_000
    phases = PhaseScheduler(steps, 0 if exploit else steps, parts)
    optimizers: Any = phases.upgrade(case.adams(splats))
    losses = list(torch.rand(64, device=case.device).mul(0.2).unbind())
    grads = [1e-4 * torch.randn_like(splats["means"]) for _ in range(8)]
    if seen < 1.0:
        for grad in grads:
            grad.mul_(torch.rand(case.points, 1, device=case.device) < seen)
    visible = torch.rand(case.points, device=case.device) < seen if masked else None
    count = round(at * steps)  # a call is one iteration

    def advance() -> None:
        nonlocal count
        count += 1
        # New gradients, as in a training: a pair is a difference of two of them.
        splats["means"].grad = grads[count % 8]
        phases.observe(losses[count % 64], iteration=count)

    def step() -> None:
        advance()
        for optimizer in optimizers.values():
            if visible is None:
                optimizer.step()
            else:
                optimizer.step(visible=visible)

    if seen < 1.0:  # the mean share is of the last hundred views, and begins at 1
        for _ in range(SETTLING):
            advance()
            optimizers["means"].step()
    return step


def noise_alone(case: Case) -> Callable[[], Any]:
    splats = case.splats()
    noise = PositionNoise(splats, NOISE_LR)
    lr = torch.tensor(LEARNING_RATES["means"], device=case.device)
    return lambda: noise.add_to(splats["means"], lr)


def curvature_alone(case: Case) -> Callable[[], Any]:
    """Pairs and direction, as `Curvature` computes them."""
    history = laid_out(full_history(case), contiguous=case.device.type == "cuda")
    # Gradients of one quadratic: every pair is accepted, so that every step stores one.
    positions = [case.draw(3) for _ in range(4)]
    scaling = torch.tensor([1.0, 2.0, 3.0], device=case.device)
    moves = [(position, position * scaling) for position in positions]
    count = 0

    def step() -> None:
        nonlocal count
        count += 1
        lqn_direction(*moves[count % 4], history, HISTORY_SIZE, min_cosine=1e-6, graft=True)

    return step


def two_loop_alone(case: Case) -> Callable[[], Any]:
    grad, history = case.draw(3), full_history(case)
    return lambda: two_loop(grad, history, HISTORY_SIZE)


def full_history(case: Case) -> Tensor:
    """A history in which every point has all its pairs."""
    s = torch.stack([case.draw(3) for _ in range(HISTORY_SIZE)])
    return history_from_pairs(s, 2 * s + 0.3 * torch.randn_like(s))


def copy_144(case: Case) -> Callable[[], Any]:
    """A copy of as many bytes as the two-loop reads and writes: 120 of pairs, 12 in, 12 out."""
    source = torch.zeros(case.points * 36, device=case.device)
    target = torch.empty_like(source)
    return lambda: target.copy_(source)


SUBJECTS: dict[str, Callable[[Case], Callable[[], Any]]] = {
    "six Adams": six_adams,
    "six Adams again": six_adams,  # other tensors, elsewhere in memory: how exact a ratio is
    "defaults": lambda case: upgraded(case, [*DEFAULTS]),
    "defaults, a tenth in view": lambda case: upgraded(case, [*DEFAULTS], seen=0.1),
    "defaults, steps of a tenth": lambda case: upgraded(case, [*DEFAULTS], seen=0.1, masked=True),
    "defaults, last thirtieth": lambda case: upgraded(case, [*DEFAULTS], at=0.975),
    "defaults + histogram": lambda case: upgraded(case, [*DEFAULTS, EnergyHistogram(warmup=4)]),
    "the paper's exploration": lambda case: upgraded(case, [EnergyHistogram.paper(warmup=4)]),
    "the paper's exploitation": lambda case: upgraded(
        case, [SquaredLoss(), Curvature()], exploit=True, at=0.0
    ),
    "position noise alone": noise_alone,
    "gsplat's noise alone": gsplat_noise_alone,
    "record + direction alone": curvature_alone,
    "two-loop, [N, 3] in and out": two_loop_alone,
    "copy of 144 bytes": copy_144,
}


def history_bytes() -> int:
    """Bytes of curvature history per point."""
    return new_history(torch.zeros(1, 3), HISTORY_SIZE).nbytes


def kernel_bandwidth_share(kernel: float, copy: float) -> float:
    """The kernel's bytes per second over the copy's, from their seconds.

    Read: 160 bytes of history, position, gradient; written: the history again (every pair of these
    problems is accepted), direction and two flags. The copy reads and writes 144 each.
    """
    kernel_bytes = 160 + 24 + 160 + 12 + 2
    return (kernel_bytes / kernel) / (288 / copy)


def gpu_only(device: torch.device) -> dict[str, float]:
    """Latency of the first use (compilation, or the disk cache) and CPU time per launch."""
    small = Case(1024, device)
    torch.cuda.synchronize(device)
    begin = time.perf_counter()
    call = curvature_alone(small)
    call()
    torch.cuda.synchronize(device)
    first_use = time.perf_counter() - begin
    begin = time.perf_counter()
    for _ in range(1000):
        call()
    per_launch = (time.perf_counter() - begin) / 1000
    torch.cuda.synchronize(device)
    return {"first_use_seconds": first_use, "cpu_seconds_per_lqn_launch": per_launch}
