"""A constant multiplier: the control that every claim for the flat histogram needs."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim._checkpoint import check_keys, check_whole
from opt3dgs_optim._checks import check_count, check_number


class ConstantMultiplier:
    """nu = `value`, whatever the energy: a plain change of all learning rates.

    While the loss falls, the flat histogram's nu is above 1 on average; part of any gain is then
    just a larger step. Compare with a constant of the same mean
    (`EnergyHistogram.mean_multiplier`) before crediting the histogram.

    Args:
        value: the multiplier, any finite number.
        warmup: number of energies during which it is 1, as in `EnergyHistogram`.
    """

    def __init__(self, value: float, warmup: int = 0) -> None:
        self.value = check_number("ConstantMultiplier", "value", value)
        self.warmup = check_count("ConstantMultiplier", "warmup", warmup, 0)
        self.num_observed = 0
        self.last_finite = torch.ones((), dtype=torch.bool)

    @property
    def multiplier(self) -> Tensor:
        """The multiplier of the next step, 0-d, on the energies' device."""
        nu = 1.0 if self.num_observed <= self.warmup else self.value
        return torch.full((), nu, device=self.last_finite.device, dtype=torch.float32)

    @property
    def mean_multiplier(self) -> Tensor:
        """`value`, 0-d."""
        return torch.tensor(self.value)

    def observe(self, energy: Tensor | float, *, view: Hashable | None = None) -> Tensor:
        """Take an energy; only whether it is finite matters.

        Args:
            energy: the training loss of this iteration, 0-d.
            view: not used; as in `EnergyHistogram.observe`.

        Returns:
            The multiplier of the next step, 0-d.
        """
        value = energy if isinstance(energy, Tensor) else torch.tensor(float(energy))
        self.last_finite = torch.isfinite(value.detach()).reshape(())
        self.num_observed += 1
        return self.multiplier

    def state_dict(self) -> dict[str, Any]:
        """The number of energies seen."""
        return {"num_observed": self.num_observed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; ValueError if it is damaged."""
        call = "ConstantMultiplier.load_state_dict"
        check_keys(call, state, ("num_observed",))
        self.num_observed = check_whole(call, "num_observed", state["num_observed"])
