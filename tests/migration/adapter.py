"""The package's two ways of saying what is on: today's options, and the parts to come.

All that the scripts of the migration know of the package's API is in this file. `make` takes the
parts' way as soon as `opt3dgs_optim.Part` exists.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam

import opt3dgs_optim

package: Any = opt3dgs_optim
IS_NEW = hasattr(package, "Part")

# gsplat's learning rates and its eps
LEARNING_RATES = {
    "means": 1.6e-4,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}
EPS = 1e-15
FLAVOURS: dict[str, dict[str, Any]] = {
    "default": {},
    "foreach": {"foreach": True},
    "single": {"foreach": False},
    "fused": {"fused": True},
}
NOISE_SCALE = 5e3  # a hundredth of 3DGS-MCMC's: its scenes are smaller by as much
FADINGS = 12  # `Fading`'s default number of events is for long runs, and may change
PHASED = (
    "nothing",
    "annealing",
    "fading",
    "defaults",
    "pooling",
    "histogram",
    "paper histogram",
    "constant",
    "curvature",
    "all",
    "noise",
    "paper",
)
STANDALONE = ("awsgld covariance", "awsgld isotropic", "awsgld drift", "lqnadam")
CASES = ("torch", *PHASED, *STANDALONE)


def mean_square(render: Tensor, target: Tensor) -> Tensor:
    """Mean squared error."""
    return (render - target).square().mean()


def mean_abs(render: Tensor, target: Tensor) -> Tensor:
    """Mean absolute error."""
    return (render - target).abs().mean()


@dataclass
class Arm:
    """Six optimizers, and the two lines of a trainer that the package changes."""

    optimizers: dict[str, Any]
    observe: Callable[..., Any]
    pixel_loss: Callable[[Tensor, Tensor], Tensor] = mean_abs

    def state_dict(self) -> dict[str, Any]:
        """What a trainer saves: the optimizers' states."""
        return {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """What a trainer loads."""
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state[name])


def make(case: str, params: dict[str, Any], flavour: str, total_steps: int, switch: int) -> Arm:
    """The arm of a case.

    Args:
        case: one of `CASES`.
        params: the six Gaussian parameters; read anew in every step, where noise is on.
        flavour: one of `FLAVOURS`.
        total_steps, switch: the schedule; `paper` takes its own switch.
    """
    if case in STANDALONE:
        return _standalone(case, params, FLAVOURS[flavour], total_steps)
    optimizers = {
        name: Adam(
            [{"params": [param], "lr": LEARNING_RATES[name], "name": name}],
            eps=EPS,
            **FLAVOURS[flavour],
        )
        for name, param in params.items()
    }
    if case == "torch":
        return Arm(optimizers, lambda loss, **_: None)
    phases = (_new if IS_NEW else _old)(case, params, total_steps, switch)
    if IS_NEW or case != "noise":
        upgraded = phases.upgrade(optimizers)
    else:
        upgraded = phases.upgrade(optimizers, gaussians=params)
    return Arm(upgraded, phases.observe, phases.pixel_loss)


def warmup_of(total_steps: int) -> int:
    """The paper's warm-up, a twelfth of the run."""
    return max(4, round(total_steps / 12))


# -- Old: the options -------------------------------------------------------------------------


def _old(case: str, params: dict[str, Any], total_steps: int, switch: int) -> Any:
    from opt3dgs_optim.curvature_options import CurvatureOptions
    from opt3dgs_optim.multiplier import ConstantMultiplier

    if case == "paper":
        return package.PhaseScheduler.paper(total_steps)
    if case == "defaults":
        return package.PhaseScheduler(total_steps, switch)
    warmup = warmup_of(total_steps)
    exploiting = {
        "curvature": CurvatureOptions(),
        "squared_loss": True,
        "reset_moments": True,
    }
    fading = package.Fading(events=FADINGS)
    defaults = {"annealing": package.Annealing(), "fading": fading}
    paper_histogram = package.EnergyHistogram.paper(warmup=warmup)
    options: dict[str, dict[str, Any]] = {
        "nothing": {},
        "annealing": {"annealing": package.Annealing()},
        "fading": {"fading": fading},
        "pooling": {**defaults, "pooling": package.Pooling()},
        "histogram": {"multiplier": package.EnergyHistogram(warmup=warmup)},
        "paper histogram": {"multiplier": paper_histogram},
        "constant": {"multiplier": ConstantMultiplier(1.7, warmup=warmup)},
        "curvature": exploiting,
        "all": {
            **defaults,
            **exploiting,
            "pooling": package.Pooling(),
            "multiplier": paper_histogram,
        },
        "noise": {"noise_scale": NOISE_SCALE},
    }
    off = {"annealing": None, "fading": None}
    return package.PhaseScheduler(total_steps, switch, **{**off, **options[case]})


