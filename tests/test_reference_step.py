"""The package makes the steps of examples/reference_step.py, bit for bit, over whole trainings."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import reference_step
import torch
from gaussians import RATES, SHAPES, adams_of, decayed, make_gaussians, same_tensors
from reference_step import default_step, paper_pixel_loss, paper_step
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import (
    DEFAULTS,
    Averaging,
    Fading,
    OutOfView,
    OwnFrame,
    Part,
    PhaseScheduler,
    paper_parts,
)
from opt3dgs_optim.mean import like_rows

pytestmark = pytest.mark.filterwarnings("ignore:opt3dgs_optim. iteration .* not been finite")

PIXELS = 40
Gaussians = dict[str, Tensor]


class Scene:
    """A renderer of nothing in particular, in which every tensor of the Gaussians has a gradient.

    A view sees a share of the points; the others get exact zeros, but for the regularisers of
    scales and opacities, which pull in some views more than in others.
    """

    def __init__(self, num_points: int, share: float) -> None:
        self.num_points, self.share = num_points, share
        generator = torch.Generator().manual_seed(0)
        self.target = 0.1 * torch.randn(PIXELS, 3, generator=generator)
        self.pixels = torch.randint(PIXELS, (num_points,), generator=generator)

    def loss(self, params: Gaussians, pixel_loss: Callable[[Tensor], Tensor], view: int) -> Tensor:
        """The loss of one view, 0-d; each view sees other points, from another place."""
        generator = torch.Generator().manual_seed(view)
        seen = torch.rand(self.num_points, generator=generator) < self.share
        place = torch.randn(3, generator=generator)
        p = {name: each[seen] for name, each in params.items()}
        spread = ((p["means"] - place) * torch.exp(-0.1 * p["scales"])).sin()
        color = spread + 0.1 * (p["sh0"].sum(1) + p["shN"].sum(1)) + p["quats"][:, 1:].tanh()
        weighted = 0.02 * color * torch.sigmoid(p["opacities"])[:, None]
        image = torch.zeros(PIXELS, 3).index_add(0, self.pixels[seen], weighted)
        regularisers = torch.sigmoid(params["opacities"]).mean() + params["scales"].exp().mean()
        return pixel_loss(image - self.target) + 0.002 * view * regularisers


def spoil(iteration: int, loss: Tensor, params: Gaussians) -> Tensor:
    """What a training meets now and then: a loss, and a gradient, that are not finite."""
    if iteration % 37 == 5:
        for name, value in (("means", torch.nan), ("sh0", -torch.inf)):
            grad = params[name].grad
            assert grad is not None
            grad[::7, ..., :1] = value
    return loss.detach() * (math.nan if iteration % 23 in (9, 10) else 1.0)


def train(
    scene: Scene,
    total: int,
    pixel_loss: Callable[..., Tensor],
    step: Callable[[Gaussians, int, Tensor], None],
) -> list[Gaussians]:
    """The parameters after every iteration."""
    params = {
        name: each.requires_grad_() for name, each in make_gaussians(scene.num_points).items()
    }
    history = []
    for iteration in range(total):
        for param in params.values():
            param.grad = None
        loss = scene.loss(params, partial(pixel_loss, iteration=iteration), iteration % 50)
        loss.backward()
        step(params, iteration, spoil(iteration, loss, params))
        history.append({name: param.detach().clone() for name, param in params.items()})
    return history


def with_the_package(
    scene: Scene, total: int, parts: Any, *, observe: bool = False
) -> list[Gaussians]:
    phases = PhaseScheduler(total, parts=parts)
    optimizers: dict[str, Any] = {}

    def step(params: Gaussians, iteration: int, loss: Tensor) -> None:
        if not optimizers:
            optimizers.update(phases.upgrade(adams_of(params)))
        if observe:
            phases.observe(loss)
        rates = decayed(iteration, total)
        for name, optimizer in optimizers.items():
            optimizer.param_groups[0]["lr"] = rates[name]
            optimizer.step()

    def pixel_loss(error: Tensor, iteration: int) -> Tensor:
        return phases.pixel_loss(error, torch.zeros_like(error))

    return train(scene, total, pixel_loss, step)


def with_the_reference(
    scene: Scene, total: int, step: Callable[..., None], pixel_loss: Callable[..., Tensor]
) -> tuple[list[Gaussians], dict[str, Any]]:
    state: dict[str, Any] = {}

    @torch.no_grad()
    def reference(params: Gaussians, iteration: int, loss: Tensor) -> None:
        grads = {name: param.grad for name, param in params.items()}
        energy = (loss,) if step is paper_step else ()
        step(params, grads, state, decayed(iteration, total), iteration, total, *energy)

    return train(scene, total, pixel_loss, reference), state


def first_difference(ours: list[Gaussians], theirs: list[Gaussians]) -> str | None:
    for iteration, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        for name in a:
            if not torch.equal(a[name], b[name]):
                return f"iteration {iteration}: {name}"
    return None


def l1(error: Tensor, iteration: int) -> Tensor:
    return error.abs().mean()


@pytest.mark.parametrize(
    ("num_points", "share", "total"),
    [
        (57, 0.15, 240),  # views see little
        (1, 1.0, 90),
    ],
)
def test_the_default_step(num_points: int, share: float, total: int) -> None:
    scene = Scene(num_points, share)
    theirs, state = with_the_reference(scene, total, default_step, l1)
    assert first_difference(with_the_package(scene, total, DEFAULTS), theirs) is None
    assert (state["share"] < 1 / 3) == (num_points == 57)


def test_more_points_than_a_cpu_takes_at_a_time() -> None:
    """And more than every event of fading fades; views see little of them."""
    num_points, total = 45_001, 30
    ours = {name: Parameter(each) for name, each in make_gaussians(num_points).items()}
    theirs, state = make_gaussians(num_points), {}
    optimizers = PhaseScheduler(total).upgrade(adams_of(ours))
    generator = torch.Generator().manual_seed(0)
    for iteration in range(total):
        seen = torch.rand(num_points, generator=generator) < 0.05
        for param in ours.values():
            grad = torch.randn(param.shape, generator=generator)
            param.grad = grad * like_rows(seen, grad) if iteration < 15 else grad
        for optimizer in optimizers.values():
            optimizer.step()
        grads: Any = {name: param.grad for name, param in ours.items()}
        default_step(theirs, grads, state, RATES, iteration, total)
    assert same_tensors(ours, theirs)
    assert state["share"] != 1


def test_a_long_run_averages_every_second_iterate() -> None:
    """From 500 iterates on; in the last tenth of them all."""
    total, has = 15_000, {"averaging": tuple(SHAPES)}
    ours = {name: Parameter(each) for name, each in make_gaussians(9).items()}
    theirs, state = make_gaussians(9), {}
    phases = PhaseScheduler(total, parts=[Averaging()])
    optimizers = phases.upgrade(adams_of(ours))
    for iteration in range(14_490, total):
        phases.observe(iteration=iteration)
        for param in ours.values():
            param.grad = torch.randn_like(param)
        for optimizer in optimizers.values():
            optimizer.step()
        grads: Any = {name: param.grad for name, param in ours.items()}
        default_step(theirs, grads, state, RATES, iteration, total, has)
        assert same_tensors(ours, theirs), iteration


ALONE: list[tuple[Part, dict]] = [
    (OwnFrame(), {"own_frame": ("means",)}),
    (Fading(names=("means", "sh0")), {"fading": ("means", "sh0")}),
    (OutOfView(), {"out_of_view": ("scales", "opacities")}),
    (Averaging(), {"averaging": tuple(SHAPES)}),
]


@pytest.mark.parametrize(("part", "has"), ALONE, ids=[type(p).__name__ for p, _ in ALONE])
def test_each_part_alone(part: Part, has: dict) -> None:
    """But that OutOfView acts where fading has emptied second moments."""
    parts, before = [part], {}
    if isinstance(part, OutOfView):
        before = {"fading": ("scales",)}
        parts, has = [Fading(names=("scales",)), part], {**has, **before}
    scene, total = Scene(40, 0.15), 240
    theirs, _ = with_the_reference(scene, total, partial(default_step, parts=has), l1)
    assert first_difference(with_the_package(scene, total, parts), theirs) is None
    plain, _ = with_the_reference(scene, total, partial(default_step, parts=before), l1)
    assert first_difference(plain, theirs), "the part did nothing in this training"


@pytest.mark.parametrize(("num_points", "share"), [(60, 0.8), (57, 0.3), (1, 1.0)])
def test_the_papers_step(num_points: int, share: float) -> None:
    """With `pixel_loss` and `observe`, as the paper's trainer calls them."""
    total = 450
    scene = Scene(num_points, share)
    theirs, state = with_the_reference(
        scene, total, paper_step, partial(paper_pixel_loss, total=total)
    )
    ours = with_the_package(scene, total, paper_parts(total), observe=True)
    assert first_difference(ours, theirs) is None
    assert all(state[name]["step"] <= 15 for name in SHAPES)  # begun anew
    assert (state["theta"] > 2 / 200).any()
    newest_first: list[Tensor] = state["means"]["pairs"][2]
    filled = [float((each != 0).any(1).float().mean()) for each in newest_first]
    assert num_points == 1 or (filled[0] > 0.5 and filled[4] > 0.0)  # all five slots


def test_the_reference_needs_torch_only() -> None:
    tree = ast.parse(Path(reference_step.__file__).read_text(encoding="utf-8"))
    nodes = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert sorted(map(ast.unparse, nodes)) == ["from torch import Tensor", "import torch"]
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
