"""Whatever a trainer does in a training's life, the steps stay those of the reference, bit for bit.

One Hypothesis state machine: steps, row edits of both families of trainers, saves and loads in
their orders, copies, switches of phase, numbers that are not finite, ends and longer runs.
"""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import reference_step
import row_edits
import torch
from gaussians import RATES, adam_of, adams_of, make_gaussians, parameters, through_a_file
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from reference_step import (
    default_step,
    new_moments,
    paper_step,
    put_mean,
)
from torch import Tensor

from opt3dgs_optim import DEFAULTS, PhaseScheduler, paper_parts

NAMES = ("means", "scales", "quats", "opacities", "sh0")
OF_THE_END = (
    "mean",
    "rest",
    "began",
    "pairs",
    "visible_before",
)  # what is dropped with the end of a run
SEEDS = st.integers(0, 2**20)


class WholeLife(RuleBasedStateMachine):
    """A training by the package, and beside it one by the reference step."""

    @initialize(
        preset=st.sampled_from(["defaults", "paper"]),
        family=st.sampled_from(["gsplat", "inria"]),
        total=st.sampled_from([60, 120, 330]),
        num_points=st.integers(2, 8),
        stock=st.sampled_from(["", "foreach", "fused"]),
    )
    def begin(self, preset: str, family: str, total: int, num_points: int, stock: str) -> None:
        self.preset, self.inria, self.total = preset, family == "inria", total
        self.options = {stock: True} if stock else {}
        self.params: dict[str, Any] = parameters(num_points, *NAMES)
        self.theirs = {name: make_gaussians(num_points)[name] for name in NAMES}
        self.params["scales"].data[0] += 4.0  # longer than the bound
        self.theirs["scales"][0] += 4.0
        self.state: dict[str, Any] = {}
        self.iteration, self.finished, self.rates = 0, False, dict(RATES)
        self.upgrade(self.new_optimizers())

    def new_optimizers(self) -> Any:
        make: Any = adam_of if self.inria else adams_of
        return make(self.params, **self.options)

    def new_phases(self) -> PhaseScheduler:
        parts = paper_parts(self.total) if self.preset == "paper" else DEFAULTS
        return PhaseScheduler(self.total, parts=parts)

    def upgrade(self, optimizers: Any) -> None:
        self.phases = self.new_phases()
        self.given = self.phases.upgrade(optimizers)

    @property
    def optimizers(self) -> list[Any]:
        return [self.given] if self.inria else list(self.given.values())

    # -- steps -------------------------------------------------------------------------------------

    @rule(
        count=st.integers(1, 6),
        seed=SEEDS,
        share=st.sampled_from([0.0, 0.2, 1.0]),
        spoiled=st.sampled_from([(), (), ("means",), ("scales", "sh0")]),
        without=st.sampled_from([(), (), ("sh0",), ("means",), NAMES]),
    )
    def train(
        self, count: int, seed: int, share: float, spoiled: Any = (), without: Any = ()
    ) -> None:
        """Some iterations; a view sees a share of the points, regularisers pull at all of them."""
        generator = torch.Generator().manual_seed(seed)
        for _ in range(count):
            rows = len(self.theirs["means"])
            seen = torch.rand(rows, generator=generator) < share
            grads: dict[str, Tensor] = {}
            for name in NAMES:
                grad = torch.randn(self.theirs[name].shape, generator=generator)
                weight = seen.float() + (0.1 if name in ("scales", "opacities") else 0.0)
                grad *= weight.reshape(-1, *[1] * (grad.dim() - 1))
                if name in spoiled:
                    grad.flatten()[:: 1 + seed % 5] = (torch.nan, torch.inf)[seed % 2]
                if name not in without:
                    grads[name] = grad
            energy = torch.rand((), generator=generator) * 0.2
            self.iterate(grads, energy if seed % 7 else energy * torch.nan)

    def iterate(self, grads: dict[str, Tensor], energy: Tensor) -> None:
        for name, param in self.params.items():
            param.grad = None if name not in grads else grads[name].clone()
        if self.preset == "paper":
            self.phases.observe(energy)
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                name = next(n for n, p in self.params.items() if p is group["params"][0])
                group["lr"] = self.rates[name]
            optimizer.step()
        given = (self.theirs, grads, self.state, self.rates, self.iteration, self.total)
        if self.preset == "paper":
            paper_step(*given, energy)
        else:
            parts = dict(reference_step.DEFAULTS)
            if self.finished:
                del parts["averaging"]
            default_step(*given, parts)
        self.iteration += 1

    @rule(factor=st.sampled_from([0.0, 0.5, 1.7]), name=st.sampled_from(NAMES))
    def schedule_rates(self, factor: float, name: str) -> None:
        self.rates[name] = RATES[name] * factor

    @rule(share=st.sampled_from([0.3, 0.6, 0.9, 0.955, 0.97, 0.985]))
    def go_forward(self, share: float) -> None:
        """As where the trainer's count is another than that of its steps."""
        later = int(share * self.total)
        if later > self.iteration:
            self.phases.observe(iteration=later)
            self.iteration = later

    @rule(given=st.sampled_from([torch.ones(9, dtype=torch.bool), [True], 5]))
    def step_with_what_is_no_closure(self, given: Any) -> None:
        with pytest.raises(TypeError, match="torch's Adam takes a closure at most"):
            self.optimizers[0].step(given)

    # -- rows --------------------------------------------------------------------------------------

    @rule(seed=SEEDS, kind=st.sampled_from(["added", "removed", "relocated", "forgotten", "both"]))
    def edit_rows(self, seed: int, kind: str) -> None:
        """Then an iteration; in INRIA's trainer the new Parameters have no gradient in it."""
        count = len(self.params["means"])
        order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
        few = order[: 1 + count // 3]
        names = ("opacities",) if kind == "forgotten" else NAMES
        edits = {
            "added": [row_edits.added(few)],
            "removed": [row_edits.removed(few)] if count > len(few) else [],
            "both": [row_edits.added(few), row_edits.removed(few[1:])],
            "relocated": [row_edits.relocated(few, order.flip(0)[: len(few)])],
            "forgotten": [row_edits.forgotten()],
        }[kind]
        for edit in edits:
            row_edits.apply(edit, self.params, self.optimizers, names, self.inria)
            for name in names:
                own = self.state.get(name)
                if own is not None:
                    edit_own(edit, own)
                    self.drop_of(own)
                self.theirs[name] = edit.param(self.theirs[name])
        if self.inria and edits:
            self.train(1, seed, 1.0, (), names)
        self.train(1, seed, 1.0)

    @rule(seed=SEEDS)
    def move_in_place(self, seed: int) -> None:
        """A trainer that writes into its Parameters."""
        row = torch.tensor([seed % len(self.theirs["means"])])
        for name in NAMES:
            with torch.no_grad():
                self.params[name][row] = 1.5
            self.theirs[name][row] = 1.5
            holder = self.given if self.inria else self.given[name]
            holder.reset_rows(self.params[name], row)
            own = self.state.get(name)
            if own is not None:
                edit_own(row_edits.Edit(lambda p: p, lambda t: zeroed(t, row)), own)
        self.train(1, seed, 1.0)

    @rule(name=st.sampled_from(["means", "scales", "sh0"]), seed=SEEDS)
    def become_nan(self, name: str, seed: int) -> None:
        row = seed % len(self.theirs["means"])
        with torch.no_grad():
            self.params[name][row] = torch.nan
        self.theirs[name][row] = torch.nan

    @rule()
    def repair_nan(self) -> None:
        for tensors in (self.params, self.theirs):
            for each in tensors.values():
                each.detach()[each.detach().isnan()] = 0.5

    # -- saves, loads, copies ----------------------------------------------------------------------

    def saved(self) -> Any:
        return through_a_file([optimizer.state_dict() for optimizer in self.optimizers])

    def load(self, states: list[Any], upgraded_first: bool) -> None:
        """Into new Parameters and new optimizers, and a new scheduler."""
        rows = {name: param.detach().clone() for name, param in self.params.items()}
        self.params = {name: torch.nn.Parameter(each) for name, each in rows.items()}
        optimizers = self.new_optimizers()
        if upgraded_first:
            self.upgrade(optimizers)
        listed = [optimizers] if self.inria else list(optimizers.values())
        for optimizer, state in zip(listed, states, strict=True):
            optimizer.load_state_dict(state)
        if not upgraded_first:
            self.upgrade(optimizers)
        self.finished = False

    @rule(upgraded_first=st.booleans())
    def save_and_load(self, upgraded_first: bool) -> None:
        """gsplat's and nerfstudio's order, or INRIA's, which loads into a stock Adam."""
        self.load(self.saved(), upgraded_first)

    @rule(upgraded_first=st.booleans(), longer=st.integers(1, 90))
    def resume_in_a_longer_run(self, upgraded_first: bool, longer: int) -> None:
        if self.preset == "paper" and self.iteration >= self.total * 29 // 30:
            return  # in the longer run it explores again, which the reference does not do
        self.total += longer
        self.load(self.saved(), upgraded_first)
        self.drop(*OF_THE_END)

    @precondition(lambda self: self.preset != "paper" and self.state)
    @rule(upgraded_first=st.booleans(), seed=SEEDS)
    def load_a_stock_checkpoint(self, upgraded_first: bool, seed: int) -> None:
        """Adam's own state alone: its steps are the clock, and its moments are in world units."""
        states = self.saved()
        for each in states:
            for group in each["param_groups"]:
                group.pop("opt3dgs", None)
            for own in each["state"].values():
                for key in set(own) - {"step", *row_edits.MOMENTS}:
                    del own[key]
        self.load(states, upgraded_first)
        self.drop(*OF_THE_END)
        for key in ("share", "look", "bound"):
            self.state.pop(key, None)
        # The positions' optimizer is the clock; one of all has the steps of all.
        made = [self.state.get(name, {}).get("step", 0) for name in NAMES]
        self.iteration = max(made) if self.inria else made[NAMES.index("means")] or max(made)
        for name in NAMES:
            own = self.state[name]
            own["last"] = self.iteration - 1
            if self.preset == "defaults" and name == "means":
                own |= new_moments(self.theirs[name])
        self.train(1, seed, 1.0)

    @staticmethod
    def drop_of(own: dict[str, Any]) -> None:
        """What is kept for rows begins anew with a new Parameter."""
        for key in OF_THE_END:
            own.pop(key, None)

    def drop(self, *keys: str) -> None:
        for name in NAMES:
            for key in keys:
                self.state.get(name, {}).pop(key, None)

    @rule(pickled=st.booleans())
    def copied(self, pickled: bool) -> None:
        """Trainers that copy their model with its optimizers."""
        whole = (self.params, self.given)
        made = pickle.loads(pickle.dumps(whole)) if pickled else copy.deepcopy(whole)
        self.params, self.given = made
        self.phases = self.optimizers[0].training

    @precondition(lambda self: self.preset != "paper" and not self.finished)
    @rule()
    def finish(self) -> None:
        self.phases.finish()
        self.finished = True
        for name in NAMES:
            own = self.state.get(name, {})
            if "mean" in own:
                known = (own["began"] > 0).reshape(-1, *[1] * (self.theirs[name].dim() - 1))
                result = self.theirs[name].clone()
                put_mean(result, own)
                self.theirs[name] = torch.where(known, result, self.theirs[name])

    # -- what holds --------------------------------------------------------------------------------

    @invariant()
    def parameters_and_moments_are_the_references(self) -> None:
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                param = group["params"][0]
                name = next(n for n, p in self.params.items() if p is param)
                assert same(param.detach(), self.theirs[name]), name
                own, state = self.state.get(name), optimizer.state.get(param)
                if own is None or not state:
                    assert own is None or own["step"] == 0
                    continue
                for key in row_edits.MOMENTS:
                    assert same(state[key], own[key]), (name, key)


def same(a: Tensor, b: Tensor) -> bool:
    """Equal bit for bit; one NaN is as good as another."""
    return a.shape == b.shape and torch.equal(
        a.nan_to_num(7.0, 8.0, 9.0), b.nan_to_num(7.0, 8.0, 9.0)
    )


def zeroed(tensor: Tensor, rows: Tensor) -> Tensor:
    tensor[rows] = 0
    return tensor


def edit_own(edit: row_edits.Edit, own: dict[str, Any]) -> None:
    """What the reference keeps for the rows."""
    for key in (*row_edits.MOMENTS, *OF_THE_END):
        if key == "pairs" and key in own:
            x, g, s, y = own[key]
            own[key] = (*map(edit.kept, (x, g)), *(list(map(edit.kept, each)) for each in (s, y)))
        elif key in own:
            own[key] = edit.kept(own[key])


@pytest.mark.filterwarnings(
    "ignore:opt3dgs_optim. iteration .* not been finite",
    "ignore:PhaseScheduler. iteration .* of total_steps",
    "ignore:PhaseScheduler. iteration .* comes after finish",
)
def test_whole_life() -> None:
    run_state_machine_as_test(
        WholeLife,
        settings=settings(
            max_examples=100,
            stateful_step_count=25,
            deadline=None,
            suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
        ),
    )
