"""PyTorch optimizers for 3D Gaussian Splatting.

It is an independent implementation of Opt3DGS (AAAI 2026, whose authors had released no code when
this was written): the optimizers AWSGLD and LQNAdam, and the PhaseScheduler that puts the paper's
two phases into an existing trainer.

What is on by default is this package's own, and not the paper's: positions are stepped in each
Gaussian's own frame, Adam's moments of the others are faded, points out of view are held, and the
training ends at the mean of its last iterates.
"""

from opt3dgs_optim.awsgld import AWSGLD
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.lbfgs import history_from_pairs, two_loop
from opt3dgs_optim.lbfgs.backend import backend_info
from opt3dgs_optim.lqnadam import LQNAdam
from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.averaging import Averaging
from opt3dgs_optim.parts.curvature import Curvature
from opt3dgs_optim.parts.fading import Fading
from opt3dgs_optim.parts.harmonics import Harmonics
from opt3dgs_optim.parts.histogram import EnergyHistogram
from opt3dgs_optim.parts.noise import IsotropicNoise, PositionNoise
from opt3dgs_optim.parts.out_of_view import OutOfView
from opt3dgs_optim.parts.own_frame import OwnFrame
from opt3dgs_optim.parts.switch import FreshMoments, SquaredLoss
from opt3dgs_optim.phases import PhaseScheduler
from opt3dgs_optim.presets import DEFAULTS, paper_parts
from opt3dgs_optim.runs import RunLog
from opt3dgs_optim.training import Training
from opt3dgs_optim.version import __version__

__all__ = [
    "AWSGLD",
    "DEFAULTS",
    "Averaging",
    "Curvature",
    "EnergyHistogram",
    "Fading",
    "FreshMoments",
    "Harmonics",
    "IsotropicNoise",
    "LQNAdam",
    "OutOfView",
    "OwnFrame",
    "Part",
    "Phase",
    "PhaseScheduler",
    "PositionNoise",
    "RunLog",
    "SquaredLoss",
    "Training",
    "__version__",
    "backend_info",
    "history_from_pairs",
    "paper_parts",
    "two_loop",
]
