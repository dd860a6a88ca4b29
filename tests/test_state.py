"""What hooks see of a parameter's state, and to whose rows it belongs: one object at a time."""

from __future__ import annotations

import copy
import itertools
import math
import re
import weakref
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import Kept
from opt3dgs_optim.state import (
    ParameterRecord,
    ParameterState,
    RowOwnership,
    broadcast_rows,
    check_kept,
    check_mask,
    check_moments,
    is_finite_sum,
    restart_rows,
    rows_of,
)

KEPT = {
    "rows": Kept("rows"),
    "count": Kept("count", per="parameter", initial=7.0),
    "clock": Kept("clock", per="training", initial=3.0),
}
DECLARED = {"Mine": KEPT, "Mine#2": KEPT}


def adam_state(param: Tensor, value: float = 1.0) -> dict[str, Any]:
    moments = {key: torch.full_like(param, value) for key in ("exp_avg", "exp_avg_sq")}
    return {"step": torch.tensor(5.0), **moments}


class Place:
    """One parameter with all that its state is made of."""

    def __init__(self, param: Tensor | None = None) -> None:
        self.param = torch.zeros(4, 3) if param is None else param
        self.adam, self.training = adam_state(self.param), dict[str, Tensor]()
        self.record = ParameterRecord()

    def view(self, part: str = "Mine") -> ParameterState:
        view = self.record.view(self.param, self.adam, DECLARED, self.training)
        return view.of(part)


# -- small functions ------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "rows"), [((), 1), ((0,), 0), ((5,), 5), ((2, 7, 3), 2)])
def test_the_number_of_rows(shape: tuple[int, ...], rows: int) -> None:
    assert rows_of(torch.zeros(shape)) == rows


@pytest.mark.parametrize("shape", [(4,), (4, 3), (4, 2, 3)])
def test_rows_are_broadcast_over_all_other_dimensions(shape: tuple[int, ...]) -> None:
    rows, like = torch.tensor([True, False, True, False]), torch.ones(shape)
    found = torch.where(broadcast_rows(rows, like), like, 0.0)
    assert found.shape == shape
    for i, kept in enumerate(rows.tolist()):
        assert torch.equal(found[i], like[i] if kept else torch.zeros_like(like[i]))
    assert broadcast_rows(torch.tensor(True), like).shape == ()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), complex(0.0, float("nan"))])
def test_a_sum_is_finite_where_all_of_it_is(bad: complex) -> None:
    values = torch.ones(5, dtype=torch.complex64 if isinstance(bad, complex) else torch.float32)
    assert is_finite_sum(values)
    values[3] = torch.tensor(bad)
    assert not is_finite_sum(values)
    assert not is_finite_sum(torch.full((2,), 3e38))


# -- whose rows -----------------------------------------------------------------------------------


def test_what_was_not_seen_with_these_rows_is_dropped() -> None:
    owner, param, other = RowOwnership(), Parameter(torch.zeros(4)), Parameter(torch.zeros(4))
    state = {"a": torch.zeros(4), "b": torch.zeros(4), "step": torch.zeros(())}
    owner.claim(param, state, ["a", "absent"])
    owner.drop_foreign(param, state, ["a", "b", "absent"])
    assert set(state) == {"a", "step"}, "b was never claimed, the step was not asked for"
    owner.drop_foreign(param, state, ["a"])
    assert set(state) == {"a", "step"}
    owner.drop_foreign(other, {**state}, [])
    found = {**state}
    owner.drop_foreign(other, found, ["a"])
    assert set(found) == {"step"}, "another parameter object, of as many rows"
    param.data = torch.zeros(5)
    owner.drop_foreign(param, state, ["a"])
    assert set(state) == {"step"}, "the same object, of another number of rows"


def test_a_tensor_in_the_place_of_a_claimed_one_is_foreign() -> None:
    owner, param = RowOwnership(), Parameter(torch.zeros(4))
    state = {"a": torch.zeros(4)}
    owner.claim(param, state, ["a"])
    state["a"] = state["a"].clone()
    owner.drop_foreign(param, state, ["a"])
    assert state == {}


# -- what the hooks see ---------------------------------------------------------------------------


