"""The step's kernels, by Triton's interpreter, beside `step.take_step` in plain torch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from interpreted import interpreted_kernels
from step_cases import (
    both,
    case,
    codes_apart,
    difference,
    moved,
    numbers_and_codes,
    tensors,
)

from opt3dgs_optim import triton
from opt3dgs_optim.parts.out_of_view import look_at_positions
from opt3dgs_optim.step import (
    LARGEST,
    Fade,
    Frame,
    Hold,
    Step,
    chosen_rows,
    mixed,
    take_step,
)

ROWS = (0, 1, 255, 256, 257, 1000, 4096)
WIDTHS: tuple[tuple[int, ...], ...] = ((), (3,), (4,), (15, 3))
TOLERANCE = 5e-7  # some four roundings of float32, of 6e-8 each
FRAME_TOLERANCE = 4e-6  # squares of sums of nine terms, which may cancel


@pytest.fixture(autouse=True, scope="module")
def kernels() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        yield interpreted_kernels(patch)


@pytest.mark.parametrize(
    ("rows", "width"),
    [
        pytest.param(n, w, marks=[pytest.mark.thorough] * (n >= 1000 and len(w) == 2))
        for n in ROWS
        for w in WIDTHS
    ],
)
def test_rows_of_every_size(rows: int, width: tuple[int, ...]) -> None:
    shape = (rows, *width)
    assert difference({"bad": 3}, shape) <= TOLERANCE
    everything = {"fade": True, "hold": True, "mean": True, "put": True, "bad": 3, "decay": 0.1}
    assert difference(everything, shape) <= TOLERANCE


@pytest.mark.parametrize("put", [False, True])
def test_means_of_16_bits_are_the_same_codes(put: bool) -> None:
    """Also of numbers that have no place on the grid, and of a mean that is too far."""
    made = []
    for kernels in (False, True):
        options: dict[str, Any] = {"coded": True, "mean": True, "put": put, "steps": 1_000}
        step = case((301, 5), torch.Generator().manual_seed(3), **options)
        step.param[:4, 0] = torch.tensor([float("inf"), float("nan"), 3e38, -3_000.0])
        assert step.mean is not None
        kept = step.mean.tensor
        kept[5, :2] = torch.tensor([-32_768, 32_767])
        before = kept.clone()
        if kernels:
            triton.launch(step)
        else:
            take_step(step)
        made.append(kept)
        assert torch.equal(kept[:4, 0], before[:4, 0])
        assert not torch.equal(kept[4:], before[4:])
    assert torch.equal(*made)


@pytest.mark.parametrize("rows", ROWS)
def test_own_frames_of_every_size(rows: int) -> None:
    assert difference({"frame": True, "bad": 3}, (rows, 3)) <= FRAME_TOLERANCE
    assert difference({"frame": True, "mean": True, "put": True}, (rows, 3)) <= FRAME_TOLERANCE


flag = st.booleans()
OPTIONS = st.fixed_dictionaries(
    {
        "steps": st.sampled_from([1, 2, 10, 1000, 100_000]),
        "mean": flag,
        "put": flag,
        "factor": st.sampled_from([1.0, 0.25, torch.tensor(0.7), torch.tensor([1.5])]),
        "bad": st.integers(0, 7),
    }
)
WEIGHT_DECAY = st.sampled_from([{}, {"shrink": 0.999}, {"decay": 0.01}])
KINDS = st.one_of(
    st.fixed_dictionaries({"fade": flag, "hold": flag}),
    st.just({"frame": True}),
)


@settings(max_examples=80, deadline=None)
@given(
    OPTIONS, WEIGHT_DECAY, KINDS, st.integers(1, 40), st.sampled_from(WIDTHS), st.integers(0, 99)
)
def test_whatever_a_step_has(
    options: dict[str, Any],
    decay: dict[str, float],
    kind: dict[str, bool],
    rows: int,
    width: tuple[int, ...],
    seed: int,
) -> None:
    frame = "frame" in kind
    shape = (rows, 3) if frame else (rows, *width)
    found = difference({**options, **decay, **kind}, shape, seed)
    assert found <= (FRAME_TOLERANCE if frame else TOLERANCE)


@settings(max_examples=40, deadline=None)
@given(OPTIONS, KINDS, st.integers(1, 300), st.sampled_from(WIDTHS), st.integers(0, 99))
def test_whatever_a_step_has_with_moments_of_16_bits(
    options: dict[str, Any], kind: dict[str, bool], rows: int, width: tuple[int, ...], seed: int
) -> None:
    """The codes are the same, but where a rounding before them lies on the border of two."""
    shape = (rows, 3) if "frame" in kind else (rows, *width)
    step, step2 = both({**options, **kind, "coded": True}, shape, seed)
    for away in codes_apart(step, step2):
        assert away.max() <= 1
        assert (away > 0).sum() <= 1 + 0.01 * away.numel()
    numbers = [numbers_and_codes(each)[0] for each in (step, step2)]
    for ours, theirs in zip(*numbers, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("key", [0, 1, 2**31 - 1, 2**31, 2**32 - 1])
@pytest.mark.parametrize("share", [0.01, 0.2, 0.5, 1.0, "a row's"])
def test_the_same_rows_fade(key: int, share: Any) -> None:
    """A row does not fade where the share is the number that its hash is."""
    exp_avg, exp_avg_sq = torch.ones(2, 4099, 3)
    param, grad = torch.zeros(2, 4099, 3)
    if share == "a row's":
        share = (mixed(7 ^ key) >> 8) / 2**24
    fade = Fade(key, share, 0.5, 0.25)
    state = {"exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}
    triton.launch(Step(param, grad, None, "", {}, state, 0, -1, fade=fade, beta1=0.5, beta2=0.5))
    chosen = chosen_rows(fade, 4099, param.device)
    assert torch.equal(exp_avg, torch.where(chosen, 0.25, 0.5)[:, None].expand(-1, 3))
    assert torch.equal(exp_avg_sq, torch.where(chosen, 0.125, 0.5)[:, None].expand(-1, 3))
    assert chosen.float().mean() == pytest.approx(share, abs=0.03)


def test_every_number_that_is_not_finite_is_counted() -> None:
    for options, shape, bad in (({}, (700, 4), 2_800), ({"frame": True}, (300, 3), 899)):
        step, step2 = both({**options, "bad": bad}, shape)
        assert int(step2.nonfinite) == bad
        assert torch.isfinite(step.param).all()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e30])
@pytest.mark.parametrize("place", ["param", "mean", "quats", "scales", "exp_avg", "exp_avg_sq"])
def test_numbers_that_are_not_finite_go_the_same_way(value: float, place: str) -> None:
    for frame in (False, True):
        made = []
        for run in (take_step, triton.launch):
            options: Any = {"frame": frame, "mean": True, "put": True, "hold": not frame}
            step = case((40, 3), torch.Generator().manual_seed(1), **options)
            if step.frame is None and place in ("quats", "scales"):
                continue
            assert step.mean is not None
            found = {"param": step.param, "mean": step.mean.tensor, **step.state}
            found |= {} if step.frame is None else step.frame._asdict()
            before = step.param.clone()
            found[place][7, 1] = value
            run(step)
            made.append(tensors(step))
            if place in ("quats", "scales") and not abs(value) < 1e30:
                # The mean is put; without one the Gaussian would not have moved.
                assert torch.isfinite(step.param).all()
                assert not torch.equal(before, step.param)
        for ours, theirs in zip(*(made or [[], []]), strict=True):
            assert torch.equal(ours.isnan(), theirs.isnan())
            assert torch.equal(ours.isinf(), theirs.isinf())
            close = (ours - theirs).abs() <= FRAME_TOLERANCE * ours.abs().clamp(min=1.0)
            assert close[ours.isfinite()].all()


@pytest.mark.parametrize("options", [{}, {"frame": True}], ids=str)
def test_eps_is_in_the_denominator(options: dict[str, Any]) -> None:
    """One that counts beside the root of the second moment."""
    made = []
    for run in (take_step, triton.launch):
        step = case((40, 3), torch.Generator().manual_seed(2), **options)
        step.eps = 0.5
        run(step)
        made.append(step.param)
    torch.testing.assert_close(*made, rtol=1e-5, atol=1e-6)  # sums that may cancel


def test_the_border_of_what_adam_can_square_in_the_frame() -> None:
    """The last number is taken, one above counts as zero; along each axis."""
    largest = torch.tensor(LARGEST[torch.float32])
    above = torch.nextafter(largest, torch.tensor(torch.inf))
    step = case((6, 3), torch.Generator().manual_seed(0), frame=True)
    step.frame = Frame(0.1, 0.1, torch.eye(4)[:1].repeat(6, 1), torch.zeros(6, 3))
    step.grad = torch.cat([largest * torch.eye(3), -above * torch.eye(3)])
    exp_avg = step.state["exp_avg"]
    faded = 0.9 * exp_avg[3:]
    triton.launch(step)
    torch.testing.assert_close(exp_avg[:3].diagonal(), 0.1 * largest.expand(3))
    torch.testing.assert_close(exp_avg[3:], faded)


def test_a_coordinate_that_would_leave_float32_stays() -> None:
    """Of a Gaussian of 3e38, turned by 45 degrees: about each of the axes."""
    half = torch.tensor(torch.pi / 8)
    quats = torch.cat([half.cos().expand(3, 1), half.sin() * torch.eye(3)], 1)
    frame = Frame(1.0, 0.0, quats, torch.full((3, 3), 88.65))
    for run in (take_step, triton.launch):
        param, exp_avg = torch.ones(3, 3), torch.ones(3, 3)
        exp_avg.fill_diagonal_(0.0)  # along the axis that it is turned about
        state = {"exp_avg": exp_avg, "exp_avg_sq": torch.ones(3, 3)}
        step = Step(param, torch.zeros(3, 3), "means", "", {}, state, 0, -1, frame=frame)
        step.lr, step.beta1, step.beta2, step.eps = 1.0, 1.0, 1.0, 0.0
        run(step)
        assert (param[[0, 1, 2], [2, 0, 1]] == 1.0).all()
        assert (param[[0, 1, 2], [1, 2, 0]].abs() < 1e33).all()


@pytest.mark.parametrize("options", [{"hold": True}, {"frame": True}, {"coded": True}], ids=str)
def test_nothing_beside_the_numbers_is_read_or_written(options: dict[str, Any]) -> None:
    shape = 683, 3  # the last program of each kernel has less than the others

    def amid(given: Any) -> Any:
        """The same numbers with 4,096 sevens before and behind."""
        around = torch.full((given.numel() + 8192,), 7).to(given.dtype)
        around[4096:-4096] = given.flatten()
        whole.append(around)
        return around[4096:-4096].view(given.shape)

    step = case(shape, torch.Generator().manual_seed(0), mean=True, **options)
    apart = case(shape, torch.Generator().manual_seed(0), mean=True, **options)
    whole: list[torch.Tensor] = []
    step.state = {key: amid(moment) for key, moment in step.state.items()}
    step.nonfinite = amid(step.nonfinite)
    assert step.mean is not None
    step.mean.tensor, step.mean.began = amid(step.mean.tensor), amid(step.mean.began)
    step.mean.rest = step.mean.rest if step.mean.rest is None else amid(step.mean.rest)
    step.param, step.grad = amid(step.param), amid(step.grad)
    triton.launch(step)
    triton.launch(apart)
    for ours, theirs in zip(tensors(step), tensors(apart), strict=True):
        assert torch.equal(ours, theirs)
    assert step.nonfinite is not None
    assert not step.nonfinite.any()
    for around in whole:
        assert (around[:4096] == 7).all()
        assert (around[-4096:] == 7).all()


def test_what_it_takes() -> None:
    """Anything else is made by plain torch."""
    draw = torch.Generator().manual_seed(0)
    assert triton.fits(case((8, 3), draw, frame=True, mean=True))
    assert triton.fits(case((8, 3), draw, fade=True, hold=True))
    assert not triton.fits(case((8, 3), draw, frame=True, fade=True))
    assert not triton.fits(case((8, 3), draw, frame=True, hold=True))
    assert not triton.fits(case((8, 3), draw, plain=True))
    for change in (torch.Tensor.double, lambda x: x.t().contiguous().t()):
        for name in ("param", "grad", "exp_avg"):
            step = case((8, 3), draw)
            if name == "exp_avg":
                step.state[name] = change(step.state[name])
            else:
                setattr(step, name, change(getattr(step, name)))
            assert not triton.fits(step), name
    step = case((8, 3), draw, mean=True, hold=True)
    assert step.mean is not None
    step.mean.tensor = step.mean.tensor.t().contiguous().t()
    assert not triton.fits(step)
    assert not triton.takes(case((8, 3), draw))  # of a CPU


class There(torch.Tensor):
    """On the second GPU."""

    def get_device(self) -> int:
        return 1


def elsewhere(tensor: torch.Tensor) -> torch.Tensor:
    """Another GPU's tensor."""
    return tensor.as_subclass(There)


