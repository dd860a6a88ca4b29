"""What the study trains, in the order in which it matters most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from studies.scenes.arms import (
    ALL_ANNEALED,
    ANNEALED,
    DEFAULTS,
    DEFAULTS_POOLED,
    EARLY,
    FADED,
    GROUPS,
    OWN_STEP,
    POOLED,
    SELDOM_FADED,
    SHARE_KEPT,
    STABLE,
    STUDY_ARMS,
    UNFADED,
    UNFADED_OPACITIES,
    V_ONLY,
    long_runs,
)
from studies.scenes.decisions import MANY_VIEWS_SCENES, points_of
from studies.scenes.training import Spec

SCENES = ("plush", "banana", "lund_door", "brighton_beach", "embedded")
QUICK_SCENES = ("banana", "embedded")  # for the options of a part
ROTATED_SCENES = (*MANY_VIEWS_SCENES, "embedded", "banana", "lund_door", "brighton_beach")
ROTATED_ARMS = (
    *("mcmc", FADED, DEFAULTS, ANNEALED, "paper", "paper-constant"),
    *(SELDOM_FADED, *UNFADED.values()),
    *("faded-3000", "rates-x2", DEFAULTS_POOLED, "annealed-2", "own-step"),
    *(STABLE, f"{STABLE}-constant"),
    *("l2@1/30", "l1+reset@1/30", "l2+reset@1/30", "l2+reset+lqn@1/30"),
    *(f"l1+reset{x}@1/{k}" for k in (4, 2) for x in ("", "+lqn", "+lqn-all")),
)
BRIEF_ARMS = ("mcmc", FADED, DEFAULTS, ANNEALED, POOLED, *EARLY)
HALF_ARMS = (  # with 50,000 Gaussians
    *("mcmc", DEFAULTS, SHARE_KEPT, SELDOM_FADED, *UNFADED.values()),
    *("paper", "paper-constant"),
)
CROWDED_ARMS = ("mcmc", DEFAULTS, SHARE_KEPT, UNFADED["means"])
RATES_ARMS = ("mcmc", OWN_STEP, DEFAULTS)
LONG_ARMS = tuple(arm.name for arm in long_runs())
FULL_PARTS_SCENES = ("brighton_beach", "lund_door")  # where the defaults lose
CONFIRMED = ("faded-v-only", V_ONLY)  # what gained most among the other leads
FIRST_ARMS = ("mcmc", "rates-x2", "annealed-8-0.4", "faded")


@dataclass(frozen=True)
class Training:
    """A training of the plan and where it lives."""

    spec: Spec
    folder: Path
    needs: tuple[Path, ...] = field(default=())  # folders of trainings that come first
    trunk: Path | None = None
    nu_from: Path | None = None


def stages(seeds: int = 3) -> dict[str, list[Spec]]:
    """The trainings of every stage; their scenes are names, not yet folders."""
    arms = {
        group: [arm.name for arm in found if not arm.retired] for group, found in GROUPS.items()
    }
    later = [name for name in arms["core"] if name not in FIRST_ARMS]
    tails = [*arms["tails"], *arms["on-top"]]
    beyond = [name for name in arms["leads"] if name not in LONG_ARMS]

    def cross(
        scenes: Sequence[str],
        arms: Sequence[str],
        count: int,
        iterations: int,
        share: float = 1.0,
        **others: Any,
    ) -> list[Spec]:
        return [
            Spec(scene, arm, seed, iterations, round(points_of(scene) * share), **others)
            for seed in range(count)
            for scene in scenes
            for arm in arms
        ]

    two = ["mcmc", ANNEALED]
    longer = ["annealed-8-0.4", "annealed-4-0.4", "faded"]
    return {
        "core": cross(SCENES, FIRST_ARMS, seeds, 3_000),
        "tails": cross(SCENES, tails, seeds, 3_000),
        "long": cross(SCENES, [*two, ALL_ANNEALED, POOLED], seeds, 7_500),
        "defaults": cross(SCENES, [ALL_ANNEALED, ANNEALED, POOLED], seeds, 3_000),
        "long-parts": cross(SCENES, [*longer, UNFADED_OPACITIES], 1, 7_500),
        "full": cross(SCENES, [*two, POOLED], 1, 30_000),
        "rotated-brief": [
            *cross(MANY_VIEWS_SCENES, BRIEF_ARMS, seeds, 7_500, rotated=True),
            *cross(
                ("bonsai",),
                [*arms["schedules"], *arms["detail"], SELDOM_FADED],
                1,
                7_500,
                rotated=True,
            ),
        ],
        "crowded": [  # 40,000 Gaussians on images of a quarter of their size
            *cross(("bonsai",), CROWDED_ARMS, 1, 7_500, 4, rotated=True),
            *cross(("plush",), CROWDED_ARMS, 1, 7_500, 10, rotated=True),
        ],
        "sizes": [  # fewer Gaussians, views and iterations
            *cross(("bonsai",), ("mcmc", DEFAULTS), 1, 7_500, 0.1, rotated=True),
            *cross(("bonsai",), ("mcmc", DEFAULTS), 1, 7_500, 0.4, rotated=True),
            *cross(("bonsai",), ("mcmc", DEFAULTS), 1, 3_000, rotated=True),
            *(
                spec
                for views in (14, 28, 55, 110)
                for spec in cross(
                    ("bonsai",), ("mcmc", DEFAULTS), 1, 7_500, rotated=True, views=views
                )
            ),
        ],
        "rates": [  # the trainer's own, all of them times a factor
            spec
            for rates in (0.1, 0.3, 1.0, 3.0, 10.0)
            for spec in cross(("plush",), RATES_ARMS, 1, 7_500, rotated=True, rates=rates)
        ],
        "explorations": [
            *cross(("plush",), [STABLE, *arms["explorations"]], 1, 7_500, rotated=True),
            *cross(("plush", "embedded"), arms["explorations"], 1, 30_000, rotated=True),
        ],
        "unseen": cross(
            ("bonsai",),
            ["mcmc", FADED, DEFAULTS, *arms["unseen"]],
            1,
            7_500,
            rotated=True,
            tiled=True,
        ),
        "adaptive": cross(MANY_VIEWS_SCENES, arms["adaptive"], 1, 30_000, rotated=True),
        "rotated": [
            spec
            for seed in range(seeds)
            for scenes in (MANY_VIEWS_SCENES, ROTATED_SCENES[len(MANY_VIEWS_SCENES) :])
            for arm in ROTATED_ARMS
            for spec in cross(scenes, [arm], seeds, 30_000, rotated=True)
            if spec.seed == seed
        ],
        "half-size": [
            *cross(("bonsai", "lego"), HALF_ARMS, 1, 30_000, 5, rotated=True, size="images_2"),
            *cross(("plush",), HALF_ARMS, 1, 30_000, 12.5, rotated=True, size="images_2"),
        ],
        "full-parts": cross(FULL_PARTS_SCENES, [UNFADED_OPACITIES], 1, 30_000),
        "rest": cross(QUICK_SCENES, later, seeds, 3_000),
        "leads": cross(QUICK_SCENES, beyond, seeds, 3_000),
        "confirmed": cross(SCENES, CONFIRMED, seeds, 3_000),
        "random": cross(SCENES, two, seeds, 3_000, init="random"),
        "small": cross(SCENES, two, seeds, 3_000, share=0.25),
        "harmonics": cross(SCENES, two, 1, 3_000, sh_degree=3),
        "rest-all": cross(SCENES, later, seeds, 3_000),
        "long-all": cross(SCENES, longer, seeds, 7_500),
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
    arm = STUDY_ARMS[spec.arm]
    needed: list[Training] = []
    folders: dict[str, Path | None] = {"trunk": None, "nu": None}
    for key, name in (("trunk", arm.trunk), ("nu", arm.needs)):
        if name is not None:
            other = replace(spec, arm=name)
            needed += _with_needs(other, out)
            folders[key] = folder_of(other, out)
    first = tuple(folder for folder in folders.values() if folder is not None)
    own = Training(spec, folder_of(spec, out), first, folders["trunk"], folders["nu"])
    return [*needed, own]


def folder_of(spec: Spec, out: Path) -> Path:
    """Where a training lives."""
    kind = f"{spec.points}-{spec.iterations}-{spec.init}"
    if spec.sh_degree:
        kind += f"-sh{spec.sh_degree}"
    if spec.size != "images_4":
        kind += f"-{spec.size}"
    kind += "-rotated" * spec.rotated
    if spec.views:
        kind += f"-{spec.views}-views"
    kind += "-tiled" * spec.tiled
    if spec.rates != 1.0:
        kind += f"-rates-{spec.rates:g}"
    arm = spec.arm.replace("/", "_")
    return out / Path(spec.scene).name / kind / arm / f"seed-{spec.seed}"
