"""A first look, in seconds and without data: python examples/quickstart.py.

Fits flat Gaussians to a small drawn picture, once with torch's Adam and once with the same Adam
upgraded by a `PhaseScheduler`, as in a real trainer, and draws both. It shows how the parts are
put together; what they are worth is measured on real scenes, see the README.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import PhaseScheduler

SIZE, GAUSSIANS, STEPS = 40, 60, 240
LEARNING_RATES = {"means": 0.01, "scales": 0.02, "opacities": 0.05, "sh0": 0.03}


@dataclass
class Training:
    """What one training left behind."""

    name: str
    image: Tensor = field(default_factory=lambda: torch.zeros(SIZE, SIZE, 3))
    psnr: list[float] = field(default_factory=list)
    factor: list[float] = field(default_factory=list)  # on Adam's step
    seconds: float = 0.0


def pixels() -> Tensor:
    """Pixel centres [SIZE, SIZE, 2] in -1..1."""
    axis = (torch.arange(SIZE) + 0.5) * (2 / SIZE) - 1
    return torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1)


def target() -> Tensor:
    """The picture to fit [SIZE, SIZE, 3]: a sun, a hill and its shadow."""
    x, y = pixels().unbind(-1)
    sky = torch.stack([0.45 + 0.2 * y, 0.65 + 0.15 * y, 0.9 + 0 * y], -1)
    sun = ((x - 0.4) ** 2 + (y + 0.45) ** 2 < 0.06)[..., None]
    hill = (y > 0.35 - 0.35 * torch.cos(2.5 * x + 0.6))[..., None]
    stripes = hill & ((6 * (x + y)).sin() > 0.3)[..., None]
    image = torch.where(sun, torch.tensor([1.0, 0.85, 0.3]), sky)
    image = torch.where(hill, torch.tensor([0.25, 0.5, 0.25]), image)
    return torch.where(stripes, torch.tensor([0.15, 0.35, 0.2]), image).clamp(0, 1)


def first_gaussians(seed: int) -> dict[str, Parameter]:
    """Gaussians in gsplat's names and activations: log scales, logit opacities."""
    draw = torch.Generator().manual_seed(seed)
    raw = {
        "means": 2 * torch.rand(GAUSSIANS, 2, generator=draw) - 1,
        "scales": torch.full((GAUSSIANS, 2), -2.0),
        "opacities": torch.zeros(GAUSSIANS),
        "sh0": torch.rand(GAUSSIANS, 3, generator=draw),
    }
    return {name: Parameter(tensor) for name, tensor in raw.items()}


def render(splats: dict[str, Parameter], where: Tensor) -> Tensor:
    """Blend all Gaussians at all pixels: [SIZE, SIZE, 3]."""
    offset = (where[:, :, None] - splats["means"]) / splats["scales"].exp()
    weight = torch.exp(-0.5 * offset.square().sum(-1)) * splats["opacities"].sigmoid()
    return (weight[..., None] * splats["sh0"]).sum(2) / (weight.sum(2, keepdim=True) + 1e-3)


def train(name: str, phases: PhaseScheduler | None, seed: int) -> Training:
    """A trainer's loop; `phases` adds to it the lines that a real trainer gets."""
    result, splats, where, picture = Training(name), first_gaussians(seed), pixels(), target()
    optimizers: dict[str, Any] = {
        key: torch.optim.Adam([{"params": [p], "lr": LEARNING_RATES[key], "name": key}], eps=1e-15)
        for key, p in splats.items()
    }
    if phases is not None:
        optimizers = phases.upgrade(optimizers)
    begin = time.perf_counter()
    for _ in range(STEPS):
        image = render(splats, where)
        if phases is None:
            loss = (image - picture).abs().mean()
        else:
            loss = phases.pixel_loss(image, picture)
        loss.backward()
        if phases is not None:
            phases.observe(loss)
            result.factor.append(phases.annealing_factor("means") or 1.0)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        error = (image.detach() - picture).square().mean()
        result.psnr.append(float(-10 * error.log10()))
    result.seconds = time.perf_counter() - begin
    result.image = render(splats, where).detach().clamp(0, 1)
    if phases is not None:
        print(phases)
        print(optimizers["means"])
    return result


def draw(trainings: list[Training], path: Path) -> None:
    """Pictures above, PSNR and the step's factor below."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6.4), dpi=120, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic(
        [["target", "0", "1"], ["psnr"] * 3, ["factor"] * 3], height_ratios=[2.4, 1.7, 0.9]
    )
    shown = [("target", "target", target())]
    shown += [
        (str(i), f"{t.name}: {t.psnr[-1]:.2f} dB, {t.seconds:.1f} s", t.image)
        for i, t in enumerate(trainings)
    ]
    for place, title, image in shown:
        axes[place].imshow(image.numpy(), interpolation="nearest")
        axes[place].set_title(title, fontsize=10)
        axes[place].axis("off")
    for training, colour in zip(trainings, ("#333333", "#0072B2"), strict=True):
        axes["psnr"].plot(training.psnr, color=colour, label=training.name)
        if training.factor:
            axes["factor"].plot(training.factor, color=colour, lw=1)
    axes["psnr"].set(ylabel="PSNR (dB)", xlim=(0, STEPS))
    axes["psnr"].legend(frameon=False, loc="lower right")
    axes["factor"].set(ylabel="step factor", xlabel="step", xlim=(0, STEPS))
    axes["factor"].axhline(1, color="#8a8a8a", ls="--", lw=0.8)
    for place in ("psnr", "factor"):
        axes[place].spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "-o",
        "--out",
        type=Path,
        default=Path("runs/quickstart.png"),
        metavar="PNG",
        help="picture to write (default: runs/quickstart.png)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the first Gaussians")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    trainings = [
        train("torch's Adam", None, options.seed),
        train("upgraded", PhaseScheduler(STEPS), options.seed),
    ]
    for training in trainings:
        print(f"{training.name}: {training.psnr[-1]:.2f} dB after {training.seconds:.1f} s")
    try:
        draw(trainings, options.out)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        print("no picture: pip install 'opt3dgs_optim[report]'", file=sys.stderr)
        return 0
    print(options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
