"""Row edits of a trainer, in any order: no row ever sees what another row has collected."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import Parameter
from trainers import begun, edit_rows, train

from opt3dgs_optim import LQNAdam, Part, PhaseScheduler
from opt3dgs_optim.lbfgs.history import header

LR, SIZE = 0.01, 3
EDITS = ("step", "invisible", "prune", "grow", "relocate", "shuffle", "exp_avg_only", "resume")


class Twin:
    """One point alone in an optimizer of its own, which nobody edits."""

    def __init__(self, x: Tensor) -> None:
        self.x = Parameter(x.clone().reshape(1, 3))
        self.optimizer = LQNAdam([self.x], lr=LR, history_size=SIZE)

    def step(self, gradient: Tensor) -> None:
        self.x.grad = gradient.reshape(1, 3).clone()
        self.optimizer.step()

    def forget(self, keys: tuple[str, ...]) -> None:
        for key in keys:
            if key in self.optimizer.state[self.x]:
                self.optimizer.state[self.x][key].zero_()


def gradient(x: Tensor) -> Tensor:
    return x * torch.tensor([1.0, 7.0, 30.0]) + 0.1


class Trainer:
    """A trainer with one parameter; every row has a twin that says where it should be."""

    def __init__(self, n: int) -> None:
        x = torch.randn(n, 3, generator=torch.Generator().manual_seed(n))
        self.x = Parameter(x)
        self.optimizer = LQNAdam([self.x], lr=LR, history_size=SIZE)
        self.twins = [Twin(row) for row in x]

    def run(self, visible: Tensor) -> None:
        g = gradient(self.x.detach()) * visible.unsqueeze(1)
        self.x.grad = g.clone()
        for twin, row in zip(self.twins, g, strict=True):
            twin.step(row)
        self.optimizer.step()

    def replace(self, rows: Tensor, new: Tensor, keys: tuple[str, ...] | None = None) -> None:
        """A new Parameter of `rows` and `new`, the state edited by rows; pairs are dropped."""
        fresh = Parameter(torch.cat([self.x.detach()[rows], new]))
        state = self.optimizer.state.pop(self.x)
        for key in state if keys is None else keys:
            if key != "step" and key in state:
                zeros = torch.zeros((len(new), *state[key].shape[1:]))
                state[key] = torch.cat([state[key][rows], zeros])
        step = state["step"]
        self.optimizer.state[fresh] = state
        self.optimizer.param_groups[0]["params"] = [fresh]
        self.x = fresh
        self.twins = [self.twins[i] for i in rows.tolist()] + [Twin(row) for row in new]
        for i, twin in enumerate(self.twins):
            if i >= len(rows):  # a new row joins the others' bias correction
                twin.step(torch.zeros(3))
                twin.optimizer.state[twin.x]["step"] = step.clone()
            twin.forget(("history",))

    def edit(self, kind: str, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        n = len(self.x)
        order = torch.randperm(n, generator=generator)
        none = torch.zeros(0, 3)
        if kind == "step":
            self.run(torch.ones(n))
        elif kind == "invisible":
            self.run((torch.rand(n, generator=generator) < 0.5).float())
        elif not self.optimizer.state:
            return
        elif kind == "prune" and n > 1:
            self.replace(order[: n - 1].sort().values, none)
        elif kind == "grow":
            self.replace(torch.arange(n), torch.randn(1, 3, generator=generator))
        elif kind == "shuffle":
            self.replace(order, none)
        elif kind == "exp_avg_only":  # the INRIA family edits these two keys and no others
            self.replace(order[: max(n - 1, 1)], none, ("exp_avg", "exp_avg_sq"))
        elif kind == "relocate":  # in place: rows zeroed, same Parameter
            row = int(order[0])
            for key, value in self.optimizer.state[self.x].items():
                if key != "step":
                    value[row] = 0
            self.twins[row].forget(("exp_avg", "exp_avg_sq", "history"))
        elif kind == "resume":
            saved, self.x = self.optimizer.state_dict(), Parameter(self.x.detach().clone())
            self.optimizer = LQNAdam([self.x], lr=LR, history_size=SIZE)
            self.optimizer.load_state_dict(saved)


@settings(max_examples=150, deadline=None)
@given(
    st.integers(1, 5), st.lists(st.tuples(st.sampled_from(EDITS), st.integers(0, 99)), max_size=14)
)
def test_every_row_goes_where_it_would_go_alone(n: int, edits: list[tuple[str, int]]) -> None:
    trainer = Trainer(n)
    for kind, seed in [*edits, ("step", 0)]:
        trainer.edit(kind, seed)
    expected = torch.cat([twin.x.detach() for twin in trainer.twins])
    # the same float32 arithmetic in rows of another number: rounding may differ by an ulp or so
    torch.testing.assert_close(trainer.x.detach(), expected, rtol=2e-5, atol=2e-6)


def test_the_oracle_notices_a_foreign_history() -> None:
    """The test above can fail: keep the pairs over a shuffle, and it does."""
    trainer = Trainer(4)
    for _ in range(6):
        trainer.edit("step", 0)
    foreign = trainer.optimizer.state[trainer.x]["history"].flip(0).clone()
    trainer.optimizer.state[trainer.x]["history"].copy_(foreign)
    trainer.edit("step", 0)
    expected = torch.cat([twin.x.detach() for twin in trainer.twins])
    assert not torch.allclose(trainer.x.detach(), expected, rtol=2e-5, atol=2e-6)


def test_zeroed_row_is_an_empty_history() -> None:
    trainer = Trainer(2)
    for _ in range(5):
        trainer.edit("step", 0)
    trainer.edit("relocate", 0)
    counters = header(trainer.optimizer.state[trainer.x]["history"], SIZE).counter
    assert sorted(counters.bool().tolist()) == [False, True]


@pytest.mark.parametrize("zeroed", [True, False])
def test_a_point_moved_in_place_begins_anew_where_its_row_is_zeroed(zeroed: bool) -> None:
    """Otherwise it keeps its pairs, and gets one taken over the jump."""
    trainer = Trainer(3)
    for _ in range(6):
        trainer.edit("step", 0)
    state, new = trainer.optimizer.state[trainer.x], torch.tensor([0.4, -0.3, 0.2])
    others = state["history"][:2].clone()
    with torch.no_grad():
        trainer.x[2] = new
    for key in ("exp_avg", "exp_avg_sq", *["history"] * zeroed):
        state[key][2] = 0
    assert torch.equal(state["history"][:2], others)
    trainer.twins[2] = Twin(new)  # a new point, which joins the others' bias correction
    trainer.twins[2].step(torch.zeros(3))
    trainer.twins[2].optimizer.state[trainer.twins[2].x]["step"] = state["step"].clone()
    trainer.twins[2].forget(("history",))
    for _ in range(4):
        trainer.edit("step", 0)
    expected = torch.cat([twin.x.detach() for twin in trainer.twins])
    torch.testing.assert_close(trainer.x.detach()[:2], expected[:2], rtol=2e-5, atol=2e-6)
    assert torch.allclose(trainer.x.detach()[2], expected[2], rtol=2e-5, atol=2e-6) == zeroed


# -- a part's own rows ----------------------------------------------------------------------------


class Age(Part):
    """Counts each point's steps: [N] and [N, 3] tensors, whose zero rows mean nothing."""

    keys = ("age", "travelled")

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        if "age" not in state:
            state["age"] = torch.zeros(len(param))
            state["travelled"] = torch.zeros_like(param)
        state["age"] += 1
        state["travelled"] += grad
        return grad


