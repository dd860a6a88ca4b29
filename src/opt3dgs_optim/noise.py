"""Langevin noise: covariance-shaped for Gaussians, isotropic for anything else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim._checks import check_choice, check_number
from opt3dgs_optim._covariance import GATE_OPACITY, GATE_SHARPNESS, covariance_noise
from opt3dgs_optim.backend import BACKENDS, Backend
from opt3dgs_optim.ops import add_covariance_noise

__all__ = [
    "GATE_OPACITY",
    "GATE_SHARPNESS",
    "CovarianceNoise",
    "GaussianTensors",
    "IsotropicNoise",
    "covariance_noise",
]

GaussianTensors = Mapping[str, Tensor]


@dataclass(frozen=True)
class CovarianceNoise:
    """3DGS-MCMC's position noise: `scale * lr * covariance_noise(...)` (eq. 2).

    Args:
        gaussians: the trainer's dict with `scales` [N, 3] log, `quats` [N, 4] wxyz and
            `opacities` [N] or [N, 1] logits, or a function that returns it. It is read anew in
            every step, because density control replaces the tensors in it.
        scale: noise_lr of 3DGS-MCMC.
        generator: random generator of the parameters' device, or None for torch's own.
        backend: `"auto"`, `"cuda"` or `"torch"`; see `backend_info`.
    """

    gaussians: GaussianTensors | Callable[[], GaussianTensors]
    scale: float = 5e5
    generator: torch.Generator | None = None
    backend: Backend = "auto"

    def __post_init__(self) -> None:
        check_number("CovarianceNoise", "scale", self.scale, 0.0)
        check_choice("CovarianceNoise", "backend", self.backend, BACKENDS)

    def add_to(self, means: Tensor, lr: float | Tensor) -> None:
        """Add the noise to `means` [N, 3] in place; lr is their present learning rate.

        Raises:
            ValueError: a tensor is missing among the Gaussians, or has another number of rows.
        """
        source = self.gaussians() if callable(self.gaussians) else self.gaussians
        missing = [name for name in ("scales", "quats", "opacities") if name not in source]
        if missing:
            raise ValueError(
                f"CovarianceNoise: {missing} are not among the Gaussians' tensors {sorted(source)}"
            )
        scales, quats, opacities = source["scales"], source["quats"], source["opacities"]
        if scales.shape[0] != means.shape[0]:
            raise ValueError(
                f"CovarianceNoise: {scales.shape[0]} scales for {means.shape[0]} means; the dict "
                "must hold the tensors that belong to the means being stepped"
            )
        eta = _normal_like(means, self.generator)
        add_covariance_noise(
            means,
            *(tensor.detach() for tensor in (scales, quats, opacities)),
            eta=eta,
            lr=lr if isinstance(lr, Tensor) else torch.tensor(lr, dtype=torch.float64),
            noise_scale=self.scale,
            backend=self.backend,
        )


@dataclass(frozen=True)
class IsotropicNoise:
    """Langevin noise of a landscape: `sqrt(2 lr temperature)`, or a fixed deviation, times eta.

    Args:
        temperature: that of the law exp(-energy / temperature) which plain SGLD drift
            (`preconditioner="none"`) then samples, in units of the energy.
        std: a fixed deviation per step, in units of the parameters, instead of a temperature.
        generator: random generator of the parameters' device, or None for torch's own.
    """

    temperature: float | None = None
    std: float | None = None
    generator: torch.Generator | None = None

    def __post_init__(self) -> None:
        if (self.temperature is None) == (self.std is None):
            raise ValueError(
                f"IsotropicNoise: temperature={self.temperature!r} and std={self.std!r}, but "
                "exactly one of the two is needed"
            )
        name = "std" if self.temperature is None else "temperature"
        check_number("IsotropicNoise", name, getattr(self, name), 0.0)

    def add_to(self, param: Tensor, lr: float | Tensor) -> None:
        """Add the noise to `param` (any shape) in place; lr is its present learning rate."""
        deviation: Any = self.std
        if self.temperature is not None:
            deviation = (2 * lr * self.temperature) ** 0.5
        param.add_(_normal_like(param, self.generator) * deviation)


def _normal_like(tensor: Tensor, generator: torch.Generator | None) -> Tensor:
    # randn_like takes no generator.
    return torch.randn(tensor.shape, dtype=tensor.dtype, device=tensor.device, generator=generator)
