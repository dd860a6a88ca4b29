"""What the hooks of one group find of the others: the trainer's tensors, whatever their order."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from trainers import INRIA_NAMES, RATES, gsplat_optimizers, inria_optimizer, make_splats

from opt3dgs_optim import (
    Averaging,
    Fading,
    OutOfView,
    OwnFrame,
    Part,
    PhaseScheduler,
    PositionNoise,
)

ROWS = 12
ORDERS = [
    tuple(INRIA_NAMES),
    tuple(reversed(INRIA_NAMES)),
    ("scales", "means", "quats", "opacities", "sh0", "shN"),
    ("quats", "opacities", "scales", "sh0", "means", "shN"),
]


def in_order(splats: dict[str, Parameter], order: tuple[str, ...], **options: Any) -> Any:
    """One Adam with its groups in that order."""
    groups = [
        {"params": [splats[name]], "lr": RATES[name], "name": INRIA_NAMES[name]} for name in order
    ]
    return torch.optim.Adam(groups, lr=0.0, eps=1e-15, **options)


def give_gradients(splats: dict[str, Parameter], iteration: int) -> None:
    draw = torch.Generator().manual_seed(iteration)
    for param in splats.values():
        param.grad = torch.randn(param.shape, generator=draw) + 0.1 * param.detach()


class Displaced(Part):
    """Its own way of moving something, which changes nothing."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def displacement(self, group: Any, param: Any, step: Tensor, state: Any, course: Any) -> Tensor:
        return step * 1.0


def trained(
    order: tuple[str, ...], make: Callable[[], list[Part]], *, masked: bool, **options: Any
) -> dict[str, Tensor]:
    """The Gaussians after ten steps, every other one with a mask."""
    torch.manual_seed(0)
    splats = make_splats(ROWS)
    phases = PhaseScheduler(100, parts=make())
    adam: Any = phases.upgrade(in_order(splats, order, **options))
    mask = torch.arange(ROWS) % 2 == 0
    for i in range(10):
        give_gradients(splats, i)
        phases.observe(0.1, iteration=i)
        adam.step(mask) if masked and i % 2 else adam.step()
    assert all(float(each["step"]) == 10 for each in adam.state.values())
    return {name: param.detach() for name, param in splats.items()}


PARTS: dict[str, Callable[[], list[Part]]] = {
    "own frame": lambda: [OwnFrame()],
    "noise": lambda: [PositionNoise(scale=1.0)],
    "own frame and the others": lambda: [OwnFrame(), Fading(), OutOfView(), Averaging()],
    "own frame, others displaced": lambda: [OwnFrame(), Displaced("scales", "quats")],
    "noise, others displaced": lambda: [PositionNoise(scale=1.0), Displaced("scales", "quats")],
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    "options",
    [{}, {"weight_decay": 0.01, "decoupled_weight_decay": True}, {"fused": True}],
    ids=str,
)
def test_the_order_of_the_groups_changes_no_bit(
    parts: str, masked: bool, options: dict[str, Any]
) -> None:
    if options.get("decoupled_weight_decay") and "decoupled_weight_decay" not in (
        torch.optim.Adam([torch.zeros(1)]).defaults
    ):
        pytest.skip("this torch has no decoupled weight decay in Adam")
    ends = [trained(order, PARTS[parts], masked=masked, **options) for order in ORDERS]
    for end in ends[1:]:
        for name, value in end.items():
            # Noise is drawn in one group only, and so alike.
            assert torch.equal(value, ends[0][name]), name


