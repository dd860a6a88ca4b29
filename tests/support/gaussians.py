"""Small sets of Gaussians, and the optimizers that trainers make for them."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

# By gsplat's names: the shape of a row, and a learning rate.
SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "scales": (3,),
    "quats": (4,),
    "opacities": (),
    "sh0": (1, 3),
    "shN": (3, 3),
}
RATES = {"means": 0.02, "scales": 0.05, "quats": 0.01, "opacities": 0.05, "sh0": 0.02, "shN": 0.001}
# INRIA's names of the same.
INRIA = {
    "means": "xyz",
    "scales": "scaling",
    "quats": "rotation",
    "opacities": "opacity",
    "sh0": "f_dc",
    "shN": "f_rest",
}


def make_gaussians(num_points: int, seed: int = 1) -> dict[str, Tensor]:
    """Random tensors [num_points, ...]."""
    generator = torch.Generator().manual_seed(seed)
    return {n: torch.randn((num_points, *s), generator=generator) for n, s in SHAPES.items()}


def parameters(num_points: int, *names: str, seed: int = 1) -> dict[str, Parameter]:
    """The Gaussians as Parameters; those of these names, or all."""
    made = make_gaussians(num_points, seed)
    return {name: Parameter(made[name]) for name in names or SHAPES}


def adams_of(
    params: Mapping[str, Tensor], make: Callable[..., Any] = Adam, **options: Any
) -> dict[str, Any]:
    """One optimizer for each, as gsplat and nerfstudio make them."""
    given = {"eps": 1e-15, **options}
    return {
        name: make([{"params": [param], "lr": RATES.get(name, 0.01), "name": name}], **given)
        for name, param in params.items()
    }


def adam_of(params: Mapping[str, Tensor], make: Callable[..., Any] = Adam, **options: Any) -> Any:
    """One optimizer of all, as INRIA's trainer makes it."""
    groups = [
        {"params": [param], "lr": RATES.get(name, 0.01), "name": INRIA.get(name, name)}
        for name, param in params.items()
    ]
    return make(groups, **{"lr": 0.0, "eps": 1e-15, **options})


def decayed(iteration: int, total: int) -> dict[str, float]:
    """Learning rates: that of the means decays, as in every trainer."""
    return {**RATES, "means": RATES["means"] * 0.01 ** (iteration / total)}


def steps(
    optimizers: Mapping[str, Any], params: Mapping[str, Any], count: int, seed: int = 0
) -> None:
    """So many iterations of random gradients."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        for param in params.values():
            grad = torch.randn(param.shape, generator=generator, dtype=torch.float32)
            param.grad = grad.to(param.dtype)
        for optimizer in optimizers.values():
            optimizer.step()


def same_tensors(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> bool:
    """Whether two sets of tensors are equal bit for bit."""
    return set(a) == set(b) and all(torch.equal(a[name], b[name]) for name in a)


def through_a_file(saved: Any) -> Any:
    """What `torch.load` makes of it, which takes tensors and plain values only."""
    file = io.BytesIO()
    torch.save(saved, file)
    file.seek(0)
    return torch.load(file, weights_only=True)
