"""The own frame: equivariance, limits, sizes from 1e-8 to 1e8, and what trainers do around it."""

from __future__ import annotations

import copy
import gc
import itertools
import math
import sys
import warnings
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import devices
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import Parameter
from trainers import (
    assert_same,
    edit_rows,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    train,
    upgraded,
)

from opt3dgs_optim import (
    Averaging,
    Fading,
    OwnFrame,
    Part,
    Phase,
    PhaseScheduler,
    PositionNoise,
    cuda,
)
from opt3dgs_optim.frames import LARGEST, Frames

TOTAL = 60


def rotation(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz: by the textbook, in float64."""
    w, x, y, z = torch.nn.functional.normalize(quats.double(), dim=1).unbind(1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, 1).reshape(-1, 3, 3)


def deviations(scales: Tensor, min_aspect: float = 0.0) -> Tensor:
    """Standard deviations [N, 3], none less than `min_aspect` of the longest, in float64."""
    found = scales.double().exp()
    least = min_aspect * found.amax(1, keepdim=True)
    return torch.where(found < least, least, found)


def frame(quats: Tensor, scales: Tensor, min_aspect: float = 0.0) -> Tensor:
    """B [N, 3, 3]."""
    return rotation(quats) * deviations(scales, min_aspect)[:, None, :]


@pytest.mark.parametrize("rows", [0, 1, 7, 255, 4097])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("min_aspect", [0.0, 0.1, 1.0])
def test_the_frame_is_that_of_the_covariance(
    rows: int, dtype: torch.dtype, min_aspect: float
) -> None:
    draw = torch.Generator().manual_seed(rows)
    v, quats = (torch.randn(rows, n, generator=draw, dtype=dtype) for n in (3, 4))
    scales = 3 * torch.randn(rows, 3, generator=draw, dtype=dtype)
    axes = deviations(scales, min_aspect).to(dtype)
    b, frames = frame(quats, scales, min_aspect), Frames(quats, scales, dtype, min_aspect)
    tight: dict[str, Any] = (
        {"rtol": 2e-5, "atol": 1e-5} if dtype == torch.float32 else {"rtol": 1e-12, "atol": 1e-12}
    )
    # Rounding is relative to the axis, and in the world to the longest of them.
    for found, expected, size in (
        (frames.gradient(v), torch.einsum("nij,ni->nj", b, v.double()), axes),
        (frames.displacement(v.clone()), torch.einsum("nij,nj->ni", b, v.double()), None),
    ):
        unit = scales.exp().amax(1, keepdim=True) if size is None else size
        torch.testing.assert_close(found / unit, expected.to(dtype) / unit, **tight)


def test_a_thin_axis_counts_as_a_share_of_the_longest() -> None:
    """A disc, a needle and a ball, each pulled along all of its axes: one full step."""
    sizes = torch.tensor([[1.0, 1.0, 1e-6], [1.0, 1e-6, 1e-6], [1e-3, 1e-3, 1e-3]])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1)
    for min_aspect, thin in ((0.0, 1e-6), (0.1, 0.1), (1.0, 1.0)):
        values = {"means": torch.zeros(3, 3), "scales": sizes.log(), "quats": quats.clone()}
        splats = {name: Parameter(value.double()) for name, value in values.items()}
        run(splats, pull(torch.full((3, 3), -1.0)), 1, rate=0.1, min_aspect=min_aspect)
        expected = torch.tensor([[1.0, 1.0, thin], [1.0, thin, thin], [1e-3] * 3]).double()
        torch.testing.assert_close(splats["means"].data, -0.1 * expected, rtol=1e-5, atol=0.0)


def scene(rows: int, seed: int, size: float = 1.0) -> dict[str, Parameter]:
    """Gaussians whose sizes differ by a factor of fifty, their axes by twenty."""
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(rows, *shape, generator=draw, dtype=torch.float64)

    values = {
        "means": 5.0 * size * normal(3),
        "scales": torch.log(torch.tensor(size)) + 1.3 * normal(1) + normal(3),
        "quats": normal(4),
    }
    return {name: Parameter(value) for name, value in values.items()}


def run(
    splats: dict[str, Parameter], grad_of: Any, steps: int = 20, lr: Any = 1e-3, **options: Any
) -> None:
    """Steps of the positions by the own frame; `grad_of(means, i)` is their gradient."""
    phases = only(TOTAL, OwnFrame(**options))
    adams = {n: torch.optim.Adam([p], lr=lr, eps=1e-30) for n, p in splats.items()}
    phases.upgrade(adams)
    for i in range(steps):
        splats["means"].grad = grad_of(splats["means"].detach(), i)
        phases.observe(0.1)
        adams["means"].step()


def pull(goal: Tensor) -> Any:
    return lambda means, i: means - goal + 0.1 * i


@settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 20),
    st.integers(0, 1000),
    st.floats(-8, 8),
    st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(
        lambda q: sum(x * x for x in q) > 0.1
    ),
)
def test_the_training_of_a_rotated_and_scaled_world_is_the_same(
    rows: int, seed: int, magnitude: float, turn: list[float]
) -> None:
    """A scene in millimetres or in kilometres, upright or not: no rate need be changed."""
    factor, quat = 10.0**magnitude, torch.tensor([turn], dtype=torch.float64)
    turned = rotation(quat)[0]
    one, other = scene(rows, seed), scene(rows, seed)
    other["means"].data = factor * one["means"].detach() @ turned.T
    other["scales"].data = one["scales"].detach() + torch.log(torch.tensor(factor))
    w, x, y, z = torch.nn.functional.normalize(quat, dim=1)[0]
    left = torch.stack([
        torch.stack([w, -x, -y, -z]), torch.stack([x, w, -z, y]),
        torch.stack([y, z, w, -x]), torch.stack([z, -y, x, w]),
    ])  # fmt: skip
    other["quats"].data = one["quats"].detach() @ left.T
    goal = torch.ones(3, dtype=torch.float64)
    run(one, lambda means, i: (means - goal) + 0.1 * i)
    # The gradient of the same loss in the other world's units.
    run(other, lambda means, i: ((means @ turned / factor - goal) + 0.1 * i) @ turned.T / factor)
    back = other["means"].detach() @ turned / factor
    # Adam divides by the gradient's size, so that rounding of one near zero is seen in its step.
    torch.testing.assert_close(back, one["means"].detach(), rtol=1e-4, atol=1e-4)


def test_a_ball_of_size_one_is_adam() -> None:
    splats = scene(6, 0)
    splats["scales"].data.zero_()
    splats["quats"].data = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 6, dtype=torch.float64)
    plain = Parameter(splats["means"].detach().clone())
    adam, grad_of = torch.optim.Adam([plain], eps=1e-30), pull(torch.ones(6, 3).double())
    phases_rate = OwnFrame(rate=0.1)
    for i in range(20):
        adam.param_groups[0]["lr"] = phases_rate.at(i / TOTAL)
        plain.grad = grad_of(plain.detach(), i)
        adam.step()
    run(splats, grad_of)
    torch.testing.assert_close(splats["means"].detach(), plain.detach(), rtol=1e-12, atol=1e-12)


def test_a_gradient_of_zero_moves_nothing() -> None:
    splats = scene(6, 1)
    before = splats["means"].detach().clone()
    run(splats, lambda means, i: torch.zeros_like(means))
    assert torch.equal(splats["means"], before)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("magnitude", [-8, -4, 0, 4, 8])
def test_a_step_is_a_share_of_a_standard_deviation(magnitude: int, dtype: torch.dtype) -> None:
    """From 1e-8 to 1e8; in bfloat16, whose positions have two digits, it is at least finite."""
    size = 10.0**magnitude
    splats = {
        "means": Parameter(torch.zeros(4, 3, dtype=dtype)),
        "scales": Parameter(torch.full((4, 3), size, dtype=torch.float64).log().to(dtype)),
        "quats": Parameter(torch.tensor([[1.0, 0, 0, 0]] * 4, dtype=dtype)),
    }
    run(splats, lambda means, i: torch.full_like(means, 1 / size), steps=1)
    moved = splats["means"].detach().double()
    assert bool(moved.isfinite().all())
    # A bfloat16 of log(1e8) is off by a thirtieth.
    tolerance = 0.2 if dtype == torch.bfloat16 else 1e-4
    torch.testing.assert_close(moved, torch.full_like(moved, -0.1 * size), rtol=tolerance, atol=0)


RATES = [float, partial(torch.tensor, dtype=torch.float64)]  # torch takes a rate as either


@pytest.mark.parametrize("kind", RATES)
@pytest.mark.parametrize("factor", [0.1, 0.3, 3.0, 10.0])
def test_the_trainers_rate_does_not_count(factor: float, kind: Any) -> None:
    ends = []
    for lr in (1e-3, kind(1e-3 * factor)):
        splats = scene(6, 2)
        run(splats, pull(torch.ones(6, 3).double()), lr=lr)
        ends.append(splats["means"].detach())
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kind", RATES)
def test_positions_with_a_rate_of_zero_are_held(kind: Any) -> None:
    splats = scene(6, 3)
    before = splats["means"].detach().clone()
    run(splats, pull(torch.ones(6, 3).double()), lr=kind(0.0))
    assert torch.equal(splats["means"], before)


@pytest.mark.parametrize("kind", RATES)
def test_the_smallest_rate_that_counts_is_the_smallest_normal_number(kind: Any) -> None:
    """Below it the factor would overflow: such a rate holds the positions, as 0 does."""
    rate = kind(1.0)
    least = torch.finfo(rate.dtype).tiny if isinstance(rate, torch.Tensor) else sys.float_info.min
    for lr, held in ((least, False), (least / 2, True)):
        splats = scene(6, 3)
        before = splats["means"].detach().clone()
        run(splats, pull(torch.ones(6, 3).double()), lr=kind(lr))
        moved = (splats["means"].detach() - before).abs().max()
        assert (moved < 1e-30) == held


def full() -> tuple[Part, ...]:
    return OwnFrame(), Fading(names=("scales", "opacities"), events=60), Averaging()


def test_gsplats_and_inrias_ways_agree() -> None:
    ends = []
    for make in (gsplat_optimizers, inria_optimizer):
        splats, phases, optimizers = upgraded(TOTAL, *full(), make=make)
        train(splats, optimizers, phases, 0, TOTAL)
        ends.append(splats)
    assert_same(ends[0], ends[1])


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
@pytest.mark.parametrize("at", [7, 59])
def test_a_resumed_training_is_the_same_bit_for_bit(make: Any, at: int) -> None:
    ends = []
    for cut in (False, True):
        splats, phases, optimizers = upgraded(TOTAL, *full(), make=make)
        train(splats, optimizers, phases, 0, at)
        if cut:
            every = optimizers if isinstance(optimizers, dict) else {"": optimizers}
            saved = {name: copy.deepcopy(each.state_dict()) for name, each in every.items()}
            values = {name: param.detach().clone() for name, param in splats.items()}
            splats, phases, optimizers = upgraded(TOTAL, *full(), make=make)
            for name, param in splats.items():
                param.data.copy_(values[name])
            every = optimizers if isinstance(optimizers, dict) else {"": optimizers}
            for name, each in every.items():
                each.load_state_dict(saved[name])
        train(splats, optimizers, phases, at, TOTAL)
        ends.append(splats)
    assert_same(ends[0], ends[1])


BROKEN = [
    ("scales", float("nan")),
    ("scales", float("inf")),
    ("scales", 800.0),
    ("quats", float("nan")),
]


@pytest.mark.parametrize(("name", "value"), [*BROKEN, ("quats", float("inf"))])
@pytest.mark.parametrize("grad", [0.0, 1.0])
def test_a_frame_that_is_not_finite_holds_its_gaussian_alone(
    name: str, value: float, grad: float
) -> None:
    """Until it is mended: nothing of it stays in Adam's moments."""
    ends = []
    for broken in (False, True):
        splats = scene(6, 8)
        phases = only(TOTAL, OwnFrame())
        adams: Any = phases.upgrade({n: torch.optim.Adam([p]) for n, p in splats.items()})
        whole, start = splats[name].detach().clone(), splats["means"].detach().clone()
        if broken:
            splats[name].data[2, 1] = value
        for i in range(6):
            if i == 3:
                if broken:
                    assert torch.equal(splats["means"][2], start[2])
                splats[name].data.copy_(whole)
            splats["means"].grad = torch.full_like(splats["means"], grad)
            phases.observe(0.1)
            adams["means"].step()
        assert all(bool(param.isfinite().all()) for param in splats.values())
        ends.append(splats["means"].detach())
    others = torch.arange(6) != 2
    assert torch.equal(ends[0][others], ends[1][others])
    assert bool((ends[1][2] != start[2]).all()) == (grad != 0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("fused", [False, True])
def test_no_size_of_a_gaussian_ruins_its_moments(dtype: torch.dtype, fused: bool) -> None:
    """Sizes and gradients from the smallest to the largest: all stays finite, and can be loaded."""
    top = math.log(torch.finfo(dtype).max)
    sizes, strengths = torch.linspace(-top, top, 23), torch.linspace(-0.9, 0.9, 7)
    scales = sizes.repeat_interleave(7)[:, None].repeat(1, 3)
    grads = (strengths * top).exp().repeat(23)[:, None] * torch.tensor([1.0, -0.5, 0.2])
    splats = {
        "means": Parameter(torch.zeros(161, 3, dtype=dtype)),
        "scales": Parameter(scales.to(dtype)),
        "quats": Parameter(torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=dtype).repeat(161, 1)),
    }
    phases = only(TOTAL, OwnFrame(rate=0.01))
    adams: Any = phases.upgrade(
        {n: torch.optim.Adam([p], lr=1e-3, eps=1e-4, fused=fused) for n, p in splats.items()}
    )
    for _ in range(8):
        splats["means"].grad = grads.to(dtype)
        phases.observe(0.1)
        adams["means"].step()
    assert all(
        bool(each.isfinite().all()) for each in adams["means"].state[splats["means"]].values()
    )
    ordinary = scales[:, 0].abs() < 3
    assert bool(splats["means"][ordinary].isfinite().all())
    assert bool((splats["means"][ordinary].abs().amax(1) > 0).any())
    adams["means"].load_state_dict(adams["means"].state_dict())


@pytest.mark.parametrize("during", list(itertools.product((None, *Phase), repeat=2)), ids=str)
def test_two_that_act_at_once_are_refused(during: tuple[Phase | None, Phase | None]) -> None:
    """Each says how long a step is: the product of both is no length."""

    class Phased(OwnFrame):
        pass

    first, second = Phased(rate=0.05), Phased(min_aspect=1.0)
    for part, phase in zip((first, second), during, strict=True):
        object.__setattr__(part, "during", phase)
    if None in during or during[0] is during[1]:
        message = (
            r"PhaseScheduler: parts has Phased\(rate=0.05.* and Phased\(.* one of them is needed"
        )
        with pytest.raises(ValueError, match=message):
            PhaseScheduler(TOTAL, parts=[first, second])
    else:
        PhaseScheduler(TOTAL, parts=[first, second])


class Turned(Part):
    """Positions stepped in a world that is turned: by itself it changes nothing but rounding."""

    names = ("means",)
    own_units = True
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)))[
        0
    ].double()

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        return grad @ self.turn

    def displacement(self, group: Any, param: Any, step: Tensor, state: Any, course: Any) -> Tensor:
        return step @ self.turn.T