@pytest.mark.parametrize(("reader", "read"), list(itertools.permutations(["means", "scales"])))
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("reads_first", [False, True])
def test_a_hook_finds_the_trainers_tensors_and_gradients(
    reader: str, read: str, masked: bool, reads_first: bool
) -> None:
    seen = list[Any]()

    class Reads(Part):
        names = (reader,)

        def before(self, group: Any, param: Any, grad: Any, state: Any, course: Any) -> Any:
            found = course.gaussians_of(param)[read]
            seen.append((found, found.detach().clone(), found.grad.clone()))
            return grad

    splats = make_splats(ROWS)
    phases = PhaseScheduler(100, parts=[Displaced("means", "scales"), OwnFrame(), Reads()])
    others = [name for name in INRIA_NAMES if name not in (reader, read)]
    two = (reader, read) if reads_first else (read, reader)
    adam: Any = phases.upgrade(in_order(splats, (*two, *others)))
    for i in range(3):
        give_gradients(splats, i)
        value, grad = splats[read].detach().clone(), torch.as_tensor(splats[read].grad).clone()
        phases.observe(0.1, iteration=i)
        adam.step(torch.arange(ROWS) % 2 == 0) if masked else adam.step()
        found, as_found, its_grad = seen[-1]
        assert found is splats[read]
        assert torch.equal(as_found, value)
        assert torch.equal(its_grad, grad)
        assert torch.equal(torch.as_tensor(splats[read].grad), grad)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("replaced", ["scales", "quats", "opacities", "sh0"])
@pytest.mark.parametrize("parts", ["own frame", "noise", "own frame and the others"])
def test_a_group_that_another_optimizer_replaces_is_found(replaced: str, parts: str) -> None:
    ends = []
    for exchange in (False, True):
        torch.manual_seed(0)
        splats = make_splats(ROWS)
        phases = PhaseScheduler(100, parts=PARTS[parts]())
        adams: Any = phases.upgrade(gsplat_optimizers(splats))
        for i in range(6):
            if exchange and i == 3:
                adams[replaced].param_groups[0] = {**adams[replaced].param_groups[0]}
            give_gradients(splats, i)
            phases.observe(0.1)
            for adam in adams.values():
                adam.step()
        assert float(adams["means"].state[splats["means"]]["step"]) == 6
        ends.append({name: param.detach() for name, param in splats.items()})
    for name, value in ends[0].items():
        assert torch.equal(value, ends[1][name]), name


@pytest.mark.parametrize("hook", ["before", "factor", "ready"])
@pytest.mark.parametrize("make", [inria_optimizer, gsplat_optimizers])
@pytest.mark.filterwarnings("ignore:.*of means begin anew")
def test_a_step_that_a_hook_refuses_changes_nothing(hook: str, make: Any) -> None:
    """Not even whose units the moments of a group before are in."""

    class Refuses(Part):
        names = ("quats",)
        angry = True

        def ready(self, group: Any, course: Any) -> bool:
            return self._said("ready", True)

        def before(self, group: Any, param: Any, grad: Any, state: Any, course: Any) -> Any:
            return self._said("before", grad)

        def factor(self, group: Any, course: Any) -> Any:
            return self._said("factor", 1.0)

        def _said(self, name: str, value: Any) -> Any:
            if self.angry and name == hook:
                raise RuntimeError("no")
            return value

    part, ends = Refuses(), []
    for refused in (False, True):
        splats = make_splats(ROWS)
        adams = make(splats)
        every = list(adams.values()) if isinstance(adams, dict) else [adams]
        for i in range(3):  # the trainer's own moments
            give_gradients(splats, i)
            for adam in every:
                adam.step()
        phases = PhaseScheduler(100, parts=[OwnFrame(), part])
        phases.upgrade(adams)
        give_gradients(splats, 3)
        phases.observe(0.1, iteration=3)
        if refused:
            part.angry = True
            holder = next(
                adam
                for adam in every
                if any(splats["quats"] is each for each in adam.param_groups[-1]["params"])
                or len(every) == 1
            )
            before = {
                name: {key: value.clone() for key, value in holder.state[param].items()}
                for name, param in splats.items()
                if param in holder.state
            }
            with pytest.raises(RuntimeError, match="no"):
                holder.step()
            for name, kept in before.items():
                for key, value in kept.items():
                    assert torch.equal(holder.state[splats[name]][key], value), (name, key)
        part.angry = False
        for i in range(3, 6):
            give_gradients(splats, i)
            phases.observe(0.1, iteration=i)
            for adam in every:
                adam.step()
        ends.append({name: param.detach() for name, param in splats.items()})
    for name, value in ends[0].items():
        assert torch.equal(value, ends[1][name]), name
