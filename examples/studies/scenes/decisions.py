"""The decision rule: what is in the defaults of `PhaseScheduler`, and why."""

from __future__ import annotations

from dataclasses import dataclass, replace

from studies.scenes.analysis import METRICS, Difference, Study, difference
from studies.scenes.arms import BASELINE, DEFAULTS, OWN_FRAME_ARM
from studies.scenes.records import MISPOSED, Setting

QUARTER, HALF, FULL = "images_4", "images_2", "images"
# What decides: the first of these that enough scenes and seeds were trained at.
LADDER = ((HALF, 30_000), (QUARTER, 30_000), (QUARTER, 7_500))
POINTS, HALF_POINTS = 4_000, 50_000
NUM_POINTS = {"embedded": 2_000, "bonsai": 10_000, MISPOSED: 10_000, "lego": 10_000}
MANY_VIEWS_SCENES = ("bonsai", "lego", "plush")  # forty training views or more
FEW_VIEWS_SCENES = ("embedded", "banana", "lund_door", "brighton_beach")
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


# On before anything could be trained at full size.
ON_BEFORE = ("Fading", "Averaging", "OutOfView")
CONFIRMING = (15_000, 30_000)  # iterations; of the trainings of a scene the longest count
MIN_FULL_SCENES = 2  # at full size, where one training takes hours and seeds are few


@dataclass(frozen=True)
class Decision:
    """Whether a part is in the defaults."""

    arm: str
    control: str
    iterations: int | None  # None: not measured on enough scenes
    found: Difference | None
    full: Difference  # at full size
    size: str = QUARTER  # of the photos
    new: bool = False  # was not on before there were trainings at full size

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
        if len(self.full.pairs) < MIN_FULL_SCENES:
            return "pays, not confirmed at full size" if self.new else verdict
        return "pays, but not at full size" if self._fails_at_full_size() else verdict

    @property
    def on(self) -> bool:
        """A part that was not shown to pay is off."""
        return self.verdict == "pays"

    def _fails_at_full_size(self) -> bool:
        """A new part fails by a metric whose mean is behind; another by one behind everywhere."""
        scenes = [replace(self.full, pairs={s: p}) for s, p in self.full.pairs.items()]
        judged = [self.full] if self.new else scenes
        return any(
            all(sign * each.of(metric)[0] < 0 for each in judged)
            for metric, (sign, _) in METRICS.items()
        )


def points_of(scene: str) -> int:
    """The most Gaussians of a scene, where a stage says nothing else."""
    return NUM_POINTS.get(scene, POINTS)


def settings_of(
    study: Study, iterations: int, tiled: int = 0, size: str = QUARTER
) -> list[Setting]:
    """The rule's scenes, with rotated views and the points that belong to a size.

    And bonsai with its wrong poses, which `difference` takes where there is nothing else.
    """
    scenes, every = (*MANY_VIEWS_SCENES, MISPOSED), every_scene(study, iterations, tiled=tiled)
    every = [s for s in every if s.scene in scenes and s.size == size]
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
    """The decision on every part, at the largest and longest trainings that enough have.

    That is three scenes, and at half size two seeds of each. Each part is judged against the same
    training without it: the multiplier against a constant of its mean, curvature against the same
    phase without it, annealing and pooling on top of the defaults. A part that pays must not be
    behind at full size; those that were on before need not be trained there.
    """
    made = {}
    every = [
        setting
        for iterations in CONFIRMING
        for degree in (0, 3)
        for setting in every_scene(study, iterations, sh_degree=degree)
    ]
    whole = [setting for setting in every if setting.size == FULL]
    for part, (arm, control) in COMPARISONS.items():
        full, new = difference(study, whole, arm, control), part not in ON_BEFORE
        made[part] = Decision(arm, control, None, None, full, new=new)
        for size, iterations in LADDER:
            settings = settings_of(study, iterations, PIECES.get(part, 0), size)
            found = difference(study, settings, arm, control)
            seeds = min(map(len, found.pairs.values()), default=0)
            if len(found.pairs) >= MIN_SCENES and (size != HALF or seeds >= MIN_SEEDS):
                made[part] = Decision(arm, control, iterations, found, full, size, new)
                break
    return made
