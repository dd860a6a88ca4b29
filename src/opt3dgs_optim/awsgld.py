"""AWSGLD: Adam's step times the flat-histogram multiplier, plus Langevin noise (eq. 15)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_choice, warn_user
from opt3dgs_optim.course import Course
from opt3dgs_optim.frames import LARGEST
from opt3dgs_optim.names import gaussian_of
from opt3dgs_optim.overrides import AdamOptions, TemporaryOverrides
from opt3dgs_optim.part import Group, Part, State
from opt3dgs_optim.parts.histogram import EnergyHistogram, refuse_to_maximize
from opt3dgs_optim.parts.noise import IsotropicNoise, PositionNoise
from opt3dgs_optim.stepadam import StepAdam

if TYPE_CHECKING:
    from typing_extensions import Unpack

PLAIN_EPS = 1e15  # so large that Adam's root of the second moment vanishes beside it
PLAIN_BETAS = (0.0, 0.0)  # no momentum, and one large gradient does not shorten the steps after it


class AWSGLD(StepAdam):
    """Adaptively weighted stochastic gradient Langevin dynamics, driven by Adam (eq. 15).

        x <- x - lr * nu * Adam(grad) + noise

    nu comes from a flat histogram over the training loss (`EnergyHistogram`), which has to be
    given: without `histogram=` nu is 1. `AWSGLD([x])`, with neither histogram nor noise, **is
    plain** `torch.optim.Adam`, bit for bit.

    It serves two purposes, which want different options. In a *training* the loss falls and changes
    with the view: `histogram=EnergyHistogram()`, Adam's drift, the trainer's own noise. As a
    *sampler* of a fixed energy it crosses barriers: `preconditioner="none"`,
    `IsotropicNoise(temperature)`, and a histogram over the energies that the walk visits, with the
    noise's temperature (second example).

    Args:
        params, lr, betas, eps, weight_decay, amsgrad: as in `torch.optim.Adam`.
        histogram: where nu comes from; several optimizers may share one. None: nu is off.
        noise: `IsotropicNoise` for any parameters, `PositionNoise` for the positions of Gaussians
            (the group named `means` or `xyz`, or the only group), or None.
        preconditioner: `"adam"`, or `"none"` for the plain SGLD drift `lr * nu * grad`, which
            samples exp(-energy / temperature) together with `IsotropicNoise(temperature=...)`. The
            drift is g / (1 + 1e-15 |g|) for a gradient g, so a thousandth short of it at 1e12.
        adam: `foreach, maximize, capturable, differentiable, fused, decoupled_weight_decay`, as in
            `torch.optim.Adam`, but `maximize` cannot be set beside a histogram: minimise the
            negated loss instead. On a GPU the fused path is used where none is asked for.

    The energy is the closure's value, or comes from `histogram.observe(loss)`, called once per
    iteration before `step()`. One that is not finite skips the step.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import AWSGLD, EnergyHistogram
        >>> x, histogram = torch.nn.Parameter(torch.ones(2)), EnergyHistogram()
        >>> optimizer = AWSGLD([x], lr=0.01, histogram=histogram)
        >>> (loss := (x**2).sum()).backward()
        >>> nu = histogram.observe(loss)
        >>> optimizer.step()
        >>> bool((x**2).sum() < 2.0)
        True

        A walk in a double well whose barrier is six times the temperature. With the histogram it
        goes to and fro; without it, it stays where it began:

        >>> from opt3dgs_optim import IsotropicNoise
        >>> def visits_both_wells(histogram):
        ...     torch.manual_seed(1)
        ...     x, seen = torch.nn.Parameter(torch.ones(1)), []
        ...     noise = IsotropicNoise(temperature=1.0)
        ...     walk = AWSGLD([x], 6e-3, histogram=histogram, noise=noise, preconditioner="none")
        ...     for _ in range(3000):
        ...         walk.zero_grad()
        ...         (energy := 6 * ((x**2 - 1) ** 2).sum()).backward()
        ...         if histogram is not None:
        ...             _ = histogram.observe(energy)
        ...         walk.step()
        ...         seen.append(x.item())
        ...     return min(seen) < -0.5 and max(seen) > 0.5
        >>> visits_both_wells(None)
        False
        >>> visits_both_wells(EnergyHistogram(40, (0.0, 8.0), temperature=1.0, warmup=0))
        True

    Raises:
        ValueError: an option is outside what is allowed.
        TypeError: `params` is a tensor, or an option is none of Adam's.
    """

    any_group = True

    def __init__(
        self,
        params: Any,
        lr: float | Tensor = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        amsgrad: bool = False,
        *,
        histogram: EnergyHistogram | None = None,
        noise: IsotropicNoise | PositionNoise | None = None,
        preconditioner: Literal["adam", "none"] = "adam",
        **adam: Unpack[AdamOptions],
    ) -> None:
        check_choice("AWSGLD", "preconditioner", preconditioner, ("adam", "none"))
        _check_kind("histogram", histogram, EnergyHistogram)
        _check_kind("noise", noise, IsotropicNoise, PositionNoise)
        parts: list[Part] = [part for part in (histogram, noise) if part is not None]
        if preconditioner == "none":
            betas, eps = PLAIN_BETAS, PLAIN_EPS
            parts.append(_PlainDrift())
        self.histogram, self.noise = histogram, noise  # looked at where groups are added
        super().__init__(params, lr, betas, eps, weight_decay, amsgrad, **adam)
        self.follow(_ObservedCourse(parts))

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As torch's; with `preconditioner="none"` betas and eps are not a group's own either.

        Raises:
            ValueError: the group is to maximise, and there is a histogram; or it is of float16, and
                `preconditioner` is "none". Then it is not added.
        """
        options = param_group if isinstance(param_group, dict) else {}  # of others torch says it
        if self.histogram is not None and options.get("maximize", self.defaults["maximize"]):
            refuse_to_maximize("AWSGLD")
        super().add_param_group(param_group)
        if self.defaults["eps"] == PLAIN_EPS:
            group = self.param_groups[-1]
            group.update(betas=PLAIN_BETAS, eps=PLAIN_EPS)
            for param in group["params"]:
                if param.dtype == torch.float16 and not group["fused"]:
                    self.param_groups.pop()
                    raise ValueError(
                        "AWSGLD: a parameter of torch.float16 with preconditioner='none', which "
                        "needs numbers up to 1e15; torch.float32, torch.bfloat16 or fused=True is "
                        "needed"
                    )

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; but `preconditioner` stays, whichever the checkpoint was made with.

        It lies in betas and eps, which torch takes from the checkpoint: with Adam's own eps the
        plain drift would stand still, and so would Adam's with that of the plain drift.

        Raises:
            ValueError: it does not fit; then nothing has been loaded.
        """
        own = [(group["betas"], group["eps"]) for group in self.param_groups]
        super().load_state_dict(state_dict)
        changed = False
        for group, (betas, eps) in zip(self.param_groups, own, strict=True):
            if (group["eps"] == PLAIN_EPS) != (eps == PLAIN_EPS):
                group.update(betas=betas, eps=eps)
                changed = True
        if changed:
            plain = self.defaults["eps"] == PLAIN_EPS
            name = "none" if plain else "adam"
            warn_user(
                "AWSGLD.load_state_dict: the checkpoint was made with another preconditioner, or "
                f"by Adam; here it stays {name!r}, with the betas and eps that belong to it"
            )

    def _step(self, mask: Tensor | None, acting: bool) -> None:
        if self.defaults["eps"] != PLAIN_EPS:
            super()._step(mask, acting)
            return
        with TemporaryOverrides() as temporary:
            # torch's CyclicLR and OneCycleLR write betas, and the drift would get momentum.
            for group in self.param_groups:
                temporary.item(group, "betas", PLAIN_BETAS)
            super()._step(mask, acting)

    def acts_on(self, part: Part, group: Group) -> bool:
        """All parts on all groups, but the positions' noise on positions."""
        if isinstance(part, PositionNoise):
            name = gaussian_of(group)
            return name == "means" or (len(self.param_groups) == 1 and name is None)
        return True

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "histogram": self.histogram, "noise": self.noise}