@pytest.mark.parametrize("turned_first", [False, True])
def test_two_units_of_their_own_are_undone_in_reverse(turned_first: bool) -> None:
    """Fed B2^T B1^T g, moved by B1 B2 z: downhill, whichever comes first."""
    parts: list[Part] = [OwnFrame(final=0.1), Turned()]
    splats = scene(40, 2, size=0.3)
    phases = only(200, *(reversed(parts) if turned_first else parts))
    adams: Any = phases.upgrade({n: torch.optim.Adam([p], eps=1e-30) for n, p in splats.items()})
    lengths = []
    for _ in range(200):
        lengths.append(float(splats["means"].detach().norm(dim=1).mean()))
        splats["means"].grad = splats["means"].detach().clone()
        phases.observe(0.1)
        adams["means"].step()
    assert lengths[-1] < 0.5 * lengths[0]


@pytest.mark.parametrize(
    "lr",
    [
        *(np.float32(0.0), np.float32(1e-40), np.float64(0.0), np.float64(1e-320)),
        *(np.int64(0), 0, torch.tensor(0), torch.tensor(0.0, dtype=torch.bfloat16)),
        *(np.float32(1e-3), np.float64(1e-3), np.int64(1), 1, torch.tensor(1)),
        *(torch.tensor(1e-3), torch.tensor(1e-3, dtype=torch.float16)),
    ],
    ids=repr,
)
def test_a_learning_rate_of_any_type(lr: Any) -> None:
    splats = scene(5, 3)
    start = splats["means"].detach().clone()
    run(splats, pull(torch.ones(5, 3)), 2, lr=lr)
    moved = (splats["means"].detach() - start).abs().amax(1) / splats["scales"].exp().amax(1)
    if float(lr) < 1e-30:
        assert not moved.any()
    else:
        assert bool(((moved > 0.01) & (moved < 0.5)).all())


