"""Langevin noise: covariance-shaped for Gaussians, isotropic for anything else."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_choice, check_number, set_options
from opt3dgs_optim.course import Course
from opt3dgs_optim.frames import axes_of, repeated_columns
from opt3dgs_optim.lbfgs.pairs import put, row_chunks
from opt3dgs_optim.part import Group, Part, Phase, State

HOLDERS = (Mapping, torch.nn.ParameterDict)  # of tensors by name; the second is no Mapping
GaussianTensors = Mapping[str, Tensor] | torch.nn.ParameterDict
# What the noise is made of, beside the means [N, 3]: the allowed dimensions after the first.
SHAPES: dict[str, tuple[tuple[int, ...], ...]] = {
    "scales": ((3,),),
    "quats": ((4,),),
    "opacities": ((), (1,)),
}
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
            `opacities` [N] or [N, 1] logits, or a function that returns it; read before and after
            every step, because density control replaces the tensors in it. None: they are looked up
            in the groups of the upgraded optimizers.
        scale: noise_lr of 3DGS-MCMC.
        during: the phase in which it is added; None: both.
        generator: random generator of the parameters' device, or None for torch's own.

    Raises:
        ValueError: an option is not allowed. In a step, before anything has moved: the Gaussians
            lack a tensor, or one of them has other rows than the means or another shape; or the
            generator is of another device.
        TypeError: `gaussians` or `generator`, or what `gaussians()` returns, is no such object.
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
        if not (gaussians is None or callable(gaussians) or isinstance(gaussians, HOLDERS)):
            raise TypeError(
                f"PositionNoise: gaussians is a {type(gaussians).__name__}, but a dict of tensors, "
                "a function that returns one, or None is needed"
            )
        _check_generator("PositionNoise", generator)
        self.gaussians = gaussians
        self.scale = check_number("PositionNoise", "scale", scale, 0.0)
        during = check_choice("PositionNoise", "during", during, (None, *Phase))
        self.during = during  # pyright: ignore[reportAttributeAccessIssue]
        self.generator = generator
        self._num_changed_by_others: dict[Any, int] = {}  # by the set of Gaussians

    def __repr__(self) -> str:
        during = "" if self.during is None else f", during={self.during.value}"
        return f"PositionNoise(scale={self.scale:g}{during})"

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """Look at what the noise will be made of; see whether others move the positions, too.

        Raises:
            ValueError, TypeError: as the class has them, before anything has moved.
        """
        self._check(param, self._source(param, course))
        self._watch(param, course)
        return grad

    def after(self, group: Group, param: Tensor, state: State, course: Course) -> None:
        """Add the noise to the positions [N, 3] in place."""
        self._add(param, group["lr"], self._source(param, course))
        place = course.place_of(param)
        looked_at = self._num_changed_by_others.get(place) == MIN_STEPS_CHANGED_BY_OTHERS
        copy = param.detach().clone() if looked_at else None
        course.publish(LEFT_AT, param, (param.data_ptr(), param._version, copy))

    def _watch(self, param: Tensor, course: Course) -> None:
        """Say once that somebody else moves the positions, as a trainer's own noise does.

        Counted for each set of Gaussians: a trainer may add noise to some of them.
        """
        # Density control puts another tensor in place; noise writes into this one, every time.
        left = course.published(LEFT_AT, param, earlier=True) or (None, 0, None)
        where, version, copy = left
        written = where == param.data_ptr() and version != param._version
        place = course.place_of(param)
        count = self._num_changed_by_others.get(place, 0)
        if count <= MIN_STEPS_CHANGED_BY_OTHERS and not written:
            count = 0
        elif count < MIN_STEPS_CHANGED_BY_OTHERS:
            count += 1
        elif copy is not None:
            count += 1  # never looked at again
            # Trainers write noise of a rate of 0 as they write any other.
            if not torch.equal(copy, param):
                course.warn_once(
                    LEFT_AT,
                    f"PositionNoise: the positions were changed in place between "
                    f"{MIN_STEPS_CHANGED_BY_OTHERS} steps in a row, while this part adds noise in "
                    "every step; if the trainer injects its own noise, set its noise_lr to 0, or "
                    "leave this part out",
                )
        self._num_changed_by_others[place] = count

    @torch.no_grad()
    def add_to(self, means: Tensor, lr: float | Tensor) -> None:
        """Add the noise to `means` [N, 3] in place; lr is their rate. ValueError: see the class."""
        if self.gaussians is None:
            raise ValueError(
                "PositionNoise.add_to: gaussians=None, but outside of a step nobody knows the "
                "Gaussians' tensors; give them to PositionNoise"
            )
        self._add(means, lr, self._source(means, None))

    def _source(self, means: Tensor, course: Course | None) -> GaussianTensors:
        """The tensors of the means' set of Gaussians, as they are now."""
        given = self.gaussians
        if given is None:
            return {} if course is None else course.gaussians_of(means)
        # torch's ParameterDict is a module, and so can be called.
        return given if isinstance(given, HOLDERS) else given()

    def _check(self, means: Tensor, source: Any) -> None:
        """Refuse what is no noise for these means: see the class."""
        if not isinstance(source, HOLDERS):
            raise TypeError(
                f"PositionNoise: gaussians() returned a {type(source).__name__}, but a dict of "
                "tensors is needed"
            )
        missing = [name for name in SHAPES if name not in source]
        if missing:
            raise ValueError(
                f"PositionNoise: {missing} are not among the Gaussians' tensors {sorted(source)}"
            )
        for name, each in (("means", means), *((name, source[name]) for name in SHAPES)):
            _check_tensor(name, each, means)
        _check_device("PositionNoise", self.generator, means)

    @torch.no_grad()
    def _add(self, means: Tensor, lr: float | Tensor, source: GaussianTensors) -> None:
        self._check(means, source)
        scales, quats, opacities = (source[name].to(means.device) for name in SHAPES)
        noise = covariance_noise(scales, quats, opacities, _normal_like(means, self.generator))
        means += noise * (lr * self.scale)


