"""Curvature pairs against one point at a time in numpy: which are taken, and what comes out."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from oracles import dense_bfgs
from points_first import direction, header, newest_gamma, record, stored_pairs
from torch import Tensor

from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history, two_loop
from opt3dgs_optim.lbfgs.history import (
    MAX_HISTORY,
    Cells,
    cells_of,
    history_shape,
    laid_out,
    push,
)
from opt3dgs_optim.lbfgs.pairs import (
    BITS,
    bits_of,
    length,
    normalised,
    overwrite,
    power_of_two,
)

F64 = torch.float64


@dataclass
class Point:
    """One point's history, as the docstrings of `record` and `direction` tell it."""

    size: int
    min_cosine: float
    position: np.ndarray | None = None
    gradient: np.ndarray | None = None
    pairs: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)  # oldest first

    def record(self, x: np.ndarray, g: np.ndarray) -> tuple[bool, bool]:
        """(accepted, candidate) of a visible step; an invisible one does not come here."""
        accepted, candidate = False, self.position is not None
        if self.position is not None and self.gradient is not None:
            s, y = x - self.position, g - self.gradient
            length = np.linalg.norm(s) * np.linalg.norm(y)
            accepted = bool(length > 0 and s @ y > self.min_cosine * length)
            if accepted:
                self.pairs = [*self.pairs, (s, y)][-self.size :]
        self.position, self.gradient = x, g
        return accepted, candidate

    def direction(self, g: np.ndarray, graft: bool) -> Any:
        if not self.pairs:
            return g
        s, y = (np.array(v) for v in zip(*self.pairs, strict=True))
        result = dense_bfgs(s, y) @ g
        return result * np.linalg.norm(g) / np.linalg.norm(result) if graft else result