def test_the_log_has_a_rate_while_it_acts() -> None:
    splats = make_splats()
    phases = only(TOTAL, OwnFrame())
    adams = phases.upgrade(gsplat_optimizers(splats))
    train(splats, adams, phases, 0, 3)
    (part,) = phases.parts
    assert part.numbers(phases)["own_frame_rate"] == pytest.approx(0.1, rel=0.2)
    group = adams["quats"].param_groups.pop()
    with pytest.warns(UserWarning, match="until then they are stepped as without this part"):
        train({**splats}, {n: a for n, a in adams.items() if n != "quats"}, phases, 3, 5)
    assert part.numbers(phases) == {}
    adams["quats"].param_groups.append(group)
    train(splats, adams, phases, 5, 6)
    assert part.numbers(phases)["own_frame_rate"] == OwnFrame().at(5 / TOTAL)
    others = {name: adam for name, adam in adams.items() if name != "means"}
    train(splats, others, phases, 6, 8)  # positions that are not stepped any more
    assert part.numbers(phases) == {}
    adams["means"].param_groups[0]["lr"] = 0.0  # or held
    train(splats, adams, phases, 8, 10)
    assert part.numbers(phases) == {}


@pytest.mark.parametrize("framed", ["a", "b"])
def test_the_log_has_a_rate_if_one_of_two_sets_has_frames(framed: str) -> None:
    splats = {f"{s}#{name}": p for s in "ab" for name, p in make_splats().items()}
    other = "b" if framed == "a" else "a"
    splats[f"{other}#scales"] = Parameter(torch.randn(12, 1))
    groups = [{"params": [param], "name": name, "lr": 1e-3} for name, param in splats.items()]
    phases, adam = only(TOTAL, OwnFrame()), torch.optim.Adam(groups)
    phases.upgrade(adam)
    for i in range(2):
        for param in splats.values():
            param.grad = torch.ones_like(param)
        phases.observe(0.1)
        if i == 0:
            with pytest.warns(UserWarning, match="need scales"):
                adam.step()
        else:
            adam.step()
    assert phases.numbers()["own_frame_rate"] == OwnFrame().at(1 / TOTAL)


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_fading_leaves_positions_alone_that_are_stepped_in_their_own_frame(make: Any) -> None:
    """But fades them where the frames are not found: else nothing would act on them."""
    fading = Fading(events=60)
    others = Fading(events=60, names=("scales", "quats", "opacities", "sh0", "shN"))
    ends = []
    for parts in ((OwnFrame(), fading), (fading, OwnFrame()), (OwnFrame(), others)):
        splats, phases, optimizers = upgraded(TOTAL, *parts, make=make)
        train(splats, optimizers, phases, 0, TOTAL)
        ends.append(splats)
    for end in ends[1:]:
        assert_same(ends[0], end)
    ends = []
    for parts in ((OwnFrame(), fading), (fading,)):
        splats = make_splats()
        splats["scales"] = Parameter(splats["scales"][:, :2].detach().clone())
        phases, optimizers = only(TOTAL, *parts), make(splats)
        phases.upgrade(optimizers)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*need scales")
            train(splats, optimizers, phases, 0, TOTAL)
        ends.append(splats)
    assert_same(ends[0], ends[1])


