"""OwnFrame: positions are stepped along each Gaussian's axes, in its standard deviations."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest
import torch
from gaussians import adam_of, adams_of, make_gaussians, parameters, same_tensors, steps
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import rotation_matrix
from row_edits import added, apply, relocated, removed
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import Fading, OwnFrame, PhaseScheduler
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.parts.own_frame import STEADY, min_aspect_of
from opt3dgs_optim.training import Training

ROWS, TOTAL = 12, 300
NAMES = ("means", "scales", "quats")
SEEDS = st.integers(0, 2**20)


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def dense_axes(quats: Tensor, scales: Tensor, least: float) -> Tensor:
    """B = R diag(s) [N, 3, 3], in float64."""
    rotation = torch.from_numpy(np.stack([rotation_matrix(q) for q in quats.double().numpy()]))
    s = scales.double().exp()
    return rotation * torch.maximum(s, least * s.amax(1, keepdim=True))[:, None, :]


def stepped(params: dict[str, Any], grad: Tensor, part: OwnFrame, count: int = 1) -> Tensor:
    """The displacement of the positions by so many equal gradients."""
    before = params["means"].detach().clone()
    optimizers = PhaseScheduler(TOTAL, parts=[part]).upgrade(adams_of(params))
    for _ in range(count):
        params["means"].grad = grad.clone()
        optimizers["means"].step()
    return params["means"].detach() - before


def test_the_first_step_is_against_the_gradient_in_the_frame() -> None:
    """By rate standard deviations along each axis: -rate B sign(B^T g)."""
    params = parameters(ROWS, *NAMES)
    quats, scales, grad = params["quats"].detach(), params["scales"].detach(), draw(7, ROWS, 3)
    dense = dense_axes(quats, scales, 0.1)
    signs = torch.einsum("nij,ni->nj", dense, grad.double()).sign()
    expected = -0.1 * torch.einsum("nij,nj->ni", dense, signs)
    moved = stepped(params, grad, OwnFrame(rate=0.1, min_aspect=0.1))
    assert torch.allclose(moved.double(), expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("moments", [32, 16])
def test_a_gaussian_out_of_view_stays_and_so_do_its_moments(moments: Any) -> None:
    """Others are stepped as if it were not there."""
    params, seen = parameters(ROWS, *NAMES), torch.arange(ROWS) % 3 != 0
    alone = {name: Parameter(each.detach()[seen].clone()) for name, each in params.items()}
    ours, theirs = (
        PhaseScheduler(TOTAL, parts=[OwnFrame()], moments=moments).upgrade(adams_of(each))
        for each in (params, alone)
    )
    stays: list[Tensor] = []
    for i in range(4):
        grad = draw(i, ROWS, 3)
        if i:
            grad[~seen] = 0.0
        params["means"].grad, alone["means"].grad = grad, grad[seen]
        ours["means"].step()
        theirs["means"].step()
        state = ours["means"].state[params["means"]]
        tensors = [params["means"].detach(), state["exp_avg"], state["exp_avg_sq"]]
        stays = stays or [each[~seen].clone() for each in tensors]
        assert all(map(torch.equal, stays, (each[~seen] for each in tensors)))
    if moments == 32:  # codes are rounded by a number's place
        assert torch.equal(params["means"][seen], alone["means"])


@settings(max_examples=20)
@given(seed=SEEDS, unit=st.sampled_from([0.01, 100.0]), turn=SEEDS)
def test_it_knows_no_unit_and_no_axes_of_the_world(seed: int, unit: float, turn: int) -> None:
    """A scene in other units, turned: every step is turned and scaled with it."""
    params = parameters(ROWS, *NAMES, seed=seed)
    q = torch.nn.functional.normalize(draw(turn, 4), dim=0)
    rotation = dense_axes(q[None], torch.zeros(1, 3), 0.0)[0].float()
    other = {name: Parameter(each.detach().clone()) for name, each in params.items()}
    other["scales"].data += math.log(unit)
    other["quats"].data = product(q, params["quats"].detach())
    grad = draw(seed + 1, ROWS, 3)
    moved = stepped(params, grad, OwnFrame(), 5)
    theirs = stepped(other, grad @ rotation.T / unit, OwnFrame(), 5)
    assert torch.allclose(theirs, unit * moved @ rotation.T, rtol=1e-2, atol=1e-4 * unit)


def product(q: Tensor, others: Tensor) -> Tensor:
    """Quaternions of a rotation after others."""
    w, u = q[0], q[1:]
    real = w * others[:, 0] - others[:, 1:] @ u
    across = torch.linalg.cross(u.expand(len(others), 3), others[:, 1:])
    imaginary = w * others[:, 1:] + others[:, :1] * u + across
    return torch.cat([real[:, None], imaginary], 1)


@pytest.mark.parametrize("width", [1, 2])
def test_flat_and_round_gaussians_step_as_those_with_three_scales(width: int) -> None:
    """2DGS has two, and its third axis none; it steps as the thinnest that there may be."""
    grad, whole, few = draw(7, ROWS, 3), parameters(ROWS, *NAMES), parameters(ROWS, *NAMES)
    for params in (whole, few):
        params["scales"].data[:, width:] = params["scales"].data[:, :1] if width == 1 else -40.0
    few["scales"] = Parameter(few["scales"].detach()[:, :width].clone())
    moved = [stepped(params, grad, OwnFrame(), 5) for params in (whole, few)]
    assert torch.equal(*moved)


def edit(params: dict[str, Any], optimizers: dict[str, Any], kind: str) -> None:
    """As density control does."""
    if kind == "prune, of that address":  # which memory that is freed gives to the next
        there = torch.from_numpy(params["means"].detach().numpy())
        params["means"] = optimizers["means"].param_groups[0]["params"][0] = Parameter(there)
        return
    last = torch.tensor([len(params["means"]) - 1])
    made = {"clone": added(last), "prune": removed(last), "relocate": relocated(last, last - 1)}
    made["prune nothing"] = removed(last[:0])
    apply(made[kind], params, optimizers.values(), list(params), inria=False)


def moved_by_a_step(params: dict[str, Any], optimizers: dict[str, Any]) -> Tensor:
    """The displacement of each Gaussian by its own first step, in x."""
    for optimizer in optimizers.values():
        optimizer.state.clear()
    before = params["means"].detach().clone()
    params["means"].grad = torch.ones_like(before)
    optimizers["means"].step()
    return (params["means"].detach() - before)[:, 0]


def test_no_axis_counts_as_longer_than_six_medians_unless_rows_are_relocated() -> None:
    """Twice in a row, until an edit moves the rows in memory. A NaN does not count."""
    params = parameters(ROWS, *NAMES)
    params["quats"].data = torch.eye(4)[:1].repeat(ROWS, 1)
    params["scales"].data.fill_(-3.0)
    params["scales"].data[:3] = torch.tensor([5.0, -2.0, math.nan])[:, None]
    optimizers = PhaseScheduler(TOTAL, parts=[OwnFrame(final=1.0)]).upgrade(adams_of(params))
    bound, own = 6 * math.exp(-3.0), math.exp(5.0)
    for kind, longest in (
        (None, bound),
        ("clone", bound),
        ("relocate", bound),
        (None, bound),
        ("relocate", own),
        (None, own),
        ("prune", bound),
        ("relocate", bound),
        ("prune nothing", bound),
        ("prune nothing", bound),
        ("relocate", bound),
        ("prune, of that address", bound),
        ("prune, of that address", bound),
    ):
        if kind is not None:
            edit(params, optimizers, kind)
        moved = moved_by_a_step(params, optimizers)
        expected = -0.1 * torch.tensor([longest, math.exp(-2.0), 0.0, math.exp(-3.0)])
        assert torch.allclose(moved[:4], expected, rtol=1e-5, atol=1e-5)  # of positions up to 30


@pytest.mark.parametrize("at", [150, 200, 201])
def test_the_longest_axis_is_found_each_hundred_iterations_in_a_resumed_training_too(
    at: int,
) -> None:
    """What was found is saved: the resumed steps are the same, though the scales have changed."""
    params, grads = parameters(ROWS, *NAMES), [draw(i, ROWS, 3) for i in range(210)]
    params["scales"].data[0] += 9.0

    def step(each: dict[str, Any], optimizers: dict[str, Any], i: int) -> Tensor:
        # Density control before the step leaves a new Parameter, without a gradient.
        each["means"].grad = None if i == 200 else grads[i].clone()
        optimizers["means"].step()
        each["scales"].data += 0.02  # a fifth more in ten iterations
        return each["means"].detach().clone()

    ours = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(adams_of(params))
    for i in range(at):
        step(params, ours, i)
    theirs = {name: Parameter(each.detach().clone()) for name, each in params.items()}
    resumed = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(adams_of(theirs))
    for name, optimizer in resumed.items():
        optimizer.load_state_dict(copy.deepcopy(ours[name].state_dict()))
    before = params["means"].detach().clone()
    for i in range(at, 210):
        assert torch.equal(step(params, ours, i), step(theirs, resumed, i))
    assert not torch.equal(before, params["means"])


@pytest.mark.parametrize(
    ("edits", "bounded"),  # by iteration
    [
        ({10: "relocate"}, True),
        ({10: "prune"}, True),
        ({20: "prune"}, True),
        ({9: "relocate", 10: "relocate"}, False),
        ({10: "relocate", 20: "relocate"}, False),
        ({9: "relocate", 10: "relocate", 20: "prune"}, True),
    ],
)
def test_a_resumed_training_has_the_bound_that_it_had(edits: dict[int, str], bounded: bool) -> None:
    """Also where the edit came after the last step before the checkpoint."""
    params, grads = parameters(ROWS, *NAMES), [draw(i, ROWS, 3) for i in range(30)]
    params["scales"].data[0] += 9.0

    def step(each: dict[str, Any], optimizers: dict[str, Any], i: int) -> Tensor:
        each["means"].grad = grads[i][: len(each["means"])].clone()
        optimizers["means"].step()
        each["scales"].data += 0.02
        return each["means"].detach().clone()

    ours = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(adams_of(params))
    for i in range(21):
        if i in edits:
            edit(params, ours, edits[i])
        if i < 20:
            step(params, ours, i)
    theirs = {name: Parameter(each.detach().clone()) for name, each in params.items()}
    resumed = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(adams_of(theirs))
    for name, optimizer in resumed.items():
        optimizer.load_state_dict(copy.deepcopy(ours[name].state_dict()))
    assert (resumed["means"].training.notes_of(OwnFrame())["steady"] < STEADY) == bounded
    for i in range(20, 30):
        assert torch.equal(step(params, ours, i), step(theirs, resumed, i))


def test_the_rate_follows_a_batch_by_its_beta() -> None:
    """gsplat has beta1 = 1 - 0.1 b for b views; a larger beta1 than 0.9 is no batch."""
    moved = {}
    for beta1 in (0.95, 0.9, 0.6):
        params = parameters(ROWS, *NAMES)
        optimizers = adams_of(params, betas=(beta1, 0.999))
        PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(optimizers)
        before = params["means"].detach().clone()
        params["means"].grad = draw(7, ROWS, 3)
        optimizers["means"].step()
        moved[beta1] = params["means"].detach() - before
    assert torch.allclose(moved[0.95], moved[0.9], rtol=1e-4, atol=1e-7)
    assert torch.allclose(moved[0.6], 2 * moved[0.9], rtol=1e-4, atol=1e-7)


def test_the_rate_decays() -> None:
    training, rates = Training([part := OwnFrame(rate=0.2, final=0.01)], 100), []
    for iteration in (0, 50, 100, 200):
        training.go_to(iteration)
        rates.append(part.at(training))
    assert rates == pytest.approx([0.2, 0.02, 0.002, 0.002])


def test_the_rate_where_no_end_is_planned() -> None:
    training, rates = Training([part := OwnFrame(rate=0.2, final=0.01)]), []
    for iteration in (0, 15_000, 15_001, 15_256, 16_024, 16_025):
        training.put_on(iteration)
        rates.append(part.at(training))
        if iteration == 15_000:
            training.plan_fall(15_001, 16_025)
    assert rates[:3] == pytest.approx([0.2, 0.025, 0.025], rel=1e-3)
    assert rates[3:] == pytest.approx([0.5 * 0.025, 0.01 * 0.025, 0.2 * 17.025**-0.75], rel=0.04)


@pytest.mark.parametrize(
    ("steps_of_run", "least"),
    [(1, 0.25), (12_000, 0.25), (15_000, 0.2), (30_000, 0.1), (100_000, 0.1), (0, 0.25)],
)
def test_thin_axes_count_for_less_in_a_long_training(steps_of_run: int, least: float) -> None:
    assert min_aspect_of(steps_of_run) == pytest.approx(least)


@pytest.mark.parametrize(("iteration", "least"), [(0, 0.25), (15_000, 0.2), (60_000, 0.1)])
def test_without_a_planned_end_thin_axes_count_by_the_iterations_so_far(
    iteration: int, least: float
) -> None:
    params = parameters(ROWS, *NAMES)
    params["means"].data.zero_()
    params["quats"].data[:] = torch.eye(4)[0]
    params["scales"].data[:] = torch.tensor([0.0, -40.0, -40.0])
    phases = PhaseScheduler(parts=[OwnFrame()])
    optimizers = phases.upgrade(adams_of(params))
    phases.observe(iteration=iteration)
    params["means"].grad = torch.ones(ROWS, 3)
    optimizers["means"].step()
    x, y, _ = params["means"].detach().unbind(1)
    torch.testing.assert_close(y / x, torch.full((ROWS,), least))


def test_moments_of_another_frame_begin_anew(caplog: pytest.LogCaptureFixture) -> None:
    """A training that begins with it in the middle, from a checkpoint of the stock trainer."""
    params = parameters(ROWS, *NAMES)
    stock = adam_of(params)
    steps({"all": stock}, params, 20)
    with caplog.at_level("INFO", "opt3dgs_optim"):
        optimizer = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(stock)
        steps({"all": optimizer}, params, 2)
    assert caplog.text.count("moments of the positions begin anew, in the own frame's units") == 1
    assert optimizer.state[params["means"]]["step"] == 2
    assert optimizer.state[params["scales"]]["step"] == 22


@pytest.mark.parametrize("missing", ["scales", "quats"])
def test_without_scales_or_quats_adam_steps_and_it_is_said_once(missing: str) -> None:
    names = [name for name in NAMES if name != missing]
    params, plain = parameters(ROWS, *names), parameters(ROWS, *names)
    optimizers = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(adams_of(params))
    with pytest.warns(
        UserWarning, match=f"OwnFrame: .*which hold .*'{missing}': None.*; Adam steps"
    ) as said:
        steps(optimizers, params, 5)
    steps(adams_of(plain), plain, 5)
    assert len(said) == 1
    assert torch.equal(params["means"], plain["means"])


@pytest.mark.parametrize("scales", [torch.zeros(ROWS + 1, 3), torch.zeros(ROWS, 3).double()])
def test_with_scales_of_other_rows_or_another_dtype_adam_steps(scales: Tensor) -> None:
    params, plain = parameters(ROWS, *NAMES), parameters(ROWS, "means")
    params["scales"] = Parameter(scales)
    optimizers = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(adams_of(params))
    with pytest.warns(UserWarning, match=r"scales \[N, 3\] .* of the same points .*; Adam steps"):
        steps(optimizers, {"means": params["means"]}, 1)
    steps(adams_of(plain), plain, 1)
    assert torch.equal(params["means"], plain["means"])


def test_two_sets_of_gaussians_in_one_adam() -> None:
    """drivestudio's names: each set has frames of its own."""
    sets = {f"{which}#{n}": p for which in "ab" for n, p in parameters(ROWS, *NAMES).items()}
    sets["b#scales"].data += 1.0
    groups = [{"params": [param], "name": name} for name, param in sets.items()]
    optimizer = PhaseScheduler(TOTAL, parts=[OwnFrame(min_aspect=0.0)]).upgrade(
        torch.optim.Adam(groups)
    )
    start = make_gaussians(ROWS)["means"]
    for name, param in sets.items():
        param.grad = torch.ones_like(param) if name.endswith("means") else None
    optimizer.step()
    ratio = (sets["b#means"] - start) / (sets["a#means"] - start)
    assert torch.allclose(ratio, torch.full_like(ratio, math.e), rtol=1e-2)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("rate", 0.0, "above 0.0"),
        ("rate", math.nan, "above 0.0"),
        ("rate", math.inf, "above 0.0"),
        ("final", 0.0, "above 0.0"),
        ("min_aspect", 1.5, r"in \[0.0, 1.0\]"),
    ],
)
def test_options_that_are_refused(name: str, value: float, allowed: str) -> None:
    said = f"OwnFrame: {name}={value}, but a finite number {allowed} is needed"
    with pytest.raises(ValueError, match=said):
        OwnFrame(**{name: value})


