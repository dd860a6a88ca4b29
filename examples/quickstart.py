"""The effect in under a minute, without data: python examples/quickstart.py

Fits 3D Gaussians to a small scene that it draws itself, once with 3DGS-MCMC as its authors publish
it and once with the same trainer whose optimizers a `PhaseScheduler` has upgraded. It draws a photo
that neither has seen, the last render of each, and the error over time. So short a training shows
more than a long one keeps: docs/evidence.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from splatting.arms import BASELINE, DEFAULT_ARM, find_arm
from splatting.fit import Fit, FitOptions
from splatting.metrics import psnr
from splatting.scenes import Scene, load_scene
from splatting.stopping import command
from splatting.writable import check_file
from torch import Tensor
from tqdm import tqdm

ITERATIONS, POINTS, LOOKS = 600, 1_500, 15
ARMS = {"3DGS-MCMC": BASELINE, "with opt3dgs_optim": DEFAULT_ARM}
COLOURS = ("#555555", "#0072b2")
SHOWN = 0.6  # of the range of PSNR, from above: the first steps would flatten the rest
APART = 0.07  # of the plot's height, between two names


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


def train(scene: Scene, options: FitOptions, looks: int) -> list[Training]:
    """Both in turns, so that what else the machine does slows both."""
    torch.set_num_threads(1)
    fits = {name: Fit(scene, find_arm(arm), options) for name, arm in ARMS.items()}
    made, clocks = [Training(name) for name in ARMS], dict.fromkeys(ARMS, 0.0)
    for fit in fits.values():
        fit.compile_kernels()
    every = max(options.iterations // looks, 1)
    with tqdm(total=len(ARMS) * options.iterations, unit="it", disable=None) as bar:
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


def draw(photo: Tensor, trainings: Sequence[Training], path: Path, unit: str = "s") -> None:
    """The photo and the last renders above, PSNR over seconds below.

    Args:
        photo: of a view that no training has seen, [H, W, 3] in 0..1.
        trainings: two; the last of their `images` are of that view.
        path: of the PNG.
        unit: of the seconds on the axis, "s" or "min".
    """
    from matplotlib.figure import Figure

    height, width = photo.shape[:2]
    pictures = 7.2 / 3 * height / width  # inches
    size = (7.2, pictures + 3.4)
    figure = Figure(figsize=size, dpi=150, layout="constrained", facecolor="white")
    ratios = [pictures + 0.6, 2.8]
    axes = figure.subplot_mosaic([["photo", "0", "1"], ["psnr"] * 3], height_ratios=ratios)
    shown = [("photo", "photo, held out", photo, "black")]
    for i, (training, colour) in enumerate(zip(trainings, COLOURS, strict=True)):
        title = f"{training.name}\n{training.psnr[-1]:.1f} dB"
        shown.append((f"{i}", title, training.images[-1], colour))
    for place, title, image, colour in shown:
        axes[place].imshow(image.clamp(0, 1).numpy(), interpolation="nearest")
        axes[place].set_title(title, fontsize=13, color=colour)
        axes[place].axis("off")
    axis, per = axes["psnr"], {"s": 1.0, "min": 60.0}[unit]
    ends = [training.psnr[-1] for training in trainings]
    top, first = max(map(max, (t.psnr for t in trainings))), min(t.psnr[0] for t in trainings)
    low = top - SHOWN * (top - first)
    heights = beside(ends, APART * (top - low))
    for training, colour, y in zip(trainings, COLOURS, heights, strict=True):
        seconds = [each / per for each in training.seconds]
        axis.plot(seconds, training.psnr, color=colour, lw=3, clip_on=True)
        axis.annotate(f" {training.name}", (seconds[-1], y), color=colour, fontsize=13, va="center")
    last = max(training.seconds[-1] for training in trainings) / per
    axis.set(xlim=(0, 1.45 * last), ylim=(low, top + 0.06 * (top - low)))
    axis.set_xticks([tick for tick in axis.get_xticks() if tick <= last])
    axis.set_xlabel(f"{'seconds' if unit == 's' else 'minutes'} of one CPU thread", fontsize=13)
    axis.set_ylabel("PSNR of held-out\nviews (dB)", fontsize=13)
    axis.tick_params(labelsize=12)
    axis.grid(axis="y", color="#e4e4e4", lw=0.8)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, format="png")


def beside(ends: Sequence[float], apart: float) -> list[float]:
    """Heights of two names beside the ends of their lines, at least so far apart."""
    first, second = ends
    missing = max(apart - abs(first - second), 0.0) / 2
    down, up = (first, second) if first <= second else (second, first)
    low, high = down - missing, up + missing
    return [low, high] if first <= second else [high, low]


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
    draw(scene.test[0].image, trainings, options.out)
    print(options.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