def test_two_models_with_an_adam_each_have_the_frames_of_their_own() -> None:
    """Upgraded one after the other, which is said to be wrong: but no step is of other sizes."""
    models = [make_splats(seed=seed) for seed in (0, 1)]
    models[1]["scales"].data += 5.0
    phases = only(TOTAL, OwnFrame())
    adams = [inria_optimizer(splats) for splats in models]
    for adam in adams:
        phases.upgrade(adam)
    before = models[0]["means"].detach().clone()
    for splats in models:
        found = phases.gaussians_of(splats["means"])
        assert all(found[name] is param for name, param in splats.items())
        for param in splats.values():
            param.grad = torch.ones_like(param)
    phases.observe(0.1)
    for adam in adams:
        adam.step()
    longest = models[0]["scales"].detach().exp().amax(1, keepdim=True)
    moved = ((models[0]["means"].detach() - before) / longest).norm(dim=1)
    assert bool((moved < 0.1 * 3**0.5 * 1.001).all())


@pytest.mark.parametrize("parts", [(), (Averaging(),)])
def test_groups_that_a_trainer_takes_away_are_given_up_at_the_next_step(
    parts: tuple[Part, ...],
) -> None:
    splats, phases, adam = upgraded(TOTAL, *parts, make=inria_optimizer)
    gone = []
    for i in range(3):
        extra = Parameter(torch.ones(2))
        gone.append(weakref.ref(extra))
        adam.add_param_group({"params": [extra], "name": "another"})
        del extra
        train(splats, adam, phases, i, i + 1)
        adam.param_groups.pop()
    train(splats, adam, phases, 3, 4)
    gc.collect()
    # The last one may be known until the groups change again.
    assert [ref() for ref in gone[:2]] == [None] * 2


