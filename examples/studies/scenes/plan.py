"""What the study trains, in the order in which it matters most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from studies.scenes.arms import (
    ANNEALED,
    BOTH,
    BOTH_AVERAGED,
    DEFAULTS,
    EARLY,
    FADED,
    GROUPS,
    HELD,
    MORE_AT_ONCE,
    OFTEN_FADED,
    OWN_STEP,
    POOLED,
    POOLED_AVERAGED,
    SCALES_ALONE,
    SELDOM_FADED,
    SHARE_KEPT,
    STABLE,
    STOCK_AVERAGED,
    STUDY_ARMS,
    UNFADED,
    UNHELD,
)
from studies.scenes.decisions import MANY_VIEWS_SCENES, points_of
from studies.scenes.training import Spec

SCENES = ("plush", "banana", "lund_door", "brighton_beach", "embedded")
FEW_VIEWS_SCENES = ("embedded", "banana", "lund_door", "brighton_beach")
ROTATED_ARMS = (
    *("mcmc", FADED, BOTH, ANNEALED, "paper", "paper-constant"),
    *(SELDOM_FADED, *UNFADED.values(), "rates-x2", "own-step"),
    *(STABLE, f"{STABLE}-constant"),
    *(BOTH_AVERAGED, DEFAULTS, STOCK_AVERAGED, POOLED, POOLED_AVERAGED),
    *("l2@1/30", "l1+reset@1/30", "l2+reset@1/30", "l2+reset+lqn@1/30"),
    *(f"l1+reset{x}@1/{k}" for k in (4, 2) for x in ("", "+lqn", "+lqn-all")),
)
BRIEF_ARMS = ("mcmc", FADED, BOTH, ANNEALED, *EARLY)
HALF_ARMS = (  # with 50,000 Gaussians
    *("mcmc", BOTH, BOTH_AVERAGED, STOCK_AVERAGED, SHARE_KEPT, SELDOM_FADED, *UNFADED.values()),
    *(FADED, DEFAULTS, "paper", "paper-constant"),
)
SIZE_ARMS = ("mcmc", BOTH, FADED, DEFAULTS)
RATES_ARMS = ("mcmc", OWN_STEP, BOTH, FADED, DEFAULTS)
UNSEEN_ARMS = ("mcmc", "out-of-view", UNHELD, BOTH)
UNSEEN_LONG_ARMS = ("mcmc", UNHELD, BOTH, FADED, HELD, f"{HELD}+averaged")
CROWDED_ARMS = (*SIZE_ARMS, SHARE_KEPT, UNFADED["means"])


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
    """The trainings of every stage; their scenes are names, not yet folders."""
    arms = {
        group: [arm.name for arm in found if not arm.retired] for group, found in GROUPS.items()
    }
    two, rotated = ["mcmc", ANNEALED], partial(cross, rotated=True)
    half_size = partial(rotated, iterations=30_000, size="images_2")
    return {
        "rotated": [
            spec
            for seed in range(seeds)
            for scenes in (MANY_VIEWS_SCENES, FEW_VIEWS_SCENES)
            for arm in ROTATED_ARMS
            for spec in rotated(scenes, [arm], seeds, 30_000)
            if spec.seed == seed
        ],
        "rotated-brief": [
            *rotated(MANY_VIEWS_SCENES, BRIEF_ARMS, seeds, 7_500),
            *rotated(MANY_VIEWS_SCENES, [BOTH_AVERAGED, DEFAULTS], seeds, 7_500),
            *rotated(("bonsai",), [SELDOM_FADED], 1, 7_500),
            *rotated(MANY_VIEWS_SCENES, [BOTH, FADED, DEFAULTS], seeds, 10_000),
        ],
        "crowded": [  # 40,000 Gaussians on images of a quarter of their size
            *rotated(("bonsai",), CROWDED_ARMS, 1, 7_500, 4),
            *rotated(("plush",), CROWDED_ARMS, 1, 7_500, 10),
        ],
        "half-size": [
            spec
            for chosen, count in ((HALF_ARMS, 1), (("mcmc", STOCK_AVERAGED, DEFAULTS), seeds))
            for scenes, share in ((("bonsai", "lego"), 5), (("plush",), 12.5))
            for spec in half_size(scenes, chosen, count, share=share)
        ],
        "sh3": rotated(MANY_VIEWS_SCENES, SIZE_ARMS, 1, 30_000, sh_degree=3),
        "adaptive": rotated(MANY_VIEWS_SCENES, arms["adaptive"], 1, 30_000),
        "sizes": [  # fewer Gaussians, iterations and views
            *rotated(("bonsai",), SIZE_ARMS, 1, 7_500, 0.1),
            *rotated(("bonsai",), SIZE_ARMS, 1, 7_500, 0.4),
            *rotated(("bonsai",), SIZE_ARMS, 1, 3_000),
            *(
                spec
                for views in (14, 28, 55, 110)
                for spec in rotated(("bonsai",), SIZE_ARMS, 1, 7_500, views=views)
            ),
        ],
        "rates": [  # the trainer's own, all of them times a factor
            spec
            for rates in (0.1, 0.3, 1.0, 3.0, 10.0)
            for spec in rotated(("plush",), RATES_ARMS, 1, 7_500, rates=rates)
        ],
        "unseen": [  # views that see little of the scene
            *rotated(("bonsai",), (FADED, *UNSEEN_ARMS), 1, 7_500, tiled=20),
            *rotated(("bonsai",), UNSEEN_ARMS, 1, 7_500, tiled=4),
            *rotated(MANY_VIEWS_SCENES, UNSEEN_ARMS, 2, 7_500, tiled=9),
            *rotated(MANY_VIEWS_SCENES, UNSEEN_LONG_ARMS, 2, 30_000, tiled=9),
        ],
        "explorations": [
            *rotated(("plush",), [STABLE, *arms["explorations"]], 1, 7_500),
            *rotated(("plush", "embedded"), arms["explorations"], 1, 30_000),
            *rotated(("plush",), (OFTEN_FADED, MORE_AT_ONCE, SCALES_ALONE), 1, 30_000),
        ],
        # Short trainings of small scenes, whose held-out views are the same for every seed.
        "core": cross(SCENES, arms["core"], seeds, 3_000),
        "tails": cross(SCENES, arms["tails"], seeds, 3_000),
        "long": cross(SCENES, [*two, FADED, "annealed-8-0.4"], seeds, 7_500),
        "full": cross(SCENES, two, 1, 30_000),
        "random": cross(SCENES, two, seeds, 3_000, init="random"),
        "small": cross(SCENES, two, seeds, 3_000, share=0.25),
        "harmonics": cross(SCENES, two, 1, 3_000, sh_degree=3),
    }


def plan(root: Path, out: Path, only: list[str] | None = None, seeds: int = 3) -> list[Training]:
    """The trainings of the named stages, or of all.

    Args:
        root: folder that holds the scenes' folders.
        out: folder for the trainings.
    """
    chosen = stages(seeds)
    unknown = set(only or ()) - set(chosen)
    if unknown:
        raise ValueError(f"--stages {sorted(unknown)}: unknown; there are {', '.join(chosen)}")
    trainings: dict[Path, Training] = {}
    for stage in only or list(chosen):
        for spec in chosen[stage]:
            source = spec.scene if spec.scene == "embedded" else str(root / spec.scene)
            for training in _with_needs(replace(spec, scene=source), out):
                trainings.setdefault(training.folder, training)
    return list(trainings.values())


def _with_needs(spec: Spec, out: Path) -> list[Training]:
    arm, needed = STUDY_ARMS[spec.arm], []
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
    kind += f"-tiled-{spec.tiled}" * (spec.tiled > 0)
    kind += f"-rates-{spec.rates:g}" * (spec.rates != 1.0)
    arm = spec.arm.replace("/", "_")
    return out / Path(spec.scene).name / kind / arm / f"seed-{spec.seed}"
