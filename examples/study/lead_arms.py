"""Arms of the study beyond the paper: what else an optimizer can do."""

from __future__ import annotations

from typing import Any

from opt3dgs_optim.annealing import Annealing
from opt3dgs_optim.fading import Fading
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.pooling import Pooling
from study.own_statistics import ChosenFading, OwnStep
from study.study_arm import (
    ALL_ANNEALED,
    BASELINE,
    DEFAULT_ANNEALING,
    DEFAULT_PARTS,
    DEFAULTS,
    POOLED,
    UNFADED_OPACITIES,
    StudyArm,
    anneal_all,
    fixed,
)

PARAMETERS = ("means", "scales", "quats", "opacities", "sh0")  # of the study's scenes
EIGENVALUE_FLOOR = 1e-3  # of a point's largest


def leads() -> list[StudyArm]:
    """What else an optimizer can do without touching the representation."""
    fast = fixed(annealing=anneal_all(8.0))
    geometry = {"means": 8.0, "scales": 8.0, "quats": 8.0, "opacities": 8.0}
    single = [
        StudyArm(
            f"annealed-{name}-only",
            f"annealed: {name} alone",
            BASELINE,
            fixed(annealing=Annealing({name: 8.0}, 0.4)),
        )
        for name in PARAMETERS
    ]
    fading = [
        StudyArm(f"faded-{key}", what, "faded", fixed(fading=fading))
        for key, what, fading in (
            ("v-only", "exp_avg_sq faded, exp_avg kept", Fading(exp_avg=1.0)),
            ("m-only", "exp_avg faded, exp_avg_sq kept", Fading(exp_avg_sq=1.0)),
            ("all-points", "all points at once, a fifth as often", Fading(share=1.0, events=60)),
            ("rarely", "a tenth of the events", Fading(events=30)),
        )
    ]
    v_only = StudyArm(
        f"{DEFAULTS}-v-only",
        "the defaults, exp_avg_sq faded, exp_avg kept",
        DEFAULTS,
        fixed(annealing=DEFAULT_ANNEALING, fading=Fading(exp_avg=1.0)),
    )
    on_annealed = "annealed-8-0.4"
    return [
        *single,
        *fading,
        *_chosen(),
        v_only,
        StudyArm(
            UNFADED_OPACITIES,
            "the defaults, opacities not faded",
            DEFAULTS,
            fixed(
                annealing=DEFAULT_ANNEALING,
                fading=Fading(names=("means", "scales", "quats", "sh0", "shN")),
            ),
        ),
        StudyArm(
            "annealed-geometry",
            "annealed: all but the colours",
            on_annealed,
            fixed(annealing=Annealing({**geometry, "sh0": 2.0}, 0.4)),
        ),
        StudyArm(
            "annealed+beta2-0.99", "annealed, beta2 = 0.99", on_annealed, fast, host={"beta2": 0.99}
        ),
        StudyArm("beta2-0.99", "beta2 = 0.99", BASELINE, fixed(), host={"beta2": 0.99}),
        StudyArm("visible", "visible rows only", BASELINE, fixed(), host={"visible": True}),
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
            fixed(),
            host={"average": 0.9},
        ),
        StudyArm(
            "annealed-no-noise",
            "annealed, no position noise at all",
            on_annealed,
            fixed(annealing=anneal_all(8.0), noise_scale=0.0),
        ),
        StudyArm(
            "decoupled",
            "opacity and scale decay outside Adam",
            BASELINE,
            fixed(),
            host={"decoupled": True},
        ),
        StudyArm(
            "annealed+decoupled",
            "annealed, opacity and scale decay outside Adam",
            on_annealed,
            fast,
            host={"decoupled": True},
        ),
        *_pooled(),
        *_small_gradients(),
        StudyArm(
            "adamw-gs",
            "AdamW-GS's parts together: visible rows only, faded, scheduled decay outside Adam",
            BASELINE,
            fixed(fading=Fading(events=140, start=1 / 30)),
            host={"visible": True, "decoupled": "scheduled"},
        ),
        *_regularised(),
        *_noisy(),
        *_tolerant(),
        *_same_view(),
        *_matrix(),
    ]


def _chosen() -> list[StudyArm]:
    """Fading of one parameter, of points that the moments choose; steps of a chosen size."""
    single = [
        StudyArm(
            f"faded-{name}-only",
            f"faded: {name} alone",
            BASELINE,
            fixed(fading=Fading(names=(name,))),
        )
        for name in PARAMETERS
    ]
    return [
        *single,
        StudyArm(
            "faded-stale",
            "the points whose exp_avg^2 / exp_avg_sq is smallest",
            "faded",
            fixed(fading=ChosenFading("stale")),
        ),
        StudyArm(
            "faded-fresh",
            "the points whose exp_avg^2 / exp_avg_sq is largest",
            "faded",
            fixed(fading=ChosenFading("fresh")),
        ),
        *(
            StudyArm(
                f"own-step-{first:g}",
                f"root mean square of every parameter's steps falling from {size} to lr / 10",
                control,
                lambda *_, first=first: {"annealing": OwnStep(first)},
            )
            for first, size, control in (
                (1.0, "lr", "annealed-4-0.4"),
                (2.0, "2 lr", "annealed-8-0.4"),
            )
        ),
        StudyArm(
            "own-step-1+faded",
            "the same from lr, and faded",
            "own-step-1",
            lambda *_: {"annealing": OwnStep(), "fading": Fading()},
        ),
    ]


