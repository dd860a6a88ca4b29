"""What is on: the parts that paid, and those of the paper."""

from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.annealing import Annealing
from opt3dgs_optim.parts.curvature import Curvature
from opt3dgs_optim.parts.fading import Fading
from opt3dgs_optim.parts.histogram import EnergyHistogram
from opt3dgs_optim.parts.last_phase import FreshMoments, SquaredLoss
from opt3dgs_optim.parts.out_of_view import OutOfView

PAPER_STEPS = 30_000
PAPER_SWITCH = 29_000 / PAPER_STEPS
PAPER_WARMUP = 2_500 / PAPER_STEPS
DEFAULTS: tuple[Part, ...] = (Annealing(), Fading(), OutOfView())  # what paid: docs/evidence.md


def paper_parts(total_steps: int = PAPER_STEPS) -> list[Part]:
    """The parts of Opt3DGS with the paper's settings, its warm-up scaled to `total_steps`."""
    warmup = round(total_steps * PAPER_WARMUP)
    return [EnergyHistogram.paper(warmup=warmup), FreshMoments(), SquaredLoss(), Curvature()]
