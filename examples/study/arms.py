"""The arms of the study: each part alone, its control, and what goes beyond the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from splatting.arms import ALL_OFF, PAPER_WARMUP, Arm, paper_scheduler
from splatting.scenes import Scene

from opt3dgs_optim import EnergyHistogram, PhaseScheduler
from opt3dgs_optim.annealing import Annealing
from opt3dgs_optim.fading import Fading
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.multiplier import ConstantMultiplier

BASELINE = "mcmc"
# (scene, iterations, mean nu of the arm in `needs`) -> the options that differ from ALL_OFF
Options = Callable[[Scene, int, float | None], dict[str, Any]]


@dataclass(frozen=True)
class StudyArm:
    """One way of training, as options of `PhaseScheduler` and of the trainer around it."""

    name: str
    what: str
    control: str  # the arm that a gain is measured against
    options: Options | None = None  # None: torch's own Adam in the trainer
    switch: float = 1.0  # where exploitation starts
    trunk: str | None = None  # branch off this arm's run at the switch
    needs: str | None = None  # the arm whose mean nu it takes
    host: dict[str, Any] = field(default_factory=dict)  # what `StudyFit` does differently

    def arm(self, scene: Scene) -> Arm:
        """The arm as the examples' trainer takes it."""
        if self.options is None:
            return Arm(self.name, self.what)
        options = self.options

        # The switch is the arm's own, so that a trunk and its branches share their `FitOptions`.
        def make(iterations: int, _switch: float, nu: float | None) -> PhaseScheduler:
            if self.name == "paper":
                return paper_scheduler(iterations, self.switch, nu)
            changed = ALL_OFF | options(scene, iterations, nu)
            return PhaseScheduler(iterations, self.switch, **changed)

        return Arm(self.name, self.what, make=make, needs=self.needs)


def _fixed(**options: Any) -> Options:
    return lambda _scene, _iterations, _nu: options


def _histogram(**changes: Any) -> Options:
    def make(_scene: Scene, iterations: int, _nu: float | None) -> dict[str, Any]:
        warmup = round(iterations * PAPER_WARMUP)
        if changes.get("paper"):
            return {"multiplier": EnergyHistogram.paper(warmup=warmup)}
        return {"multiplier": EnergyHistogram(**{"warmup": warmup, **changes})}

    return make


def _constant(_scene: Scene, iterations: int, nu: float | None) -> dict[str, Any]:
    assert nu is not None
    return {"multiplier": ConstantMultiplier(nu, warmup=round(iterations * PAPER_WARMUP))}


def _epoch_pairs(scene: Scene, _iterations: int, _nu: float | None) -> dict[str, Any]:
    pairs = CurvatureOptions(pairs="epoch", epoch_steps=len(scene.train), powell=True)
    return {"squared_loss": True, "reset_moments": True, "curvature": pairs}


def core() -> list[StudyArm]:
    """Whole trainings that only the trainer's learning rates, nu or the moments distinguish."""
    rates = [
        StudyArm(f"rates-x{k:g}", f"all steps times {k:g}", BASELINE, _fixed(multiplier=float(k)))
        for k in (1.5, 2, 3)
    ]
    annealed = [
        StudyArm(
            f"annealed-{peak:g}-{final:g}",
            f"all steps times {peak:g} falling to {final:g}",
            BASELINE,
            _fixed(annealing=Annealing(peak, final)),
        )
        for peak, final in ((4, 0.4), (8, 0.4), (8, 0.1), (16, 0.4))
    ]
    both = Annealing(4.0, 0.4)
    return [
        StudyArm(BASELINE, "stock 3DGS-MCMC, torch's Adam", BASELINE),
        StudyArm("awsgld", "with the flat-histogram multiplier", BASELINE, _histogram()),
        StudyArm(
            "constant", "a constant multiplier, its mean nu", BASELINE, _constant, needs="awsgld"
        ),
        *rates,
        *annealed,
        StudyArm("faded", "moments of random points faded", BASELINE, _fixed(fading=Fading())),
        StudyArm(
            "annealed-4-0.4+faded",
            "annealed from 4, and faded: the defaults",
            "annealed-8-0.4",
            _fixed(annealing=both, fading=Fading()),
        ),
        StudyArm(
            "annealed-8-0.4+awsgld",
            "annealed, with the flat-histogram multiplier",
            "annealed-8-0.4",
            lambda *call: {**_histogram()(*call), "annealing": Annealing(8.0, 0.4)},
        ),
        StudyArm(
            "faded+awsgld",
            "faded, with the flat-histogram multiplier",
            "faded",
            lambda *call: {**_histogram()(*call), "fading": Fading()},
        ),
        StudyArm("paper", "everything, the paper's settings", BASELINE, _fixed(), 29 / 30),
    ]


def histograms() -> list[StudyArm]:
    """The multiplier's options, one changed at a time."""
    changes: dict[str, dict[str, Any]] = {
        "zeta-0.25": {"zeta": 0.25},
        "zeta-0.5": {"zeta": 0.5},
        "clamp-0-5": {"clamp": (0.0, 5.0)},
        "clamp-0.25-4": {"clamp": (0.25, 4.0)},
        "ema": {"energy": "ema"},
        "view-centred": {"energy": "view_centered"},
        "backward-slope": {"slope": "backward"},
        "fixed": {"paper": True},
    }
    return [
        StudyArm(f"awsgld-{name}", f"the histogram with {options}", "awsgld", _histogram(**options))
        for name, options in changes.items()
    ]