def _pooled() -> list[StudyArm]:
    """One second moment per point: for stock, and of other parameters than the defaults'."""
    kinds: dict[str, tuple[str, ...]] = {
        "means": ("means",),
        "scales": ("scales",),
        "scales-quats": ("scales", "quats"),
        "all": ("means", "scales", "quats", "sh0", "shN"),
    }
    no_regularisers: dict[str, Any] = {"host": {"regularisers": 0.0}}
    alone, pooled = f"{DEFAULTS}+regularisers-0", f"{POOLED}+regularisers-0"
    return [
        StudyArm("pooled", "second moments pooled", BASELINE, fixed(pooling=Pooling())),
        StudyArm(
            alone,
            "the defaults, no regularisers",
            DEFAULTS,
            fixed(**DEFAULT_PARTS),
            **no_regularisers,
        ),
        StudyArm(
            pooled,
            "the defaults, pooled, no regularisers",
            alone,
            fixed(**DEFAULT_PARTS, pooling=Pooling()),
            **no_regularisers,
        ),
        *(
            StudyArm(
                f"{POOLED}-{key}",
                f"the defaults, pooled: {', '.join(names)}",
                DEFAULTS,
                fixed(**DEFAULT_PARTS, pooling=Pooling(names)),
            )
            for key, names in kinds.items()
        ),
    ]


def _small_gradients() -> list[StudyArm]:
    """Annealed and faded, with an eps that shortens the steps of points with small gradients."""
    return [
        StudyArm(
            f"{DEFAULTS}+eps-{key}-{share:g}",
            f"the defaults, eps {share:g} of the typical gradient, {key}",
            DEFAULTS,
            fixed(**DEFAULT_PARTS),
            host={"relative_eps": dict.fromkeys(names, share)},
        )
        for key, names, share in (
            ("all", PARAMETERS, 0.1),
            ("opacities", ("opacities",), 0.1),
        )
    ]


def _regularised() -> list[StudyArm]:
    """Annealed and faded: weaker regularisers, or none in Adam's moments; positions unannealed."""
    both = {"annealing": anneal_all(4.0), "fading": Fading()}
    others: dict[str, float] = dict.fromkeys(("scales", "quats", "opacities", "sh0", "shN"), 4.0)
    kinds: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
        "+decoupled": ("opacity and scale decay outside Adam", both, {"decoupled": True}),
        "+regularisers-0": ("no regularisers", both, {"regularisers": 0.0}),
        "+regularisers-0.1": ("a tenth of the regularisers", both, {"regularisers": 0.1}),
        "-means-1": (
            "positions not annealed",
            {**both, "annealing": Annealing(others, 0.4)},
            {},
        ),
    }
    return [
        StudyArm(
            f"{ALL_ANNEALED}{name}",
            f"annealed from 4, faded, {what}",
            ALL_ANNEALED,
            fixed(**options),
            host=host,
        )
        for name, (what, options, host) in kinds.items()
    ]


def _noisy() -> list[StudyArm]:
    """Stock, with the position noise on some rows only, or none."""
    return [
        StudyArm("no-noise", "no position noise", BASELINE, fixed(noise_scale=0.0)),
        *(
            StudyArm(
                f"noise-{rows}",
                f"position noise only on rows that this view's loss {does}",
                BASELINE,
                host={"noise": rows},
            )
            for rows, does in (("visible", "reaches"), ("hidden", "does not reach"))
        ),
    ]


def _same_view() -> list[StudyArm]:
    """L-BFGS directions whose pairs hold no difference between views."""
    kinds = (("l1+reset", 10), ("l1+reset", 4), ("l2+reset", 4))
    return [
        StudyArm(
            f"{loss}+lqn-view@1/{share}",
            f"pairs between two visits of one view, in the last 1/{share}",
            f"{loss}@1/{share}",
            fixed(
                squared_loss=loss.startswith("l2"),
                reset_moments=True,
                curvature=CurvatureOptions(),
            ),
            1 - 1 / share,
            trunk=BASELINE,
            host={"same_view": True},
        )
        for loss, share in kinds
    ]


def _tolerant() -> list[StudyArm]:
    """L-BFGS directions from such pairs only whose curvature stands out of the noise."""
    return [
        StudyArm(
            f"l2+reset+lqn-cosine-{cosine:g}@1/10",
            f"only pairs with cos(s, y) above {cosine:g}, in the last 1/10",
            "l2+reset@1/10",
            fixed(
                squared_loss=True,
                reset_moments=True,
                curvature=CurvatureOptions(min_cosine=cosine),
            ),
            0.9,
            trunk=BASELINE,
        )
        for cosine in (0.3, 0.7)
    ]


def _matrix() -> list[StudyArm]:
    """A 3x3 second moment for the positions, floored; in the last phase or all the time."""
    host = {"matrix": EIGENVALUE_FLOOR}
    what = "a 3x3 second moment per point for the positions"
    return [
        StudyArm(
            "matrix@1/10",
            f"{what}, in the last 1/10",
            BASELINE,
            switch=0.9,
            trunk=BASELINE,
            host=host,
        ),
        StudyArm("matrix", what, BASELINE, host=host),
    ]
