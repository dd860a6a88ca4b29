"""Langevin noise: covariance-shaped for Gaussians, isotropic for anything else."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_choice, check_number, set_options, warn_user
from opt3dgs_optim.course import Course
from opt3dgs_optim.frames import rotate, unit_quaternion
from opt3dgs_optim.lbfgs.pairs import columns, put, row_chunks
from opt3dgs_optim.part import Group, Part, Phase, State

GaussianTensors = Mapping[str, Tensor]
# What it publishes from step to step: where, how often written, and a copy where one is needed.
LEFT_AT = "positions_left_at"
GATE_SHARPNESS = 100.0  # k of eq. 2's gate
GATE_OPACITY = 0.005  # t of eq. 2's gate: the opacity under which a Gaussian counts as dead
# Steps in a row with positions changed by somebody else before it is said.
MIN_STEPS_CHANGED_BY_OTHERS = 5


class PositionNoise(Part):
    """3DGS-MCMC's position noise: `scale * lr * covariance_noise(...)` after each step (eq. 2).

    For trainers that do not inject it themselves; gsplat's MCMCStrategy and 3dgs-mcmc do, and
    then this part must be left out (or their noise_lr be 0). lr is the trainer's own present
    learning rate of the positions, without any factor.

    Args:
        gaussians: the trainer's dict with `scales` [N, 3] log, `quats` [N, 4] wxyz and
            `opacities` [N] or [N, 1] logits, or a function that returns it; read in every step,
            because density control replaces the tensors in it. None: they are looked up in the
            groups of the upgraded optimizers.
        scale: noise_lr of 3DGS-MCMC.
        during: the phase in which it is added; None: both.
        generator: random generator of the parameters' device, or None for torch's own.

    Raises:
        ValueError: an option is not allowed; in a step, Gaussians lack a tensor, or rows of one.
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
        self._num_changed_by_others = 0

    def __repr__(self) -> str:
        during = "" if self.during is None else f", during={self.during.value}"
        return f"PositionNoise(scale={self.scale:g}{during})"

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """Say once that somebody else moves the positions too, as a trainer's own noise does.

        Raises:
            ValueError: what the noise is made of is missing, before anything has moved.
        """
        if not callable(self.gaussians):
            _check_source(self.gaussians or course.gaussians_of(param))
        # Density control puts another tensor in place; noise writes into this one, every time.
        left = course.published(LEFT_AT, param, earlier=True) or (None, 0, None)
        where, version, copy = left
        written = where == param.data_ptr() and version != param._version
        if self._num_changed_by_others <= MIN_STEPS_CHANGED_BY_OTHERS and not written:
            self._num_changed_by_others = 0
        elif self._num_changed_by_others < MIN_STEPS_CHANGED_BY_OTHERS:
            self._num_changed_by_others += 1
        elif copy is not None:
            self._num_changed_by_others += 1  # never looked at again
            # Trainers write noise of a rate of 0 as they write any other.
            if not torch.equal(copy, param):
                warn_user(
                    f"PositionNoise: the positions were changed in place between "
                    f"{MIN_STEPS_CHANGED_BY_OTHERS} steps in a row, while this part adds noise in "
                    "every step; if the trainer injects its own noise, set its noise_lr to 0, or "
                    "leave this part out"
                )
        return grad

    def after(self, group: Group, param: Tensor, state: State, course: Course) -> None:
        """Add the noise to the positions [N, 3] in place."""
        source = self.gaussians if self.gaussians is not None else course.gaussians_of(param)
        self._add(param, group["lr"], source() if callable(source) else source)
        looked_at = self._num_changed_by_others == MIN_STEPS_CHANGED_BY_OTHERS
        copy = param.detach().clone() if looked_at else None
        course.publish(LEFT_AT, param, (param.data_ptr(), param._version, copy))

    @torch.no_grad()
    def add_to(self, means: Tensor, lr: float | Tensor) -> None:
        """Add the noise to `means` [N, 3] in place; lr is their rate. ValueError: see the class."""
        source = self.gaussians() if callable(self.gaussians) else self.gaussians
        if source is None:
            raise ValueError(
                "PositionNoise.add_to: gaussians=None, but outside of a step nobody knows the "
                "Gaussians' tensors; give them to PositionNoise"
            )
        self._add(means, lr, source)

    @torch.no_grad()
    def _add(self, means: Tensor, lr: float | Tensor, source: GaussianTensors) -> None:
        _check_source(source)
        scales, quats, opacities = source["scales"], source["quats"], source["opacities"]
        if len(scales) != len(means):
            raise ValueError(
                f"PositionNoise: {len(scales)} scales for {len(means)} means; the dict must hold "
                "the tensors that belong to the means being stepped"
            )
        scales, quats, opacities = (each.to(means.device) for each in (scales, quats, opacities))
        noise = covariance_noise(scales, quats, opacities, _normal_like(means, self.generator))
        means += noise * (lr * self.scale)