def _check_tensor(name: str, tensor: Any, means: Tensor) -> None:
    """Refuse what is none of floating point numbers, of as many rows as the means have."""
    if not isinstance(tensor, Tensor):
        kind = type(tensor).__name__
        raise TypeError(f"PositionNoise: {name} is a {kind}, but a tensor is needed")
    allowed = SHAPES.get(name, ((3,),))
    if tuple(tensor.shape[1:]) not in allowed or not (tensor.dim() and tensor.is_floating_point()):
        needed = " or ".join(str(["N", *width]).replace("'", "") for width in allowed)
        raise ValueError(
            f"PositionNoise: {name} has shape {tuple(tensor.shape)} and {tensor.dtype}, but "
            f"{needed} of real floating-point numbers is needed"
        )
    if len(tensor) != len(means):
        raise ValueError(
            f"PositionNoise: {len(tensor)} {name} for {len(means)} means; the dict must hold "
            "the tensors that belong to the means being stepped"
        )


def _check_generator(call: str, generator: Any) -> None:
    """TypeError unless it is one of torch's, or None."""
    if generator is not None and not isinstance(generator, torch.Generator):
        raise TypeError(f"{call}: generator={generator!r}, but a torch.Generator or None is needed")


def _check_device(call: str, generator: torch.Generator | None, param: Tensor) -> None:
    """ValueError where a generator draws numbers for other devices than the parameter's."""
    if generator is not None and generator.device.type != param.device.type:
        raise ValueError(
            f"{call}: generator is one of {generator.device}, but one of the parameter's device, "
            f"{param.device}, is needed"
        )


@dataclass(repr=False, eq=False)
class IsotropicNoise(Part):
    """Langevin noise of a landscape: `sqrt(2 lr temperature)`, or a fixed deviation, times eta.

    Args:
        temperature: that of the law exp(-energy / temperature) which plain SGLD drift
            (`AWSGLD(preconditioner="none")`) then samples, in units of the energy. Of a complex
            number real and imaginary part are two coordinates, and eta has a variance of 1 in each.
        std: a fixed deviation per step, in units of the parameters, instead of a temperature. Of a
            complex number it is that of the whole, as of `torch.randn`: eta has a variance of 1/2
            in the real part and of 1/2 in the imaginary one.
        generator: random generator of the parameters' device, or None for torch's own.

    Raises:
        ValueError: temperature and std are both given, or neither, or one below 0; in a step,
            before anything has moved, the generator is of another device.
        TypeError: `generator` is none.
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
        _check_generator("IsotropicNoise", self.generator)

    def factor(self, group: Group, course: Course) -> None:
        """None. Asked before anything moves, and so the place to refuse a wrong generator.

        Raises:
            ValueError: the generator is of another device than a parameter that is to be moved.
        """
        if self.generator is not None:
            for param in group["params"]:
                if param.grad is not None:
                    _check_device("IsotropicNoise", self.generator, param)

    def after(self, group: Group, param: Tensor, state: State, course: Course) -> None:
        """Add the noise to the parameter (any shape) in place."""
        # .data: no write of the trainer's, which `PositionNoise` would see by the version counter.
        values, deviation = param.data, cast(Any, self.std)
        if self.temperature is not None:
            deviation = (2 * group["lr"] * self.temperature) ** 0.5
            values = torch.view_as_real(values) if values.is_complex() else values
        values.add_(_normal_like(values, self.generator) * deviation)


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
    noise, wide = torch.empty_like(eta), torch.promote_types(eta.dtype, torch.float32)
    for rows in row_chunks(eta):
        axes = axes_of(quats[rows], scales[rows], wide, 0.0)  # Sigma = B B^T
        vectors = repeated_columns(eta[rows], wide)
        spare = torch.empty_like(vectors)
        axes.into(vectors, spare)
        opacity = torch.sigmoid(opacities[rows].reshape(-1))
        gate = torch.sigmoid(-GATE_SHARPNESS * (opacity - GATE_OPACITY))
        put(noise[rows], axes.out_of(vectors, spare).mul_(gate))
    return noise