def test_what_lies_elsewhere_or_is_of_other_rows_is_left_to_torch() -> None:
    """Which says what is wrong; a kernel would read what is not there."""
    draw = torch.Generator().manual_seed(0)
    for name in ("grad", "state", "mean", "hold", "factor"):
        step = case((8, 3), draw, mean=True, hold=True, factor=torch.ones(()))
        assert triton.fits(step)
        setattr(step, name, moved(getattr(step, name), elsewhere))
        assert not triton.fits(step), name
    step = case((8, 3), draw, hold=True)
    for rows in (torch.ones(3, dtype=torch.bool), torch.ones(8)):
        step.hold = Hold(rows, 1.0)
        assert not triton.fits(step)
    step = case((8, 3), draw, frame=True)
    assert step.frame is not None
    for other in ({"quats": torch.ones(2, 4)}, {"scales": torch.ones(8, 2)}):
        step.frame, whole = step.frame._replace(**other), step.frame
        assert not triton.fits(step)
        step.frame = whole
    step.frame = moved(step.frame, elsewhere)
    assert not triton.fits(step)


@pytest.mark.parametrize("rows", [1, 8, 1025])
@pytest.mark.parametrize("coded", [False, True])
def test_it_looks_at_positions_as_torch_does(
    rows: int, coded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One coordinate of a gradient, or of a second moment, is enough."""
    draw = torch.Generator().manual_seed(rows)
    behind = torch.ones(rows + 1, 3)  # what lies behind is not looked at
    grad = behind[:rows].copy_(torch.randn(rows, 3, generator=draw))
    grad *= torch.eye(3)[torch.arange(rows) % 3]
    second = grad.roll(1, 1).square() if not coded else (grad.roll(1, 1) * 1e4).to(torch.int16)
    grad[torch.rand(rows, generator=draw) < 0.4] = 0.0
    second[torch.rand(rows, generator=draw) < 0.4] = 0
    for moments in (second, None):
        found = []
        for look in (triton.look, look_at_positions):
            out_of_view = torch.empty(rows, dtype=torch.bool)
            counter = torch.full((1,), 5, dtype=torch.int64)
            look(grad, moments, out_of_view, counter)
            found.append((out_of_view.tolist(), counter.item()))
        assert found[0] == found[1]