def walk(rows: int, dim: int, steps: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions and gradients [steps, N, D] of a function with some negative curvature, visible."""
    generator = torch.Generator().manual_seed(seed)
    hessian = torch.randn(rows, dim, dim, generator=generator, dtype=F64)
    hessian = hessian @ hessian.mT - 0.3 * torch.eye(dim, dtype=F64)
    x = torch.randn(steps, rows, dim, generator=generator, dtype=F64)
    g = torch.einsum("nij,knj->kni", hessian, x)
    return x, g, torch.rand(steps, rows, generator=generator) < 0.8


@pytest.mark.parametrize("contiguous", [False, True])
@pytest.mark.parametrize(("size", "dim"), [(1, 1), (1, 3), (2, 2), (3, 3), (4, 3), (5, 3), (6, 4)])
def test_every_point_is_its_own_history(size: int, dim: int, contiguous: bool) -> None:
    rows, steps = 15, 3 * size + 6
    x, g, visible = walk(rows, dim, steps, seed=10 * size + dim)
    history = new_history(x[0], size, contiguous=contiguous)
    points = [Point(size, 0.05) for _ in range(rows)]
    rejected = 0
    for k in range(steps):
        accepted, candidates = record(history, size, x[k], g[k], visible[k], min_cosine=0.05)
        for row in range(rows):
            said = (bool(accepted[row]), bool(candidates[row]))
            if visible[k, row]:
                assert said == points[row].record(x[k, row].numpy(), g[k, row].numpy())
            else:
                assert said == (False, False)
            rejected += said == (False, True)
        assert header(history, size).steps.tolist() == visible[: k + 1].sum(0).tolist()
        pairs, _ = stored_pairs(history, size)
        held = (pairs != 0).any(2).sum(0).tolist()
        assert held == [len(point.pairs) for point in points]
        for graft in (True, False):
            found = direction(g[k], history, size, graft=graft)
            for row in range(rows):
                expected = points[row].direction(g[k, row].numpy(), graft)
                # pairs of a cosine of 0.05 and more, in float64
                np.testing.assert_allclose(found[row].numpy(), expected, rtol=1e-6, atol=1e-8)
    assert rejected > 0
    assert max(len(point.pairs) for point in points) == size


@pytest.mark.parametrize("graft", [True, False])
def test_a_step_is_record_and_direction(graft: bool) -> None:
    """With zero, broken and huge gradients among them, which are not visible."""
    x, g, _ = walk(40, 3, 12, seed=4)
    x, g = x.float(), g.float()
    g[3, 5], g[4, 5:8, 1], g[5, 7, 2], g[6, 9, :2] = 0.0, math.nan, math.inf, 0.0
    g[7, 11] = 1.0
    histories = [new_history(x[0], 5) for _ in "ab"]
    for k in range(12):
        visible = torch.isfinite(g[k]).all(1) & (g[k] != 0).any(1)
        both = record(histories[0], 5, x[k], g[k], visible, min_cosine=0.01)
        fed = direction(g[k], histories[0], 5, graft=graft)
        found = lqn_direction(x[k], g[k], histories[1], 5, min_cosine=0.01, graft=graft)
        torch.testing.assert_close(found[0], fed, rtol=0, atol=0, equal_nan=True)
        assert torch.equal(found[1], both[0])
        assert torch.equal(found[2], both[1])
        bits = [history.contiguous().view(torch.int32) for history in histories]
        assert torch.equal(*bits)
        assert bool((found[2] == visible).all()) == (k > 0)
        assert k < 3 or not torch.equal(fed, g[k])


def test_no_pair_leaves_every_bit_of_the_gradient() -> None:
    """Scaling there and back would round; no visible step, or one, is no pair yet."""
    x, g, _ = walk(500, 3, 2, seed=1)
    x, g = x.float(), g.float() / 3
    history = new_history(x[0], 5)
    for visible in (torch.zeros(500, dtype=torch.bool), torch.ones(500, dtype=torch.bool)):
        record(history, 5, x[0], g[0], visible, min_cosine=0.0)
        for graft in (True, False):
            assert torch.equal(direction(g[1], history, 5, graft=graft), g[1])
        torch.testing.assert_close(two_loop(g[1], history, 5), g[1], rtol=1e-6, atol=0)


@pytest.mark.parametrize("small", [1e-35, 0.0])
def test_components_of_all_sizes_in_one_gradient(small: float) -> None:
    """Divided by the largest: by the smallest, float32 would overflow."""
    g = torch.Generator().manual_seed(2)
    s = torch.randn(4, 20, 3, generator=g) * 1e8
    y = s * 1e-8 * torch.tensor([1.0, 2.0, 3.0])
    grad = torch.tensor([3e37, 1.0, small]).repeat(20, 1)
    found = direction(grad, history_from_pairs(s, y), 4, graft=True)
    wide = history_from_pairs(s.double(), y.double())
    expected = direction(grad.double(), wide, 4, graft=True)
    # float32: four pairs, of cosines of 0.9 and more
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e32)
    assert not torch.equal(found, grad)


@pytest.mark.parametrize(
    ("cosine", "bound", "taken"), [(0.0, 0.0, 0), (0.6, 0.6, 0), (0.6, 0.5, 1)]
)
def test_the_bound_itself_is_not_enough(cosine: float, bound: float, taken: int) -> None:
    history = new_history(torch.zeros(1, 2, dtype=F64), 3)
    visible = torch.ones(1, dtype=torch.bool)
    zero, s = torch.zeros(1, 2, dtype=F64), torch.tensor([[1.0, 0.0]], dtype=F64)
    y = torch.tensor([[cosine, math.sqrt(1 - cosine**2)]], dtype=F64)
    assert float(normalised(torch.stack([s.T, y.T])).cosine) == cosine
    record(history, 3, zero, zero, visible, min_cosine=bound)
    accepted, _ = record(history, 3, s, y, visible, min_cosine=bound)
    assert int(accepted) == taken


@pytest.mark.parametrize("size", [1e-44, 1e-30, 1e-3, 1.0, 7.0, 1e30, 3e37])
def test_length_of_vectors(size: float) -> None:
    x = torch.tensor([[3.0, 0.0, -1.0], [4.0, 0.0, 2.0], [0.0, 0.0, 2.0]]) * size
    found = length(x)
    expected = x.double().norm(dim=0)
    assert float(found[1]) == 0.0
    # float32; a denormal has few digits, but the same ones on both sides
    torch.testing.assert_close(found[[0, 2]].double(), expected[[0, 2]], rtol=1e-6, atol=1.5e-45)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_power_of_two_in_a_number(dtype: torch.dtype) -> None:
    least = torch.finfo(dtype).tiny
    numbers = torch.tensor([1.0, 3.0, 5.0, 0.1, least, least / 2, 0.0, torch.inf], dtype=dtype)
    below = torch.nextafter(numbers[:4], torch.zeros(4, dtype=dtype))
    found = power_of_two(torch.cat([numbers, below])).tolist()
    assert found == [1, 2, 4, 0.0625, least, 0, 0, torch.inf, 0.5, 2, 4, 0.0625]


# -- where it lies ---------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 3, 4, 16])
@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_a_history_in_either_layout(dim: int, size: int) -> None:
    points = torch.zeros(9, dim)
    for contiguous in (False, True):
        history = new_history(points, size, contiguous=contiguous)
        shape = history_shape(points, size)
        assert tuple(history.shape) == shape
        assert history.is_contiguous() == contiguous
        if not contiguous:
            assert history.stride(0) == 1  # of one lane, all points lie side by side
        history.copy_(torch.randn(shape))
        for wanted in (False, True):
            other = laid_out(history, contiguous=wanted)
            assert torch.equal(other, history)
            assert (other is history) == (wanted == contiguous)
            assert other.is_contiguous() == wanted
            assert wanted or other.stride(0) == 1


def test_the_layout_is_torchs_unless_asked() -> None:
    assert not new_history(torch.zeros(9, 3), 5).is_contiguous()
    assert MAX_HISTORY == 16


@pytest.mark.parametrize(("size", "dim", "slots"), [(1, 3, 2), (3, 3, 4), (4, 3, 4), (5, 3, 5)])
def test_the_header_gets_a_slot_where_the_spare_lanes_are_few(
    size: int, dim: int, slots: int
) -> None:
    assert history_shape(torch.zeros(7, dim), size) == (7, slots, 2 * (dim + 1))


@pytest.mark.parametrize("size", [1, 3, 4, 5, 16])
@pytest.mark.parametrize("dim", [1, 2, 3, 4, 7])
def test_pairs_and_header_lie_where_the_docstring_says(size: int, dim: int) -> None:
    """The CUDA kernel reads them there."""
    g = torch.Generator().manual_seed(size)
    s = torch.randn(size, 6, dim, generator=g, dtype=F64)
    y = s * (0.5 + torch.rand(size, 6, dim, generator=g, dtype=F64))
    history = history_from_pairs(s, y)
    position, gradient = torch.randn(2, 6, dim, generator=g, dtype=F64)
    head = header(history, size)
    head.position.copy_(position)
    head.gradient.copy_(gradient)
    head.steps.fill_(7)
    unit = (s * y).sum(2, keepdim=True).sqrt()
    for slot in range(size):
        newest = size - 1 - slot
        torch.testing.assert_close(history[:, slot, :dim], (s / unit)[newest])
        torch.testing.assert_close(history[:, slot, dim + 1 : 2 * dim + 1], (y / unit)[newest])
    if size > dim:
        assert torch.equal(history[:, :dim, dim], position)
        assert torch.equal(history[:, :dim, 2 * dim + 1], gradient)
        assert bool((history[:, dim, dim] == 7).all())
    else:
        assert torch.equal(history[:, size, :dim], position)
        assert torch.equal(history[:, size, dim + 1 : 2 * dim + 1], gradient)
        assert bool((history[:, size, dim] == 7).all())
    gamma = (s[-1] * y[-1]).sum(1) / (y[-1] ** 2).sum(1)
    torch.testing.assert_close(newest_gamma(history, size), gamma)
    found = stored_pairs(history, size)
    torch.testing.assert_close(found[0], (s / unit).flip(0))
    torch.testing.assert_close(found[1], (y / unit).flip(0))
    cells = Cells(cells_of(history), size)
    assert torch.equal(cells.steps, head.steps)
    assert torch.equal(cells.last, torch.stack([position.T, gradient.T]))
    for kind in (0, 1):
        assert torch.equal(cells.pairs[:, kind].mT, found[kind])


@pytest.mark.parametrize("accepted", [False, True])
def test_pairs_move_down_whatever_their_size(accepted: bool) -> None:
    """Their difference may leave float32."""
    s = torch.tensor([[[-3e38, 0.0, 0.0]], [[3e38, 0.0, 0.0]], [[-3e38, 0.0, 0.0]]])
    history = history_from_pairs(torch.ones(3, 1, 3), torch.ones(3, 1, 3))
    for slot, vector in enumerate(s):
        history[:, slot, :3] = vector
    before = history.clone()
    new = normalised(torch.ones(2, 3, 1)).vectors
    push(Cells(cells_of(history), 3), new, torch.tensor([accepted]))
    if not accepted:
        assert torch.equal(history, before)
    else:
        assert torch.equal(history[:, 1:3, :3], before[:, :2, :3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rows_are_overwritten_bit_for_bit(dtype: torch.dtype) -> None:
    numbers = [0.0, -0.0, 1.5, torch.inf, -torch.inf, torch.nan, 1e-310, 3e38]
    every = torch.tensor(numbers, dtype=torch.float64).to(dtype)
    old, new = torch.cartesian_prod(every, every).T.contiguous()
    mask = torch.arange(len(old)) % 3 == 0
    found = torch.stack([old, old])
    bits = BITS[dtype]
    overwrite(found.view(bits), torch.stack([new, old]).view(bits), bits_of(mask))
    assert torch.equal(found[0].view(bits), torch.where(mask, new.view(bits), old.view(bits)))
    assert torch.equal(found[1].view(bits), old.view(bits))
