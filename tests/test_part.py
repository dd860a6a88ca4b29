"""The protocol's proof: a part of a stranger's gets everything without the package knowing it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
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
    upgraded,
)

import opt3dgs_optim
from opt3dgs_optim import (
    Annealing,
    Curvature,
    Kept,
    OwnFrame,
    Part,
    Phase,
    PhaseScheduler,
    RunLog,
)
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.runs.log import RESERVED

SOURCE = Path(opt3dgs_optim.__file__).parent
TOTAL = 40


class SignAgreement(Part):  # fifteen lines
    """A coordinate whose gradient disagrees with the mean of the last ones is not stepped."""

    during = Phase.EXPLOITATION
    keeps = (Kept("disagreed", shape=()),)  # per point: how often

    def __init__(self, patience: float = 0.5) -> None:
        self.patience, self.share = patience, 0.0

    def before(self, group: Any, param: Tensor, grad: Tensor, state: Any, course: Any) -> Tensor:
        against = grad * state["exp_avg"] < 0
        self.share = self.share * self.patience + (1 - self.patience) * against.float().mean()
        state["disagreed"] += against.reshape(len(param), -1).any(1)
        return torch.where(against, 0.0, grad)

    def numbers(self, course: Any) -> dict[str, Any]:
        return {"disagreeing": self.share}

    def state_dict(self) -> dict[str, Any]:
        return {"share": float(self.share)}

    def load_state_dict(self, state: Any) -> None:
        self.share = torch.tensor(state["share"])

    def evidence(self, course: Any) -> Tensor:
        return torch.as_tensor(self.share, dtype=torch.float32).reshape(1)

    def useless(self, evidence: list[float], course: Any) -> str | None:
        return "all agree" if course.exploiting and evidence[0] < 1e-3 else None


def pulled(splats: dict[str, Parameter], optimizers: Any, phases: Any, steps: int) -> None:
    """Gradients whose sign changes in every other point and step."""
    every = optimizers.values() if isinstance(optimizers, dict) else [optimizers]
    for _ in range(steps):
        phases.observe(0.1)
        flip = -1.0 if phases.iteration % 2 else 1.0
        for param in splats.values():
            odd = (torch.arange(len(param)) % 2 == 1).reshape(-1, *[1] * (param.dim() - 1))
            param.grad = torch.where(odd, flip, 1.0).expand_as(param).clone()
        for optimizer in every:
            optimizer.step()


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_it_acts_in_its_phase_only_and_does_what_it_says(make: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, SignAgreement(), switch=20, make=make)
    pulled(splats, optimizers, phases, 20)
    assert "SignAgreement.disagreed" not in state_of(optimizers, splats["means"])
    before = state_of(optimizers, splats["means"])["exp_avg"].clone()
    pulled(splats, optimizers, phases, 1)
    state = state_of(optimizers, splats["means"])
    assert state["SignAgreement.disagreed"].tolist() == [0.0, 1.0] * 6
    torch.testing.assert_close(state["exp_avg"][1::2], 0.9 * before[1::2])


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
@pytest.mark.parametrize("at", [12, 27])
def test_its_rows_and_its_state_are_in_checkpoints(make: Any, at: int, tmp_path: Path) -> None:
    ends = []
    for cut in (False, True):
        splats, part = make_splats(), SignAgreement()
        phases = only(TOTAL, Annealing(names=GAUSSIAN), part, switch=20)
        optimizers: Any = phases.upgrade(make(splats))
        pulled(splats, optimizers, phases, at)
        if cut:
            every = optimizers if isinstance(optimizers, dict) else {"all": optimizers}
            torch.save({n: o.state_dict() for n, o in every.items()}, tmp_path / "state.pt")
            saved = torch.load(tmp_path / "state.pt", weights_only=True)
            part = SignAgreement()
            phases = only(TOTAL, Annealing(names=GAUSSIAN), part, switch=20)
            optimizers = phases.upgrade(make(splats))
            every = optimizers if isinstance(optimizers, dict) else {"all": optimizers}
            for name, optimizer in every.items():
                optimizer.load_state_dict(saved[name])
        pulled(splats, optimizers, phases, TOTAL - at)
        ends.append((splats, float(part.share), state_of(optimizers, splats["quats"])))
    assert_same(ends[0][0], ends[1][0])
    assert ends[0][1] == ends[1][1] > 0
    assert torch.equal(ends[0][2]["SignAgreement.disagreed"], ends[1][2]["SignAgreement.disagreed"])


def test_masks_leave_its_other_rows_alone() -> None:
    splats = make_splats()
    phases = only(TOTAL, SignAgreement(), switch=0)
    means: Any = phases.upgrade(gsplat_optimizers(splats))["means"]
    for step in range(6):
        phases.observe(0.1)
        splats["means"].grad = torch.full((12, 3), (-1.0) ** step)
        means.step(visible=torch.arange(12) < (12 if step < 3 else 4))
    # against in each second step, for the others in the first three only
    assert means.state[splats["means"]]["SignAgreement.disagreed"].tolist() == [3.0] * 4 + [1.0] * 8


EDITS = [(torch.arange(6), 2), (torch.arange(11), 1), (torch.arange(12).flip(0), 0)]


@pytest.mark.parametrize(("keep", "new"), EDITS, ids=["fewer", "as many", "in another order"])
def test_its_rows_begin_anew_after_the_trainers_edits(keep: Tensor, new: int) -> None:
    """Also where the number of rows is what it was: other rows, for all that is known."""
    splats, phases, optimizers = upgraded(TOTAL, SignAgreement(), switch=0)
    pulled(splats, optimizers, phases, 5)
    assert bool((state_of(optimizers, splats["scales"])["SignAgreement.disagreed"] > 1).any())
    edit_rows(splats, optimizers, keep, new)
    assert "SignAgreement.disagreed" not in optimizers["means"].state_dict()["state"][0]
    pulled(splats, optimizers, phases, 1)
    counts = state_of(optimizers, splats["scales"])["SignAgreement.disagreed"]
    assert len(counts) == len(keep) + new
    assert not bool((counts > 1).any())


def test_it_is_in_the_repr_and_in_the_upgrades_line(caplog: pytest.LogCaptureFixture) -> None:
    phases = only(TOTAL, SignAgreement(), Annealing(names=GAUSSIAN))
    with caplog.at_level("INFO", "opt3dgs_optim"):
        means = phases.upgrade(gsplat_optimizers(make_splats()))["means"]
    for said in (repr(phases), repr(means), caplog.text):
        assert "SignAgreement()" in said


def test_its_numbers_are_columns_of_the_run_log(tmp_path: Path) -> None:
    splats = make_splats()
    with RunLog(tmp_path / "run.jsonl") as log:
        phases = PhaseScheduler(TOTAL, 20, [SignAgreement(), Annealing(names=GAUSSIAN)], log=log)
        optimizers = phases.upgrade(gsplat_optimizers(splats))
        pulled(splats, optimizers, phases, TOTAL)
    lines = [json.loads(line) for line in (tmp_path / "run.jsonl").read_text().splitlines()]
    columns = [set(line) & {"disagreeing", "annealing"} for line in lines if line["kind"] == "step"]
    assert columns == [{"annealing"}] * 20 + [{"annealing", "disagreeing"}] * 20


class Column(Part):
    """Says one thing of itself, from an iteration on."""

    names = None

    def __init__(self, said: Any, first: int = 0) -> None:
        self.said, self.first = said, first

    def numbers(self, course: Any) -> Any:
        return self.said if course.current >= self.first else {}


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize(
    "said",
    [
        *({name: 1.0} for name in RESERVED),
        {"energy": 1.0},
        {"self": 1.0},
        {"mine": 1.0, "energy": torch.ones(())},
        None,
        [("mine", 1.0)],
        "mine",
        1.0,
    ],
)
def test_a_column_of_the_logs_own_is_refused_and_the_part_is_named(
    said: Any, first: int, tmp_path: Path
) -> None:
    with RunLog(tmp_path / "run.jsonl") as log:
        phases = PhaseScheduler(TOTAL, 20, [Column({"mine": 1.0}), Column(said, first)], log=log)
        for _ in range(first):
            phases.observe(0.1)
        with pytest.raises(ValueError, match=r"Column#2\.numbers: .* but a dict is needed"):
            phases.observe(0.1)
    steps = [line for line in (tmp_path / "run.jsonl").read_text().splitlines() if "mine" in line]
    assert len(steps) == first


def test_an_adaptive_training_switches_it_off() -> None:
    splats, part = make_splats(), SignAgreement()
    phases = PhaseScheduler(200, 0, [part], adaptive=True)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train_agreeing = torch.ones(12, 3)
    for _ in range(100):
        phases.observe(0.1)
        splats["means"].grad = train_agreeing.clone()
        optimizers["means"].step()
    assert phases.switched_off == {"SignAgreement": "all agree"}
    assert "SignAgreement(): switched off, all agree" in repr(phases)
    assert phases.hooks["before"] == []
    assert phases.numbers() == {}


class Everywhere(Part):
    """Acts on every group, Gaussian or not."""

    names = None

    def factor(self, group: Any, course: Any) -> float:
        return 0.0


@pytest.mark.parametrize("names", [None, ("means",), ("sh0", "quats")])
def test_a_part_says_which_parameters_it_acts_on(names: Any) -> None:
    class Some(Everywhere):
        pass

    Some.names = names
    splats, exposure = make_splats(), Parameter(torch.ones(4))
    optimizer = inria_optimizer(splats)
    optimizer.add_param_group({"params": [exposure], "lr": 0.1, "name": "exposure"})
    phases = only(TOTAL, Some())
    phases.upgrade(optimizer)
    everything = {**splats, "exposure": exposure}
    before = {name: p.detach().clone() for name, p in everything.items()}
    for param in everything.values():
        param.grad = torch.ones_like(param)
    phases.observe(0.1)
    optimizer.step()
    still = {name for name, p in everything.items() if torch.equal(before[name], p)}
    assert still == (set(everything) if names is None else set(names))


def test_factors_of_all_parts_multiply() -> None:
    class Two(Part):
        def factor(self, group: Any, course: Any) -> Tensor:
            return torch.tensor(2.0, dtype=torch.float64)

    class Quarter(Part):
        def factor(self, group: Any, course: Any) -> float | None:
            return None if group["name"] == "sh0" else 0.25

    splats = make_splats()
    before = {name: p.detach().clone() for name, p in splats.items()}
    phases = only(TOTAL, Two(), Quarter(), Two())
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    phases.observe(0.1)
    for name, factor in (("means", 1.0), ("sh0", 4.0)):
        splats[name].grad = torch.ones_like(splats[name])
        optimizers[name].step()
        moved = (before[name] - splats[name].detach()).mean()
        rate = optimizers[name].param_groups[0]["lr"]
        assert float(moved) == pytest.approx(rate * factor, rel=1e-3)


def test_the_last_part_with_a_pixel_loss_wins() -> None:
    class Cubed(Part):
        def pixel_loss(self, error: Tensor) -> Tensor:
            return error.abs().pow(3).mean()

    phases = only(TOTAL, opt3dgs_optim.SquaredLoss(), Cubed(), switch=0)
    assert float(phases.pixel_loss(torch.full((2,), 0.5), torch.zeros(2))) == 0.125


def test_a_hook_that_is_not_overridden_is_never_called() -> None:
    class Quiet(Part):
        pass

    phases = only(TOTAL, Quiet())
    for hook in ("observe", "pixel_loss", "factor", "before", "after"):
        assert phases.hooks[hook] == []


# -- a part is one short file, whose name the presets alone know ---------------------------------


def test_a_part_is_one_file_that_only_the_presets_know() -> None:
    knows = {
        path.relative_to(SOURCE).as_posix()
        for path in SOURCE.rglob("*.py")
        if re.search(r"\bAveraging\b", path.read_text())
    }
    # The checkpoint reads what format 2 called it.
    assert knows == {"__init__.py", "presets.py", "parts/averaging.py", "checkpoint.py"}


def test_the_core_knows_no_part() -> None:
    """What the course and the steps are made of imports none of the parts."""
    for name in (
        *("part", "course", "stepadam", "state", "checkpoint", "overrides", "upgrading"),
        *("names", "checks"),
    ):
        text = (SOURCE / f"{name}.py").read_text()
        assert "opt3dgs_optim.parts" not in text, name


def test_a_dropped_step_of_several_parameters_leaves_shared_numbers_alone() -> None:
    """One number for all of an optimizer's parameters, each of which has counted in it."""

    class Count(Part):
        keeps = (Kept("all", per="training"), Kept("own", per="parameter"))

        def before(
            self, group: Any, param: Tensor, grad: Tensor, state: Any, course: Any
        ) -> Tensor:
            state["all"] += 1
            state["own"] += 1
            return grad

        def after(self, group: Any, param: Tensor, state: Any, course: Any) -> None:
            state["all"] += 10

    splats = make_splats()
    phases = PhaseScheduler(TOTAL, parts=[Count()])
    optimizer = phases.upgrade(inria_optimizer(splats))
    counted = []
    for loss in (0.1, float("nan"), 0.1):
        for param in splats.values():
            param.grad = torch.ones_like(param)
        phases.observe(loss)
        optimizer.step()
        counted.append(float(phases.kept_numbers["Count.all"]) / len(splats))
    assert counted == [11, 11, 22]


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"during": "exploration"}, "during='exploration', but a Phase or None"),
        ({"names": ("xyz",)}, r"names=\('xyz',\), but None or a tuple of gsplat's names"),
        ({"names": "means"}, "names='means', but"),
        ({"keeps": Kept("n")}, "keeps=.*, but a tuple of Kept is needed"),
    ],
    ids=str,
)
def test_what_a_part_says_of_itself_is_checked(attributes: dict[str, Any], said: str) -> None:
    part = type("Own", (Part,), attributes)()
    with pytest.raises(ValueError, match=f"PhaseScheduler: Own.*{said}"):
        PhaseScheduler(TOTAL, parts=[part])


