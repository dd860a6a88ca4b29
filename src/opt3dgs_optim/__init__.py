"""Opt3DGS optimizers for existing 3D Gaussian Splatting trainers.

`AWSGLD` explores, `LQNAdam` exploits, `PhaseScheduler` puts both into a trainer's optimizers and
switches between them. Paper: Huang, Chen, Liu, Ji, "Opt3DGS", AAAI 2026, arXiv 2511.13571.
"""

from opt3dgs_optim._version import __version__
from opt3dgs_optim.annealing import Annealing
from opt3dgs_optim.awsgld import AWSGLD
from opt3dgs_optim.backend import BackendInfo, backend_info
from opt3dgs_optim.curvature import two_loop
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.fading import Fading
from opt3dgs_optim.lqnadam import LQNAdam
from opt3dgs_optim.phases import Phase, PhaseScheduler
from opt3dgs_optim.pooling import Pooling
from opt3dgs_optim.runs import RunLog

__all__ = [
    "AWSGLD",
    "Annealing",
    "BackendInfo",
    "EnergyHistogram",
    "Fading",
    "LQNAdam",
    "Phase",
    "PhaseScheduler",
    "Pooling",
    "RunLog",
    "__version__",
    "backend_info",
    "two_loop",
]
