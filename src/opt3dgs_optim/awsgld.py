"""AWSGLD: Adam's step times the flat-histogram multiplier, plus Langevin noise (eq. 15)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim._adam import HookedAdam, fused_on_cuda
from opt3dgs_optim._checks import check_choice, check_part
from opt3dgs_optim._groups import is_positions
from opt3dgs_optim._mistakes import EnergyWatch
from opt3dgs_optim._repr import block, group_lines, noise_line, nu_line, skipped_lines
from opt3dgs_optim._visible import shaped
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.noise import CovarianceNoise, IsotropicNoise


class AWSGLD(HookedAdam):
    """Adaptively weighted stochastic gradient Langevin dynamics, driven by Adam (eq. 15).

        x <- x - lr * nu * Adam(grad) + noise

    nu comes from a flat histogram over the training loss (`EnergyHistogram`): steps are longer
    where the loss is being seen more often with rising energy, shorter or backwards beyond the
    peak. With `histogram=None` and `noise=None` this is `torch.optim.Adam`, bit for bit.

    Args:
        params, lr, betas, eps, weight_decay, amsgrad: as in `torch.optim.Adam`.
        foreach, maximize, capturable, differentiable, fused: as in `torch.optim.Adam`. With CUDA
            parameters and no path asked for, the fused one is used: it alone takes nu from the
            device without a synchronisation.
        histogram: where nu comes from; several optimizers may share one. None: nu is off.
        noise: `IsotropicNoise` for any parameters, `CovarianceNoise` for the positions of
            Gaussians (the group named `means` or `xyz`, or the only group), or None.
        preconditioner: `"adam"`, or `"none"` for the plain SGLD drift `lr * nu * grad`, which
            samples exp(-energy / temperature) together with `IsotropicNoise(temperature=...)`.
        skip_nonfinite: rows with a non-finite gradient keep parameters and moments for a step
            (those rows of `.grad` are set to zero).

    The energy is the closure's value, or comes from `histogram.observe(loss)`, called once per
    iteration before `step()`. A non-finite energy skips the step. The histogram's state travels
    inside `state_dict()`.

    Memory: Adam's; the histogram is a few hundred numbers, noise is drawn in 12 bytes per point
    during the step.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import AWSGLD, EnergyHistogram
        >>> x = torch.nn.Parameter(torch.tensor([2.0, 2.0]))
        >>> histogram = EnergyHistogram(energy_range=(0.0, 8.0), temperature=1.0, warmup=10)
        >>> optimizer = AWSGLD([x], lr=0.01, histogram=histogram)
        >>> for _ in range(20):
        ...     optimizer.zero_grad()
        ...     loss = (x**2).sum()
        ...     loss.backward()
        ...     _ = histogram.observe(loss)
        ...     optimizer.step()
        >>> bool((x**2).sum() < 8.0)
        True

    Raises:
        ValueError: an option is outside what is allowed.
    """

    _own = (*HookedAdam._own, "histogram", "noise", "preconditioner", "_energy_watch")

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
        noise: IsotropicNoise | CovarianceNoise | None = None,
        preconditioner: Literal["adam", "none"] = "adam",
        skip_nonfinite: bool = True,
        foreach: bool | None = None,
        maximize: bool = False,
        capturable: bool = False,
        differentiable: bool = False,
        fused: bool | None = None,
    ) -> None:
        check_choice("AWSGLD", "preconditioner", preconditioner, ("adam", "none"))
        check_part("AWSGLD", "histogram", histogram, "an EnergyHistogram", "observe", "multiplier")
        check_part("AWSGLD", "noise", noise, "IsotropicNoise or CovarianceNoise", "add_to")
        params = list(params)
        if histogram is not None:
            fused = fused_on_cuda(params, fused, foreach, capturable)
        super().__init__(
            params,
            lr,
            betas,
            eps,
            weight_decay,
            amsgrad,
            skip_nonfinite=skip_nonfinite,
            foreach=foreach,
            maximize=maximize,
            capturable=capturable,
            differentiable=differentiable,
            fused=fused,
        )
        self.histogram = histogram
        self.noise = noise
        self.preconditioner = preconditioner
        self._energy_watch = EnergyWatch("AWSGLD")

    def __repr__(self) -> str:
        lines = [nu_line(self.histogram), noise_line(self.noise)]
        lines += skipped_lines(self.skipped_rows) + group_lines(self.param_groups)
        return block(type(self).__name__, lines)

    def _shared_state(self) -> dict[str, Any] | None:
        return None if self.histogram is None else {"histogram": self.histogram.state_dict()}

    def _load_shared_state(self, shared: Mapping[str, Any]) -> None:
        if self.histogram is not None and "histogram" in shared:
            self.histogram.load_state_dict(shared["histogram"])

    def _begin_step(self, loss: Any) -> None:
        if self.histogram is None:
            return
        if loss is not None:
            self.histogram.observe(loss)
        self._energy_watch.check(self.histogram)

    def _bad_step(self) -> Tensor | None:
        return None if self.histogram is None else ~self.histogram.last_finite

    def _factor(self, group: dict[str, Any]) -> Tensor | float | None:
        if self.histogram is None or self.histogram.num_observed == 0:
            return None
        return self.histogram.multiplier

    def _update(
        self,
        group: dict[str, Any],
        params: list[Tensor],
        grads: list[Tensor],
        moments: tuple[list[Tensor], ...],
        found_inf: Tensor | None,
        has_complex: bool,
    ) -> None:
        if self.preconditioner == "adam":
            super()._update(group, params, grads, moments, found_inf, has_complex)
            return
        for param, grad in zip(params, grads, strict=True):
            self._drift(group, param, grad, None if found_inf is None else found_inf <= 0)

    def _update_rows(
        self, group: dict[str, Any], param: Tensor, grad: Tensor, rows: Tensor
    ) -> None:
        if self.preconditioner == "adam":
            super()._update_rows(group, param, grad, rows)
        else:
            self._drift(group, param, grad, shaped(rows, param))

    def _drift(
        self, group: dict[str, Any], param: Tensor, grad: Tensor, moving: Tensor | None
    ) -> None:
        drift = grad + group["weight_decay"] * param if group["weight_decay"] else grad
        if moving is not None:
            drift = torch.where(moving, drift, 0.0)
        sign = 1.0 if group["maximize"] else -1.0
        param.add_(drift * (sign * self._scaled_lr(group, param.device)))

    def _after_group(self, group: dict[str, Any], params: list[Tensor]) -> None:
        if self.noise is None:
            return
        if isinstance(self.noise, CovarianceNoise) and not self._holds_positions(group):
            return
        self._add_noise(self.noise, group, params)

    def _holds_positions(self, group: dict[str, Any]) -> bool:
        return is_positions(group) or (len(self.param_groups) == 1 and "name" not in group)
