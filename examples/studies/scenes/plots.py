"""The study's plots."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from studies.scenes.analysis import Study, difference
from studies.scenes.arms import BASELINE, DEFAULTS
from studies.scenes.decisions import points_of
from studies.scenes.records import MISPOSED, RIGHT, Setting
from studies.scenes.tables import label

# Okabe and Ito's colours: told apart with any kind of colour vision.
COLOURS = {BASELINE: "#000000", DEFAULTS: "#0072b2", "paper": "#d55e00"}
VIEWS = {RIGHT: 220, MISPOSED: 220, "lego": 87, "plush": 84}  # to train on, of scenes with many
SCENE_COLOURS = {RIGHT: "#0072b2", MISPOSED: "#999999", "lego": "#d55e00", "plush": "#009e73"}
SIZE_AXES = {  # of `plot_sizes`, and what else is to know of the trainings there
    "Gaussians": "quarter size, 7,500 iterations",
    "training views": "quarter size, 7,500 iterations",
    "iterations": "quarter size",
    "share of the full width": "30,000; half: 50,000 Gaussians",
}
WIDTH, PANEL = 6.4, 2.0  # inches, of a figure and of a row: two columns, which a phone can show
DPI = 150


def plot_metrics(
    study: Study,
    settings: Sequence[Setting],
    arms: Sequence[str],
    path: Path,
    shorter: Sequence[int] = (),
) -> None:
    """PSNR and LPIPS of the held-out views over the baseline's seconds, a row per scene.

    Means over the seeds that all of a scene's arms have: a seed has held-out views of its own.

    Args:
        shorter: lengths of trainings that were that long from their start: dots at their ends, at
            the first length's cost of an iteration.
    """
    figure, axes = plt.subplots(
        len(settings),
        2,
        figsize=(WIDTH, PANEL * len(settings) + 0.7),
        squeeze=False,
        layout="constrained",
    )
    for panels, setting in zip(axes, settings, strict=True):
        runs = {arm: found for arm in arms if (found := study.runs(setting, arm))}
        shared = sorted(set.intersection(*map(set, runs.values()))) if runs else []
        for arm, found in runs.items() if shared else ():
            records = [found[seed] for seed in shared]
            shares = records[0].curve["iteration"] * study.cost(setting, arm) / setting.iterations
            for axis, metric in zip(panels, ("psnr", "lpips"), strict=True):
                mean = np.mean([record.curve[metric] for record in records], axis=0)
                # The first looks are off the scale of what is compared.
                axis.plot(shares[2:], mean[2:], color=COLOURS[arm], label=label(arm))
                axis.grid(alpha=0.3)
        for arm, count in itertools.product(arms if shared else (), shorter):
            found = study.runs(replace(setting, iterations=count), arm)
            if set(shared) <= found.keys():
                cost = study.cost(replace(setting, iterations=shorter[0]), arm)
                place = count / setting.iterations * cost
                for axis, metric in zip(panels, ("psnr", "lpips"), strict=True):
                    end = np.mean([found[seed].curve[metric][-1] for seed in shared])
                    axis.plot(place, end, "o", color=COLOURS[arm])
        panels[0].set_ylabel(f"{setting.scene}\n{setting.points:,} Gaussians")
    for axis, title in zip(axes[0], ("PSNR (dB)", "LPIPS"), strict=True):
        axis.set_title(f"{title}, held-out views", fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("time (1: 3DGS-MCMC's end)")
    _finish(figure, path)


def plot_one(study: Study, setting: Setting, path: Path) -> None:
    """PSNR of 3DGS-MCMC and of the defaults over the baseline's seconds, for a README.

    Means over the seeds that both have, with the names at the lines' ends.
    """
    figure, axis = plt.subplots(figsize=(WIDTH, 3.0), layout="constrained")
    pairs = difference(study, [setting], DEFAULTS, BASELINE).pairs[setting.scene]
    lines = {
        BASELINE: (1.0, [control for _, control, _ in pairs]),
        # The iterates, and their mean in the end: what the trainer has at each of these times.
        DEFAULTS: (pairs[0][2], [study.runs(setting, DEFAULTS)[arm.seed] for arm, _, _ in pairs]),
    }
    ends = {}
    for arm, (cost, records) in lines.items():
        shares = records[0].curve["iteration"] * cost / setting.iterations
        mean = np.mean([record.curve["psnr"] for record in records], axis=0)
        # The first look is off the scale of what is compared.
        axis.plot(shares[1:], mean[1:], color=COLOURS[arm], linewidth=2.5)
        ends[arm] = float(shares[-1]), float(mean[-1])
    for arm, end in ends.items():
        above = end[1] == max(value for _, value in ends.values())
        axis.annotate(
            f"{label(arm)}, {end[1]:.1f} dB",
            end,
            xytext=(6, 0),
            textcoords="offset points",
            color=COLOURS[arm],
            va="bottom" if above else "top",  # they may end close to each other
        )
    axis.set_xlim(0, 1.4)
    axis.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(axis="y", alpha=0.3)
    axis.set_xlabel("time, as a share of 3DGS-MCMC's 30,000 iterations")
    axis.set_ylabel("PSNR of held-out\nviews (dB)")
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def plot_sizes(study: Study, path: Path) -> None:
    """What the defaults gain over 3DGS-MCMC in the end, over four sizes of a training.

    A row per size, the other three the scene's own; scenes with two of it, means over the seeds.
    """
    lines: dict[str, dict[str, dict[float, Sequence[float]]]] = {name: {} for name in SIZE_AXES}
    for setting in study.settings():
        found = difference(study, [setting], DEFAULTS, BASELINE)
        for axis, place in _places(setting).items() if found.count else ():
            pairs = found.pairs[setting.scene]
            gains = [
                float(np.mean([a.curve[metric][-1] - b.curve[metric][-1] for a, b, _ in pairs]))
                for metric in ("psnr", "lpips")
            ]
            lines[axis].setdefault(setting.scene, {})[place] = gains
    figure, axes = plt.subplots(
        len(lines),
        2,
        figsize=(WIDTH, (PANEL + 0.3) * len(lines)),
        layout="constrained",
        sharey="col",
    )
    for panels, (axis, every) in zip(axes, lines.items(), strict=True):
        scenes = {scene: gains for scene, gains in every.items() if len(gains) > 1}
        for scene, gains in scenes.items():
            places = sorted(gains)
            for metric, panel in enumerate(panels):
                values = [gains[place][metric] for place in places]
                panel.plot(places, values, "o-", color=SCENE_COLOURS[scene], label=scene)
        ticks = sorted({place for gains in scenes.values() for place in gains})
        for panel in panels:
            panel.set_xscale("log")
            panel.set_xticks(ticks, [f"{tick:,g}" for tick in ticks], fontsize=9)
            panel.minorticks_off()
            panel.axhline(0.0, color="black", linewidth=0.8)
            panel.grid(alpha=0.3)
            panel.set_xlabel(f"{axis}\n({SIZE_AXES[axis]})", fontsize=9)
    axes[0, 0].set_title("gain in PSNR (dB)", fontsize=10)
    axes[0, 1].set_title("change of LPIPS", fontsize=10)
    _finish(figure, path)


def _finish(figure: Figure, path: Path) -> None:
    """Save a figure with one legend of all its axes below them."""
    every = [axis.get_legend_handles_labels() for axis in figure.axes]
    lines = {name: line for lines, names in every for line, name in zip(lines, names, strict=True)}
    figure.legend(
        lines.values(), lines, loc="outside lower center", ncols=len(lines), frameon=False
    )
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def _places(setting: Setting) -> dict[str, float]:
    """Where trainings stand on the axes of `plot_sizes`, on those on which they alone differ."""
    scene, places = setting.scene, {}
    if scene not in VIEWS:
        return {}
    own = Setting(scene, points_of(scene), 7_500, "sfm", rotated=True)
    half = replace(own, iterations=30_000, size="images_2", points=50_000)
    if setting == replace(own, points=setting.points):
        places["Gaussians"] = setting.points
    if setting == replace(own, views=setting.views):
        places["training views"] = setting.views or VIEWS[scene]
    if setting == replace(own, iterations=setting.iterations):
        places["iterations"] = setting.iterations
    if setting in (replace(own, iterations=30_000), half):
        places["share of the full width"] = 0.5 if setting == half else 0.25
    return places
