"""The effect in under a minute, without data: python examples/quickstart.py

Fits 3D Gaussians to a small scene that it draws itself, once with stock 3DGS-MCMC and once with the
same trainer whose optimizers a `PhaseScheduler` has upgraded, and draws photo, both renders and
the error over time. What is left of the gain in long trainings: docs/evidence.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from splatting.arms import DEFAULT_ARM, find_arm
from splatting.embedded import embedded_scene
from splatting.fit import Fit, FitOptions
from splatting.scenes import Scene
from splatting.writable import check_file
from torch import Tensor
from tqdm import tqdm

ITERATIONS, POINTS, LOOKS = 600, 1_500, 15
ARMS = {"stock 3DGS-MCMC": "mcmc", "upgraded": DEFAULT_ARM}
COLOURS = ("#333333", "#0072b2")


@dataclass
class Training:
    """What one training left behind."""

    name: str
    seconds: list[float] = field(default_factory=lambda: [0.0])
    psnr: list[float] = field(default_factory=list)  # of the views that it has not seen
    image: Tensor = field(default_factory=lambda: torch.zeros(0))  # [H, W, 3]


def train(name: str, arm: str, scene: Scene, seed: int, iterations: int) -> Training:
    """Fit the scene; evaluations do not count in the seconds."""
    found = Training(name)
    fit = Fit(scene, find_arm(arm), FitOptions(iterations, POINTS, seed))
    fit.compile_kernels()
    found.psnr.append(fit.evaluate()["psnr"])
    begin, spent = time.perf_counter(), 0.0
    for iteration in tqdm(range(1, iterations + 1), desc=name, unit="it"):
        fit.step()
        if iteration % max(iterations // LOOKS, 1) == 0 or iteration == iterations:
            spent += time.perf_counter() - begin
            found.seconds.append(spent)
            found.psnr.append(fit.evaluate()["psnr"])
            begin = time.perf_counter()
    found.image = fit.image(scene.test[0])
    return found


def draw(scene: Scene, trainings: Sequence[Training], path: Path) -> None:
    """Photo and renders above, PSNR over seconds below."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 6.2), dpi=120, layout="constrained", facecolor="white")
    axes = figure.subplot_mosaic([["photo", "0", "1"], ["psnr"] * 3], height_ratios=[1.0, 1.1])
    shown = [("photo", "photo", scene.test[0].image)]
    shown += [(str(i), f"{t.name}: {t.psnr[-1]:.1f} dB", t.image) for i, t in enumerate(trainings)]
    for place, title, image in shown:
        axes[place].imshow(image.clamp(0, 1).numpy(), interpolation="nearest")
        axes[place].set_title(title, fontsize=11)
        axes[place].axis("off")
    for training, colour in zip(trainings, COLOURS, strict=True):
        axes["psnr"].plot(training.seconds, training.psnr, color=colour, lw=2, label=training.name)
    axes["psnr"].set(xlabel="seconds", ylabel="PSNR of unseen views (dB)")
    axes["psnr"].legend(frameon=False, loc="lower right")
    axes["psnr"].grid(alpha=0.3)
    axes["psnr"].spines[["top", "right"]].set_visible(False)
    figure.savefig(path, format="png")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add(
        "-o", "--out", type=Path, default=Path("runs/quickstart.png"), metavar="PNG", help="picture"
    )
    add("--seed", type=int, default=0, help="of the training")
    options = parser.parse_args(arguments)
    try:
        check_file(options.out)
    except OSError as error:
        print(f"quickstart: {error}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    scene = embedded_scene()
    print("preparing the renderer; the first time it is compiled, some 20 s", file=sys.stderr)
    trainings = [train(name, arm, scene, options.seed, ITERATIONS) for name, arm in ARMS.items()]
    for training in trainings:
        print(f"{training.name}: {training.psnr[-1]:.1f} dB after {training.seconds[-1]:.0f} s")
    draw(scene, trainings, options.out)
    print(options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
