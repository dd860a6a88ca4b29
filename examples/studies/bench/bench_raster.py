"""Time the parts of an iteration: python examples/studies/bench/bench_raster.py [--points N] ...

Prints median, 10 % and 90 % quantile in milliseconds of each part, for a random scene.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from splatting.camera import Camera
from splatting.metrics import photometric_loss
from splatting.rasterizer import render
from torch import Tensor


def synthetic_scene(points: int, degree: int, seed: int = 0) -> dict[str, Tensor]:
    """A cube of `points` Gaussians, each about as wide as the mean distance between them."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    spacing = 2.0 * max(points, 1) ** (-1 / 3)
    return {
        "means": 2 * torch.rand(points, 3, generator=generator) - 1,
        "quats": normal(points, 4),
        "scales": 0.3 * normal(points, 3) + torch.log(torch.tensor(0.3 * spacing)),
        "opacities": 1.5 * normal(points),
        "sh0": normal(points, 1, 3),
        "shN": 0.1 * normal(points, (degree + 1) ** 2 - 1, 3),
    }


def synthetic_camera(width: int, height: int) -> Camera:
    """A camera that sees the cube [-1, 1]^3 from a distance of 4."""
    viewmat = torch.eye(4)
    viewmat[2, 3] = 4.0
    return Camera(viewmat, 1.2 * width, 1.2 * width, width / 2, height / 2, width, height)


def measure(arguments: argparse.Namespace) -> dict[str, list[float]]:
    """Milliseconds of each part in each repetition."""
    camera = synthetic_camera(arguments.width, arguments.height)
    gaussians = synthetic_scene(arguments.points, arguments.degree)
    with torch.no_grad():
        target = render(synthetic_scene(arguments.points, arguments.degree, 1), camera).image
    for tensor in gaussians.values():
        tensor.requires_grad_()
    optimizers = [torch.optim.Adam([t], lr=1e-3, eps=1e-15) for t in gaussians.values()]
    times: dict[str, list[float]] = {}
    for repetition in range(arguments.warmup + arguments.repeat):
        marks = [("start", time.perf_counter())]

        def mark(name: str, marks: list[tuple[str, float]] = marks) -> None:
            marks.append((name, time.perf_counter()))

        rendered = render(gaussians, camera).image
        mark("render, forward")
        image = rendered.detach().requires_grad_()
        loss = photometric_loss(image, target)
        mark("loss, forward")
        (gradient,) = torch.autograd.grad(loss, image)
        mark("loss, backward")
        rendered.backward(gradient)
        mark("render, backward")
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad()
        mark("Adam")
        if repetition < arguments.warmup:
            continue
        for (_, before), (name, after) in itertools.pairwise(marks):
            times.setdefault(name, []).append(1e3 * (after - before))
        times.setdefault("iteration", []).append(1e3 * (marks[-1][1] - marks[0][1]))
    return times


def main() -> None:
    """Parse the options, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=4000)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--height", type=int, default=106)
    parser.add_argument("--degree", type=int, default=0, choices=range(4))
    parser.add_argument("--repeat", type=int, default=100)
    parser.add_argument("--warmup", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    for name, values in measure(arguments).items():
        deciles = statistics.quantiles(values, n=10)
        spread = f"{deciles[0]:.2f} .. {deciles[-1]:.2f}"
        print(f"{name:18} {statistics.median(values):7.2f} ms   ({spread})")


if __name__ == "__main__":
    main()
