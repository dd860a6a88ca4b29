"""Corners of the public classes that no other test walks into."""

from __future__ import annotations

import copy
import io
import pickle
from typing import Any

import pytest
import torch
from opt3dgs_optim._checks import check_interval
from opt3dgs_optim._running import ViewMeans
from opt3dgs_optim.multiplier import ConstantMultiplier

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam, PhaseScheduler


def point() -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.ones(2, 3))


def test_what_they_are_is_readable() -> None:
    histogram = EnergyHistogram(20, (0.0, 1.0), temperature=0.1, warmup=3)
    histogram.observe(0.5)
    said = repr(histogram)
    for part in ("num_partitions=20", "(0.0, 1.0)", "temperature=0.1", "warmup=3", "observed=1"):
        assert part in said
    assert "switch_step=5" in repr(PhaseScheduler(10, 5))
    assert "curvature=None" in repr(PhaseScheduler(10, 5, curvature=None))


def test_a_constant_multiplier_says_what_it_is() -> None:
    control = ConstantMultiplier(2.5, warmup=2)
    assert float(control.mean_multiplier) == 2.5
    assert [float(control.observe(0.1)) for _ in range(4)] == [1.0, 1.0, 2.5, 2.5]
    assert not bool(control.observe(float("nan")) and control.last_finite)


def test_the_state_of_the_histogram_lives_where_the_energy_does() -> None:
    """On a device without data (meta): nothing is read back to the host."""
    histogram = EnergyHistogram(warmup=8)
    nu = torch.ones(())
    for _ in range(12):
        nu = histogram.observe(torch.zeros((), device="meta"))
    assert nu.device.type == "meta"
    assert histogram.weights.device.type == "meta"
    assert histogram.last_finite.device.type == "meta"


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


@pytest.mark.parametrize("cls", [AWSGLD, LQNAdam])
@pytest.mark.parametrize("how", ["deepcopy", "pickle", "torch.save"])
def test_copies_go_on_alike(cls: Any, how: str) -> None:
    x = point()
    optimizer = cls([x], lr=0.01)
    for k in range(4):
        x.grad = x.detach() * torch.tensor([1.0, 4.0, 9.0]) + k
        x.grad[1] = float("nan") if k == 1 else 1.0
        optimizer.step()
    if how == "deepcopy":
        twin = copy.deepcopy(optimizer)
    elif how == "pickle":
        twin = pickle.loads(pickle.dumps(optimizer))
    else:
        torch.save(optimizer, buffer := io.BytesIO())
        buffer.seek(0)
        twin = torch.load(buffer, weights_only=False)
    assert int(twin.skipped_rows) == 1
    y = twin.param_groups[0]["params"][0]
    for param, each in ((x, optimizer), (y, twin)):
        param.grad = param.detach() * 2
        each.step()
    assert torch.equal(x, y)


def test_a_table_of_views_grows() -> None:
    views = ViewMeans(0.9, torch.float64, torch.device("cpu"))
    yes = torch.tensor(True)
    for view in range(150):
        value = torch.tensor(float(view), dtype=torch.float64)
        assert float(views.update(view, value, yes)) == view
    assert len(views.state()["views"]) == 150
    no = views.update("new", torch.tensor(3.0, dtype=torch.float64), torch.tensor(False))
    assert float(no) == 3.0  # no mean yet: the value itself


def test_an_interval_of_no_numbers() -> None:
    with pytest.raises(ValueError, match=r"call: option\[1\]='b'"):
        check_interval("call", "option", (0.0, "b"))


def test_an_optimizer_steps_with_a_tensor_learning_rate_and_nu() -> None:
    x, y = point(), point()
    for param, lr in ((x, 0.01), (y, torch.tensor(0.01))):
        optimizer = AWSGLD([param], lr=lr, histogram=ConstantMultiplier(3.0), fused=True)  # pyright: ignore[reportArgumentType]
        for _ in range(3):
            optimizer.histogram.observe(0.1)  # pyright: ignore[reportOptionalMemberAccess]
            param.grad = torch.ones(2, 3)
            optimizer.step()
    torch.testing.assert_close(x, y)
    assert float(x.detach().max()) == pytest.approx(1 - 0.09)


def test_powell_damping_needs_a_model() -> None:
    """Before the first pair there is no curvature to damp towards: such a pair is rejected."""
    x = torch.nn.Parameter(torch.ones(4, 3))
    optimizer = LQNAdam([x], lr=0.01, powell=True)
    start = x.detach().clone()
    for _ in range(5):  # a concave function: s.y < 0
        x.grad = 1.0 - (x.detach() - start)
        optimizer.step()
        assert float(optimizer.accepted_share or 0.0) == 0.0