def test_the_view_is_of_the_present_parameter_and_state() -> None:
    place = Place()
    first = place.view()
    assert place.view("Mine#2") is first
    place.adam = adam_state(place.param)
    assert place.view().adam is place.adam
    place.param = torch.zeros(4, 3)
    assert place.view().param is place.param


def test_a_view_that_has_let_go_holds_no_memory() -> None:
    place = Place()
    view = place.view()
    param = weakref.ref(place.param)
    view.let_go()
    place.param, place.adam = torch.zeros(2, 3), {}
    assert param() is None


def test_it_is_a_mapping_of_moments_and_of_what_the_part_keeps() -> None:
    place = Place()
    place.adam |= {"strange": 1}
    view = place.view()
    names = {"step", "exp_avg", "exp_avg_sq", "rows", "count", "clock"}
    assert set(view) == names
    assert len(view) == len(list(view)) == 6
    assert all(name in view for name in names)
    assert "max_exp_avg_sq" not in view
    assert "strange" not in view
    assert view["exp_avg"] is place.adam["exp_avg"]
    assert view.peek("exp_avg_sq") is place.adam["exp_avg_sq"]
    with pytest.raises(KeyError):
        view["absent"]
    place.record.last_step = 12
    assert view.last_step == 12


def test_it_makes_what_is_kept_where_it_is_declared() -> None:
    place = Place()
    view = place.view()
    assert torch.equal(view["rows"], torch.zeros(4, 3))
    assert view["count"].item() == 7.0
    assert view["clock"].item() == 3.0
    assert place.adam["Mine.rows"] is view["rows"]
    assert place.record.numbers["Mine.count"] is view["count"]
    assert place.training["Mine.clock"] is view["clock"]
    view["count"].add_(1)
    assert place.view("Mine#2")["count"].item() == 7.0
    assert place.view()["count"].item() == 8.0


@pytest.mark.parametrize("name", ["rows", "count", "clock"])
def test_it_is_assigned_in_place_and_deleted(name: str) -> None:
    view = Place().view()
    initial, kept = view[name].clone(), view[name]
    view[name] = torch.full_like(initial, 2.5)
    assert view[name] is kept
    assert torch.equal(kept, torch.full_like(initial, 2.5))
    view[name] = 4
    assert torch.equal(kept, torch.full_like(initial, 4.0))
    view[name] += 1
    assert torch.equal(kept, torch.full_like(initial, 5.0))
    del view[name]
    assert view[name] is not kept
    assert torch.equal(view[name], initial)
    del view[name]
    del view[name]  # of nothing
    with pytest.raises(KeyError):
        del view["exp_avg"]


def test_rows_are_exchanged_for_the_same_laid_out_anew() -> None:
    place = Place()
    view = place.view()
    other = torch.ones(3, 4).t()
    view["rows"] = other
    view.exchange("rows", other)
    assert view["rows"] is place.adam["Mine.rows"] is other


def test_what_is_kept_follows_the_parameter_to_its_device() -> None:
    place = Place()
    rows, count = place.view()["rows"], place.view()["count"]
    place.param = torch.zeros(4, 3, device="meta")
    for name, was in (("rows", rows), ("count", count)):
        assert place.view()[name].device.type == "meta"
        assert place.view()[name] is place.view()[name]
        assert was.device.type == "cpu"


def test_a_pickled_record_has_no_view() -> None:
    place = Place()
    place.view()["count"] = 2
    place.record.last_step = 4
    other = copy.deepcopy(place.record)
    known = {"last_step": 4, "last_moved": None, "units": None, "numbers": {"Mine.count": 2}}
    assert vars(other) == {**known, "param": None, "_view": None}


# -- what is undone -------------------------------------------------------------------------------

ROWS = torch.tensor([True, False, True, False])
NAMES = ("exp_avg", "rows", "count", "clock")
# By what is held still and whether the step counts: the factor on each row of what is read.
ALL, NONE, MASK = [1, 1, 1, 1], [0, 0, 0, 0], [1, 0, 1, 0]
OUTCOMES: dict[tuple[bool, bool], dict[str, list[int]]] = {
    (False, True): {"exp_avg": ALL, "rows": ALL, "count": [1], "clock": [1]},
    (False, False): {"exp_avg": ALL, "rows": NONE, "count": [0], "clock": [0]},
    (True, True): {"exp_avg": MASK, "rows": MASK, "count": [1], "clock": [1]},
    # An event has happened, whether its step counts or not: the moments' edit holds.
    (True, False): {"exp_avg": MASK, "rows": NONE, "count": [0], "clock": [0]},
}