@pytest.mark.parametrize("reversed_", [False, True])
def test_moments_go_on_where_a_trainer_empties_its_groups_and_fills_them_again(
    reversed_: bool,
) -> None:
    splats, phases, adam = upgraded(TOTAL, OwnFrame(), Averaging(), make=inria_optimizer)
    train(splats, adam, phases, 0, 5)
    groups = [dict(group) for group in adam.param_groups]
    adam.param_groups.clear()
    for group in reversed(groups) if reversed_ else groups:
        adam.add_param_group(group)
    train(splats, adam, phases, 5, 6)
    assert {int(adam.state[param]["step"]) for param in splats.values()} == {6}
    records = [adam.record_of(param) for param in splats.values()]
    assert all(record is not None and record.last_step == 5 for record in records)


# -- whose units Adam's moments are in ---------------------------------------------------------


def positions_after(
    change: Callable[[Any, Any], Any] | None, *, first: tuple[Part, ...], second: tuple[Part, ...]
) -> tuple[Tensor, Tensor]:
    """The step of the positions after a change from some parts to others, and their step count.

    The moments before it are those of thirty steps.

    Args:
        change: makes other optimizers of these, with the parts `second`; None: only `second` acts,
            from zero moments on.
    """
    splats = scene(6, 7)
    adams: Any = {n: torch.optim.Adam([p], lr=1e-3, eps=1e-30) for n, p in splats.items()}
    phases = only(TOTAL, *(first if change else second))
    adams = phases.upgrade(adams)
    grad = pull(torch.ones(6, 3).double())
    start = splats["means"].detach().clone()
    for i in range(30 if change else 0):
        splats["means"].grad = grad(splats["means"].detach(), i)
        phases.observe(0.1)
        adams["means"].step()
    splats["means"].data.copy_(start)
    if change:
        phases, adams = change(phases, adams)
    splats["means"].grad = grad(start, 0)
    phases.observe(0.1, iteration=30)
    adams["means"].step()
    return splats["means"].detach() - start, adams["means"].state[splats["means"]]["step"]


def resumed(*second: Part) -> Callable[[Any, Any], Any]:
    """A checkpoint that a training with other parts goes on from."""

    def change(_: Any, adams: Any) -> Any:
        phases = only(TOTAL, *second)
        params = {name: adam.param_groups[0]["params"][0] for name, adam in adams.items()}
        again: Any = {n: torch.optim.Adam([p], lr=1e-3, eps=1e-30) for n, p in params.items()}
        again = phases.upgrade(again)
        again["means"].load_state_dict(adams["means"].state_dict())
        return phases, again

    return change


@pytest.mark.filterwarnings("ignore:.*steps, but this is iteration")
@pytest.mark.parametrize(
    ("first", "second"), [((), (OwnFrame(),)), ((OwnFrame(),), ()), ((OwnFrame(),), (Fading(),))]
)
def test_moments_of_other_units_begin_anew(
    first: tuple[Part, ...], second: tuple[Part, ...]
) -> None:
    """Those of the world would hold a small Gaussian for thousands of steps, or throw it."""
    fresh, _ = positions_after(None, first=first, second=second)
    acts = "begins" if second == (OwnFrame(),) else "ceases"
    with pytest.warns(
        UserWarning, match=f"begin anew, since OwnFrame {acts} to act: those that were there"
    ):
        moved, count = positions_after(resumed(*second), first=first, second=second)
    assert count.item() == 1
    torch.testing.assert_close(moved, fresh, rtol=1e-12, atol=0.0)


def test_moments_of_this_process_that_begin_anew_are_said_to_have_been_there() -> None:
    splats = make_splats()
    adams = gsplat_optimizers(splats)
    train(splats, adams, None, 0, 3)
    phases = only(TOTAL, OwnFrame())
    phases.upgrade(adams)
    with pytest.warns(
        UserWarning, match="begins to act: those that were there count as made in other units"
    ):
        train(splats, adams, phases, 3, 4)


@pytest.mark.filterwarnings("error")
def test_a_checkpoint_of_other_units_that_a_warning_refuses_changes_nothing() -> None:
    """And is refused again."""
    splats, phases, adams = upgraded(TOTAL, OwnFrame())
    train(splats, adams, phases, 0, 3)
    foreign = copy.deepcopy(adams["means"].state_dict())
    splats, phases, adams = upgraded(TOTAL)
    train(splats, adams, phases, 0, 5)
    before = copy.deepcopy(adams["means"].state_dict())
    for _ in range(2):
        with pytest.raises(UserWarning, match="begin anew, since OwnFrame ceases to act"):
            adams["means"].load_state_dict(foreign)
        after = adams["means"].state_dict()
        assert after["param_groups"] == before["param_groups"]
        assert_same(after["state"][0], before["state"][0])


@pytest.mark.parametrize("parts", [(), (OwnFrame(),)])
def test_moments_of_the_same_units_go_on(parts: tuple[Part, ...]) -> None:
    _, count = positions_after(resumed(*parts), first=parts, second=parts)
    assert count.item() == 31


