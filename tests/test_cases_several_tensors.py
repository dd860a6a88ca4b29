"""Several tensors in one group: each is treated as it is where it is alone.

graphdeco-inria/gaussian-splatting #1066; drivestudio has several sets of Gaussians in one
optimizer.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from placed_training import ARMS
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import Kept, Part, PhaseScheduler

TOTAL, SWITCH, ROWS = 90, 60, 20
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (1,)}
RATES = {"means": 1e-2, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2}
# Parts that draw numbers draw them for one set of Gaussians after the other.
NOT_ALONE = ("PositionNoise", "IsotropicNoise", "everything")
ALONE = [arm for arm in ARMS if arm not in NOT_ALONE]


class Sets:
    """Sets of Gaussians, all in one optimizer's groups."""

    def __init__(self, arm: str, numbers: list[int]) -> None:
        self.numbers = numbers
        draws = [torch.Generator().manual_seed(number) for number in numbers]
        self.params = {
            name: [
                Parameter(torch.randn(ROWS, *shape, generator=draw, dtype=torch.float32))
                for draw in draws
            ]
            for name, shape in SHAPES.items()
        }
        self.phases = PhaseScheduler(TOTAL, SWITCH, list(ARMS[arm](None)))
        self.adam: Any = self.phases.upgrade(
            torch.optim.Adam(
                [
                    {"params": params, "lr": RATES[name], "name": name}
                    for name, params in self.params.items()
                ],
                eps=1e-15,
            )
        )

    def run(self) -> Sets:
        draw = torch.Generator().manual_seed(0)
        for _ in range(TOTAL):
            views = torch.rand(4, ROWS, generator=draw) < 0.2  # of each set that may be there
            for params in self.params.values():
                for number, param in zip(self.numbers, params, strict=True):
                    seen = views[number].reshape(-1, 1)
                    param.grad = torch.where(seen, param.detach() - number, 0.0)
            self.phases.observe(0.1 + 0.01 * float(torch.rand((), generator=draw)))
            self.adam.step()
        return self

    def values(self, at: int) -> dict[str, Tensor]:
        return {name: params[at].detach().clone() for name, params in self.params.items()}

    def moments(self, at: int) -> dict[str, Tensor]:
        keys = ("step", "exp_avg", "exp_avg_sq")
        states = {name: self.adam.state[params[at]] for name, params in self.params.items()}
        return {f"{n}.{key}": state[key].clone() for n, state in states.items() for key in keys}


@pytest.mark.parametrize("arm", ALONE)
@pytest.mark.parametrize("numbers", [[0, 1], [2, 1, 0]])
def test_each_set_goes_where_it_goes_alone(arm: str, numbers: list[int]) -> None:
    together = Sets(arm, numbers).run()
    for at, number in enumerate(numbers):
        alone = Sets(arm, [number]).run()
        for found, expected in (
            (together.values(at), alone.values(0)),
            (together.moments(at), alone.moments(0)),
        ):
            unlike = [key for key in found if not torch.equal(found[key], expected[key])]
            assert unlike == [], f"set {at} of {numbers}"


class Counted(Part):
    """How many steps each parameter has made."""

    keeps = (Kept("steps", per="parameter"),)

    def after(self, group: Any, param: Tensor, state: Any, course: Any) -> None:
        state["steps"] += 1


@pytest.mark.parametrize(
    ("then", "expected"),
    [
        ("ab", [8, 8]),
        ("ba", [8, 8]),
        ("bc", [8, 3]),  # a has left, and c is new
        ("ca", [3, 8]),
        ("cb", [8, 8]),  # c stands where a stood
        ("cd", [8, 8]),  # density control has replaced both
        ("abc", [8, 8, 3]),
        ("b", [8]),
        ("c", [3]),  # nobody knows whose place it is
    ],
)
def test_what_is_kept_goes_with_a_parameter_that_stays(then: str, expected: list[int]) -> None:
    every = {name: Parameter(torch.zeros(4, 3)) for name in "abcd"}
    adam: Any = torch.optim.Adam([{"params": [every[n] for n in "ab"], "name": "means"}], lr=0.01)
    phases = PhaseScheduler(TOTAL, parts=[Counted()])
    phases.upgrade(adam)
    for names, many in (("ab", 5), (then, 3)):
        adam.param_groups[0]["params"] = [every[name] for name in names]
        for _ in range(many):
            for param in every.values():
                param.grad = torch.ones_like(param)
            phases.observe(0.1)
            adam.step()
    records = adam.param_groups[0].records
    assert [int(record.numbers["Counted.steps"]) for record in records] == expected
