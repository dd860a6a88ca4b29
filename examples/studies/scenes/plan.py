"""What the study trains, in the order in which it matters most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from studies.scenes.arms import (
    ADAPTIVE,
    ADAPTIVE_DEFAULTS,
    ADAPTIVE_OWN_FRAME,
    AVERAGED,
    BASELINE,
    DEFAULTS,
    LIST,
    OWN_FRAME,
    OWN_FRAME_ARM,
    find_study_arm,
)
from studies.scenes.decisions import FEW_VIEWS_SCENES, MANY_VIEWS_SCENES, points_of
from studies.scenes.training import Spec

STOCK = (BASELINE, f"{BASELINE}{AVERAGED}")
TODAY = (*STOCK, "faded", DEFAULTS)
FRAMES = (OWN_FRAME_ARM, f"{OWN_FRAME}{AVERAGED}")
RATES = tuple(arm.name for arm in LIST if arm.name.startswith(("rates-", "positions-")))
ADAPTIVE_ARMS = (ADAPTIVE, ADAPTIVE_DEFAULTS, ADAPTIVE_OWN_FRAME)


@dataclass(frozen=True)
class Training:
    """A training of the plan and where it lives."""

    spec: Spec
    folder: Path
    needs: tuple[Path, ...] = ()  # folders of trainings that come first
    trunk: Path | None = None
    nu_from: Path | None = None


def cross(
    scenes: Sequence[str],
    arms: Sequence[str],
    seeds: int,
    iterations: int,
    share: float = 1.0,
    **others: Any,
) -> list[Spec]:
    """Every arm on every scene, with that share of the scene's points."""
    return [
        Spec(scene, arm, seed, iterations, round(points_of(scene) * share), **others)
        for seed in range(seeds)
        for scene in scenes
        for arm in arms
    ]


def stages(seeds: int = 3) -> dict[str, list[Spec]]:
    """The trainings of every stage; their scenes are names, not yet folders.

    A quarter of the photos' width with 4,000 or 10,000 Gaussians, half of it with 50,000, and the
    whole with 200,000 and harmonics of degree 3. Bonsai is meant with poses that fit, as those of
    `register.py` do.
    """
    rotated = partial(cross, rotated=True)
    at_half = partial(rotated, iterations=30_000, size="images_2")
    half_sizes = ((("bonsai",), 5), (("plush",), 12.5), (("lego",), 5))
    return {
        "embedded": rotated(("embedded",), TODAY, 1, 1_500),  # needs no download
        "quarter": [
            spec
            for scenes in (MANY_VIEWS_SCENES, FEW_VIEWS_SCENES)
            for arm in (*TODAY, "paper", "paper-constant")
            for spec in rotated(scenes, [arm], seeds, 30_000)
        ],
        "quarter-brief": rotated(MANY_VIEWS_SCENES, TODAY, seeds, 7_500),
        "quarter-10,000": rotated(MANY_VIEWS_SCENES, ["faded", DEFAULTS], seeds, 10_000),
        "half": [
            spec
            for arms, count in ((("paper", "paper-constant"), 1), (TODAY, seeds))
            for scenes, share in half_sizes
            for spec in at_half(scenes, arms, count, share=share)
        ],
        "adaptive": rotated(MANY_VIEWS_SCENES, [*ADAPTIVE_ARMS, "adc+averaged"], seeds, 30_000),
        "sh3": rotated(MANY_VIEWS_SCENES, TODAY, 1, 30_000, sh_degree=3),
        # The positions in their own frame: half size decides.
        "own-frame": [
            spec
            for arm in FRAMES
            for scenes, share in half_sizes
            for spec in at_half(scenes, [arm], seeds, share=share)
        ],
        "own-frame-quarter": [
            *rotated(MANY_VIEWS_SCENES, FRAMES, seeds, 30_000),
            *rotated(FEW_VIEWS_SCENES, [OWN_FRAME_ARM], seeds, 30_000),
        ],
        # Stock with other constant rates: what a longer step is to be compared with.
        "rates-tuned": [
            *rotated(MANY_VIEWS_SCENES, ["rates-x2"], seeds, 30_000),
            *rotated(MANY_VIEWS_SCENES, RATES, 1, 30_000),
            *(s for x, share in half_sizes for s in at_half(x, RATES, 1, share=share)),
        ],
        "half-adaptive": [
            spec
            for scenes, share in half_sizes
            for spec in at_half(scenes, ADAPTIVE_ARMS, 1, share=share)
        ],
        # 640x480, 800x532 and 800x800, some two core-hours each: half as long as the others.
        "whole": [
            spec
            for scenes, share in ((("plush",), 50), (("bonsai", "lego"), 20))
            for spec in rotated(
                scenes,
                (OWN_FRAME_ARM, DEFAULTS, BASELINE),
                1,
                15_000,
                share,
                size="images",
                sh_degree=3,
            )
        ],
        # One size of a training after the other.
        "crowded": [  # 40,000 Gaussians on images of a quarter of their size
            *rotated(("bonsai",), TODAY, 1, 7_500, 4),
            *rotated(("plush",), TODAY, 1, 7_500, 10),
        ],
        "sizes": [  # fewer Gaussians, iterations and views
            *rotated(("bonsai",), TODAY, 1, 7_500, 0.1),
            *rotated(("bonsai",), TODAY, 1, 7_500, 0.4),
            *rotated(("bonsai",), TODAY, 1, 3_000),
            *(
                spec
                for views in (14, 28, 55, 110)
                for spec in rotated(("bonsai",), TODAY, 1, 7_500, views=views)
            ),
        ],
        "rates": [  # the trainer's own, all of them times a factor
            spec
            for rates in (0.1, 0.3, 1.0, 3.0, 10.0)
            for spec in rotated(("plush",), [*TODAY, OWN_FRAME_ARM], 1, 7_500, rates=rates)
        ],
    }


