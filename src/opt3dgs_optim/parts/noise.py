"""Langevin noise: covariance-shaped for Gaussians, isotropic for anything else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_choice, check_number, set_options
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Frame, Step, axes_of, into_frame, out_of_frame
from opt3dgs_optim.training import Training

GaussianTensors = Mapping[str, Tensor] | torch.nn.ParameterDict
GATE_SHARPNESS = 100.0  # k of eq. 2's gate
GATE_OPACITY = 0.005  # t of eq. 2's gate: the opacity under which a Gaussian counts as dead


class PositionNoise(Part):
    """3DGS-MCMC's position noise: `scale * lr * covariance_noise(...)` after each step (eq. 2).

    For trainers that do not inject it themselves. gsplat's MCMCStrategy and 3dgs-mcmc do: leave
    this part out there (or set their noise_lr to 0). lr is the trainer's own present learning
    rate of the positions, without any factor.

    Args:
        gaussians: the trainer's dict with `scales` [N, 3] log, `quats` [N, 4] wxyz and
            `opacities` [N] or [N, 1] logits, or a function that returns it; read after every step,
            because density control replaces the tensors in it. None: they are looked up in the
            groups of the upgraded optimizers.
        scale: noise_lr of 3DGS-MCMC.
        during: the phase in which it is added; None: both.
        generator: random generator of the parameters' device, or None for torch's own.

    Raises:
        ValueError: an option is not allowed; in a step, the Gaussians lack a tensor.
    """

    names = ("means",)

    def __init__(
        self,
        gaussians: GaussianTensors | Callable[[], GaussianTensors] | None = None,
        scale: float = 5e5,
        *,
        during: Phase | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        self.gaussians = gaussians
        self.scale = check_number("PositionNoise", "scale", scale, 0.0)
        during = check_choice("PositionNoise", "during", during, (None, *Phase))
        self.during = during  # pyright: ignore[reportAttributeAccessIssue]
        self.generator = generator

    def __repr__(self) -> str:
        during = "" if self.during is None else f", during={self.during}"
        return f"PositionNoise(scale={self.scale:g}{during})"

    def after(self, step: Step, training: Training) -> None:
        """Add the noise to the positions [N, 3] in place."""
        found = self._tensors()
        if found is None:
            names = ("scales", "quats", "opacities")
            found = {name: training.param_of(step.set, name) for name in names}
        self._add(step.param, step.group["lr"], found)

    @torch.no_grad()
    def add_to(self, means: Tensor, lr: float) -> None:
        """Add the noise to `means` [N, 3] in place, outside of a step; lr is their rate."""
        found = self._tensors()
        if found is None:
            raise ValueError("PositionNoise.add_to: gaussians=None; give them to PositionNoise")
        self._add(means, lr, found)

    def _tensors(self) -> Any:
        given = self.gaussians
        return given if given is None or hasattr(given, "keys") else given()  # pyright: ignore

    def _add(self, means: Tensor, lr: float, found: Any) -> None:
        for name, numbers in (("scales", 3), ("quats", 4), ("opacities", 1)):
            tensor = found.get(name)
            if tensor is None or tensor.numel() != numbers * len(means):
                has = "missing" if tensor is None else list(tensor.shape)
                raise ValueError(
                    f"PositionNoise: {name} is {has}, but [{len(means)}, {numbers}] is needed for "
                    f"{len(means)} means; give a function where the trainer makes new tensors"
                )
        eta = torch.randn(
            means.shape, dtype=means.dtype, device=means.device, generator=self.generator
        )
        noise = covariance_noise(found["scales"], found["quats"], found["opacities"], eta)
        means.data.add_(noise, alpha=lr * self.scale)


@dataclass(repr=False, eq=False)
class IsotropicNoise(Part):
    """Langevin noise of a landscape: `sqrt(2 lr temperature)`, or a fixed deviation, times eta.

    Args:
        temperature: in units of the energy. Plain SGLD drift
            (`AWSGLD(preconditioner="none")`) then samples exp(-energy / temperature).
        std: a fixed deviation per step, in units of the parameters, instead of a temperature.
        generator: random generator of the parameters' device, or None for torch's own.

    Raises:
        ValueError: temperature and std are both given, or neither, or one below 0.
    """

    temperature: float | None = None
    std: float | None = None
    generator: torch.Generator | None = None

    names = None

    def __post_init__(self) -> None:
        if (self.temperature is None) == (self.std is None):
            given = f"temperature={self.temperature!r} and std={self.std!r}"
            raise ValueError(f"IsotropicNoise: {given}, but exactly one of the two is needed")
        name = "std" if self.temperature is None else "temperature"
        set_options(self, **{name: check_number("IsotropicNoise", name, getattr(self, name), 0.0)})

    def after(self, step: Step, training: Training) -> None:
        """Add the noise to the parameter (any shape) in place."""
        deviation, param = self.std, step.param
        if self.temperature is not None:
            deviation = (2 * step.group["lr"] * self.temperature) ** 0.5
        eta = torch.randn(
            param.shape, dtype=param.dtype, device=param.device, generator=self.generator
        )
        param.data.add_(eta, alpha=deviation)  # pyright: ignore[reportArgumentType]


def covariance_noise(scales: Tensor, quats: Tensor, opacities: Tensor, eta: Tensor) -> Tensor:
    """Noise [N, 3], squared world units, of each Gaussian's covariance and opacity (eq. 2).

        sigmoid(-k (o - t)) * Sigma @ eta,   Sigma = R diag(s)^2 R^T,   k = 100, t = 0.005

    Args:
        scales: [N, 3] log of the standard deviations, world units.
        quats: [N, 4] rotations, wxyz, need not be normalised.
        opacities: [N] or [N, 1] logits.
        eta: [N, 3] standard normal.
    """
    axes = axes_of(Frame(1.0, 0.0, quats, scales))  # Sigma = B B^T
    opacity = torch.sigmoid(opacities.detach().reshape(-1, 1))
    gate = torch.sigmoid(-GATE_SHARPNESS * (opacity - GATE_OPACITY))
    return out_of_frame(axes, into_frame(axes, eta)).mul_(gate)
