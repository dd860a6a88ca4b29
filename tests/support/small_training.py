"""A small real training that can be killed at any time: Gaussians fitted to a few images.

    python tests/support/small_training.py FOLDER --steps 400 --every 20

Continues from FOLDER/checkpoint.pt where there is one, and writes FOLDER/memory.txt: resident bytes
at each tenth of the run. Runs by itself, so that a test can kill it.
"""

from __future__ import annotations

import argparse
import gc
import os
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import Parameter
from trainers import everything

from opt3dgs_optim import EnergyHistogram

POINTS, SIZE, VIEWS = 24, 12, 6
RATES = {"means": 5e-3, "scales": 5e-3, "quats": 1e-3, "opacities": 2e-2, "sh0": 1e-2}
WIDTHS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (3,)}


def start(seed: int = 0) -> dict[str, Parameter]:
    """Random Gaussians in a unit cube."""
    generator = torch.Generator().manual_seed(seed)
    splats = {
        name: torch.randn(POINTS, *width, generator=generator) * 0.4
        for name, width in WIDTHS.items()
    }
    splats["scales"] -= 1.5
    return {name: Parameter(value) for name, value in splats.items()}


def render(splats: dict[str, Tensor], view: int) -> Tensor:
    """[SIZE, SIZE, 3]: the Gaussians' footprints from one of VIEWS directions, added up."""
    angle = torch.tensor(torch.pi * view / VIEWS)
    right = torch.stack([angle.cos(), torch.zeros(()), angle.sin()])
    axes = torch.stack([right, torch.tensor([0.0, 1.0, 0.0])])
    at = splats["means"] @ axes.T
    turned = splats["quats"] / splats["quats"].norm(dim=1, keepdim=True).clamp(min=1e-6)
    spread = splats["scales"].exp().mean(1) * (1 + 0.1 * turned[:, 0])
    ticks = torch.linspace(-1, 1, SIZE)
    grid = torch.stack(torch.meshgrid(ticks, ticks, indexing="ij"), dim=-1).reshape(-1, 1, 2)
    weight = (-((grid - at) ** 2).sum(-1) / (2 * spread**2)).exp()
    return (weight * splats["opacities"].sigmoid()) @ splats["sh0"].sigmoid()


class Training:
    """The loop, its state on disk."""

    def __init__(self, folder: Path, steps: int) -> None:
        self.folder, self.steps = folder, steps
        self.checkpoint = folder / "checkpoint.pt"
        self.phases = everything(
            steps, steps * 2 // 3, nu=EnergyHistogram(warmup=max(8, steps // 12))
        )
        saved = None
        if self.checkpoint.exists():
            saved = torch.load(self.checkpoint, weights_only=True)
        values = saved["splats"] if saved else start()
        self.splats = {name: Parameter(value.detach().clone()) for name, value in values.items()}
        self.optimizers = self.phases.upgrade(
            {
                name: torch.optim.Adam([{"params": p, "lr": RATES[name], "name": name}], eps=1e-15)
                for name, p in self.splats.items()
            }
        )
        if saved:
            for name, optimizer in self.optimizers.items():
                optimizer.load_state_dict(saved["optimizers"][name])
        with torch.no_grad():
            truth = start(seed=1)
            self.targets = [render(truth, view) for view in range(VIEWS)]  # pyright: ignore

    def step(self) -> float:
        view = self.phases.iteration % VIEWS
        loss = self.phases.pixel_loss(render(self.splats, view), self.targets[view])  # pyright: ignore
        loss.backward()
        self.phases.observe(loss)
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        return float(loss.detach())

    def save(self) -> None:
        """Written beside, then renamed: a kill leaves the old one or the new one."""
        states = {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}
        values = {name: param.detach() for name, param in self.splats.items()}
        beside = self.checkpoint.with_suffix(".tmp")
        torch.save({"splats": values, "optimizers": states}, beside)
        os.replace(beside, self.checkpoint)

    def run(self, every: int) -> None:
        with (self.folder / "memory.txt").open("a") as memory:
            while self.phases.iteration < self.steps:
                self.step()
                if self.phases.iteration % every == 0 or self.phases.iteration == self.steps:
                    self.save()
                if self.phases.iteration % max(1, self.steps // 10) == 0:
                    memory.write(f"{self.phases.iteration} {resident()} {tensors()}\n")


def resident() -> int:
    """Resident bytes of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def tensors() -> int:
    """Bytes of all tensors that are alive."""
    gc.collect()
    return sum(o.nbytes for o in gc.get_objects() if type(o) in (Tensor, Parameter))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--every", type=int, default=20)
    options = parser.parse_args()
    Training(options.folder, options.steps).run(options.every)


if __name__ == "__main__":
    main()