def plan(
    root: Path,
    out: Path,
    only: Sequence[str] = (),
    seeds: int = 3,
    arms: Sequence[str] = (),
) -> list[Training]:
    """The trainings of the named stages, or of all.

    Args:
        root: folder that holds the scenes' folders.
        out: folder for the trainings.
        only: stages; all where there are none.
        arms: these in the place of the stages' own, wherever those are trained.

    Raises:
        ValueError: a stage or an arm is unknown.
    """
    chosen = stages(seeds)
    unknown = set(only) - set(chosen)
    if unknown:
        raise ValueError(f"--stages {sorted(unknown)}: unknown; there are {', '.join(chosen)}")
    trainings: dict[Path, Training] = {}
    for stage in only or chosen:
        for spec in chosen[stage]:
            source = spec.scene if spec.scene == "embedded" else str(root / spec.scene)
            for arm in arms or [spec.arm]:
                for training in _with_needs(replace(spec, scene=source, arm=arm), out):
                    trainings.setdefault(training.folder, training)
    return list(trainings.values())


def _with_needs(spec: Spec, out: Path) -> list[Training]:
    arm, needed = find_study_arm(spec.arm), []
    folders: dict[str | None, Path] = {}
    for name in filter(None, (arm.trunk, arm.needs)):
        other = replace(spec, arm=name)
        needed += _with_needs(other, out)
        folders[name] = folder_of(other, out)
    first, trunk = tuple(folders.values()), folders.get(arm.trunk)
    return [*needed, Training(spec, folder_of(spec, out), first, trunk, folders.get(arm.needs))]


def folder_of(spec: Spec, out: Path) -> Path:
    """Where a training lives."""
    kind = f"{spec.points}-{spec.iterations}-{spec.init}"
    kind += f"-sh{spec.sh_degree}" * (spec.sh_degree > 0)
    kind += f"-{spec.size}" * (spec.size != "images_4")
    kind += "-rotated" * spec.rotated
    kind += f"-{spec.views}-views" * (spec.views > 0)
    kind += f"-rates-{spec.rates:g}" * (spec.rates != 1.0)
    arm = spec.arm.replace("/", "_")
    return out / Path(spec.scene).name / kind / arm / f"seed-{spec.seed}"