def _check_source(source: GaussianTensors) -> None:
    """ValueError unless it has all that the noise is made of."""
    missing = [name for name in ("scales", "quats", "opacities") if name not in source]
    if missing:
        raise ValueError(
            f"PositionNoise: {missing} are not among the Gaussians' tensors {sorted(source)}"
        )


@dataclass(repr=False, eq=False)
class IsotropicNoise(Part):
    """Langevin noise of a landscape: `sqrt(2 lr temperature)`, or a fixed deviation, times eta.

    Args:
        temperature: that of the law exp(-energy / temperature) which plain SGLD drift
            (`AWSGLD(preconditioner="none")`) then samples, in units of the energy.
        std: a fixed deviation per step, in units of the parameters, instead of a temperature
            (ValueError: both, neither, or below 0).
        generator: random generator of the parameters' device, or None for torch's own.
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

    def after(self, group: Group, param: Tensor, state: State, course: Course) -> None:
        """Add the noise to the parameter (any shape) in place."""
        deviation: Any = self.std
        if self.temperature is not None:
            deviation = (2 * group["lr"] * self.temperature) ** 0.5
        # .data: no write of the trainer's, which `PositionNoise` would see by the version counter.
        param.data.add_(_normal_like(param, self.generator) * deviation)


def _normal_like(tensor: Tensor, generator: torch.Generator | None) -> Tensor:
    # randn_like takes no generator.
    return torch.randn(tensor.shape, dtype=tensor.dtype, device=tensor.device, generator=generator)


def covariance_noise(scales: Tensor, quats: Tensor, opacities: Tensor, eta: Tensor) -> Tensor:
    """Noise [N, 3], squared world units, of each Gaussian's covariance and opacity (eq. 2).

        sigmoid(-k (o - t)) * Sigma @ eta,   Sigma = R diag(s)^2 R^T,   k = 100, t = 0.005

    Args:
        scales: [N, 3] log of the standard deviations, world units.
        quats: [N, 4] rotations, wxyz, need not be normalised.
        opacities: [N] or [N, 1] logits.
        eta: [N, 3] standard normal.
    """
    noise = torch.empty_like(eta)
    for rows in row_chunks(eta):
        w, axis = unit_quaternion(quats[rows], quats.dtype)
        # R^T eta: rotation by the conjugate quaternion; then the variances; then R.
        local = rotate(w, [-a for a in axis], list(columns(eta[rows], eta.dtype).unbind()))
        variance = (2 * columns(scales[rows], scales.dtype)).exp().unbind()
        shaped = [a * b for a, b in zip(variance, local, strict=True)]
        opacity = torch.sigmoid(opacities[rows].reshape(-1))
        gate = torch.sigmoid(-GATE_SHARPNESS * (opacity - GATE_OPACITY))
        put(noise[rows], [v * gate for v in rotate(w, axis, shaped)])
    return noise
