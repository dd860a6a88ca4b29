"""The effect in under a minute, without data: python examples/quickstart.py

Fits 3D Gaussians to a small scene that it draws itself, once with stock 3DGS-MCMC and once with the
same trainer whose optimizers a `PhaseScheduler` has upgraded, and draws photo, both renders after
a third of stock's time, and the error over time. What is left of the gain in long trainings:
docs/evidence.md.
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
from splatting.fit import Fit, FitOptions
from splatting.metrics import psnr
from splatting.scenes import Scene, load_scene
from splatting.stopping import command
from splatting.writable import check_file
from torch import Tensor
from tqdm import tqdm

ITERATIONS, POINTS, LOOKS = 600, 1_500, 15
ARMS = {"stock 3DGS-MCMC": "mcmc", "with opt3dgs_optim": DEFAULT_ARM}
COLOURS = ("#555555", "#0072b2")
SHARE = 1 / 3  # of stock's seconds, after which the pictures are
LOWEST = 11.5  # dB, of the plot


@dataclass
class Training:
    """What one training showed."""

    name: str
    seconds: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)  # test views, mean, dB
    images: list[Tensor] = field(default_factory=list)  # of the first test view, [H, W, 3]

    def look(self, fit: Fit, seconds: float) -> None:
        """At all test views, after so many seconds of training."""
        pairs = [(fit.image(view), view.image) for view in fit.scene.test]
        self.seconds.append(seconds)
        self.psnr.append(float(torch.stack([psnr(a, b) for a, b in pairs]).mean()))
        self.images.append(pairs[0][0])

    def at(self, seconds: float) -> int:
        """The last look that was not later."""
        return max(i for i, each in enumerate(self.seconds) if each <= seconds)


def train(scene: Scene, options: FitOptions, looks: int) -> list[Training]:
    """Stock and ours in turns, so that what else the machine does slows both."""
    torch.set_num_threads(1)
    fits = {name: Fit(scene, find_arm(arm), options) for name, arm in ARMS.items()}
    made, clocks = [Training(name) for name in ARMS], dict.fromkeys(ARMS, 0.0)
    for fit in fits.values():
        fit.compile_kernels()
    every = max(options.iterations // looks, 1)
    with tqdm(total=len(ARMS) * options.iterations, unit="it") as bar:
        while True:
            for training, fit in zip(made, fits.values(), strict=True):
                training.look(fit, clocks[training.name])
                begin = time.process_time()
                for _ in range(min(every, options.iterations - fit.iteration)):
                    fit.step()
                    bar.update()
                clocks[training.name] += time.process_time() - begin
            if len(made[0].seconds) > -(-options.iterations // every):
                return made


def draw(scene: Scene, trainings: Sequence[Training], path: Path) -> float:
    """Photo and renders after `SHARE` of stock's seconds above, PSNR over seconds below.

    Returns the seconds after which the pictures are.
    """
    from matplotlib.figure import Figure

    end = min(training.seconds[-1] for training in trainings)
    seconds = SHARE * trainings[0].seconds[-1]
    figure = Figure(figsize=(7.2, 5.4), dpi=150, layout="constrained", facecolor="white")
    axes = figure.subplot_mosaic([["photo", "0", "1"], ["psnr"] * 3], height_ratios=[1.0, 1.15])
    shown = [("photo", "photo, held out", scene.test[0].image)]
    for i, training in enumerate(trainings):
        at = training.at(seconds)
        shown.append((f"{i}", f"{training.name}\n{training.psnr[at]:.1f} dB", training.images[at]))
    for place, title, image in shown:
        axes[place].imshow(image.clamp(0, 1).numpy(), interpolation="nearest")
        axes[place].set_title(title, fontsize=13)
        axes[place].axis("off")
    axis = axes["psnr"]
    for training, colour, offset in zip(trainings, COLOURS, (-0.7, 0.5), strict=True):
        axis.plot(training.seconds, training.psnr, color=colour, lw=3)
        at = training.at(seconds * 2)
        place = (training.seconds[at], training.psnr[at] + offset)
        align = "top" if offset < 0 else "bottom"
        axis.annotate(training.name, place, color=colour, fontsize=14, va=align)
    axis.axvline(seconds, color="#999999", lw=1.2, ls="--")
    axis.annotate(" the pictures above", (seconds, LOWEST + 0.4), fontsize=12)
    axis.set(xlim=(0, end), ylim=(LOWEST, max(t.psnr[-1] for t in trainings) + 1.4))
    axis.set_xlabel("seconds of training (one CPU thread)", fontsize=13)
    axis.set_ylabel("test PSNR (dB)", fontsize=13)
    axis.tick_params(labelsize=12)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, format="png")
    return seconds


@command("quickstart")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    out = Path("runs/quickstart.png")
    parser.add_argument("-o", "--out", type=Path, default=out, metavar="PNG", help="picture")
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    options = parser.parse_args(arguments)
    check_file(options.out)
    print("preparing the renderer; the first time it is compiled, some 20 s", file=sys.stderr)
    scene = load_scene("embedded")
    trainings = train(scene, FitOptions(ITERATIONS, POINTS, options.seed), LOOKS)
    for training in trainings:
        print(f"{training.name}: {training.psnr[-1]:.1f} dB after {training.seconds[-1]:.0f} s")
    draw(scene, trainings, options.out)
    print(options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