def test_moments_begin_anew_where_it_is_switched_off_and_on() -> None:
    splats, phases, optimizers = upgraded(TOTAL, OwnFrame())
    steps = []
    for i, off in enumerate((False, False, True, True, False, False)):
        phases.switched_off = {"OwnFrame": "a reason"} if off else {}
        phases._plan()
        train(splats, optimizers, phases, i, i + 1)
        steps.append(int(state_of(optimizers, splats["means"])["step"]))
    assert steps == [1, 2, 1, 2, 1, 2]
    assert int(state_of(optimizers, splats["scales"])["step"]) == 6


@pytest.mark.filterwarnings("ignore:.*of means begin anew")
@pytest.mark.parametrize("on_device", [False, True])
def test_a_dropped_first_step_does_not_count(
    on_device: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = []
    if on_device:
        devices.on_a_device(monkeypatch)
    for dropped in (False, True):
        splats, stock, optimizers = upgraded(TOTAL, fused=True)
        train(splats, optimizers, stock, 0, 5)
        saved = {name: copy.deepcopy(each.state_dict()) for name, each in optimizers.items()}
        values = {name: param.detach().clone() for name, param in splats.items()}
        splats, phases, optimizers = upgraded(TOTAL, OwnFrame(), fused=True)
        for name, param in splats.items():
            param.data.copy_(values[name])
            optimizers[name].load_state_dict(saved[name])
        if dropped:
            for param in splats.values():
                param.grad = torch.ones_like(param)
            phases.observe(float("nan"), iteration=5)
            for each in optimizers.values():
                each.step()
        phases.observe(0.1, iteration=6)
        for param in splats.values():
            param.grad = torch.ones_like(param)
        for each in optimizers.values():
            each.step()
        ends.append(splats)
    assert_same(ends[0], ends[1])


@pytest.mark.filterwarnings("ignore:.*of means begin anew")
def test_moments_that_the_stock_trainer_has_gone_on_with_begin_anew() -> None:
    """Ours, stock, ours: the stock steps between were in the units of the world."""
    splats, phases, optimizers = upgraded(TOTAL, OwnFrame())
    train(splats, optimizers, phases, 0, 5)
    saved = {name: copy.deepcopy(each.state_dict()) for name, each in optimizers.items()}
    stock = gsplat_optimizers(splats)
    for name, each in stock.items():
        each.load_state_dict(saved[name])
        splats[name].grad = torch.ones_like(splats[name])
        each.step()
    saved = {name: copy.deepcopy(each.state_dict()) for name, each in stock.items()}
    again = only(TOTAL, OwnFrame())
    optimizers: Any = again.upgrade(gsplat_optimizers(splats))
    for name, each in optimizers.items():
        with pytest.warns(UserWarning, match="another optimizer has gone on with them"):
            each.load_state_dict(saved[name])
    train(splats, optimizers, again, 6, 7)
    assert int(state_of(optimizers, splats["means"])["step"]) == 1
    assert int(state_of(optimizers, splats["scales"])["step"]) == 7


@pytest.mark.parametrize("units", ["OwnFrame", [1], None, {"OwnFrame": 1}])
def test_damaged_units_are_refused(units: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, OwnFrame())
    train(splats, optimizers, phases, 0, 3)
    saved = copy.deepcopy(optimizers["means"].state_dict())
    record = saved["param_groups"][0]["opt3dgs"]["optimizer"]["records"][0][0]
    assert record["units"] == ["OwnFrame"]
    record["units"] = units
    before = state_of(optimizers, splats["means"])["exp_avg"].clone()
    with pytest.raises(ValueError, match=r"units=.*, but names of parts are needed"):
        optimizers["means"].load_state_dict(saved)
    assert torch.equal(state_of(optimizers, splats["means"])["exp_avg"], before)


def test_density_control_between_steps() -> None:
    splats, phases, optimizers = upgraded(TOTAL, *full())
    train(splats, optimizers, phases, 0, 10)
    edit_rows(splats, optimizers, torch.arange(11, -1, -2), 3)
    train(splats, optimizers, phases, 10, TOTAL)
    assert splats["means"].shape == (9, 3)
    assert all(bool(param.isfinite().all()) for param in splats.values())


@pytest.mark.parametrize("options", [{"foreach": False}, {"foreach": True}, {"fused": True}])
def test_every_path_of_torch_makes_the_same_step(options: dict[str, bool]) -> None:
    ends = []
    for path in ({}, options):
        splats, phases, optimizers = upgraded(TOTAL, OwnFrame(), **path)
        train(splats, optimizers, phases, 0, 20)
        ends.append(splats)
    for name, param in ends[0].items():  # fused Adam rounds otherwise
        torch.testing.assert_close(param, ends[1][name], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_rows_that_a_mask_holds_stand_still(make: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, OwnFrame(), make=make)
    train(splats, optimizers, phases, 0, 5)
    mask = torch.arange(12) % 3 == 0
    before = splats["means"].detach().clone()
    moments = {k: v.clone() for k, v in state_of(optimizers, splats["means"]).items()}
    for param in splats.values():
        param.grad = torch.ones_like(param)
    phases.observe(0.1)
    for each in optimizers.values() if isinstance(optimizers, dict) else [optimizers]:
        each.step(mask)
    assert torch.equal(splats["means"][~mask], before[~mask])
    assert not bool((splats["means"][mask] == before[mask]).any())
    after = state_of(optimizers, splats["means"])
    assert torch.equal(after["exp_avg"][~mask], moments["exp_avg"][~mask])


@pytest.mark.parametrize("options", [{}, {"foreach": True}, {"fused": True}])
def test_rows_that_a_mask_holds_do_not_decay_either(options: dict[str, bool]) -> None:
    splats = scene(6, 8)
    phases = only(TOTAL, OwnFrame())
    asked: dict[str, Any] = {"weight_decay": 0.1, **options}
    adams: Any = phases.upgrade({n: torch.optim.AdamW([p], **asked) for n, p in splats.items()})
    mask, before = torch.arange(6) < 3, splats["means"].detach().clone()
    for _ in range(3):
        splats["means"].grad = torch.zeros_like(splats["means"])
        phases.observe(0.1)
        adams["means"].step(mask)
    kept = before[:3] * (1 - 1e-3 * 0.1) ** 3
    torch.testing.assert_close(splats["means"][:3].detach(), kept, rtol=1e-12, atol=0.0)
    assert torch.equal(splats["means"][3:], before[3:])


@pytest.mark.parametrize("on_device", [False, True])
def test_a_dropped_step_moves_nothing(on_device: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if on_device:
        devices.on_a_device(monkeypatch)
    splats, phases, optimizers = upgraded(TOTAL, *full(), fused=True)
    train(splats, optimizers, phases, 0, 5)
    before = {name: param.detach().clone() for name, param in splats.items()}
    for name, param in splats.items():
        param.grad = torch.ones_like(param)
        phases.observe(float("nan"))
        optimizers[name].step()
    assert_same(before, splats)


def test_amp_and_maximize_see_the_same_problem() -> None:
    ends = []
    for scale, up in ((None, False), (1024.0, False), (None, True)):
        splats = {n: Parameter(p.detach().float()) for n, p in scene(6, 4).items()}
        phases = only(TOTAL, OwnFrame())
        options: dict[str, Any] = {"eps": 1e-30, "maximize": up, "fused": True}
        adams: Any = phases.upgrade(
            {n: torch.optim.Adam([p], **options) for n, p in splats.items()}
        )
        means = adams["means"]
        for i in range(10):
            grad = pull(torch.ones(6, 3))(splats["means"].detach(), i)
            splats["means"].grad = (-grad if up else grad) * (scale or 1.0)
            if scale is not None:
                means.grad_scale, means.found_inf = torch.tensor(scale), torch.tensor(0.0)
            phases.observe(0.1)
            means.step()
        ends.append(splats["means"].detach())
    for end in ends[1:]:
        torch.testing.assert_close(end, ends[0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("decoupled", [False, True])
def test_weight_decay_is_of_the_positions_themselves(decoupled: bool) -> None:
    """Not of the buffer that Adam moves: a ball of size one is Adam with its decay."""
    splats = scene(6, 5)
    splats["scales"].data.zero_()
    splats["quats"].data = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 6, dtype=torch.float64)
    plain = Parameter(splats["means"].detach().clone())
    cls = torch.optim.AdamW if decoupled else torch.optim.Adam
    options: dict[str, Any] = {"lr": 0.1, "weight_decay": 0.2, "eps": 1e-30}
    phases = only(TOTAL, OwnFrame(rate=0.1, final=1.0))
    adams: Any = phases.upgrade({n: cls([p], **options) for n, p in splats.items()})
    theirs = cls([plain], **options)
    for i in range(5):
        for param, adam in ((splats["means"], adams["means"]), (plain, theirs)):
            param.grad = pull(torch.ones(6, 3).double())(param.detach(), i)
            if param is plain:
                adam.step()
            else:
                phases.observe(0.1)
                adam.step()
    torch.testing.assert_close(splats["means"].detach(), plain.detach(), rtol=1e-12, atol=1e-12)


SHAPES = {
    "the positions alone": ((4, 3), {}),
    "no quaternions": ((4, 3), {"scales": (4, 3)}),
    "no scales": ((4, 3), {"quats": (4, 4)}),
    "scales of other points": ((4, 3), {"scales": (5, 3), "quats": (4, 4)}),
    "quaternions of other points": ((4, 3), {"scales": (4, 3), "quats": (5, 4)}),
    "one scale for all axes": ((4, 3), {"scales": (4, 1), "quats": (4, 4)}),
    "angles": ((4, 3), {"scales": (4, 3), "quats": (4, 3)}),
    "Gaussians of a plane": ((4, 2), {"scales": (4, 2), "quats": (4, 4)}),
}


@pytest.mark.parametrize("case", SHAPES)
def test_where_no_frame_is_found_it_says_so_and_the_step_is_adams(case: str) -> None:
    shape, others = SHAPES[case]
    x, y = Parameter(torch.ones(shape)), Parameter(torch.ones(shape))
    splats = {"means": x, **{name: Parameter(torch.ones(size)) for name, size in others.items()}}
    phases = only(TOTAL, OwnFrame())
    adams: Any = {name: torch.optim.Adam([param], lr=0.1) for name, param in splats.items()}
    ours = phases.upgrade(adams)["means"]
    theirs = torch.optim.Adam([y], lr=0.1)
    for i in range(3):
        phases.observe(0.1)
        for param, adam in ((x, ours), (y, theirs)):
            param.grad = torch.full(shape, 1.0 + i)
            if i == 0 and adam is ours:
                with pytest.warns(UserWarning, match=r"need scales \[N, 3\] and quats \[N, 4\]"):
                    adam.step()
            else:
                adam.step()
    assert torch.equal(x, y)


def test_nothing_is_kept_from_step_to_step() -> None:
    def alive() -> int:
        gc.collect()
        return sum(type(each) is Frames for each in gc.get_objects())

    others = alive()
    phases, splats = only(TOTAL, OwnFrame()), scene(6, 3)
    adams: Any = phases.upgrade({n: torch.optim.Adam([p]) for n, p in splats.items()})
    splats["means"].grad = torch.ones_like(splats["means"])
    phases.observe(0.1)
    adams["means"].step()
    assert alive() == others
    assert set(adams["means"].state[splats["means"]]) == {"step", "exp_avg", "exp_avg_sq"}


def test_noise_and_the_trainers_schedule_read_the_trainers_rate() -> None:
    splats = make_splats()
    phases = only(TOTAL, OwnFrame(), PositionNoise(scale=1.0))
    optimizers = gsplat_optimizers(splats)
    phases.upgrade(optimizers)
    rate = optimizers["means"].param_groups[0]["lr"]
    train(splats, optimizers, phases, 0, 3)
    assert optimizers["means"].param_groups[0]["lr"] == rate
    assert optimizers["means"].param_groups[0]["params"] == [splats["means"]]
    assert set(optimizers["means"].state) == {splats["means"]}


def test_the_rate_falls_by_a_hundred_over_the_run() -> None:
    """By default a full step is a tenth of a deviation at first, a thousandth in the end."""
    splats = scene(5, 2)
    phases = only(TOTAL, OwnFrame(min_aspect=0.0))
    adams = {n: torch.optim.Adam([p], lr=1e-3, eps=1e-30) for n, p in splats.items()}
    phases.upgrade(adams)
    inverse = torch.linalg.inv(frame(splats["quats"].data, splats["scales"].data))
    for i in range(TOTAL):
        rate = 0.1 * 0.01 ** (i / TOTAL)
        before = splats["means"].detach().clone()
        # In the own frame the gradient is 1 along every axis, always: Adam's steps are full.
        splats["means"].grad = inverse.transpose(1, 2) @ torch.ones(3, dtype=torch.float64)
        phases.observe(0.1)
        adams["means"].step()
        moved = torch.einsum("nij,nj->ni", inverse, splats["means"].detach() - before)
        expected = torch.full((5, 3), -rate, dtype=torch.float64)
        torch.testing.assert_close(moved, expected, rtol=1e-6, atol=0.0)
        assert phases.numbers()["own_frame_rate"] == pytest.approx(rate, rel=1e-12)
    assert [OwnFrame().at(progress) for progress in (-1.0, 0.0, 1.0, 2.0)] == [
        *(0.1, 0.1),
        *(pytest.approx(0.001), pytest.approx(0.001)),
    ]


def test_the_bound_is_half_of_the_root_of_the_largest_number() -> None:
    expected = {torch.float16: 7, torch.bfloat16: 63, torch.float32: 63, torch.float64: 511}
    assert {dtype: 2.0**exponent for dtype, exponent in expected.items()} == LARGEST
    for dtype, bound in LARGEST.items():
        assert 0.2 < (bound**2 / torch.finfo(dtype).max) < 0.3


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32], ids=str)
def test_what_a_device_is_given_and_what_becomes_of_its_answer(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames as they were, in single precision; in half precision its bound is another."""
    given = list[Tensor]()

    def kernel(grad: Tensor, quats: Tensor, scales: Tensor, min_aspect: float) -> Tensor:
        given[:] = grad, quats, scales
        return torch.tensor([[3e4, -3e4, 2.0]]).expand_as(grad).clone()

    monkeypatch.setattr(cuda, "has_own_frames", lambda _: True)
    monkeypatch.setattr(cuda, "own_frame_gradient", kernel)
    quats, scales = torch.ones(5, 4, dtype=dtype), torch.zeros(5, 3, dtype=dtype)
    frames = Frames(quats, scales, dtype, 0.1)
    quats += 1  # as one optimizer of all groups moves them before the step is asked for
    scales += 1
    found = frames.gradient(torch.ones(5, 3, dtype=dtype))
    assert [each.dtype for each in given] == [torch.float32] * 3
    assert [float(each.mean()) for each in given] == [1.0, 1.0, 0.0]
    assert found.dtype == dtype
    most = 128.0 if dtype == torch.float16 else 3e4
    assert found[0].tolist() == [most, -most, 2.0]


@pytest.mark.parametrize("together", [False, True])
@pytest.mark.parametrize("copied", [False, True])
def test_models_that_are_upgraded_by_calls_of_their_own(together: bool, copied: bool) -> None:
    """Each is stepped in its own sizes, in the same iteration or in turns; in a copy, too."""
    phases = PhaseScheduler(TOTAL, parts=[OwnFrame()])
    models = []
    for size in (-4.0, 2.0):
        splats = {"means": torch.zeros(4, 3), "scales": torch.full((4, 3), size)}
        splats["quats"] = torch.ones(4, 4)
        params = {name: Parameter(value) for name, value in splats.items()}
        models.append({n: torch.optim.Adam([p], lr=1e-3) for n, p in params.items()})
        phases.upgrade(models[-1])
    if copied:
        phases, models = copy.deepcopy((phases, models))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of both in one iteration
        for i in range(4):
            phases.observe(0.1)
            for number, adams in enumerate(models):
                if together or i % 2 == number:
                    adams["means"].param_groups[0]["params"][0].grad = torch.ones(4, 3)
                    adams["means"].step()
    lengths = []
    for adams in models:
        means, scales = (adams[name].param_groups[0]["params"][0] for name in ("means", "scales"))
        lengths.append((means.norm(dim=1) / scales[:, 0].exp()).tolist())
    most = 0.1 * 3**0.5 * (4 if together else 2)
    assert 0.5 * most < min(lengths[0] + lengths[1]) <= max(lengths[0] + lengths[1]) <= most
