"""What optimizers and the scheduler say of themselves: a few short lines.

Numbers that live on a GPU are read, so that a `repr` waits for it.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from typing import Any

from torch import Tensor

MOST_GROUPS = 8
WIDTH = 96  # of a line whose length is not known


def block(name: str, lines: Iterable[str]) -> str:
    """`name(`, the lines, indented, and `)`."""
    return "\n".join([f"{name}(", *(f"  {line}" for line in lines), ")"])


def group_lines(groups: Iterable[Mapping[str, Any]]) -> list[str]:
    """A line per parameter group: name, shape and learning rate."""
    lines = [_group_line(i, group) for i, group in enumerate(groups)]
    more = len(lines) - MOST_GROUPS
    return lines if more <= 0 else [*lines[:MOST_GROUPS], f"and {more} more groups"]


def _group_line(index: int, group: Mapping[str, Any]) -> str:
    params = group["params"]
    if len(params) == 1:
        size = str(list(params[0].shape))
    else:
        size = f"{len(params)} tensors, {sum(p.numel() for p in params):,} numbers"
    return f"{group.get('name', f'group {index}')} {size}: lr {float(group['lr']):.4g}"


def phase_line(iteration: int, total_steps: int, switch_step: int, phase: str) -> str:
    """Phase, iteration and how far the switch is."""
    where = f"phase: {phase}, iteration {iteration} of {total_steps}"
    if iteration >= switch_step:
        return f"{where}, since {switch_step}"
    if switch_step >= total_steps:
        return f"{where}, no switch"
    return f"{where}, switch at {switch_step} (in {switch_step - iteration})"


def nu_line(multiplier: Any, exploiting: bool = False) -> str:
    """The multiplier of the step that comes next, from an `EnergyHistogram` or a constant."""
    if multiplier is None:
        return "nu: off"
    if exploiting:
        return "nu: off while exploiting"
    observed, warmup = multiplier.num_observed, getattr(multiplier, "warmup", 0)
    if observed == 0:
        return "nu: 1, no energy observed yet"
    if observed <= warmup:
        return f"nu: 1, warm-up: {observed} of {warmup} energies"
    mean = getattr(multiplier, "mean_multiplier", None)
    since = "" if mean is None else f", mean {float(mean):.4g} since the warm-up"
    return f"nu: {float(multiplier.multiplier):.4g}{since}"


def curvature_line(options: Any, share: Tensor | None) -> str:
    """History size and kind of the pairs, and how many of the last step's were accepted."""
    kept = f"curvature: {options.history_size} {options.pairs} pairs per point"
    if share is None:
        return f"{kept}, not in use yet"
    return f"{kept}, accepted share {float(share):.3g} in the last step"


def skipped_lines(skipped_rows: Tensor | int) -> list[str]:
    """A line if rows were skipped for a non-finite gradient."""
    rows = int(skipped_rows)
    return [f"skipped rows: {rows:,}, for a non-finite gradient"] if rows else []


def noise_line(noise: Any) -> str:
    """Kind and size of the Langevin noise; the tensors it reads are not shown."""
    if noise is None:
        return "noise: off"
    sizes = ((name, getattr(noise, name, None)) for name in ("scale", "temperature", "std"))
    shown = [f"{name} {size:g}" for name, size in sizes if size is not None]
    return f"noise: {' '.join([type(noise).__name__, *shown])}"


def scheduler_lines(scheduler: Any) -> list[str]:
    """Phase and multiplier of a `PhaseScheduler`, its parts that are on, what is switched off."""
    lines = [
        phase_line(
            scheduler.iteration,
            scheduler.total_steps,
            scheduler.switch_step,
            scheduler.phase.value,
        ),
        nu_line(scheduler.multiplier, scheduler.phase.value == "exploitation"),
    ]
    if scheduler.noise is not None:
        lines.append(noise_line(scheduler.noise))
    parts = (getattr(scheduler, name, None) for name in ("annealing", "fading", "pooling"))
    for part in parts:
        if part is not None:
            lines += textwrap.wrap(str(part), WIDTH, subsequent_indent="  ")
    return lines + adaptive_lines(scheduler.switched_off) if scheduler.adaptive else lines


def adaptive_lines(switched_off: Mapping[str, str]) -> list[str]:
    """A line per part that `adaptive=True` has switched off, with its reason as far as it fits."""
    if not switched_off:
        return ["adaptive: nothing is switched off"]
    texts = [f"switched off: {part}: {reason}" for part, reason in switched_off.items()]
    return [textwrap.shorten(text, WIDTH, placeholder=" ...") for text in texts]
