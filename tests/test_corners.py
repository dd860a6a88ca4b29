"""Corners of the public classes that no other test walks into."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam
from opt3dgs_optim.checks import check_interval, warn_user


def point() -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.ones(2, 3))


@pytest.mark.parametrize("cls", [AWSGLD, LQNAdam])
def test_named_parameters_and_groups(cls: Any) -> None:
    """torch 2.6 and later take (name, parameter) pairs."""
    x, y = point(), point()
    kinds: list[Any] = [[("a", x)], [{"params": [y], "lr": 0.1}]]
    optimizer: Any
    for params in kinds:
        options: Any = {"histogram": EnergyHistogram.paper(warmup=0)} if cls is AWSGLD else {}
        optimizer = cls(params, lr=0.01, **options)
        if cls is AWSGLD:
            optimizer.histogram.observe(0.1)
        for group in optimizer.param_groups:
            for param in group["params"]:
                param.grad = torch.ones(2, 3)
        optimizer.step()
    assert float(x.detach().max()) == pytest.approx(0.99)
    assert float(y.detach().max()) == pytest.approx(0.9)


@pytest.mark.parametrize("cls", [AWSGLD, LQNAdam])
def test_a_parameter_without_gradient_is_left_alone(cls: Any) -> None:
    x, y = point(), point()
    optimizer = cls([x, y], lr=0.01)
    x.grad = torch.ones(2, 3)
    optimizer.step()
    assert torch.equal(y, torch.ones(2, 3))
    assert not optimizer.state[y] if y in optimizer.state else True


def test_an_interval_of_no_numbers() -> None:
    with pytest.raises(ValueError, match=r"call: option\[1\]='b'"):
        check_interval("call", "option", (0.0, "b"))


@pytest.mark.parametrize("value", [0.5, "wide", (0.0,), (1.0, 0.0), (0.0, float("inf"))])
def test_an_interval_that_is_none(value: Any) -> None:
    with pytest.raises(ValueError, match="call: option"):
        check_interval("call", "option", value)
    assert check_interval("call", "option", [0, 1]) == (0.0, 1.0)


def test_a_warning_is_at_the_line_of_whoever_called() -> None:
    with pytest.warns(UserWarning, match="mind this") as told:
        warn_user("mind this")
    assert told[0].filename == __file__