@pytest.mark.parametrize("kind", [bool, torch.tensor])
@pytest.mark.parametrize(("masked", "counts"), OUTCOMES)
def test_what_hooks_have_written_is_undone(masked: bool, counts: bool, kind: Any) -> None:
    place = Place()
    view = place.view()
    old = {name: view[name].clone() for name in NAMES}
    view.guard(moments=True)
    for name in NAMES:
        view[name].add_(1.0)
        view[name].mul_(2.0)  # read again: what is saved is what was there first
    view.settle(ROWS if masked else None, kind(counts))
    for name, written in OUTCOMES[masked, counts].items():
        new = 2 * (old[name] + 1)
        keep = torch.tensor(written, dtype=torch.bool)
        keep = keep[:, None] if old[name].dim() else keep[0]
        assert torch.equal(place.view()[name], torch.where(keep, new, old[name])), name


def test_what_is_deleted_is_back_after_a_step_that_does_not_count() -> None:
    view = Place().view()
    view["count"] = 4
    view.guard(moments=False)
    view["count"].add_(1)
    del view["count"]
    view.settle(None, False)
    assert view["count"].item() == 4


def test_without_their_guard_moments_are_not_copied() -> None:
    place = Place()
    view = place.view()
    view.guard(moments=False)
    view["exp_avg"].add_(1.0)
    view.settle(ROWS, False)
    assert torch.equal(place.adam["exp_avg"], torch.full((4, 3), 2.0))


def test_nothing_is_undone_after_it_is_settled() -> None:
    place = Place()
    view = place.view()
    for name in NAMES:
        assert name in view
    view.guard(moments=True)
    before = view["rows"].clone()
    view["rows"].add_(1)
    view.settle(None, False)
    view["rows"].add_(2)
    view["exp_avg"].add_(2)
    view.settle(ROWS, False)
    assert torch.equal(view["rows"], before + 2)
    assert torch.equal(view["exp_avg"], torch.full((4, 3), 3.0))


# -- what is checked ------------------------------------------------------------------------------


def test_a_mask_is_flat_and_bool() -> None:
    plain = torch.tensor([True, False, True])
    assert check_mask("A", [plain], 3).tolist() == [True, False, True]
    for mask in (plain[:, None], plain.float(), 2 * plain.int(), -1.0 * plain.float()):
        found = check_mask("A", [mask], None)
        assert found.dtype == torch.bool
        assert found.tolist() == [True, False, True]
    found = check_mask("A", [torch.tensor([0.5, 0.0], requires_grad=True)], 2)
    assert found.tolist() == [True, False]


