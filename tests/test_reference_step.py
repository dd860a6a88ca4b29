"""The package makes the steps of examples/reference_step.py, bit for bit, over whole trainings."""

from __future__ import annotations

import ast
import copy
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import reference_step
import torch
from reference_step import adam_, default_step, new_moments, paper_pixel_loss, paper_step
from torch import Tensor

from opt3dgs_optim import DEFAULTS, OwnFrame, Part, PhaseScheduler, paper_parts

SHAPES = {
    "means": (3,),
    "scales": (3,),
    "quats": (4,),
    "opacities": (),
    "sh0": (1, 3),
    "shN": (3, 3),
}
RATES = {"means": 0.02, "scales": 0.05, "quats": 0.01, "opacities": 0.05, "sh0": 0.02, "shN": 0.001}
PIXELS = 40


class Scene:
    """A renderer of nothing in particular, in which every tensor of the Gaussians has a gradient.

    A view sees a share of the points; the others get exact zeros, but for the regularisers of
    scales and opacities.
    """

    def __init__(self, num_points: int, share: float, seed: int = 0) -> None:
        self.num_points, self.share = num_points, share
        self.generator = torch.Generator().manual_seed(seed)
        self.target = 0.1 * self.draw(PIXELS, 3)
        self.pixels = torch.randint(PIXELS, (num_points,), generator=self.generator)

    def draw(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator)

    def gaussians(self) -> dict[str, Tensor]:
        return {name: self.draw(self.num_points, *shape) for name, shape in SHAPES.items()}

    def loss(
        self, params: dict[str, Tensor], pixel_loss: Callable[[Tensor], Tensor], view: int
    ) -> Tensor:
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
        return pixel_loss(image - self.target) + 0.01 * regularisers


def decayed(iteration: int, total: int) -> dict[str, float]:
    """Learning rates: that of the means decays, as in every trainer."""
    return {**RATES, "means": RATES["means"] * 0.01 ** (iteration / total)}


def spoil(iteration: int, loss: Tensor, params: dict[str, Tensor]) -> Tensor:
    """What a training meets now and then: a loss, and a gradient, that are not finite."""
    if iteration % 37 == 5:
        grads = [params[name].grad for name in ("means", "sh0")]
        for grad, value in zip(grads, (torch.nan, -torch.inf), strict=True):
            assert grad is not None
            grad[::7] = value
    return loss.detach() * (math.nan if iteration % 23 in (9, 10) else 1.0)


def train(
    scene: Scene,
    start: dict[str, Tensor],
    total: int,
    pixel_loss: Callable[..., Tensor],
    step: Callable[[dict[str, Tensor], int, Tensor], None],
) -> list[dict[str, Tensor]]:
    """The parameters after every iteration."""
    params = {name: each.clone().requires_grad_() for name, each in start.items()}
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
    scene: Scene, start: dict[str, Tensor], total: int, phases: PhaseScheduler
) -> list[dict[str, Tensor]]:
    optimizers: dict[str, Any] = {}

    def step(params: dict[str, Tensor], iteration: int, loss: Tensor) -> None:
        rates = decayed(iteration, total)
        if not optimizers:
            for name, param in params.items():
                group = {"params": [param], "lr": rates[name], "name": name}
                optimizers[name] = torch.optim.Adam([group], eps=1e-15)
            phases.upgrade(optimizers)
        phases.observe(loss)
        for name, optimizer in optimizers.items():
            optimizer.param_groups[0]["lr"] = rates[name]
            optimizer.step()

    def pixel_loss(error: Tensor, iteration: int) -> Tensor:
        return phases.pixel_loss(error, torch.zeros_like(error))

    return train(scene, start, total, pixel_loss, step)


def with_the_reference(
    scene: Scene,
    start: dict[str, Tensor],
    total: int,
    step: Callable[..., None],
    pixel_loss: Callable[..., Tensor],
) -> tuple[list[dict[str, Tensor]], dict[str, Any]]:
    state: dict[str, Any] = {}

    @torch.no_grad()
    def reference(params: dict[str, Tensor], iteration: int, loss: Tensor) -> None:
        if not math.isfinite(loss):
            return
        grads = {name: param.grad for name, param in params.items()}
        rates = decayed(iteration, total)
        energy = (loss,) if step is paper_step else ()
        step(params, grads, state, rates, iteration, total, *energy)

    return train(scene, start, total, pixel_loss, reference), state


