"""The decision rule: what is in the defaults of `PhaseScheduler`, and why."""

from __future__ import annotations

from dataclasses import dataclass

from studies.scenes.analysis import METRICS, Difference, Study, difference
from studies.scenes.arms import BASELINE, DEFAULTS, OWN_FRAME_ARM
from studies.scenes.records import Setting

QUARTER, HALF, FULL = "images_4", "images_2", "images"
# What decides: the first of these that enough scenes and seeds were trained at.
LADDER = ((HALF, 30_000), (QUARTER, 30_000), (QUARTER, 7_500))
POINTS, HALF_POINTS = 4_000, 50_000
NUM_POINTS = {"embedded": 2_000, "bonsai": 10_000, "lego": 10_000}
MANY_VIEWS_SCENES = ("bonsai", "lego", "plush")  # forty training views or more
MIN_SCENES, MIN_SEEDS = 3, 2
# part -> (the arm with it, the arm without it)
COMPARISONS = {
    "Fading": ("faded", BASELINE),
    "Averaging": (DEFAULTS, "faded"),
    "Annealing": ("annealed+averaged", DEFAULTS),
    "Annealing of the positions": ("annealed-all", "annealed"),
    "Pooling": ("faded+pooled+averaged", DEFAULTS),
    "EnergyHistogram": ("awsgld-stable", "awsgld-stable-constant"),
    "SquaredLoss": ("l2@1/30", BASELINE),
    "FreshMoments": ("l1+reset@1/30", BASELINE),
    "Curvature": ("l2+reset+lqn@1/30", "l2+reset@1/30"),
    "OutOfView": ("faded+out-of-view", "faded"),
    "OwnFrame": (OWN_FRAME_ARM, DEFAULTS),
}
# Parts that change no bit of an ordinary training are judged where they act: with every view cut
# into so many.
PIECES = {"OutOfView": 9}


# On before anything could be trained at full size, which must confirm every other part.
ON_BEFORE = ("Fading", "Averaging", "OutOfView")
CONFIRMING = 30_000  # iterations


@dataclass(frozen=True)
class Decision:
    """Whether a part is in the defaults."""

    arm: str
    control: str
    iterations: int | None  # None: not measured on enough scenes
    found: Difference | None
    size: str = QUARTER  # of the photos
    confirmed: bool = True  # by trainings at full size, or on before there were any

    @property
    def verdict(self) -> str:
        """The rule's, or that there are too few trainings: one seed turns nothing on."""
        if self.found is None:
            return "too few"
        verdict, seeds = self.found.verdict, min(map(len, self.found.pairs.values()))
        if verdict != "pays":
            return verdict
        if seeds < MIN_SEEDS:
            return "pays, one seed"
        return verdict if self.confirmed else "pays, not confirmed at full size"

    @property
    def on(self) -> bool:
        """A part that was not shown to pay is off."""
        return self.verdict == "pays"


def points_of(scene: str) -> int:
    """The most Gaussians of a scene, where a stage says nothing else."""
    return NUM_POINTS.get(scene, POINTS)


def settings_of(
    study: Study, iterations: int, tiled: int = 0, size: str = QUARTER
) -> list[Setting]:
    """The rule's scenes, with rotated views and the points that belong to a size."""
    every = every_scene(study, iterations, tiled=tiled)
    every = [s for s in every if s.scene in MANY_VIEWS_SCENES and s.size == size]
    return [s for s in every if s.points == (HALF_POINTS if size == HALF else points_of(s.scene))]


def every_scene(study: Study, iterations: int, **others: int) -> list[Setting]:
    """Every scene and size of the rotated trainings of all views at the trainer's rates.

    `others` are fields of `Setting`: of whole views and colours without harmonics where not given.
    """
    return [
        s
        for s in study.settings()
        if s == Setting(s.scene, s.points, iterations, "sfm", rotated=True, size=s.size, **others)
    ]


def decide(study: Study) -> dict[str, Decision]:
    """The decision on every part, at the largest and longest trainings that three scenes have.

    Each part is judged against the same training without it: the multiplier against a constant of
    its mean, curvature against the same phase without it, annealing and pooling on top of the
    defaults. At half size one seed decides nothing while there are several at a quarter. A part
    that pays must be confirmed at full size, but for those that were on before.
    """
    made = {}
    for part, (arm, control) in COMPARISONS.items():
        made[part] = Decision(arm, control, None, None)
        confirmed = part in ON_BEFORE or is_confirmed(study, arm, control)
        for size, iterations in LADDER:
            settings = settings_of(study, iterations, PIECES.get(part, 0), size)
            found = difference(study, settings, arm, control)
            seeds = min(map(len, found.pairs.values()), default=0)
            if len(found.pairs) >= MIN_SCENES and (size != HALF or seeds >= MIN_SEEDS):
                made[part] = Decision(arm, control, iterations, found, size, confirmed)
                break
    return made


def is_confirmed(study: Study, arm: str, control: str) -> bool:
    """Whether an arm was trained at full size and length, and is behind in no metric there."""
    every = every_scene(study, CONFIRMING) + every_scene(study, CONFIRMING, sh_degree=3)
    found = difference(study, [s for s in every if s.size == FULL], arm, control)
    ahead = (sign * found.of(metric)[0] >= 0 for metric, (sign, _) in METRICS.items())
    return found.count > 0 and all(ahead)