@pytest.mark.parametrize(
    ("masks", "num_points", "said"),
    [
        ([], None, "A.step: 0 masks, but one is needed"),
        ([torch.ones(2)] * 2, None, "A.step: 2 masks, but one is needed"),
        ([[True]], None, "visible=[True], but a mask of shape [N] is needed"),
        ([torch.tensor(True)], None, "but a mask of shape [N] is needed"),
        ([torch.ones(2, dtype=torch.complex64)], None, "but a mask of shape [N] is needed"),
        ([torch.ones(2)], 3, "A.step: num_points=3, but the mask has 2 rows"),
        ([torch.ones(2)], 0, "A.step: num_points=0, but the mask has 2 rows"),
    ],
)
def test_bad_masks(masks: list[Any], num_points: int | None, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        check_mask("A", masks, num_points)


@pytest.mark.parametrize("key", ["exp_avg", "exp_avg_sq"])
def test_moments_may_have_other_rows_but_no_other_shape(key: str) -> None:
    param = torch.zeros(4, 3)
    check_moments("A", param, adam_state(param))
    check_moments("A", param, adam_state(torch.zeros(9, 3)))
    for wrong, said in ((torch.zeros(4, 2), "(4, 2)"), (torch.zeros(4), "(4,)"), ("no", "no")):
        with pytest.raises(ValueError, match=re.escape(f"A: {key} has shape {said}, but")):
            check_moments("A", param, {**adam_state(param), key: wrong})
    for absent in ("step", key):
        saved = {name: value for name, value in adam_state(param).items() if name != absent}
        with pytest.raises(ValueError, match=absent):
            check_moments("A", param, saved)


def test_moments_may_overflow_in_half_precision_and_where_the_parameter_is_lost() -> None:
    param = torch.zeros(4, 3)
    for dtype, value in itertools.product((torch.float16, torch.float32), (math.inf, math.nan)):
        for key in ("exp_avg", "exp_avg_sq"):
            saved = adam_state(param.to(dtype))
            saved[key][2, 1] = value
            if (dtype, key, value) == (torch.float16, "exp_avg_sq", math.inf):
                check_moments("A", param, saved)
                continue
            with pytest.raises(ValueError, match=f"A: {key} is not finite.* in 1 of 4 rows"):
                check_moments("A", param, saved)
            lost = param.clone()
            lost[2, 1] = math.nan
            check_moments("A", lost, saved)
            with pytest.raises(ValueError, match=key):
                check_moments("A", torch.full((9, 3), math.nan), saved)  # of other rows


def test_complex_moments_are_those_of_a_complex_parameter() -> None:
    param = torch.zeros(4, dtype=torch.complex64)
    check_moments("A", param, adam_state(param))
    for key in ("exp_avg", "exp_avg_sq"):
        with pytest.raises(ValueError, match=f"A: {key} is of torch.float32"):
            check_moments("A", param, {**adam_state(param), key: torch.zeros(4)})
        broken = adam_state(param)
        broken[key][1] = complex(0.0, math.nan)
        with pytest.raises(ValueError, match=f"A: {key} is not finite.* in 1 of 4 rows"):
            check_moments("A", param, broken)


@pytest.mark.parametrize("shape", [(4, 3), (4,), (4, 2, 3), (), (0, 3)])
def test_rows_that_are_not_finite_begin_anew_unless_the_parameter_is_lost(shape: Any) -> None:
    param, mean = torch.ones(shape), torch.ones(shape)
    count = torch.ones(shape[:1])
    entries = {"mean": Kept("mean"), "count": Kept("count", shape=(), allowed=(0, 9))}
    assert restart_rows({"mean": mean, "count": count}, entries, param) == 0
    if not param.numel():
        return
    mean.view(-1)[-1] = math.inf
    kept = {"mean": mean, "count": count}
    assert restart_rows(kept, entries, param) == 1
    assert bool(mean.isinf().any())  # the checkpoint itself is not written to
    for value in kept.values():
        last = value[-1] if value.dim() else value
        assert not last.any()
        assert bool((value[:-1] == 1).all() if value.dim() else True)
    beyond = count.clone()
    beyond.view(-1)[-1] = 10
    kept = {"mean": torch.ones_like(mean), "count": beyond}
    assert restart_rows(kept, entries, param) == 1
    assert not (kept["mean"][-1] if param.dim() else kept["mean"]).any()
    param.view(-1)[-1] = math.nan
    assert restart_rows({"mean": mean, "count": count}, entries, param) == 0


def test_what_is_kept_per_row_is_checked() -> None:
    kept, param = Kept("k", shape=(2,)), torch.zeros(4, 3)
    for rows in (6, 4, 0):
        check_kept("A", "P.k", kept, torch.ones(rows, 2), param)
    for value, said in (
        (None, "P.k=None, but a tensor is needed"),
        (torch.ones(6), "P.k has shape (6,), but (6, 2) is needed"),
        (torch.ones(()), "P.k has shape (), but (4, 2) is needed"),
        (torch.ones(6, 2).to_sparse(), "P.k has shape (6, 2), but dense (6, 2) is needed"),
        (torch.ones(6, 3), "P.k has shape (6, 3), but (6, 2) is needed"),
        (torch.ones(6, 2).double(), "P.k is of torch.float64, but torch.float32 is needed"),
    ):
        with pytest.raises(ValueError, match=re.escape(said)):
            check_kept("A", "P.k", kept, value, param)
    whole = Kept("k", dtype=torch.int64)
    check_kept("A", "P.k", whole, torch.ones(4, 3, dtype=torch.int64), param)
    check_kept("A", "P.k", Kept("k"), torch.ones(()), torch.zeros(()))
