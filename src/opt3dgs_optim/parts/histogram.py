"""The energy histogram: partitions, their weights Theta, and the multiplier nu.

Equation numbers are those of the Opt3DGS paper (every displayed equation counted; 7 partition,
13 index, 14 multiplier, 16 update of the weights). The paper's text is not implementable word
for word; where this module differs, the comment at the line says why.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim._checkpoint import check_histogram_state
from opt3dgs_optim._running import RunningMoments, ViewMeans
from opt3dgs_optim.checks import check_choice, check_count, check_interval, check_number
from opt3dgs_optim.part import Group, Part, Phase
from opt3dgs_optim.ranks import RankMean

PAPER_TEMPERATURE = 2e-3  # not given in the paper; zeta * tau / du = 1.5 at its zeta and du
PAPER_RANGE = (0.0, 0.2)
CALL = "EnergyHistogram"
LARGEST = {torch.float64: 1e150, torch.float32: 1e15}  # energies whose squares can be summed


class EnergyHistogram(Part):
    """Flat-histogram weights over the training loss, and the step multiplier they give.

    The energy axis is cut into `num_partitions` partitions. Their weights Theta (float64, sum 1,
    never 0) follow the visits by stochastic approximation (eq. 16), and the multiplier

        nu = 1 + zeta * tau * (log theta[J] - log theta[J - 1]) / du                  (eq. 14)

    scales the step of an optimizer that sits in partition J. All state lives on the device of
    the observed energies; `observe` never synchronises with the host.

    Args:
        num_partitions: number of partitions m, at least 3.
        energy_range: (low, high) in units of the loss, cut uniformly; the first and the last
            partition are open (eq. 7). `"auto"` measures it: during the first half of the
            warm-up the energies' recent mean and deviation are tracked, then the range is fixed
            at mean - 30 to mean + 4 deviations, but not below 0 where no energy was negative (the
            loss goes on falling, by many deviations in a short run).
        zeta: flattening exponent, 0 (no flattening) to 1.
        temperature: tau, in units of the loss, or `"auto"`:
            (1 - zeta) / (2 zeta) * deviation of the energy, so that an energy two deviations
            from the mean gets |nu - 1| = 1 once theta has settled at p^(1 / (1 - zeta)).
        warmup: number of energies during which nu is 1. The weights are estimated meanwhile
            (from its second half on, with an automatic range).
        step_size: lambda of eq. 16: `"decay"` for min(1e-2, 10 / (k^0.8 + 100)), or a constant
            in (0, 1), which leaves a permanent jitter in the weights.
        slope: how d log theta / du is taken: `"backward"` difference (eq. 14), or
            `"least_squares"` over the `slope_radius` partitions on either side (less noise).
        slope_radius: radius of the least-squares window, in partitions.
        clamp: (low, high) bounds of nu, or None.
        energy: `"raw"` (the loss as observed), `"ema"` (its exponential moving average), or
            `"view_centered"` (loss - that view's running mean + the global running mean, so that
            an easy view is not taken for a good state; `observe` then needs `view`).
        ema_decay: decay per energy of the running means above.
        floor: smallest weight before renormalisation; log theta never sees 0.
        process_group: a `torch.distributed` process group over whose ranks every energy is
            averaged; every rank must call `observe` as often. (Of a `PhaseScheduler` give it to
            that instead.)

    Raises:
        ValueError: an option is outside what is allowed.
    """

    def __init__(
        self,
        num_partitions: int = 200,
        energy_range: tuple[float, float] | Literal["auto"] = "auto",
        *,
        zeta: float = 0.75,
        temperature: float | Literal["auto"] = "auto",
        warmup: int = 2500,
        step_size: float | Literal["decay"] = "decay",
        slope: Literal["backward", "least_squares"] = "backward",
        slope_radius: int = 5,
        clamp: tuple[float, float] | None = (-5.0, 5.0),
        energy: Literal["raw", "ema", "view_centered"] = "raw",
        ema_decay: float = 0.9,
        floor: float = 1e-8,
        process_group: Any = None,
    ) -> None:
        self.num_partitions = check_count(CALL, "num_partitions", num_partitions, 3)
        self.energy_range = _check_auto_or_interval(energy_range)
        self.zeta = check_number(CALL, "zeta", zeta, 0.0, 1.0)
        self.temperature = _check_temperature(temperature, self.zeta)
        self.warmup = check_count(CALL, "warmup", warmup, 0)
        self.step_size = _check_step_size(step_size)
        self.slope = check_choice(CALL, "slope", slope, ("backward", "least_squares"))
        self.slope_radius = check_count(CALL, "slope_radius", slope_radius, 1)
        self.clamp = None if clamp is None else check_interval(CALL, "clamp", clamp)
        self.energy = check_choice(CALL, "energy", energy, ("raw", "ema", "view_centered"))
        self.ema_decay = check_number(CALL, "ema_decay", ema_decay, 0.0, 1.0, open_high=True)
        self.floor = check_number(CALL, "floor", floor, 0.0, 1 / num_partitions, open_low=True)
        self._over_ranks = None if process_group is None else RankMean(CALL, process_group)
        needs_calibration = "auto" in (self.energy_range, self.temperature)
        if needs_calibration and self.warmup < 4:
            raise ValueError(
                f"{CALL}: warmup={warmup}, but an automatic range or temperature is measured "
                "during the warm-up and needs at least 4 energies"
            )
        # Theta is estimated from here on; before it, the range is being measured.
        self._calibration = self.warmup // 2 if needs_calibration else 0
        self.num_observed = 0  # calls of observe(), a host integer: says whether anybody calls
        self._allocate(torch.device("cpu"))

    @classmethod
    def paper(cls, **overrides: Any) -> EnergyHistogram:
        """The paper's settings: range [0, 0.2], 200 partitions, zeta .75, warm-up 2,500.

        The temperature (2e-3), the clamp ([-5, 5]) and lambda's schedule are not in the paper.
        """
        settings: dict[str, Any] = {
            "energy_range": PAPER_RANGE,
            "temperature": PAPER_TEMPERATURE,
            **overrides,
        }
        return cls(**settings)

    def _allocate(self, device: torch.device) -> None:
        # MPS has no float64.
        dtype = torch.float32 if device.type == "mps" else torch.float64
        self._largest = LARGEST[dtype]
        m = self.num_partitions
        fixed_range = (0.0, 1.0) if self.energy_range == "auto" else self.energy_range
        low, high = float(fixed_range[0]), float(fixed_range[1])
        tau = 0.0 if self.temperature == "auto" else float(self.temperature)
        scalar = torch.tensor([low, (high - low) / m, tau, 0.0, 1.0], dtype=dtype, device=device)
        self._low, self._width, self._tau, self._count, self._nu = scalar.unbind()
        self._weights = torch.full((m,), 1.0 / m, dtype=dtype, device=device)
        # The window of the recent energies: an eighth of the warm-up.
        self._recent = RunningMoments(1.0 - 8.0 / max(self._calibration, 16), dtype, device)
        self._nu_moments = RunningMoments(1.0, dtype, device)
        self._smooth = RunningMoments(self.ema_decay, dtype, device)
        self._views = ViewMeans(self.ema_decay, dtype, device)
        self._last_finite = torch.ones((), dtype=torch.bool, device=device)

    def forget(self) -> None:
        """Free what is held on a device: as if no energy had been seen."""
        self._allocate(torch.device("cpu"))
        self.num_observed = 0

    def use_energy(self, energy: Literal["raw", "ema", "view_centered"]) -> None:
        """Go over to another kind of energy; the views' means are freed, and begin anew."""
        if energy != self.energy:
            self.energy = energy
            self._views = ViewMeans(self.ema_decay, self._weights.dtype, self._weights.device)

    # -- reading -----------------------------------------------------------------------------

    @property
    def weights(self) -> Tensor:
        """Theta, [num_partitions], positive, sum 1 (eq. 9)."""
        return self._weights.clone()

    @property
    def multiplier(self) -> Tensor:
        """Nu after the last finite energy, 0-d, on the energies' device."""
        return self._nu

    @property
    def last_finite(self) -> Tensor:
        """Whether the last energy was finite, 0-d bool, on the energies' device."""
        return self._last_finite

    @property
    def mean_multiplier(self) -> Tensor:
        """Mean of nu over all energies after the warm-up (1 before it), 0-d.

        It is what an honest control uses: a constant multiplier of this size.
        """
        return torch.where(self._nu_moments.weight > 0, self._nu_moments.mean, 1.0)

    @property
    def multiplier_std(self) -> Tensor:
        """Standard deviation of nu over all energies after the warm-up, 0-d."""
        return self._nu_moments.variance.sqrt()

    @property
    def multiplier_moments(self) -> Tensor:
        """[3]: energies after the warm-up, nu's mean and sum of squared deviations over them."""
        moments = self._nu_moments
        return torch.stack([moments.weight, moments.mean, moments.squares])

    @property
    def calibrated_range(self) -> tuple[float, float]:
        """(low, high) in use, in units of the loss. Synchronises with the device."""
        low = float(self._low)
        return low, low + float(self._width) * self.num_partitions

    @property
    def calibrated_temperature(self) -> float:
        """Tau in use, in units of the loss. Synchronises with the device."""
        return float(self._tau)

    during = Phase.EXPLORATION

    def factor(self, group: Group, course: Any) -> Tensor | None:
        return self._nu if self.num_observed else None

    def numbers(self, course: Any) -> Mapping[str, Any]:
        return {"nu": self._nu} if self.num_observed > self.warmup else {}

    # -- one energy --------------------------------------------------------------------------

    @torch.no_grad()
    def observe(
        self,
        energy: Tensor | float,
        valid_: Any = None,
        course: Any = None,
        *,
        view: Hashable | None = None,
    ) -> Tensor:
        """Take one energy: compute nu from the present weights, then update the weights.

        Args:
            energy: the training loss of this iteration, 0-d (or one element). A non-finite
                energy, or one beyond 1e150 (1e15 on MPS), changes nothing.
            view: which view it belongs to (an int or str); needed for `energy="view_centered"`.

        Returns:
            nu, 0-d, on the energy's device.

        Raises:
            ValueError: the energy has several elements, or its view is missing.
        """
        if self.energy == "view_centered" and not isinstance(view, (int, str)):
            raise ValueError(
                f"{CALL}.observe: view={view!r}, but energy='view_centered' needs the view's "
                "index or name (an int or str)"
            )
        value = self._on_device(energy)
        if self._over_ranks is not None:
            value = self._over_ranks(value)
        self.num_observed += 1
        # False for NaN too. Beyond the bound a loss has diverged, and its variance is infinite.
        valid = self._last_finite.copy_(value.abs() <= self._largest)
        # From here on `value` is finite, so that no where() has to guard against NaN again.
        value = self._transform(torch.where(valid, value, self._recent.mean), valid, view)
        if self._calibration:
            self._calibrate(value, valid)
        index = self._partition(value)
        nu = self._warmed_up(self._multiplier(index))
        # All state is updated in place: a CUDA graph of a step reads nu where it was captured.
        self._nu.copy_(torch.where(valid, nu, self._nu))
        self._nu_moments.update(self._nu, valid & (self._count >= self.warmup))
        self._update_weights(index, valid)
        self._count.add_(valid)
        return self._nu.clone()

    def _on_device(self, energy: Tensor | float) -> Tensor:
        if not isinstance(energy, Tensor):
            energy = torch.tensor(float(energy), dtype=self._weights.dtype, device="cpu")
        elif energy.numel() != 1:
            raise ValueError(
                f"{CALL}.observe: energy has shape {tuple(energy.shape)}, but one number is needed"
            )
        if energy.device != self._weights.device:
            if self.num_observed:  # e.g. resumed from a checkpoint: the state follows the loss
                state = self.state_dict()
                self._allocate(energy.device)
                self.load_state_dict(state)
            else:
                self._allocate(energy.device)
        return energy.detach().reshape(()).to(self._weights.dtype)

    def _transform(self, value: Tensor, valid: Tensor, view: Hashable | None) -> Tensor:
        if self.energy == "raw":
            return value
        self._smooth.update(value, valid)
        if self.energy == "ema":
            return self._smooth.mean
        return value - self._views.update(view, value, valid) + self._smooth.mean

    def _calibrate(self, value: Tensor, valid: Tensor) -> None:
        """Measure range and temperature while the first half of the warm-up lasts."""
        measuring = valid & (self._count < self._calibration)
        self._recent.update(value, measuring)
        mean = self._recent.mean
        # A constant energy has no deviation: keep the width above what float64 resolves, whatever
        # the loss's unit.
        deviation = self._recent.variance.sqrt().maximum(mean.abs() * 1e-12)
        deviation = deviation.clamp(min=1 / self._largest)
        if self.energy_range == "auto":
            low, high = mean - 30 * deviation, mean + 4 * deviation
            low = torch.where(self._recent.low >= 0, low.clamp(min=0.0), low)
            width = (high - low) / self.num_partitions
            self._low.copy_(torch.where(measuring, low, self._low))
            self._width.copy_(torch.where(measuring, width, self._width))
        if self.temperature == "auto":
            tau = (1 - self.zeta) / (2 * self.zeta) * deviation
            self._tau.copy_(torch.where(measuring, tau, self._tau))

    def _partition(self, value: Tensor) -> Tensor:
        """J of eq. 13, counted from 0: u[J-1] < energy <= u[J], the end partitions open."""
        index = torch.ceil((value - self._low) / self._width) - 1
        return index.clamp(0, self.num_partitions - 1).long().reshape(1)

    def _multiplier(self, index: Tensor) -> Tensor:
        """Nu of eq. 14 for partition `index`, before the warm-up is considered."""
        last = self.num_partitions - 1
        log_weights = self._weights.log()
        if self.slope == "backward":
            # "theta(J - 1) v 1" in the paper is a clamp of the index (its source, CSGLD, Deng et
            # al. 2020); read as max(theta, 1) it would give nu = -3973 at the first step.
            difference = log_weights[index] - log_weights[(index - 1).clamp(min=0)]
        else:
            difference = _local_slope(log_weights, index, self.slope_radius)
        nu = 1 + self.zeta * self._tau * difference.reshape(()) / self._width
        if self.clamp is not None:
            nu = nu.clamp(*self.clamp)
        # du is not the width of the two open end partitions: no slope is known there.
        inner = ((index > 0) & (index < last)).reshape(())
        return torch.where(inner, nu, 1.0)

    def _warmed_up(self, nu: Tensor) -> Tensor:
        return torch.where(self._count < self.warmup, 1.0, nu)

    def _update_weights(self, index: Tensor, valid: Tensor) -> None:
        """Eq. 16, with a floor: theta += lambda theta_J^zeta (1[i = J] - theta)."""
        theta = self._weights
        counting = valid & (self._count >= self._calibration)
        rate = self._lambda() * theta[index] ** self.zeta * counting
        theta = theta - rate * theta
        theta = theta.index_add(0, index, rate).clamp(min=self.floor)
        self._weights.copy_(torch.where(counting, theta / theta.sum(), self._weights))

    def _lambda(self) -> Tensor | float:
        if self.step_size != "decay":
            return self.step_size  # pyright: ignore[reportReturnType]
        return (10 / (self._count**0.8 + 100)).clamp(max=1e-2)

    # -- state -------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """All that `observe` has learnt, as plain floats and lists. Synchronises."""
        return {
            "num_observed": self.num_observed,
            "weights": self._weights.tolist(),
            "scalars": torch.stack(
                [self._low, self._width, self._tau, self._count, self._nu]
            ).tolist(),
            "recent": self._recent.state(),
            "nu_moments": self._nu_moments.state(),
            "smooth": self._smooth.state(),
            "views": self._views.state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`, of this or an older version.

        Raises:
            ValueError: it is damaged, or of another number of partitions; nothing is changed then.
        """
        check_histogram_state(f"{CALL}.load_state_dict", state, self.num_partitions)
        self._allocate(self._weights.device)
        like = {"dtype": self._weights.dtype, "device": self._weights.device}
        scalars = torch.tensor(state["scalars"], **like)
        self._low, self._width, self._tau, self._count, self._nu = scalars.unbind()
        self._weights = torch.tensor(state["weights"], **like)
        for name in ("recent", "nu_moments", "smooth", "views"):
            if name in state:
                getattr(self, f"_{name}").load(state[name])
        self.num_observed = int(state["num_observed"])

    def __repr__(self) -> str:
        return (
            f"{CALL}(num_partitions={self.num_partitions}, energy_range={self.energy_range!r}, "
            f"zeta={self.zeta}, temperature={self.temperature!r}, warmup={self.warmup}, "
            f"slope={self.slope!r}, clamp={self.clamp}, energy={self.energy!r}, "
            f"observed={self.num_observed})"
        )


def _local_slope(values: Tensor, index: Tensor, radius: int) -> Tensor:
    """Least-squares slope of `values` over index - radius .. index + radius, cut at the ends."""
    offset = torch.arange(-radius, radius + 1, device=values.device)
    where = index + offset
    inside = ((where >= 0) & (where < values.shape[0])).to(values.dtype)
    y = values[where.clamp(0, values.shape[0] - 1)]
    x = offset.to(values.dtype)
    x = x - (x * inside).sum() / inside.sum()
    return (inside * x * y).sum() / (inside * x * x).sum()


def _check_auto_or_interval(value: Any) -> tuple[float, float] | Literal["auto"]:
    if isinstance(value, str):
        check_choice(CALL, "energy_range", value, ("auto",))
        return "auto"
    return check_interval(CALL, "energy_range", value)


def _check_temperature(value: Any, zeta: float) -> float | Literal["auto"]:
    if not isinstance(value, str):
        return check_number(CALL, "temperature", value, 0.0)
    check_choice(CALL, "temperature", value, ("auto",))
    if not 0.0 < zeta < 1.0:
        raise ValueError(
            f"{CALL}: zeta={zeta}, but temperature='auto' = (1 - zeta) / (2 zeta) * deviation "
            "needs 0 < zeta < 1"
        )
    return "auto"


def _check_step_size(value: Any) -> float | Literal["decay"]:
    if isinstance(value, str):
        check_choice(CALL, "step_size", value, ("decay",))
        return "decay"
    return check_number(CALL, "step_size", value, 0.0, 1.0, open_low=True, open_high=True)
