"""The README's picture: python examples/studies/scenes/front_picture.py

Trains the embedded scene twice, by stock 3DGS-MCMC and with the package's defaults, and draws a
held-out view after equal seconds beside the test PSNR over seconds. The numbers go into
docs/results/front.json.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from statistics import fmean

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from splatting.arms import DEFAULT_ARM, find_arm
from splatting.fit import Fit, FitOptions
from splatting.metrics import psnr
from splatting.scenes import Scene, load_scene
from torch import Tensor

FOLDER = Path(__file__).resolve().parents[3] / "docs" / "results"
EVERY = 50  # iterations between two looks, which the clock does not count
ARMS = {"stock 3DGS-MCMC": "mcmc", "with opt3dgs_optim": DEFAULT_ARM}
COLOURS = ("#555555", "#0072B2")
VIEW = 0  # of the held-out ones


@dataclass
class Course:
    """What one training showed."""

    seconds: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)  # test views, mean, dB
    images: list[Tensor] = field(default_factory=list)  # of one test view, [H, W, 3]

    def look(self, scene: Scene, fit: Fit, seconds: float) -> None:
        """At all test views, after so many seconds of training."""
        images = [fit.image(view) for view in scene.test]
        pairs = zip(images, scene.test, strict=True)
        self.seconds.append(seconds)
        self.psnr.append(fmean(float(psnr(image, view.image)) for image, view in pairs))
        self.images.append(images[VIEW])

    def at(self, seconds: float) -> int:
        """The last look that was not later."""
        return max(i for i, each in enumerate(self.seconds) if each <= seconds)


def train(scene: Scene, options: FitOptions) -> dict[str, Course]:
    """Both trainings on one thread, in turns, so that what else the machine does slows both."""
    for arm in ARMS.values():  # compiled before the clocks start
        first = Fit(scene, find_arm(arm), options)
        for _ in range(EVERY):
            first.step()
    fits = {name: Fit(scene, find_arm(arm), options) for name, arm in ARMS.items()}
    courses, clocks = {name: Course() for name in ARMS}, dict.fromkeys(ARMS, 0.0)
    for _ in range(0, options.iterations + 1, EVERY):
        for name, fit in fits.items():
            courses[name].look(scene, fit, clocks[name])
            begin = time.process_time()
            for _ in range(EVERY if fit.iteration < options.iterations else 0):
                fit.step()
            clocks[name] += time.process_time() - begin
    return courses


def draw(scene: Scene, courses: dict[str, Course], seconds: float, path: Path) -> None:
    """Photo and renders after `seconds` above, PSNR over seconds below."""
    figure = Figure(figsize=(7.2, 5.4), dpi=150, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic([["photo", *courses], ["curve"] * 3], height_ratios=[1.0, 1.15])
    tiles = {"photo": ("photo, held out", scene.test[VIEW].image)}
    for name, course in courses.items():
        at = course.at(seconds)
        tiles[name] = (f"{name}\n{course.psnr[at]:.1f} dB", course.images[at])
    for place, (title, image) in tiles.items():
        axes[place].imshow(image.clamp(0, 1).numpy(), interpolation="nearest")
        axes[place].set_title(title, fontsize=13)
        axes[place].axis("off")
    axis = axes["curve"]
    for (name, course), colour in zip(courses.items(), COLOURS, strict=True):
        axis.plot(course.seconds, course.psnr, color=colour, lw=3)
        at = course.at(seconds * 2)
        below = colour == COLOURS[0]
        place = (course.seconds[at], course.psnr[at] + (-0.7 if below else 0.5))
        align = "top" if below else "bottom"
        axis.annotate(name, place, color=colour, fontsize=14, va=align)
    axis.axvline(seconds, color="#999999", lw=1.2, ls="--")
    low = 11.5
    axis.annotate(" the pictures above", (seconds, low + 0.4), fontsize=12)
    end = min(course.seconds[-1] for course in courses.values())
    axis.set_xlim(0, end)
    axis.set_ylim(low, max(course.psnr[-1] for course in courses.values()) + 1.4)
    axis.set_xlabel("seconds of training (one CPU thread)", fontsize=13)
    axis.set_ylabel("test PSNR (dB)", fontsize=13)
    axis.tick_params(labelsize=12)
    axis.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--iterations", type=int, default=1500, help="of each training")
    add("--share", type=float, default=1 / 3, help="of stock's seconds, at which to look")
    add("--out", type=Path, default=FOLDER / "front.png", metavar="PNG", help="picture to write")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    scene = load_scene("embedded")
    options = FitOptions(args.iterations)
    courses = train(scene, options)
    stock, ours = courses.values()
    seconds = args.share * stock.seconds[-1]
    draw(scene, courses, seconds, args.out)
    reached = next(s for s, p in zip(ours.seconds, ours.psnr, strict=True) if p >= stock.psnr[-1])
    machine = f"{platform.system()} {platform.machine()}, one thread, torch {torch.__version__}"
    record = {
        "command": "python examples/studies/scenes/front_picture.py",
        "date": f"{date.today()}",
        "machine": machine,
        "iterations": args.iterations,
        "points": options.points,
        "pictures_after_seconds": round(seconds, 2),
        "seconds_to_stock_psnr": round(reached, 2),
        "curves": {
            name: {
                "seconds": [round(s, 3) for s in course.seconds],
                "psnr": [round(p, 3) for p in course.psnr],
            }
            for name, course in courses.items()
        },
    }
    args.out.with_suffix(".json").write_text(json.dumps(record) + "\n", encoding="utf-8")
    print(args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
