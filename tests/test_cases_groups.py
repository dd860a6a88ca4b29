"""The parameter groups of trainers in the field: which Gaussian parameter each holds."""

from __future__ import annotations

import itertools
import subprocess
import sys
from typing import Any

import pytest
import torch
from torch.nn import Parameter

from opt3dgs_optim import Kept, OwnFrame, Part, PhaseScheduler

# In the order of gsplat's names.
GSPLAT = ("means", "scales", "quats", "opacities", "sh0", "shN")
TRAINERS: dict[str, tuple[str, ...]] = {
    "gsplat": GSPLAT,
    "INRIA": ("xyz", "scaling", "rotation", "opacity", "f_dc", "f_rest"),
    "nerfstudio": ("means", "scales", "quats", "opacities", "features_dc", "features_rest"),
    "fVDB": ("means", "log_scales", "quats", "logit_opacities", "sh0", "shN"),
    "3DGRUT": (
        *("positions", "scale", "rotation", "density"),
        *("features_albedo", "features_specular"),
    ),
    "gaussian-splatting-lightning": (
        *("means", "scales", "rotations", "opacities", "shs_dc", "shs_rest"),
    ),
}
SHAPES = ((3,), (3,), (4,), (), (1, 3), (15, 3))
LAYOUTS = ("a dict", "named groups")


def trained(names: tuple[str, ...], layout: str, order: tuple[int, ...]) -> list[torch.Tensor]:
    """The parameters, in gsplat's order, after a short training with the defaults."""
    draw = torch.Generator().manual_seed(0)
    params = [Parameter(torch.randn(8, *shape, generator=draw)) for shape in SHAPES]
    phases = PhaseScheduler(300)
    if layout == "a dict":
        made = {names[i]: torch.optim.Adam([params[i]], lr=0.01, eps=1e-15) for i in order}
        adams = list(phases.upgrade(made).values())
    else:
        groups = [{"params": [params[i]], "name": names[i]} for i in order]
        adams = [phases.upgrade(torch.optim.Adam(groups, lr=0.01, eps=1e-15))]
    for iteration in range(260):  # until the mean share of the seen is small
        seen = torch.arange(8) % 8 == iteration % 8
        for param in params:
            rows = seen.reshape(-1, *[1] * (param.dim() - 1))
            param.grad = torch.where(rows, param.detach() - 1.0, 1e-3)
        params[0].grad = torch.where(seen[:, None], params[0].detach() - 1.0, 0.0)
        phases.observe(0.1)
        for adam in adams:
            adam.step()
    return [param.detach() for param in params]


CASES = list(itertools.product(TRAINERS, LAYOUTS))


@pytest.mark.parametrize("case", CASES)
def test_its_gaussians_are_trained_as_gsplats(case: tuple[str, str]) -> None:
    trainer, layout = case
    expected = trained(GSPLAT, layout, (0, 1, 2, 3, 4, 5))
    found = trained(TRAINERS[trainer], layout, (0, 1, 2, 3, 4, 5))
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("trainer", TRAINERS)
def test_nothing_is_left_alone(trainer: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="opt3dgs_optim")
    trained(TRAINERS[trainer], "named groups", (0, 1, 2, 3, 4, 5))
    assert "in the steps of" in caplog.text
    assert "left alone" not in caplog.text


