"""Leaving out what a scene does not need: parts are switched off on the training's own evidence.

Each part is judged by what it did to *this* training, at rare checks: the numbers wait on the
device until a check reads them all with one synchronisation. `docs/adaptive.md` has the reasons.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Hashable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from opt3dgs_optim._adaptive_state import NO_EVIDENCE
from opt3dgs_optim._evidence import (
    foresight,
    largest_noise,
    noise_tensors,
    nu_numbers,
    widest_float,
)
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.multiplier import ConstantMultiplier

if TYPE_CHECKING:
    from opt3dgs_optim.phases import PhaseScheduler

CHECK_STEPS = 100  # iterations between two checks, at most
# nu is judged over so many energies at least, and over such a share of the run.
NU_WINDOW, NU_WINDOW_SHARE = 300, 1 / 30
NU_EFFECT = 0.1  # relative: learning rates that differ by less are taken as the same
TOP_SHARE = 0.5  # of Theta, in the open partition above the range: the loss may yet fall into it
PROBE_STEPS = 10  # exploitation steps between two looks at what the pairs foretell
MIN_PROBES = 5
MIN_ACCEPTED = 0.1  # share of the candidate pairs
# Pairs that are mostly the difference between views reach 0.03 to 0.07, exact ones of a quadratic
# with condition 100 reach 0.2.
MIN_FORESIGHT = 0.1
NOISE_EFFECT = 1e-3  # of the noise's deviation along a Gaussian's longest axis, in learning rates
ONE_VIEW = 200  # energies, all of one view

LOGGER = logging.getLogger("opt3dgs_optim")


class Adaptive:
    """What `PhaseScheduler(adaptive=True)` watches and decides.

    Over the ranks of a process group every number is averaged, so that all ranks decide alike.
    """

    def __init__(self, scheduler: PhaseScheduler) -> None:
        self._scheduler = scheduler
        self._asked_multiplier = scheduler.multiplier
        self._asked_energy: Any = getattr(scheduler.multiplier, "energy", None)
        self._asked_curvature = scheduler.curvature
        self._asked_options = scheduler.curvature_options
        self.reasons: dict[str, str] = {}
        self._constant: float | None = None  # what nu was replaced by
        self._windows: list[list[float]] = []  # of nu at each check: [energies, mean, square sum]
        self._probes = 0
        # [accepted, candidates, sum of foresight, points looked at], on the device
        self._pairs = torch.zeros(4, dtype=torch.float64)
        self._view: str | None = None
        self._views = 0  # energies of the only view; -1 once there are several
        self._opacities: weakref.ref[Tensor] | None = None  # those looked at last
        self._missed_edit = False  # before a checkpoint

    def __getstate__(self) -> dict[str, Any]:
        # A copy has tensors of its own.
        return {**vars(self), "_opacities": None, "_missed_edit": self._edited()}

    # -- evidence, in every iteration, without a synchronisation -------------------------------

    def observed(self, value: Tensor, view: Hashable | None) -> None:
        """After each energy, before the steps that follow it."""
        self._see(view)
        if value.is_cuda and torch.cuda.is_current_stream_capturing():
            return  # a captured step is replayed as it is: nothing can be left out of it
        if self._scheduler.num_observed % self._interval() == 0:
            self._check(value.device)
        elif "noise" in self.reasons and self._edited():
            noise = self._noise_number(value.device)
            self._judge_noise(float(self._scheduler.over_ranks(noise)))

    def _interval(self) -> int:
        """Iterations between checks: a tenth of a short exploitation."""
        scheduler = self._scheduler
        left = scheduler.total_steps - scheduler.switch_step
        return min(CHECK_STEPS, max(left // 10, 10)) if scheduler.exploiting else CHECK_STEPS

    def _see(self, view: Hashable | None) -> None:
        if self._views < 0 or view is None:
            return
        name = repr(view)
        if self._view in (None, name):
            self._view, self._views = name, self._views + 1
            return
        self._views = -1
        if "view_centering" in self.reasons:
            self._use_energy(self._asked_energy)
            self._switch_on("view_centering", "there is a second view")

    def foresee(
        self, history: Tensor, size: int, position: Tensor, gradient: Tensor, visible: Tensor | None
    ) -> None:
        """Before a step stores its pairs: how well did those that are stored foretell them?"""
        epoch = self._scheduler.curvature_options.pairs == "epoch"
        if not epoch and self._scheduler.num_observed % PROBE_STEPS:
            return
        self._move(position.device)
        self._pairs[2:] += foresight(history, size, position, gradient, visible)
        self._probes += 1

    def count_pairs(self, tally: list[Tensor]) -> None:
        """After an exploitation step: its [accepted, candidates], per parameter."""
        if tally:
            self._move(tally[0].device)
            self._pairs[:2] += torch.stack(tally).sum(0)

    def _move(self, device: torch.device) -> None:
        if self._pairs.device != device:
            self._pairs = self._pairs.to(device, widest_float(device))

    # -- a check: one synchronisation ----------------------------------------------------------

    def _check(self, device: torch.device) -> None:
        parts = [self._nu_numbers(device), self._pairs, self._noise_number(device).reshape(1)]
        dtype = widest_float(device)
        packed = torch.cat([part.to(device, dtype) for part in parts])
        numbers = self._scheduler.over_ranks(packed).tolist()
        self._judge_views()
        self._judge_multiplier(numbers[:4])
        self._judge_curvature(numbers[4:8])
        self._judge_noise(numbers[8])

    def _nu_numbers(self, device: torch.device) -> Tensor:
        """[energies since the warm-up, mean of nu, square sum, Theta above the range]."""
        multiplier = self._scheduler.multiplier
        if not isinstance(multiplier, EnergyHistogram):
            return torch.zeros(4, device=device)
        return nu_numbers(multiplier)

    def _noise_number(self, device: torch.device) -> Tensor:
        noise = self._scheduler.given_noise
        if noise is None:
            return torch.zeros((), device=device)
        tensors = noise_tensors(noise)
        self._opacities, self._missed_edit = weakref.ref(tensors["opacities"]), False
        with torch.no_grad():
            return largest_noise(tensors["scales"], tensors["opacities"], noise.scale)

    def _edited(self) -> bool:
        """Whether density control has put other opacities in place since the last look."""
        noise = self._scheduler.given_noise
        if noise is None:
            return False
        opacities = noise_tensors(noise)["opacities"]
        if self._opacities is None and not self._missed_edit:
            self._opacities = weakref.ref(opacities)  # resumed: the same rows in another object
        return self._opacities is None or opacities is not self._opacities()

    # -- decisions -----------------------------------------------------------------------------

    def _judge_multiplier(self, numbers: list[float]) -> None:
        if self._scheduler.exploiting or "multiplier" in self.reasons:
            return
        *now, above = numbers
        if now[0] <= 0:
            return
        window = max(NU_WINDOW, NU_WINDOW_SHARE * self._scheduler.total_steps)
        self._windows.append(now)
        old = [each for each in self._windows if now[0] - each[0] >= window]
        if not old:
            return
        self._windows = self._windows[len(old) - 1 :]
        energies, mean, deviation = _between(old[-1], now)
        if above > TOP_SHARE or deviation > NU_EFFECT * abs(mean):
            return
        # Its mean is a learning rate that this training has been running with: leaving it would
        # be a change of its own. A mean of 0 or less would never come down again.
        near_one = mean <= 0 or abs(mean - 1) <= NU_EFFECT
        self._constant = 1.0 if near_one else mean
        follow = "off" if near_one else f"a constant {mean:.3g} from now on"
        self._use_constant()
        self._switch_off(
            "multiplier",
            f"nu was {mean:.3f} with a deviation of {deviation:.3f} over {energies:.0f} energies: "
            f"{follow}",
        )

    def _judge_curvature(self, numbers: list[float]) -> None:
        accepted, candidates, foretold, points = numbers
        if not self._scheduler.curvature or candidates == 0 or self._probes < MIN_PROBES:
            return
        share, mean = accepted / candidates, foretold / max(points, 1.0)
        if share < MIN_ACCEPTED:
            why = f"{share:.3f} of the candidate pairs were accepted (threshold {MIN_ACCEPTED})"
        elif mean < MIN_FORESIGHT:
            why = (
                f"the pairs foretell the next ones by a cosine of only {mean:.3f} more than the "
                f"gradient does (threshold {MIN_FORESIGHT}; accepted share {share:.2f})"
            )
        else:
            return
        self._scheduler.curvature = False
        self._drop_pairs()
        self._switch_off("curvature", why)

    def _judge_noise(self, largest: float) -> None:
        if self._scheduler.given_noise is None:
            return
        resting = "noise" in self.reasons
        if largest < NOISE_EFFECT and not resting:
            self._switch_off(
                "noise",
                "no Gaussian is near the opacity gate: the largest noise is "
                f"{largest:.1g} learning rates (threshold {NOISE_EFFECT:g}); looked at again at "
                "every check and edit of the points",
            )
        elif largest >= NOISE_EFFECT and resting:
            self._switch_on("noise", f"the largest noise is {largest:.2g} learning rates")

    def _judge_views(self) -> None:
        scheduler = self._scheduler
        if self._views < ONE_VIEW:
            return
        why = f"all of {self._views} energies are of one view, {self._view}"
        if getattr(scheduler.multiplier, "energy", "") == "view_centered":
            self._use_energy("raw")
            self._switch_off("view_centering", why)
        if scheduler.curvature and scheduler.curvature_options.pairs == "epoch":
            self._use_options(True)
            self._drop_pairs()
            self._switch_off("epoch_pairs", f"{why}: consecutive pairs are exact")

    # -- what a decision does ------------------------------------------------------------------

    def _switch_off(self, part: str, reason: str) -> None:
        self.reasons[part] = reason
        self._tell("switched_off", part, reason)

    def _switch_on(self, part: str, reason: str) -> None:
        del self.reasons[part]
        self._tell("switched_on", part, reason)

    def _tell(self, event: str, part: str, reason: str) -> None:
        iteration = max(self._scheduler.iteration - 1, 0)
        LOGGER.info("iteration %d: %s %s: %s", iteration, part, event.replace("_", " "), reason)
        if self._scheduler.log is not None:
            self._scheduler.log.event(event, iteration, part=part, reason=reason)

    def _use_constant(self) -> None:
        """Put the constant in the histogram's place, and free the histogram's tensors."""
        if isinstance(self._asked_multiplier, EnergyHistogram):
            self._asked_multiplier.forget()
        self._windows = []
        assert self._constant is not None
        constant = ConstantMultiplier(self._constant)
        constant.num_observed = self._scheduler.num_observed
        self._scheduler.multiplier = None if self._constant == 1 else constant

    def _use_energy(self, kind: Any) -> None:
        if isinstance(self._scheduler.multiplier, EnergyHistogram):
            self._scheduler.multiplier.use_energy(kind)

    def _use_options(self, consecutive: bool) -> None:
        options = self._asked_options
        if consecutive:
            options = replace(options, pairs="consecutive", epoch_steps=None)
        self._scheduler.curvature_options = options

    def _drop_pairs(self) -> None:
        self._scheduler.drop_pairs()
        self._pairs.zero_()
        self._probes = 0

    # -- state ---------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Evidence and decisions, as plain numbers and strings. Synchronises."""
        return {
            "switched_off": dict(self.reasons),
            "constant": self._constant,
            "windows": [list(each) for each in self._windows],
            "probes": self._probes,
            "pairs": self._pairs.tolist(),
            "view": self._view,
            "views": self._views,
            "edited": "noise" in self.reasons and self._edited(),
        }

    def load_state_dict(self, state: Mapping[str, Any] | None) -> None:
        """Restore a `state_dict()` that `check_loadable` has passed.

        None (of a run that was not adaptive) begins without evidence.
        """
        if state is None:
            state = NO_EVIDENCE
        self.reasons = dict(state["switched_off"])
        self._constant = state["constant"]
        self._windows = [list(each) for each in state["windows"]]
        self._probes, self._views, self._view = state["probes"], state["views"], state["view"]
        self._pairs = torch.tensor(state["pairs"], dtype=torch.float64)
        self._opacities, self._missed_edit = None, bool(state["edited"])
        self._scheduler.multiplier = self._asked_multiplier
        self._use_energy("raw" if "view_centering" in self.reasons else self._asked_energy)
        if "multiplier" in self.reasons:
            self._use_constant()
        self._scheduler.curvature = self._asked_curvature and "curvature" not in self.reasons
        self._use_options("epoch_pairs" in self.reasons)


def _between(old: list[float], now: list[float]) -> tuple[float, float, float]:
    """(number, mean, deviation) of what came between two running moments (Chan et al. 1979)."""
    count = now[0] - old[0]
    mean = (now[0] * now[1] - old[0] * old[1]) / count
    square = now[2] - old[2] - old[0] * count / now[0] * (mean - old[1]) ** 2
    return count, mean, (max(square, 0.0) / count) ** 0.5
