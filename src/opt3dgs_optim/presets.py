"""What is on: the parts that paid, and those of the paper."""

from __future__ import annotations

from opt3dgs_optim.checks import check_count
from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.averaging import Averaging
from opt3dgs_optim.parts.curvature import Curvature
from opt3dgs_optim.parts.fading import Fading
from opt3dgs_optim.parts.histogram import EnergyHistogram
from opt3dgs_optim.parts.out_of_view import OutOfView
from opt3dgs_optim.parts.own_frame import OwnFrame
from opt3dgs_optim.parts.switch import FreshMoments, SquaredLoss

PAPER_STEPS = 30_000
PAPER_SWITCH = 29_000 / PAPER_STEPS
PAPER_WARMUP = 2_500 / PAPER_STEPS


# For relocation as in 3DGS-MCMC, and for clone, split and prune (docs/evidence.md).
DEFAULTS: tuple[Part, ...] = (
    OwnFrame(),
    Fading(names=("scales", "quats", "opacities", "sh0", "shN")),
    OutOfView(),
    Averaging(),
)


def paper_parts(total_steps: int = PAPER_STEPS) -> list[Part]:
    """The parts of Opt3DGS with the paper's settings, its warm-up scaled to `total_steps`."""
    total_steps = check_count("paper_parts", "total_steps", total_steps, 1)
    warmup = round(total_steps * PAPER_WARMUP)
    return [EnergyHistogram.paper(warmup=warmup), FreshMoments(), SquaredLoss(), Curvature()]