# -- New: the parts ---------------------------------------------------------------------------


def _new(case: str, params: dict[str, Any], total_steps: int, switch: int) -> Any:
    if case == "paper":
        return package.PhaseScheduler.paper(total_steps)
    if case == "defaults":
        return package.PhaseScheduler(total_steps, switch)
    warmup = warmup_of(total_steps)
    annealing, fading = package.Annealing(), package.Fading(events=FADINGS)
    paper_histogram = package.EnergyHistogram.paper(warmup=warmup)
    exploiting = [package.FreshMoments(), package.SquaredLoss(), package.Curvature()]
    parts: dict[str, list[Any]] = {
        "nothing": [],
        "annealing": [annealing],
        "fading": [fading],
        "pooling": [annealing, fading, package.Pooling()],
        "histogram": [package.EnergyHistogram(warmup=warmup)],
        "paper histogram": [paper_histogram],
        "constant": [package.ConstantMultiplier(1.7, warmup=warmup)],
        "curvature": exploiting,
        "all": [annealing, fading, paper_histogram, *exploiting, package.Pooling()],
        "noise": [package.PositionNoise(params, scale=NOISE_SCALE)],
    }
    return package.PhaseScheduler(total_steps, switch, parts=parts[case])


# -- both: AWSGLD and LQNAdam by themselves ---------------------------------------------------


def _standalone(
    case: str, params: dict[str, Any], flavour: dict[str, Any], total_steps: int
) -> Arm:
    groups = {
        name: [{"params": [param], "lr": LEARNING_RATES[name], "name": name}]
        for name, param in params.items()
    }
    if case == "lqnadam":
        made = {n: opt3dgs_optim.LQNAdam(g, eps=EPS, **flavour) for n, g in groups.items()}
        return Arm(made, lambda loss, **_: None, mean_square)
    histogram = opt3dgs_optim.EnergyHistogram.paper(warmup=warmup_of(total_steps))
    options: dict[str, Any] = {"histogram": histogram, "eps": EPS, **flavour}
    noise = _noise_of(case, params)
    if case == "awsgld drift":
        options["preconditioner"] = "none"
    made = {}
    for name, group in groups.items():
        everywhere = case != "awsgld covariance" or name == "means"
        made[name] = opt3dgs_optim.AWSGLD(group, noise=noise if everywhere else None, **options)
    return Arm(made, lambda loss, **_: histogram.observe(loss))


def _noise_of(case: str, params: dict[str, Any]) -> Any:
    if IS_NEW:
        CovarianceNoise, IsotropicNoise = package.PositionNoise, package.IsotropicNoise
    else:
        from opt3dgs_optim.noise import CovarianceNoise, IsotropicNoise

    if case == "awsgld covariance":
        return CovarianceNoise(params, NOISE_SCALE)
    if case == "awsgld isotropic":
        return IsotropicNoise(std=1e-4)
    return IsotropicNoise(temperature=1e-6)


# -- six parameters ---------------------------------------------------------------------------


def gaussians(num_points: int, seed: int = 0) -> dict[str, torch.nn.Parameter]:
    """Six Gaussian parameters as gsplat names and shapes them; some opacities are near zero."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(num_points, *shape, generator=generator)

    values = {
        "means": normal(3),
        "scales": 0.3 * normal(3) - 2.0,
        "quats": normal(4),
        "opacities": 2.0 * normal() - 4.0,
        "sh0": normal(1, 3),
        "shN": 0.1 * normal(15, 3),
    }
    return {name: torch.nn.Parameter(value) for name, value in values.items()}