def aged(steps: int = 5) -> tuple[dict[str, Parameter], Any, Any, Any]:
    splats, optimizers = begun(phases := PhaseScheduler(60, parts=[Age()]))
    train(splats, optimizers, phases, 0, steps)
    return splats, optimizers, phases, optimizers["means"]


def test_rows_begin_anew_after_gsplats_edits() -> None:
    """Also where the number of rows is what it was: other rows, for all that is known."""
    for keep, new in ((torch.arange(6), 2), (torch.arange(11), 1), (torch.arange(12).flip(0), 0)):
        splats, optimizers, phases, means = aged()
        edit_rows(splats, optimizers, keep, new)
        train(splats, optimizers, phases, 5, 6)
        assert means.state[splats["means"]]["age"].tolist() == [1.0] * (len(keep) + new)


def test_what_was_kept_of_other_rows_is_in_no_checkpoint() -> None:
    splats, optimizers, _, means = aged()
    edit_rows(splats, optimizers, torch.arange(6), 2)
    assert "age" not in means.state_dict()["state"][0]


def test_a_checkpoint_of_other_rows_is_said() -> None:
    """Trainers that load the optimizer before they resize the points."""
    _, _, _, means = aged()
    saved = means.state_dict()
    for key in ("exp_avg", "exp_avg_sq"):
        saved["state"][0][key] = saved["state"][0][key][:4]
    x = Parameter(torch.ones(4, 3))
    other = PhaseScheduler(60, parts=[Age()]).upgrade({"means": torch.optim.Adam([x])})["means"]
    with pytest.warns(UserWarning, match="of 12 rows for a parameter of 4: dropped"):
        other.load_state_dict(saved)
    assert "age" not in other.state[x]
    assert "exp_avg" in other.state[x]