@pytest.mark.parametrize("trainer", ["gsplat", "INRIA", "nerfstudio"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_order_of_groups_says_nothing(trainer: str, layout: str) -> None:
    """3DGRUT's and others' positions are not the first; what is out of view is known in time."""
    expected = trained(TRAINERS[trainer], layout, (0, 1, 2, 3, 4, 5))
    found = trained(TRAINERS[trainer], layout, (5, 3, 1, 0, 2, 4))
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


POSITIONS = ((3,), (4, 3), (1, 3), (2, 2, 3), ())


@pytest.mark.parametrize("shape", POSITIONS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_positions_of_any_shape(shape: tuple[int, ...], layout: str) -> None:
    """Positions over time [N, T, 3], and a lone coordinate [N]: they are stepped, or refused."""
    rows = 50
    shapes = {"means": (rows, *shape), "scales": (rows, 3), "opacities": (rows,)}
    splats = {name: Parameter(torch.rand(each)) for name, each in shapes.items()}
    phases = PhaseScheduler(300)
    if layout == "a dict":
        adams = list(phases.upgrade({n: torch.optim.Adam([p]) for n, p in splats.items()}).values())
    else:
        groups = [{"params": [p], "name": n} for n, p in splats.items()]
        adams = [phases.upgrade(torch.optim.Adam(groups))]
    for i in range(260):
        visible = torch.arange(rows) % 20 == i % 20
        for param in splats.values():
            seen = visible.reshape(-1, *[1] * (param.dim() - 1))
            param.grad = torch.where(seen, torch.ones_like(param), 0.0)
        phases.observe(0.1)
        for adam in adams:
            adam.step()
    assert all(bool(param.isfinite().all()) for param in splats.values())


UPGRADE = """
import logging, torch
from opt3dgs_optim import PhaseScheduler
{set_up}
param = torch.nn.Parameter(torch.zeros(2, 3))
PhaseScheduler(100, parts=[]).upgrade({{"means": torch.optim.Adam([param])}})
"""


@pytest.mark.processes
@pytest.mark.parametrize(
    ("set_up", "said"),
    [
        ("", True),
        ('logging.basicConfig(level="INFO")', True),
        ("logging.basicConfig()", False),
        ('logging.getLogger("opt3dgs_optim").setLevel(logging.WARNING)', False),
        ('logging.getLogger("opt3dgs_optim").disabled = True', False),
    ],
)
def test_what_was_taken_is_said_unless_somebody_asks_for_silence(set_up: str, said: bool) -> None:
    command = [sys.executable, "-c", UPGRADE.format(set_up=set_up)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ("in the steps of means" in done.stderr) == said


# -- groups that are put in another order, exchanged or removed -----------------------------------


class Memory(Part):
    """Keeps a number per parameter: how often it was stepped, of which kind."""

    keeps = (Kept("steps", per="parameter"), Kept("rows", shape=()))
    names = None

    def before(self, group, param, grad, state, course):
        state["steps"] += 1 + 100 * list(GSPLAT).index(group["gaussian"])
        state["rows"] += 1.0
        return grad


def reverse(adam: torch.optim.Adam) -> None:
    adam.param_groups.reverse()


def put_first(adam: torch.optim.Adam) -> None:
    adam.add_param_group({"params": [Parameter(torch.ones(3))], "name": "pose"})
    adam.param_groups.insert(0, adam.param_groups.pop())


def remove(adam: torch.optim.Adam) -> None:
    adam.param_groups = [group for group in adam.param_groups if group["name"] != "f_rest"]


def exchange(adam: torch.optim.Adam) -> None:
    adam.param_groups[:] = [dict(group) for group in adam.param_groups]


def exchange_in_another_order(adam: torch.optim.Adam) -> None:
    adam.param_groups = [dict(group) for group in reversed(adam.param_groups)]


CHANGES = (reverse, put_first, remove, exchange, exchange_in_another_order)


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("frame", [False, True])
def test_what_is_kept_for_a_parameter_stays_its_own(change: Any, frame: bool) -> None:
    names = TRAINERS["INRIA"]
    params = {name: Parameter(torch.ones(8, *s)) for name, s in zip(names, SHAPES, strict=True)}
    own: list[Part] = [OwnFrame()] if frame else []
    phases = PhaseScheduler(300, parts=[Memory(), *own])
    groups = [{"params": [param], "name": name} for name, param in params.items()]
    adam: Any = phases.upgrade(torch.optim.Adam(groups))
    for i in range(6):
        if i == 3:
            change(adam)
        for param in params.values():
            param.grad = torch.ones_like(param)
        phases.observe(0.1)
        adam.step()
    for number, (name, param) in enumerate(params.items()):
        if change is remove and name == "f_rest":
            continue
        record = adam.record_of(param)
        assert record is not None
        assert record.numbers["Memory.steps"].item() == 6 * (1 + 100 * number)
        assert adam.state[param]["step"].item() == 6
        assert adam.state[param]["Memory.rows"].tolist() == 8 * [6.0]


def test_a_tensor_may_leave_its_group() -> None:
    """Poses of a camera that is not optimized any more; the others keep what is theirs."""
    poses = [Parameter(torch.zeros(6)) for _ in range(3)]
    means = Parameter(torch.ones(4, 3))
    phases = PhaseScheduler(300)
    groups = [{"params": [means], "name": "xyz"}, {"params": poses, "name": "pose"}]
    adam = phases.upgrade(torch.optim.Adam(groups))
    for i in range(6):
        if i == 3:
            adam.param_groups[1]["params"].pop(0)
        for param in (means, *poses):
            param.grad = torch.ones_like(param)
        phases.observe(0.1)
        adam.step()
    assert [adam.state[pose]["step"].item() for pose in poses] == [3, 6, 6]
    assert adam.state[means]["step"].item() == 6


def sets_of_gaussians(*names: str) -> dict[str, Parameter]:
    """Two sets of Gaussians of different sizes, by `SET#NAME`."""
    return {
        f"{one}#{name}": Parameter(torch.full((5, width), size if name == "scales" else 1.0))
        for one, size in zip(names, (-1.0, -5.0), strict=True)
        for name, width in (("means", 3), ("scales", 3), ("quats", 4))
    }


@pytest.mark.parametrize("named", [False, True], ids=["unnamed groups", "named groups"])
def test_the_key_says_which_set_an_optimizer_holds(named: bool) -> None:
    """Whatever its group is called: also after a load, which puts other groups in place."""
    params = sets_of_gaussians("near", "far")
    adams = {
        key: torch.optim.Adam(
            [{"params": [param], **({"name": key.rpartition("#")[2]} if named else {})}]
        )
        for key, param in params.items()
    }
    phases = PhaseScheduler(100, parts=[OwnFrame(rate=0.1)])
    phases.upgrade(adams)
    for _ in range(2):
        for one, size in (("near", -1.0), ("far", -5.0)):
            found = phases.gaussians_of(params[f"{one}#means"])
            assert found["scales"] is params[f"{one}#scales"]
            assert found["scales"][0, 0] == size
        for adam in adams.values():
            adam.load_state_dict(adam.state_dict())


def test_a_key_goes_before_the_name_of_a_group() -> None:
    p, q = Parameter(torch.ones(4, 3)), Parameter(torch.ones(4, 3))
    adams = {
        "means": torch.optim.Adam([{"params": [p], "name": "scales"}]),
        "scales": torch.optim.Adam([{"params": [q], "name": "means"}]),
    }
    phases = PhaseScheduler(100)
    phases.upgrade(adams)
    assert phases.gaussians_of(p)["means"] is p


@pytest.mark.parametrize("another", [False, True], ids=["one leaves", "and another comes"])
def test_a_tensor_that_moves_up_in_its_group_keeps_its_own_gaussians(another: bool) -> None:
    params = sets_of_gaussians("near", "far")
    names = ("means", "scales", "quats")
    adam: Any = torch.optim.Adam(
        [{"params": [params[f"{s}#{n}"] for s in ("near", "far")], "name": n} for n in names]
    )
    phases = PhaseScheduler(100, parts=[OwnFrame(rate=0.1, final=1.0)])
    phases.upgrade(adam)

    def step() -> None:
        for group in adam.param_groups:
            for param in group["params"]:
                param.grad = torch.ones_like(param)
        phases.observe(0.1)
        adam.step()

    step()
    more = sets_of_gaussians("new", "other")
    for group in adam.param_groups:
        name = group["name"]
        del adam.state[group["params"][0]]
        group["params"] = [params[f"far#{name}"]] + ([more[f"new#{name}"]] if another else [])
    means = params["far#means"]
    assert phases.gaussians_of(means)["scales"] is params["far#scales"]
    before = means.detach().clone()
    step()
    assert float((before - means.detach()).abs().max()) == pytest.approx(
        0.1 * 2.718281828**-5, rel=0.1
    )
