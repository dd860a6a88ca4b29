"""Small stand-ins for a trainer, with the row edits that density control makes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import (
    Averaging,
    Curvature,
    EnergyHistogram,
    FreshMoments,
    Part,
    PhaseScheduler,
    SquaredLoss,
)

PAPER_SWITCH = 29 / 30

RATES = {
    "means": 1e-2,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}
SHAPES = {
    "means": (3,),
    "scales": (3,),
    "quats": (4,),
    "opacities": (),
    "sh0": (1, 3),
    "shN": (15, 3),
}
INRIA_NAMES = {
    "means": "xyz",
    "sh0": "f_dc",
    "shN": "f_rest",
    "opacities": "opacity",
    "scales": "scaling",
    "quats": "rotation",
}


class AveragedThroughout(Averaging):
    """`Averaging` of all iterates, for short runs."""

    share = 1.0


def everything(
    total_steps: int,
    switch: float | int = PAPER_SWITCH,
    *others: Part,
    nu: Part | None = None,
    curvature: Part | None = None,
    settling: int = 100,
    **options: Any,
) -> PhaseScheduler:
    """Both phases of the paper on, which the defaults leave off, and `others`.

    Args:
        nu: instead of an `EnergyHistogram` with a warm-up of a twelfth of the run.
        curvature: instead of `Curvature()`.
        settling: of `FreshMoments`.
        options: of `PhaseScheduler`.
    """
    parts: list[Part] = [
        nu or EnergyHistogram(warmup=max(4, total_steps // 12)),
        FreshMoments(settling),
        SquaredLoss(),
        curvature or Curvature(),
        *others,
    ]
    return PhaseScheduler(total_steps, switch, parts, **options)


def only(total_steps: int, *parts: Part, switch: float | int = PAPER_SWITCH) -> PhaseScheduler:
    """These parts, and nothing else."""
    return PhaseScheduler(total_steps, switch, list(parts))


def gaussians(n: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """Gaussians to be moved, in float64: log scales, quaternions, opacity logits."""
    generator = torch.Generator().manual_seed(seed)
    like: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    return {
        "scales": torch.randn(n, 3, **like),
        "quats": 3 * torch.randn(n, 4, **like),
        "opacities": 6 * torch.randn(n, **like) - 4,
    }


def make_splats(n: int = 12, seed: int = 0) -> dict[str, Parameter]:
    """Random Gaussians under gsplat's names."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: Parameter(torch.randn(n, *shape, generator=generator))
        for name, shape in SHAPES.items()
    }


def gsplat_optimizers(splats: dict[str, Parameter], **options: Any) -> dict[str, torch.optim.Adam]:
    """One Adam per parameter, built as gsplat's simple_trainer does."""
    return {
        name: torch.optim.Adam(
            [{"params": param, "lr": RATES[name], "name": name}], eps=1e-15, **options
        )
        for name, param in splats.items()
    }


def inria_optimizer(splats: dict[str, Parameter]) -> torch.optim.Adam:
    """One Adam with named groups, built as INRIA's training_setup does."""
    groups = [
        {"params": [splats[name]], "lr": RATES[name], "name": inria}
        for name, inria in INRIA_NAMES.items()
    ]
    return torch.optim.Adam(groups, lr=0.0, eps=1e-15)


def view_loss(
    splats: dict[str, Parameter], view: int, phases: PhaseScheduler | None = None
) -> Tensor:
    """A smooth loss in which all parameters and the view matter; every third point is unseen."""
    generator = torch.Generator().manual_seed(1000 + view)
    loss = torch.zeros(())
    for name, param in splats.items():
        weight = torch.rand(param.shape[1:], generator=generator) + 0.5
        seen = torch.arange(param.shape[0]) % 3 != view % 3
        render = (param * weight)[seen]
        target = torch.full_like(render, 0.1 * (view + 1))
        term = (
            (render - target).abs().mean() if phases is None else phases.pixel_loss(render, target)
        )
        loss = loss + (0.02 if name != "means" else 0.05) * term
    return loss


def every_one(optimizers: Any) -> list[Any]:
    """The optimizers of a dict, or the only one."""
    return list(optimizers.values()) if isinstance(optimizers, dict) else [optimizers]


def state_of(optimizers: Any, param: Any) -> dict[str, Any]:
    """A parameter's state, in whichever optimizer it is."""
    return next(each.state[param] for each in every_one(optimizers) if param in each.state)


def values_of(splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Copies of the parameters."""
    return {name: param.detach().clone() for name, param in splats.items()}


def step_all(optimizers: Any) -> None:
    """Step and zero_grad of every optimizer."""
    for optimizer in every_one(optimizers):
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)


def train(
    splats: dict[str, Parameter],
    optimizers: Mapping[str, torch.optim.Optimizer] | torch.optim.Optimizer,
    phases: PhaseScheduler | None,
    first: int,
    last: int,
) -> None:
    """Iterations first .. last - 1 in gsplat's order: backward, (observe), step, zero_grad."""
    for iteration in range(first, last):
        loss = view_loss(splats, iteration % 5, phases)
        loss.backward()
        if phases is not None:
            phases.observe(loss)
        step_all(optimizers)


def trained_by_adam(last: int, **options: Any) -> dict[str, Parameter]:
    """The Gaussians after so many iterations of the trainer's own Adam."""
    splats = make_splats()
    train(splats, gsplat_optimizers(splats, **options), None, 0, last)
    return splats


def assert_same(ours: Mapping[str, Tensor], theirs: Mapping[str, Tensor]) -> None:
    """Bit for bit, whatever their names are in."""
    assert set(ours) == set(theirs)
    for name, value in ours.items():
        assert torch.equal(value, theirs[name]), name


def edit_rows(
    splats: dict[str, Parameter],
    optimizers: Mapping[str, torch.optim.Optimizer],
    rows: Tensor,
    new: int,
) -> None:
    """gsplat's `_update_param_with_optimizer`: keep `rows`, append `new` zero-state rows."""
    for name, optimizer in optimizers.items():
        for group in optimizer.param_groups:
            old = group["params"][0]
            added = old.detach()[:new].clone()
            fresh = Parameter(torch.cat([old.detach()[rows], added]))
            state = optimizer.state.pop(old, {})
            for key, value in state.items():
                if key != "step":
                    zeros = torch.zeros((new, *value.shape[1:]))
                    state[key] = torch.cat([value[rows], zeros])
            optimizer.state[fresh] = state
            group["params"] = [fresh]
            splats[name] = fresh


def begun(
    phases: PhaseScheduler, make: Any = gsplat_optimizers, **options: Any
) -> tuple[dict[str, Parameter], Any]:
    """Gaussians, and their optimizers, which `make` has made and `phases` upgraded."""
    splats = make_splats()
    return splats, phases.upgrade(make(splats, **options))


def upgraded(
    total_steps: int,
    *parts: Part,
    make: Any = gsplat_optimizers,
    switch: float | int = PAPER_SWITCH,
    **options: Any,
) -> tuple[dict[str, Parameter], PhaseScheduler, Any]:
    """Gaussians, a scheduler with these parts alone, and the upgraded optimizers."""
    phases = only(total_steps, *parts, switch=switch)
    splats, optimizers = begun(phases, make, **options)
    return splats, phases, optimizers