def test_how_often_something_is_kept_is_checked() -> None:
    with pytest.raises(ValueError, match="Kept: per='point', but 'row' or"):
        Kept("n", per="point")  # pyright: ignore[reportArgumentType]


def test_one_part_alone_is_no_list_of_parts() -> None:
    with pytest.raises(TypeError, match=r"parts=Annealing.*, but a list of parts is needed"):
        PhaseScheduler(TOTAL, parts=Annealing())  # pyright: ignore[reportArgumentType]


def test_a_window_holds_for_energies_and_the_photometric_term() -> None:
    class Late(Part):
        def __init__(self) -> None:
            self.observed: list[int] = []

        def window(self, course: Any) -> tuple[int, int]:
            return 5, 8

        def observe(self, energy: Tensor, valid: Any, course: Any) -> None:
            self.observed.append(course.current)

        def pixel_loss(self, error: Tensor) -> Tensor:
            return error.sum() * 7

    part = Late()
    phases = PhaseScheduler(12, parts=[part])
    losses = []
    for _ in range(12):
        losses.append(phases.pixel_loss(torch.ones(1), torch.zeros(1)).item())
        phases.observe(0.1)
    assert part.observed == [5, 6, 7]
    assert losses == [7.0 if i in part.observed else 1.0 for i in range(12)]


