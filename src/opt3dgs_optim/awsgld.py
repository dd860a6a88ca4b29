"""AWSGLD: Adam's step times the flat-histogram multiplier, plus Langevin noise (eq. 15)."""

from __future__ import annotations

from typing import Any, Literal

from opt3dgs_optim.adam import StepAdam
from opt3dgs_optim.checks import check_choice
from opt3dgs_optim.contract import Slots, check_supported
from opt3dgs_optim.names import split_name
from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.histogram import EnergyHistogram
from opt3dgs_optim.parts.noise import IsotropicNoise, PositionNoise
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training


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
        params, lr, betas, eps, weight_decay: as in `torch.optim.Adam`.
        histogram: where nu comes from, one that serves this optimizer alone. None: nu is off.
        noise: `IsotropicNoise` for any parameters, `PositionNoise` for the positions of Gaussians
            (its groups named as a trainer's), or None.
        preconditioner: `"adam"`, or `"none"` for the plain SGLD drift `lr * nu * grad`, which
            samples exp(-energy / temperature) together with `IsotropicNoise(temperature=...)`.

    The energy is the closure's value, or comes from `histogram.observe(loss)`, called once per
    iteration before `step()`. A non-finite energy leaves nu as it is.

    Its state is `torch.optim.Adam`'s, and what the histogram has learnt is in `state_dict()`.

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
        >>> visits_both_wells(EnergyHistogram(energy_range=(0.0, 8.0), temperature=1.0, warmup=0))
        True

    Raises:
        ValueError: an option is outside what is allowed, or the histogram serves another optimizer.
        TypeError: histogram or noise is something else.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        *,
        histogram: EnergyHistogram | None = None,
        noise: IsotropicNoise | PositionNoise | None = None,
        preconditioner: Literal["adam", "none"] = "adam",
    ) -> None:
        check_choice("AWSGLD", "preconditioner", preconditioner, ("adam", "none"))
        if histogram is not None and not isinstance(histogram, EnergyHistogram):
            raise TypeError(f"AWSGLD: histogram={histogram!r}, but an EnergyHistogram is needed")
        if noise is not None and not isinstance(noise, (IsotropicNoise, PositionNoise)):
            raise TypeError(
                f"AWSGLD: noise={noise!r}, but IsotropicNoise or PositionNoise is needed"
            )
        super().__init__(params, lr, betas, eps, weight_decay)
        slots: Slots = [split_name(group.get("name")) for group in self.param_groups]
        check_supported("AWSGLD", self, slots)
        parts: list[Part] = [part for part in (histogram, noise) if part is not None]
        if preconditioner == "none":
            parts.append(PlainDrift())
        training = Training(parts)
        if histogram is not None:
            histogram.names = None  # nu is on every group's step
        self.follow(training, slots)

    @property
    def histogram(self) -> EnergyHistogram | None:
        """Where nu comes from."""
        return self.training.part(EnergyHistogram)


class PlainDrift(Part):
    """The drift of plain SGLD, lr * nu * grad, without Adam's moments."""

    names = None

    def plan(self, step: Step, training: Training) -> None:
        """Have no moments in the step."""
        step.plain = True