def test_the_defaults_are_what_it_says_of_itself() -> None:
    assert repr(OwnFrame()) == "OwnFrame(rate=0.1, final=0.03, min_aspect=None)"


def test_of_two_sets_the_one_in_own_frames_is_known_after_a_load() -> None:
    """Of the other, whose Gaussians have no quaternions, the moments are in world units."""
    shapes = {"a#means": 3, "a#scales": 3, "a#quats": 4, "b#means": 3}

    def made() -> tuple[dict[str, Any], Any]:
        torch.manual_seed(0)
        params = {name: Parameter(torch.randn(6, width)) for name, width in shapes.items()}
        groups = [{"params": [param], "name": name} for name, param in params.items()]
        return params, PhaseScheduler(60, parts=[OwnFrame()]).upgrade(Adam(groups, lr=0.01))

    params, optimizer = made()
    with pytest.warns(UserWarning, match="Adam steps them"):
        steps({"all": optimizer}, params, 10)
    others, resumed = made()
    with torch.no_grad():
        for name, param in others.items():
            param.copy_(params[name])
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    with pytest.warns(UserWarning, match="Adam steps them"):
        steps({"all": resumed}, others, 10, seed=1)
    steps({"all": optimizer}, params, 10, seed=1)
    assert all(torch.equal(params[name], others[name]) for name in params)


def test_moments_in_the_own_frame_are_not_faded() -> None:
    """A faded step would be half a standard deviation long."""
    trained = []
    for names in (GAUSSIAN, tuple(name for name in GAUSSIAN if name != "means")):
        params = parameters(ROWS)
        parts = [OwnFrame(), Fading(names=names)]
        steps(PhaseScheduler(TOTAL, parts=parts).upgrade(adams_of(params)), params, TOTAL)
        trained.append(params)
    assert same_tensors(*trained)