@pytest.mark.parametrize("parts", ["paper", {"fading": 1}, 3])
def test_parts_that_are_no_list(parts: Any) -> None:
    with pytest.raises(TypeError, match=r"parts=.*, but a list of parts is needed"):
        PhaseScheduler(100, parts=parts)


def test_a_part_that_needs_the_parameters_units_comes_first() -> None:
    """A pair of the positions' difference in the world and gradients in the own frame is none."""
    with pytest.raises(ValueError, match=r"Curvature after OwnFrame.*Curvature must come first"):
        PhaseScheduler(TOTAL, parts=[OwnFrame(), Curvature()])
    PhaseScheduler(TOTAL, parts=[Curvature(), OwnFrame()])
    PhaseScheduler(TOTAL, parts=[OwnFrame(), Curvature(names=("scales",))])


def test_a_part_whose_words_fail_upgrades_nothing() -> None:
    class Mute(Annealing):
        def __repr__(self) -> str:
            raise RuntimeError("no words")

    adam = torch.optim.Adam([{"params": [Parameter(torch.ones(2, 3))], "name": "means"}])
    with pytest.raises(RuntimeError, match="no words"):
        PhaseScheduler(TOTAL, parts=[Mute()]).upgrade(adam)
    assert type(adam) is torch.optim.Adam