def check_same(ours: list[dict[str, Tensor]], theirs: list[dict[str, Tensor]]) -> None:
    for iteration, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        for name in a:
            assert torch.equal(a[name], b[name]), f"iteration {iteration}: {name}"


def l1(error: Tensor, iteration: int) -> Tensor:
    return error.abs().mean()


@pytest.mark.parametrize(
    ("num_points", "share", "total", "own_frame"),
    [
        (60, 0.8, 150, False),
        (57, 0.15, 300, False),
        (57, 0.15, 300, True),
        (20_001, 0.2, 60, False),
        (20_001, 0.2, 60, True),
        (1, 1.0, 90, False),
    ],
)
def test_the_default_step(num_points: int, share: float, total: int, own_frame: bool) -> None:
    """Many points and few; views that see much and little; of 20,001 points some events happen."""
    scene = Scene(num_points, share)
    start = scene.gaussians()
    phases = PhaseScheduler(total)
    if own_frame:
        phases = PhaseScheduler(total, parts=[OwnFrame(), *DEFAULTS])
    step = partial(default_step, own_frame=own_frame)
    theirs, state = with_the_reference(scene, start, total, step, l1)
    check_same(with_the_package(scene, start, total, phases), theirs)
    assert state["events"] == int(min(300, 0.47 * total / 4))
    assert (state["share"] < 1 / 3) == (share < 1 / 3 and total == 300)


@pytest.mark.parametrize(("num_points", "share"), [(60, 0.8), (57, 0.3), (1, 1.0)])
def test_the_papers_step(num_points: int, share: float) -> None:
    total = 450
    scene = Scene(num_points, share)
    start = scene.gaussians()

    def pixel_loss(error: Tensor, iteration: int) -> Tensor:
        return paper_pixel_loss(error, iteration, total)

    theirs, state = with_the_reference(scene, start, total, paper_step, pixel_loss)
    check_same(with_the_package(scene, start, total, PhaseScheduler.paper(total)), theirs)
    assert all(state[name]["fresh"] and state[name]["step"] < 15 for name in SHAPES)
    assert (state["theta"] > 2 / 200).any()
    newest_first: list[Tensor] = state["means"]["pairs"][2]
    filled = [float((each != 0).any(1).float().mean()) for each in newest_first]
    assert num_points == 1 or (filled[0] > 0.5 and filled[4] > 0.0)  # all five slots


@pytest.mark.parametrize(
    ("step", "parts"),
    [(default_step, [*DEFAULTS]), (paper_step, paper_parts(300))],
    ids=["default", "paper"],
)
def test_every_part_is_at_work_in_these_trainings(
    step: Callable[..., None], parts: list[Part]
) -> None:
    """Else the tests above would hold whatever that part does."""
    total = 300
    scene = Scene(57, 0.15)
    start = scene.gaussians()

    def pixel_loss(error: Tensor, iteration: int) -> Tensor:
        return paper_pixel_loss(error, iteration, total) if step is paper_step else l1(error, 0)

    theirs, _ = with_the_reference(scene, start, total, step, pixel_loss)
    assert len(parts) >= 3
    for left_out in range(len(parts)):
        others = [copy.deepcopy(part) for i, part in enumerate(parts) if i != left_out]
        ours = with_the_package(scene, start, total, PhaseScheduler(total, parts=others))
        with pytest.raises(AssertionError, match="iteration"):
            check_same(ours, theirs)


def test_one_adam_is_torchs() -> None:
    torch.manual_seed(0)
    param = torch.nn.Parameter(torch.randn(31, 3))
    target, own = param.detach().clone(), new_moments(param.detach())
    adam = torch.optim.Adam([param], lr=0.01, eps=1e-15)
    for grad in torch.randn(20, 31, 3):
        param.grad = grad
        adam.step()
        adam_(target, grad, own, 0.01)
    assert torch.equal(param, target)
    assert torch.equal(adam.state[param]["exp_avg_sq"], own["exp_avg_sq"])


def test_the_reference_needs_torch_only() -> None:
    tree = ast.parse(Path(reference_step.__file__).read_text(encoding="utf-8"))
    nodes = [node for node in ast.walk(tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert sorted(ast.unparse(node) for node in nodes) == [
        "from torch import Tensor",
        "import torch",
    ]
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