def last_phases() -> list[StudyArm]:
    """What changes at the switch, branched off one and the same exploration."""
    kinds: dict[str, tuple[str, str | None, Options]] = {
        "l1+reset": ("L1, moments reset", None, _fixed(reset_moments=True)),
        "l2": ("L2, moments kept", None, _fixed(squared_loss=True)),
        "l2+reset": ("L2, moments reset", None, _fixed(squared_loss=True, reset_moments=True)),
        "l2+reset+lqn": (
            "the same with L-BFGS directions, consecutive pairs",
            "l2+reset",
            _fixed(squared_loss=True, reset_moments=True, curvature=CurvatureOptions()),
        ),
        "l2+reset+lqn-powell": (
            "the same with Powell damping",
            "l2+reset",
            _fixed(squared_loss=True, reset_moments=True, curvature=CurvatureOptions(powell=True)),
        ),
        "l2+reset+lqn-epoch": ("pairs between means over epochs", "l2+reset", _epoch_pairs),
        "l1+reset+lqn": (
            "L1, moments reset, L-BFGS directions",
            "l1+reset",
            _fixed(reset_moments=True, curvature=CurvatureOptions()),
        ),
        "noise-off": ("no noise", None, _fixed(noise_in_exploitation=False)),
    }
    return [
        StudyArm(
            f"{name}@1/{share}",
            f"{what}, in the last 1/{share}",
            f"{control}@1/{share}" if control else BASELINE,
            options,
            1 - 1 / share,
            trunk=BASELINE,
        )
        for share in (30, 10, 4)
        for name, (what, control, options) in kinds.items()
    ]


def on_top() -> list[StudyArm]:
    """The last phase on top of annealing: does curvature earn its place there?"""
    trunk = "annealed-8-0.4"
    anneal = Annealing(8.0, 0.4)
    kinds: dict[str, tuple[str | None, dict[str, Any]]] = {
        "l2": (None, {"squared_loss": True}),
        "l1+reset": (None, {"reset_moments": True}),
        "l1+reset+lqn": ("l1+reset", {"reset_moments": True, "curvature": CurvatureOptions()}),
        "lqn": (None, {"curvature": CurvatureOptions()}),
        "noise-off": (None, {"noise_in_exploitation": False}),
    }
    return [
        StudyArm(
            f"annealed+{name}@1/10",
            f"annealed, then {name} in the last tenth",
            f"annealed+{control}@1/10" if control else trunk,
            _fixed(annealing=anneal, **options),
            0.9,
            trunk=trunk,
        )
        for name, (control, options) in kinds.items()
    ]


def leads() -> list[StudyArm]:
    """What else an optimizer can do without touching the representation."""
    fast = _fixed(annealing=Annealing(8.0, 0.4))
    geometry = {"means": 8.0, "scales": 8.0, "quats": 8.0, "opacities": 8.0}
    single = [
        StudyArm(
            f"annealed-{name}-only",
            f"annealed: {name} alone",
            BASELINE,
            _fixed(annealing=Annealing({name: 8.0}, 0.4)),
        )
        for name in ("means", "scales", "quats", "opacities", "sh0")
    ]
    fading = [
        StudyArm(f"faded-{key}", what, "faded", _fixed(fading=fading))
        for key, what, fading in (
            ("v-only", "exp_avg_sq faded, exp_avg kept", Fading(exp_avg=1.0)),
            ("m-only", "exp_avg faded, exp_avg_sq kept", Fading(exp_avg_sq=1.0)),
            ("all-points", "all points at once, a fifth as often", Fading(share=1.0, events=60)),
            ("rarely", "a tenth of the events", Fading(events=30)),
        )
    ]
    on_annealed = "annealed-8-0.4"
    return [
        *single,
        *fading,
        StudyArm(
            "annealed-geometry",
            "annealed: all but the colours",
            on_annealed,
            _fixed(annealing=Annealing({**geometry, "sh0": 2.0}, 0.4)),
        ),
        StudyArm(
            "annealed+beta2-0.99", "annealed, beta2 = 0.99", on_annealed, fast, host={"beta2": 0.99}
        ),
        StudyArm("beta2-0.99", "beta2 = 0.99", BASELINE, _fixed(), host={"beta2": 0.99}),
        StudyArm("visible", "visible rows only", BASELINE, _fixed(), host={"visible": True}),
        StudyArm(
            "annealed+visible",
            "annealed, visible rows only",
            on_annealed,
            fast,
            host={"visible": True},
        ),
        StudyArm(
            "annealed+average",
            "annealed, last tenth of the iterates averaged",
            on_annealed,
            fast,
            host={"average": 0.9},
        ),
        StudyArm(
            "average",
            "last tenth of the iterates averaged",
            BASELINE,
            _fixed(),
            host={"average": 0.9},
        ),
        StudyArm(
            "annealed-no-noise",
            "annealed, no position noise at all",
            on_annealed,
            _fixed(annealing=Annealing(8.0, 0.4), noise_scale=0.0),
        ),
        StudyArm(
            "decoupled",
            "opacity and scale decay outside Adam",
            BASELINE,
            _fixed(),
            host={"decoupled": True},
        ),
        StudyArm(
            "annealed+decoupled",
            "annealed, opacity and scale decay outside Adam",
            on_annealed,
            fast,
            host={"decoupled": True},
        ),
    ]


STUDY_ARMS = {
    arm.name: arm
    for arms in (core(), histograms(), last_phases(), on_top(), leads())
    for arm in arms
}


def find_study_arm(name: str) -> StudyArm:
    """The arm of that name; ValueError that lists the others."""
    if name not in STUDY_ARMS:
        raise ValueError(f"arm {name!r} is unknown; there are {', '.join(STUDY_ARMS)}")
    return STUDY_ARMS[name]