class _ObservedCourse(Course):
    """A course without a clock whose energies a histogram is told."""

    def stepping(self, closure_value: Any, optimizer: StepAdam) -> bool:
        histogram = self.part(EnergyHistogram)
        if histogram is None:
            return super().stepping(closure_value, optimizer)
        self.steps += 1
        if closure_value is not None:
            histogram.observe(closure_value)
        before, self.num_observed = self.num_observed, histogram.num_observed
        if self.steps == 1 and histogram.num_observed == 0:
            warn_user(
                "AWSGLD: no energy has been observed yet, so the multiplier is not adapted; call "
                "histogram.observe(loss) before step(), or pass it a closure that returns the loss"
            )
        # Of a step without an energy of its own nothing is known.
        self.valid = histogram.last_finite if self.num_observed != before else True
        return True


class _PlainDrift(Part):
    """Undoes the division by Adam's eps."""

    names = None

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """The gradient, but for numbers whose square, which Adam takes, would be infinite."""
        largest = LARGEST.get(grad.dtype)
        return grad if largest is None else grad.clamp(-largest, largest)

    def factor(self, group: Group, course: Course) -> float:
        return group["eps"]


def _check_kind(name: str, value: Any, *kinds: type) -> None:
    if value is not None and not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"AWSGLD: {name}={value!r}, but {wanted} or None is needed")
