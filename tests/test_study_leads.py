"""Same-view curvature pairs and the matrix of second moments, against what they must equal."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from splatting.arms import ALL_OFF
from splatting.density import MCMCDensityControl
from splatting.fit import FitOptions
from splatting.scenes import load_scene
from study.arms import find_study_arm
from study.fitting import StudyFit
from study.full_matrix import SECOND_MOMENT, FullMatrixAdam, packed, unpacked, whitened
from study.view_pairs import VISITS, SameViewAdam
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import PhaseScheduler
from opt3dgs_optim._history import stored_pairs
from opt3dgs_optim.lqnadam import CurvatureOptions

POINTS = 7
_embedded = cache(lambda: load_scene("embedded"))  # seconds to make


def _fit(arm: str, host: dict[str, object] | None = None) -> StudyFit:
    found = find_study_arm(arm)
    found = found if host is None else replace(found, host=host)
    return StudyFit(_embedded(), found, FitOptions(40, 40))


# -- same-view pairs -------------------------------------------------------------------------------


def _hessians(views: int) -> Tensor:
    """Of every view and point, [views, POINTS, 3, 3], positive definite, all different."""
    root = torch.randn(views, POINTS, 3, 3, generator=torch.Generator().manual_seed(3))
    return root @ root.mT + 0.1 * torch.eye(3)


class _Views:
    """Quadratic losses, one per view, whose minima lie far apart: y is mostly view difference."""

    def __init__(self, views: int, size: int = 5) -> None:
        draws = torch.Generator().manual_seed(4)
        self.hessians = _hessians(views)
        self.minima = torch.randn(views, POINTS, 3, generator=draws)
        self.means = Parameter(torch.randn(POINTS, 3, generator=draws))
        options = ALL_OFF | {"noise_scale": 0.0, "curvature": CurvatureOptions(size)}
        self.phases = PhaseScheduler(1000, 0, **options)
        adam = torch.optim.Adam([{"params": self.means, "lr": 0.01, "name": "means"}], eps=1e-15)
        upgraded = self.phases.upgrade({"means": adam})["means"]
        self.optimizer = SameViewAdam.of(upgraded, views)

    def gradient(self, view: int) -> Tensor:
        away = self.means.detach() - self.minima[view]
        return (self.hessians[view] @ away[:, :, None]).squeeze(2)

    def step(self, view: int, hidden: int | None = None) -> None:
        gradient = self.gradient(view)
        if hidden is not None:
            gradient[hidden] = 0.0
        self.means.grad, self.optimizer.view = gradient, view
        self.phases.observe(1.0, view=view)
        self.optimizer.step()

    def pairs(self) -> tuple[Tensor, Tensor]:
        """s and y, [K, POINTS, 3], newest first; zero where there is none."""
        history = self.optimizer.state[self.means]["history"]
        s, y = stored_pairs(history, self.optimizer.curvature_options.history_size)
        return s.transpose(1, 2), y.transpose(1, 2)

    def count(self) -> list[float]:
        return self.pairs()[1].norm(dim=2).sum(dim=0).round().tolist()  # each y has length 1


def test_pairs_hold_one_views_curvature() -> None:
    toy = _Views(3)
    order = [0, 1, 2, 1, 2, 0, 2, 1]
    for view in order:
        toy.step(view)
    s, y = toy.pairs()
    for slot, view in enumerate(reversed(order[3:])):  # the first visits make no pair
        # y is a difference of gradients of size 1 to 10, rounded, over one of some 0.1.
        wanted = (toy.hessians[view] @ s[slot][:, :, None]).squeeze(2)
        torch.testing.assert_close(y[slot], wanted, rtol=1e-3, atol=1e-3)
    assert toy.count() == [5.0] * POINTS
    assert toy.optimizer.accepted_share == 1.0


def test_a_first_visit_makes_no_pair_and_steps_as_adam() -> None:
    toy = _Views(4)
    adam_means = Parameter(toy.means.detach().clone())
    adam = torch.optim.Adam([adam_means], lr=0.01, eps=1e-15)
    for view in range(4):
        adam_means.grad = toy.gradient(view)
        toy.step(view)
        adam.step()
        assert toy.phases.accepted_share == 0.0
    assert torch.equal(toy.means, adam_means)
    toy.step(0)
    assert toy.phases.accepted_share == 1.0


def test_a_point_that_a_view_misses_keeps_its_visit_before() -> None:
    toy = _Views(2)
    toy.step(0)
    first = toy.optimizer.state[toy.means][VISITS][:, 0].clone()
    for view in (1, 0, 1):
        toy.step(view, hidden=2 if view == 0 else None)
    assert toy.count() == [2.0, 2.0, 1.0] + [2.0] * (POINTS - 3)
    visits = toy.optimizer.state[toy.means][VISITS]
    same = (visits[:, 0] == first).all(dim=1)
    assert same.tolist() == [row == 2 for row in range(POINTS)]
    toy.step(0)
    s, y = toy.pairs()
    # Against the visit of three steps ago, at which the point was seen.
    torch.testing.assert_close(y[0, 2], toy.hessians[0, 2] @ s[0, 2], rtol=1e-3, atol=1e-3)


def test_visits_are_dropped_where_rows_may_have_moved() -> None:
    toy = _Views(2)
    for view in (0, 1, 0, 1):
        toy.step(view)
    assert toy.count() == [2.0] * POINTS
    toy.optimizer.reset_points(torch.tensor([1]))
    toy.step(0)
    assert toy.phases.accepted_share == 0.0
    assert toy.count() == [2.0, 0.0] + [2.0] * (POINTS - 2)  # the others' pairs stay

    # As density control does: another object, the state edited along.
    state = toy.optimizer.state.pop(toy.means)
    grown = Parameter(torch.cat([toy.means.detach(), torch.ones(1, 3)]))
    edited = {k: v if k == "step" else torch.cat([v, v[:1] * 0]) for k, v in state.items()}
    toy.optimizer.state[grown] = edited
    toy.optimizer.param_groups[0]["params"] = [grown]
    assert VISITS not in toy.optimizer.state_dict()["state"][0]
    grown.grad = torch.ones(POINTS + 1, 3)
    toy.optimizer.view = 1
    toy.phases.observe(1.0)
    toy.optimizer.step()
    visits = toy.optimizer.state[grown][VISITS]
    assert visits.shape == (POINTS + 1, 2, 6)
    assert not visits[:, 0].any()
    assert toy.phases.accepted_share == 0.0


def test_pairs_and_visits_can_be_freed() -> None:
    toy = _Views(2)
    toy.step(0)
    toy.phases.drop_pairs()
    assert toy.optimizer.state[toy.means].keys() == {"step", "exp_avg", "exp_avg_sq"}


def test_visits_travel_in_checkpoints() -> None:
    whole, resumed = _Views(2), _Views(2)
    for view in (0, 1, 1):
        whole.step(view)
    saved = copy.deepcopy(whole.optimizer.state_dict())
    with torch.no_grad():
        resumed.means.copy_(whole.means)
    resumed.optimizer.load_state_dict(saved)
    for toy in (whole, resumed):
        toy.step(0)
        toy.step(1)
    assert torch.equal(whole.means, resumed.means)
    assert whole.count() == resumed.count() == [3.0] * POINTS


def test_only_a_schedulers_optimizer_takes_same_view_pairs() -> None:
    with pytest.raises(TypeError, match="Adam is no PhasedAdam"):
        SameViewAdam.of(torch.optim.Adam([Parameter(torch.ones(2, 3))]), 2)


# -- the matrix of second moments ------------------------------------------------------------------


def _stream(steps: int = 30) -> Tensor:
    """Gradients of correlated coordinates, [steps, POINTS, 3], float64."""
    draws = torch.Generator().manual_seed(8)
    mixing = torch.randn(POINTS, 3, 3, generator=draws, dtype=torch.float64)
    white = torch.randn(steps, POINTS, 3, 1, generator=draws, dtype=torch.float64)
    return (mixing @ white).squeeze(3)


def _walk(optimizer: torch.optim.Optimizer, param: Parameter, gradients: Tensor) -> Tensor:
    for gradient in gradients:
        param.grad = gradient.to(param.dtype)
        optimizer.step()
    return param.detach()


def _start(dtype: torch.dtype = torch.float64) -> Parameter:
    return Parameter(torch.zeros(POINTS, 3, dtype=dtype))


def test_a_step_turns_with_the_axes() -> None:
    rotation = torch.linalg.qr(_stream(1)[0, :3]).Q
    ours, turned, adam, adam_turned = (_start() for _ in range(4))
    path = _walk(FullMatrixAdam([ours], lr=0.1), ours, _stream())
    other = _walk(FullMatrixAdam([turned], lr=0.1), turned, _stream() @ rotation.mT)
    torch.testing.assert_close(other, path @ rotation.mT, rtol=1e-9, atol=1e-9)
    # Adam's does not, so the test can tell.
    path = _walk(torch.optim.Adam([adam], lr=0.1), adam, _stream())
    other = _walk(torch.optim.Adam([adam_turned], lr=0.1), adam_turned, _stream() @ rotation.mT)
    assert (other - path @ rotation.mT).abs().max() > 0.01


def test_a_diagonal_second_moment_is_adam() -> None:
    axis = torch.nn.functional.one_hot(torch.arange(30) % 3, 3)[:, None]
    along = _stream() * axis  # one coordinate at a time: g g^T has no other entries
    ours, adam = _start(), _start()
    optimizer = FullMatrixAdam([ours], lr=0.1, floor=1e-9)
    wanted = _walk(torch.optim.Adam([adam], lr=0.1), adam, along)
    torch.testing.assert_close(_walk(optimizer, ours, along), wanted, rtol=1e-9, atol=1e-9)


def test_two_steps_by_hand() -> None:
    param = _start()
    first, second = _stream(2)
    _walk(FullMatrixAdam([param], lr=0.1, betas=(0.5, 0.75), floor=0.01), param, _stream(2)[:1])
    # One gradient: V = g g^T, and along its only eigenvector m / sqrt(V) is of length one.
    torch.testing.assert_close(
        param.detach(), -0.1 * torch.nn.functional.normalize(first, dim=1), rtol=1e-6, atol=0.0
    )
    param = _start()
    optimizer = FullMatrixAdam([param], lr=0.1, betas=(0.5, 0.75), floor=0.01)
    _walk(optimizer, param, first[None])
    before = param.detach().clone()
    _walk(optimizer, param, second[None])
    for row in range(POINTS):
        outer = [torch.outer(g[row], g[row]) for g in (first, second)]
        moment = (0.25 * 0.75 * outer[0] + 0.25 * outer[1]) / (1 - 0.75**2)
        mean = (0.25 * first[row] + 0.5 * second[row]) / (1 - 0.5**2)
        values, vectors = torch.linalg.eigh(moment)
        roots = values.clamp(min=0.01 * float(values.max())).sqrt()
        wanted = -0.1 * vectors @ ((vectors.T @ mean) / roots)
        torch.testing.assert_close(param[row] - before[row], wanted, rtol=1e-6, atol=1e-9)


def test_the_state_of_an_adam_is_taken_over() -> None:
    adam_param, param = _start(), _start()
    adam = torch.optim.Adam([{"params": adam_param, "lr": 0.1, "name": "means"}], eps=1e-15)
    _walk(adam, adam_param, _stream())
    ours = FullMatrixAdam([{"params": param, "lr": 0.5, "name": "means"}], floor=1e-9)
    ours.load_state_dict(copy.deepcopy(adam.state_dict()))
    state = ours.state[param]
    assert state.keys() == {"step", "exp_avg", SECOND_MOMENT}
    wanted = torch.diag_embed(adam.state[adam_param]["exp_avg_sq"])
    assert torch.equal(unpacked(state[SECOND_MOMENT], 3), wanted)
    group = ours.param_groups[0]
    assert (group["lr"], group["eps"], group["floor"]) == (0.1, 1e-15, 1e-9)
    # A gradient of zero leaves it diagonal: the next step is Adam's.
    with torch.no_grad():
        param.copy_(adam_param)
    nothing = torch.zeros(1, POINTS, 3)
    torch.testing.assert_close(
        _walk(ours, param, nothing), _walk(adam, adam_param, nothing), rtol=1e-9, atol=1e-12
    )
    again = FullMatrixAdam([{"params": _start(), "lr": 0.1, "name": "means"}])
    again.load_state_dict(copy.deepcopy(ours.state_dict()))
    (copied,) = again.state.values()
    assert torch.equal(copied[SECOND_MOMENT], ours.state[param][SECOND_MOMENT])


def test_gradients_that_hold_no_matrix() -> None:
    zero = torch.zeros(5, POINTS, 3)
    param = _start(torch.float32)
    assert not _walk(FullMatrixAdam([param], eps=1e-15), param, zero).any()

    # Always along one line: the other two eigenvalues are zero, and rounding decides them.
    direction = torch.nn.functional.normalize(_stream(1)[0], dim=1)
    line = direction * torch.linspace(1e-7, 3e-7, 200)[:, None, None]
    moved = _walk(FullMatrixAdam([param], lr=0.1, eps=1e-15), param, line)
    along = -(moved * direction).sum(dim=1)
    assert (along > 0.5 * 0.1 * 200).all()  # nearly one learning rate in each step
    across = moved + along[:, None] * direction
    # float32 leaves 1e-7 of the mean across the line; the floor of 1e-3 makes that 32 times more.
    assert across.norm(dim=1).max() < 1e-4 * float(along.max())

    tiny, huge, broken = 1e-30, 1e25, float("nan")
    rows = torch.tensor([tiny, huge, broken, 1.0, 1.0, 1.0, 1.0])[:, None].expand(POINTS, 3)
    before = param.detach().clone()
    after = _walk(FullMatrixAdam([param], lr=0.1, eps=1e-15), param, rows[None])
    assert torch.isfinite(after).all()
    assert torch.equal(after[1:3], before[1:3])  # their squares are not finite
    assert (after[3:] != before[3:]).all()


def test_parameters_without_gradients_or_points_stay() -> None:
    still, none = _start(), Parameter(torch.zeros(0, 3))
    none.grad = torch.zeros(0, 3)
    optimizer = FullMatrixAdam([still, none])
    optimizer.step()
    assert not still.any()
    assert not optimizer.state


def test_the_floor_bounds_a_step_across() -> None:
    moment = torch.diag(torch.tensor([4.0, 1e-9, 0.0]))[None]
    vectors = torch.tensor([[2.0, 0.02, 0.03]])
    # Roots 2, and sqrt(0.0025 * 4) = 0.1 for the others.
    wanted = torch.tensor([[1.0, 0.2, 0.3]])
    torch.testing.assert_close(whitened(vectors, moment, 0.0025, 0.0), wanted)


def test_packing_keeps_a_symmetric_matrix() -> None:
    matrices = torch.randn(4, 3, 3)
    matrices = matrices + matrices.mT
    assert packed(matrices).shape == (4, 6)
    assert torch.equal(unpacked(packed(matrices), 3), matrices)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"floor": 0.0}, r"floor=0.0, but a number in \(0, 1\]"),
        ({"lr": -1.0}, "lr=-1.0, but a number from 0 on"),
        ({"betas": (0.9, 1.0)}, r"betas=\(0.9, 1.0\), but numbers in"),
    ],
)
def test_bad_options_say_what_is_allowed(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FullMatrixAdam([_start()], **options)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"shapes \[\(3,\)\], but \[N, D\]"):
        FullMatrixAdam([Parameter(torch.zeros(3))])


# -- in the trainer --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["l1+reset+lqn-view@1/4", "l2+reset+lqn-view@1/4", "matrix@1/10"])
def test_the_last_phase_goes_on_from_stock_training(tmp_path: Path, name: str) -> None:
    trunk, branch = _fit("mcmc"), _fit(name)
    trunk.iteration = round(find_study_arm(name).switch * trunk.options.iterations) - 1
    trunk.step()
    trunk.save(tmp_path / "at.pt")
    branch.load(tmp_path / "at.pt", "mcmc")
    for fit in (trunk, branch):
        fit.step()
    means = branch.optimizers["means"]
    state = means.state[branch.gaussians["means"]]
    if name.startswith("matrix"):
        assert isinstance(means, FullMatrixAdam)
        assert float(state["step"]) == 2.0  # nothing was reset
        assert not torch.equal(branch.gaussians["means"], trunk.gaussians["means"])
        for key in ("scales", "sh0"):
            assert torch.equal(branch.gaussians[key], trunk.gaussians[key]), key
    else:
        assert isinstance(means, SameViewAdam)
        visited = state[VISITS].any(dim=2).any(dim=0)
        assert visited.nonzero().flatten().tolist() == [means.view]
        assert branch.phases is not None
        assert branch.phases.squared_loss == name.startswith("l2")


@pytest.mark.parametrize("name", ["l1+reset+lqn-view@1/4", "matrix"])
def test_rows_that_density_control_edits(name: str) -> None:
    fit = _fit(name)
    fit.iteration = 30
    if fit.phases is not None:
        fit.phases.load_state_dict({"iteration": 30, "num_observed": 30, "multiplier": None})
    for _ in range(2):
        fit.step()
    with torch.no_grad():
        fit.gaussians["opacities"][:5] = -8.0
    control = MCMCDensityControl(60, 0, 10, 1)
    control.step(1, fit.gaussians, fit.optimizers)
    rows = len(fit.gaussians["means"])
    assert rows > 40
    view = int(getattr(fit.optimizers["means"], "view", 0))
    fit.step()
    state = fit.optimizers["means"].state[fit.gaussians["means"]]
    assert all(value.shape[0] == rows for key, value in state.items() if key != "step")
    assert torch.isfinite(fit.gaussians["means"]).all()
    if VISITS in state:
        assert not state[VISITS][:, view].any()  # those of before the edit are gone


@pytest.mark.parametrize(
    ("name", "host", "message"),
    [
        ("mcmc", {"same_view": True}, "same_view=True, but it has no curvature"),
        ("faded", {"same_view": True}, "same_view=True, but it has no curvature"),
        ("faded", {"matrix": 1e-3}, "matrix=0.001, but its positions are stepped by the scheduler"),
        ("mcmc", {"matrix": 2.0}, "floor=2.0, but a number in"),
    ],
)
def test_arms_that_cannot_be(name: str, host: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _fit(name, host)
