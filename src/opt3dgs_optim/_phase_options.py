"""Options of `PhaseScheduler` that may be said in several ways, and the paper's schedule."""

from __future__ import annotations

from typing import Any

from opt3dgs_optim._checks import check_count, check_number
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.multiplier import ConstantMultiplier

CALL = "PhaseScheduler"
PAPER_STEPS = 30_000
PAPER_SWITCH = 29_000 / PAPER_STEPS
PAPER_WARMUP = 2_500 / PAPER_STEPS
SETTLING_STEPS = 100  # of Adam's second moment over views, after a restart


def switch_iteration(switch: float | int, total_steps: int) -> int:
    """The first iteration of exploitation: an int as it is, a float as a fraction of the run."""
    if isinstance(switch, int) and not isinstance(switch, bool):
        return check_count(CALL, "switch", switch, 0, total_steps)
    fraction = check_number(CALL, "switch", switch, 0.0, 1.0)
    return round(fraction * total_steps)


def resets_moments(value: bool | str, steps_left: int) -> bool:
    """Whether Adam's moments start anew at the switch; "auto": where they have time to settle."""
    if isinstance(value, bool):
        return value
    if value != "auto":
        raise ValueError(f"{CALL}: reset_moments={value!r}, but True, False or 'auto' is needed")
    return steps_left >= SETTLING_STEPS


def as_multiplier(value: Any, total_steps: int) -> EnergyHistogram | ConstantMultiplier | None:
    """What gives nu: `value` itself, or made of "histogram" or a number."""
    if value is None or isinstance(value, (EnergyHistogram, ConstantMultiplier)):
        return value
    if value == "histogram":
        # An automatic range needs a few energies even in the shortest run.
        return EnergyHistogram(warmup=max(4, round(total_steps * PAPER_WARMUP)))
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return ConstantMultiplier(check_number(CALL, "multiplier", value))
    raise ValueError(
        f"{CALL}: multiplier={value!r}, but 'histogram', an EnergyHistogram, a number or None is "
        "needed"
    )
