"""Trainers that remove Gaussians are told from those that relocate them; `Fading` goes off."""

from __future__ import annotations

import copy
import io
import itertools
import pickle
import random
import types
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from gsplat_host import Trainer, scene_of_main, strategies
from inria_host import OPTIONS, made_model
from torch import Tensor
from torch.nn import Parameter, ParameterDict
from trainers import gsplat_optimizers, inria_optimizer, make_splats

from opt3dgs_optim import DEFAULTS, DEFAULTS_ADC, Fading, PhaseScheduler
from opt3dgs_optim.removed_rows import EDITS, RemovedRows, were_removed
from opt3dgs_optim.runs import RunLog

TOTAL, POINTS = 60, 200
FIRST, EVERY = 5, 7  # first iteration after which rows are edited; the edits follow its multiples
FIRST_EDIT = 7

pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning"),
    pytest.mark.filterwarnings("ignore:.*non-writable:UserWarning"),
]


def row_numbers(count: int) -> Tensor:
    """Opacities that say which row they were."""
    return torch.arange(count, dtype=torch.float32)[:, None] - count / 2


# -- single edits ---------------------------------------------------------------------------------

ROWS = row_numbers(100)
REMOVING: dict[str, Callable[[Tensor], Tensor]] = {
    "prune one at the end": lambda v: v[:-1],
    "prune the first": lambda v: v[1:],
    "split three": lambda v: torch.cat([v[3:], v[:3] + 0.5, v[:3] + 0.5]),
    "split most": lambda v: torch.cat([v[::5], *2 * [v[torch.arange(100) % 5 > 0]]]),
    "clone forty, split one": lambda v: torch.cat([v[1:], v[1:41], v[:1] + 0.5, v[:1] + 0.5]),
    "clone ten, split one, sort": lambda v: torch.cat([v[1:], v[1:11], v[:1], v[:1]]).flip(0),
    "prune one, clone two": lambda v: torch.cat([v[:30], v[31:], v[50:52]]),
}
KEEPING: dict[str, Callable[[Tensor], Tensor]] = {
    "a copy": lambda v: v.clone(),
    "clone": lambda v: torch.cat([v, v[::3]]),
    "reset": lambda v: v.clamp(max=-10.0),
    "reset to one value": lambda v: torch.full_like(v, -4.6),
    "relocate": lambda v: overwritten(v, slice(0, 30), v[30:60] - 0.3),
    # Forks of 3dgs-mcmc leave the opacity as it is.
    "relocate with the same opacity": lambda v: overwritten(v, slice(0, 40), v[40:80]),
    "relocate and grow": lambda v: torch.cat([overwritten(v, slice(0, 30), v[30:60] - 0.3), v[:5]]),
    "all changed, but two": lambda v: torch.cat([v[50:52], v[2:] - 0.3]),
    "permute": lambda v: v.flip(0),
    "the highest rises": lambda v: overwritten(v, slice(99, 100), v[99:] + 1.0),
    "relocate, grow and permute": lambda v: torch.cat(
        [overwritten(v, slice(0, 30), v[30:60] - 0.3).flip(0), v[:5] - 0.3]
    ),
}


def overwritten(values: Tensor, rows: slice, new: Tensor) -> Tensor:
    """A copy with other values in some rows."""
    values = values.clone()
    values[rows] = new
    return values


@pytest.mark.parametrize("edit", REMOVING)
@pytest.mark.parametrize("shape", [(100,), (100, 1)])
def test_rows_that_are_removed_are_found(edit: str, shape: tuple[int, ...]) -> None:
    before = ROWS.reshape(shape)
    assert were_removed(before, REMOVING[edit](before))


@pytest.mark.parametrize("edit", KEEPING)
def test_rows_that_are_kept_are_not_taken_for_removed(edit: str) -> None:
    assert not were_removed(ROWS, KEEPING[edit](ROWS))


def removed_by_the_rule(before: list[int], after: list[int]) -> bool:
    """The rule of `were_removed`, row by row."""
    count = len(before)
    if len(after) < count:
        return True
    # Where rows were, in the order in which they are now, of those that are known by their value.
    known = [
        (before.index(value), now)
        for now, value in enumerate(after[:count])
        if before.count(value) == 1
    ]
    moved = sum(was != now for was, now in known)
    if 10 * len(known) < count or moved == 0 or 2 * moved < len(known):
        return False
    steps = [later - earlier for (earlier, _), (later, _) in itertools.pairwise(known)]
    if 10 * sum(step > 0 for step in steps) >= 9 * len(steps):
        return True
    copied = sum(before.count(value) == 1 and after.count(value) > 1 for value in before)
    return 100 * copied > count


NEW = range(1000, 2000)  # values that no row had
AT_THE_BOUNDS: dict[str, tuple[list[int], list[int], bool]] = {
    "one known of ten, moved": ([*range(10)], [*NEW[:3], 2, *NEW[4:10]], True),
    "one known of eleven, moved": ([*range(11)], [*NEW[:3], 2, *NEW[4:11]], False),
    "half of the known have moved": ([*range(10)], [0, 2, *NEW[:8]], True),
    "a third of the known have moved": ([*range(10)], [0, 1, 3, *NEW[:7]], False),
    "one in ten out of order": ([*range(11)], [*range(1, 10), 0, 10], True),
    "one in nine out of order": ([*range(10)], [*range(1, 9), 0, 9], False),
    "sorted anew, one in a hundred copied": ([*range(100)], [*range(99, -1, -1), 5], False),
    "sorted anew, two in a hundred copied": ([*range(100)], [*range(99, -1, -1), 5, 6], True),
    "sorted anew, one in ten copied": ([*range(10)], [*range(9, -1, -1), 5], True),
    # Two rows of one value are known by nothing.
    "pairs exchanged": ([0, 0, 1, 1, 2, 2, 3], [1, 1, 0, 0, 2, 2, 3], False),
    "pairs sorted anew and copied": ([*range(7), 7, 7], [7, 7, 7, *range(6, -1, -1)], False),
}


@pytest.mark.parametrize("case", AT_THE_BOUNDS)
def test_the_bounds_of_the_rule(case: str) -> None:
    before, after, removed = AT_THE_BOUNDS[case]
    assert removed_by_the_rule(before, after) is removed
    assert were_removed(Tensor(before), Tensor(after)) is removed


def test_it_is_the_rule() -> None:
    found = Counter[bool]()
    for seed in range(2_000):
        chance = random.Random(seed)
        count = chance.randrange(1, 25)
        before = [chance.randrange(chance.choice((5, 1000))) for _ in range(count)]
        after = [value for value in before if chance.random() < 0.9]
        after = [chance.choice(NEW) if chance.random() < 0.1 else value for value in after]
        if chance.random() < 0.4:
            chance.shuffle(after)
        after += [chance.choice([*before, *NEW[:5]]) for _ in range(count - len(after))]
        after += [chance.choice(before) for _ in range(chance.randrange(3))]
        expected = removed_by_the_rule(before, after)
        assert were_removed(Tensor(before), Tensor(after)) is expected, (before, after)
        found[expected] += 1
    assert min(found[True], found[False]) > 200


def test_a_look_at_the_same_tensor_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Tensor] = []

    def look(before: Tensor, after: Tensor) -> bool:
        looked.append(after)
        return were_removed(before, after)

    monkeypatch.setattr("opt3dgs_optim.removed_rows.were_removed", look)
    watch, optimizer = RemovedRows(), optimizer_of(row_numbers(10))
    (group,) = optimizer.param_groups
    for _ in range(3):
        assert not watch.found([optimizer])
    assert not looked
    # Pruned and cloned: in other memory, and as many as before.
    rows = group["params"][0].detach()
    group["params"][0] = Parameter(torch.cat([rows[2:], rows[8:]]))
    assert watch.found([optimizer])
    # In the same memory, and fewer.
    group["params"][0] = Parameter(group["params"][0].detach()[:7])
    assert watch.found([optimizer])
    assert not watch.found([optimizer])
    assert len(looked) == 2


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_rows(count: int) -> None:
    rows = row_numbers(count)
    assert not were_removed(rows, rows.clone())
    assert not were_removed(rows, torch.cat([rows, rows]))
    if count:
        assert were_removed(rows, rows[1:])


def optimizer_of(*opacities: Tensor) -> torch.optim.Adam:
    """One optimizer with so many sets of Gaussians."""
    groups = [
        {"params": [Parameter(rows)], "name": f"{number}#opacity"}
        for number, rows in enumerate(opacities)
    ]
    return PhaseScheduler(TOTAL).upgrade(torch.optim.Adam(groups))


def test_edits_in_place_and_steps_are_no_removal() -> None:
    watch, optimizer = RemovedRows(), optimizer_of(row_numbers(10))
    (group,) = optimizer.param_groups
    assert not watch.found([optimizer])
    group["params"][0].data.add_(1.0)
    assert not watch.found([optimizer])
    rows = Parameter(group["params"][0].data)  # as relocation makes it: the same memory
    rows.data[:8] = rows.data[2:].clone()
    group["params"][0] = rows
    assert not watch.found([optimizer])


def test_each_set_of_gaussians_is_compared_with_itself() -> None:
    watch = RemovedRows()
    optimizer, other = optimizer_of(row_numbers(10), row_numbers(20)), optimizer_of(row_numbers(5))
    assert not watch.found([optimizer, other])
    assert not watch.found([other, optimizer])
    group = optimizer.param_groups[1]
    group["params"][0] = Parameter(group["params"][0].detach()[5:])
    assert watch.found([other, optimizer])
    assert not watch.found([other, optimizer])
    del optimizer.param_groups[0]  # the first set goes: what is now first is another one
    assert not watch.found([optimizer])


# -- a scene that is told -------------------------------------------------------------------------


class Scene:
    """As gsplat's main branch has it: told of every edit of rows, which it notes."""

    def __init__(self) -> None:
        self.edits: list[str] = []

    def on_split(self, chosen: Tensor, rest: Tensor) -> None:
        self.edits.append("split")

    def on_remove(self, mask: Tensor) -> None:
        self.edits.append("remove")

    def on_relocate(self, dead: Tensor, sampled: Tensor) -> None:
        self.edits.append("relocate")


NOTHING = torch.zeros(0)
SORTED = row_numbers(10)


@pytest.mark.parametrize(
    ("tell", "rows", "found"),
    [
        (lambda scene: scene.on_relocate(NOTHING, sampled=NOTHING), SORTED.flip(0), False),
        (lambda scene: scene.on_remove(NOTHING), SORTED.flip(0), True),
        (lambda scene: scene.on_split(NOTHING, rest=NOTHING), None, True),
        (lambda scene: None, SORTED[1:], True),  # an edit of which the scene was not told
        (lambda scene: scene.on_relocate(NOTHING, NOTHING), SORTED[1:], True),  # and two edits
    ],
)
def test_what_a_scene_is_told_decides(
    monkeypatch: pytest.MonkeyPatch, tell: Callable[[Scene], None], rows: Any, found: bool
) -> None:
    looks: list[bool] = []
    monkeypatch.setattr(
        "opt3dgs_optim.removed_rows.were_removed",
        lambda *both: looks.append(were_removed(*both)) or looks[-1],
    )
    watch, scene, optimizer = RemovedRows(), Scene(), optimizer_of(SORTED)
    for _ in range(2):  # twice is once
        watch.listen(scene)
    assert not watch.found([optimizer])
    if rows is not None:
        optimizer.param_groups[0]["params"][0] = Parameter(rows)
    tell(scene)
    assert watch.found([optimizer]) is found
    assert len(looks) == int(rows is not None and len(rows) < 10)
    assert not watch.found([optimizer])
    assert len(scene.edits) <= 1
    optimizer.param_groups[0]["params"][0] = Parameter(optimizer.param_groups[0]["params"][0][2:])
    assert watch.found([optimizer])  # the next exchange is looked at again


@pytest.mark.parametrize("edit", EDITS)
def test_which_edits_remove_rows(edit: str) -> None:
    """Split takes the parents out; all others but removal keep every row that there was."""
    watch, scene = RemovedRows(), types.SimpleNamespace(**dict.fromkeys(EDITS, len))
    watch.listen(scene)
    getattr(scene, edit)(NOTHING)
    assert watch.found([]) == (edit in ("on_split", "on_remove"))


def test_what_was_told_before_a_rewind_holds_no_more() -> None:
    watch, scene, optimizer = RemovedRows(), Scene(), optimizer_of(SORTED)
    watch.listen(scene)
    scene.on_remove(NOTHING)
    watch.forget()
    assert not watch.found([optimizer])
    scene.on_remove(NOTHING)  # it still listens
    assert watch.found([optimizer])


@pytest.mark.parametrize("road", [copy.deepcopy, lambda scene: pickle.loads(pickle.dumps(scene))])
def test_a_scene_that_is_listened_to_can_be_copied(road: Callable[[Scene], Scene]) -> None:
    watch, scene = RemovedRows(), Scene()
    watch.listen(scene)
    other = road(scene)
    other.on_remove(NOTHING)
    assert (scene.edits, other.edits) == ([], ["remove"])
    assert not watch.found([])


def test_an_object_that_is_told_of_nothing_is_refused() -> None:
    phases = PhaseScheduler(TOTAL)
    optimizers = gsplat_optimizers(make_splats(3))
    with pytest.raises(TypeError, match=r"upgrade: scene is a dict that has none of on_duplicate"):
        phases.upgrade(optimizers, scene={})
    assert {type(each) for each in optimizers.values()} == {torch.optim.Adam}


class Sealed:
    """A scene whose methods cannot be replaced."""

    __slots__ = ()

    def on_remove(self, mask: Tensor) -> None: ...


def test_a_scene_that_cannot_be_listened_to_is_refused() -> None:
    optimizers = gsplat_optimizers(make_splats(3))
    with pytest.raises(TypeError, match=r"methods of scene, a Sealed, cannot be replaced.*leave"):
        PhaseScheduler(TOTAL).upgrade(optimizers, scene=Sealed())
    assert {type(each) for each in optimizers.values()} == {torch.optim.Adam}


def test_a_scene_is_left_alone_where_the_upgrade_fails() -> None:
    scene, other = Scene(), gsplat_optimizers(make_splats(3))
    PhaseScheduler(TOTAL).upgrade(other)
    with pytest.raises(TypeError, match="with parts of its own"):
        PhaseScheduler(TOTAL).upgrade(other, scene=scene)
    assert scene.on_remove.__func__ is Scene.on_remove


def test_a_scene_is_listened_to_where_a_second_upgrade_fails() -> None:
    scene, phases = Scene(), PhaseScheduler(TOTAL)
    phases.upgrade(gsplat_optimizers(make_splats(3)), scene=scene)
    other = torch.optim.SGD([{"params": [Parameter(torch.ones(3, 3))], "name": "means"}], lr=0.1)
    with pytest.raises(TypeError, match="SGD"):
        phases.upgrade({"means": other}, scene=scene)
    assert phases._removed_rows.listens_to(scene)


def test_a_scene_is_left_alone_where_a_warning_is_an_error() -> None:
    scene, splats = Scene(), make_splats(3)
    groups = [{"params": [splats["means"]], "name": "means"}]
    groups += [{"params": [Parameter(torch.ones(3, 2))], "name": "of as many rows"}]
    with pytest.raises(UserWarning, match="of as many rows"):
        PhaseScheduler(TOTAL).upgrade(torch.optim.Adam(groups), scene=scene)
    assert scene.on_remove.__func__ is Scene.on_remove


def test_many_schedulers_listen_to_one_scene_one_after_the_other() -> None:
    scene, watch = Scene(), RemovedRows()
    for _ in range(2_000):
        watch = RemovedRows()
        watch.listen(scene)
    scene.on_remove(NOTHING)
    assert watch.found([])
    assert scene.edits == ["remove"]


@pytest.mark.parametrize("kind", ["mcmc", "default"])
def test_the_real_scene_of_gsplat_main(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """Its strategy tells of every edit: nothing is compared, and the answer is the same."""

    def look(*_: Tensor) -> bool:
        raise AssertionError("the scene had told of it")

    monkeypatch.setattr("opt3dgs_optim.removed_rows.were_removed", look)
    phases, scene = PhaseScheduler(TOTAL), scene_of_main(ParameterDict(make_splats(POINTS, 0)))
    scene.splats["opacities"].data[::3] = -9.0
    optimizers = phases.upgrade(gsplat_optimizers(dict(scene.splats)), scene=scene)
    options = {} if kind == "mcmc" else {"reset_every": 1_000}  # a reset is no edit of rows
    strategy = gsplat_strategy(kind, "main", **options)
    Trainer(scene.splats, optimizers, strategy, total=TOTAL, phases=phases, scene=scene).run(0, 45)
    scene.validate()
    assert set(phases.switched_off) == ({"Fading"} if kind == "default" else set())


# -- real strategies ------------------------------------------------------------------------------


def gsplat_strategy(kind: str, version: str = "1.5.3", **options: Any) -> Any:
    """gsplat's strategy, which edits every 7th iteration after the 5th."""
    times = {"refine_start_iter": FIRST, "refine_stop_iter": 50, "refine_every": EVERY}
    if kind == "mcmc":
        return strategies(version).MCMCStrategy(cap_max=400, noise_lr=1.0, **times)
    default: dict[str, Any] = {"grow_grad2d": 1e-4, "grow_scale3d": 0.6, "prune_opa": 0.3}
    default |= {"reset_every": 20, "prune_scale3d": 1e9, **options}
    return strategies(version).DefaultStrategy(**times, **default)


def gsplat_trainer(kind: str, phases: PhaseScheduler, **options: Any) -> Trainer:
    """Its strategy around 200 Gaussians, a third of them dead."""
    splats: Any = ParameterDict(make_splats(POINTS, 0))
    splats["opacities"].data[::3] = -9.0
    optimizers = phases.upgrade(gsplat_optimizers(dict(splats)))
    strategy = gsplat_strategy(kind, **options)
    return Trainer(splats, optimizers, strategy, total=TOTAL, phases=phases)


SPLITS_ONLY = {"prune_opa": 1e-9, "grow_scale3d": 2.5}


@pytest.mark.parametrize("options", [{}, SPLITS_ONLY, {"grow_grad2d": 1e9}])
def test_clone_split_and_prune_of_gsplat(
    options: dict[str, float], caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """Together, splits only, prunes only: seen in the iteration after the first edit, said once."""
    caplog.set_level("INFO", "opt3dgs_optim")
    with RunLog(tmp_path / "run.jsonl") as log:
        phases = PhaseScheduler(TOTAL, log=log)
        trainer = gsplat_trainer("default", phases, **options)
        trainer.run(0, FIRST_EDIT + 1)
        assert phases.switched_off == {}
        trainer.run(FIRST_EDIT + 1, FIRST_EDIT + 2)
        assert set(phases.switched_off) == {"Fading"}
        trainer.run(FIRST_EDIT + 2, TOTAL)
    said = [text for text in caplog.messages if "switched off" in text]
    assert len(said) == 1
    assert "Fading is switched off, since the trainer removes Gaussians" in said[0]
    assert (tmp_path / "run.jsonl").read_text().count('"switched_off"') == 1
    assert "Fading" in repr(phases)
    assert set(phases.switched_off) == {"Fading"}


def test_the_log_is_closed_before_the_last_checkpoint(tmp_path: Path) -> None:
    """The optimizers' state is saved all the same, though it is the first to see the removal."""
    with RunLog(tmp_path / "run.jsonl") as log:
        phases = PhaseScheduler(TOTAL, log=log)
        trainer = gsplat_trainer("default", phases)
        trainer.run(0, FIRST_EDIT + 1)
    state = trainer.optimizers["means"].state_dict()
    assert set(phases.switched_off) == {"Fading"}
    assert state["param_groups"][0]["opt3dgs"]["switched_off"].keys() == {"Fading"}


def test_relocation_of_gsplat_is_none(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "opt3dgs_optim")
    phases = PhaseScheduler(TOTAL)
    trainer = gsplat_trainer("mcmc", phases)
    trainer.run(0, TOTAL)
    assert len(trainer.splats["means"]) > POINTS
    assert phases.switched_off == {}
    assert "in the steps of" in caplog.text
    assert "switched off" not in caplog.text


@pytest.mark.parametrize("parts", [DEFAULTS, DEFAULTS_ADC])
def test_parts_that_were_chosen_stay(parts: Any) -> None:
    phases = PhaseScheduler(TOTAL, parts=parts)
    gsplat_trainer("default", phases).run(0, TOTAL)
    assert phases.switched_off == {}


def test_fading_that_is_off_is_as_if_it_were_not_there() -> None:
    """Fading's first event is at 3 % of the training, here after the first edit."""
    total = 1_000
    ends = []
    for parts in (None, [part for part in DEFAULTS if not isinstance(part, Fading)]):
        phases = PhaseScheduler(total, parts=parts)
        trainer = gsplat_trainer("default", phases)
        trainer.run(0, TOTAL)
        ends.append(trainer.splats)
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


# -- the INRIA family -----------------------------------------------------------------------------


def inria_model(kind: str) -> Any:
    splats = make_splats(POINTS)
    splats["opacities"].data[::3] = -9.0
    return made_model(kind, splats)


def densify_and_prune(model: Any, iteration: int) -> None:
    """As INRIA's: clone, split (children appended, then the parents pruned), prune."""
    chosen = torch.arange(len(model._xyz)) % 5 == iteration % 5
    model.append(chosen.nonzero()[:, 0])
    parents = torch.zeros(len(model._xyz), dtype=torch.bool)
    parents[iteration % 11 :: 11] = True
    model.append(parents.nonzero()[:, 0])
    model.append(parents[: len(parents)].nonzero()[:, 0])
    model.prune_points(torch.cat([parents, torch.zeros(2 * int(parents.sum()), dtype=torch.bool)]))


def relocate_and_grow(model: Any, iteration: int) -> None:
    """As 3dgs-mcmc's."""
    model.relocate_gs((model.get_opacity <= 0.005).squeeze(-1))
    model.add_new_gs(400)


def run_inria(
    model: Any, phases: PhaseScheduler, edit: Callable[[Any, int], None], first: int, last: int
) -> None:
    """INRIA's order: backward, observe, edits of rows, step."""
    for iteration in range(first, last):
        torch.manual_seed(iteration)
        seen = torch.arange(len(model._xyz)) % 3 != iteration % 3
        render = model._xyz.sum(-1) + model.get_opacity[:, 0] + model.get_scaling.mean(-1)
        render = render + model._rotation.sum(-1)
        render = render + model._features_dc.mean((1, 2)) + model._features_rest.mean((1, 2))
        loss = (render[seen] - 0.1 * (iteration % 5)).abs().mean() + 0.01 * model.get_opacity.mean()
        loss.backward()
        phases.observe(loss, iteration=iteration)
        if iteration > FIRST and iteration % EVERY == 0:
            with torch.no_grad():
                edit(model, iteration)
            if iteration % (3 * EVERY) == 0 and edit is densify_and_prune:
                model.reset_opacity()
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)


def test_densify_and_prune_of_inria() -> None:
    model, phases = inria_model("simulated"), PhaseScheduler(TOTAL)
    phases.upgrade(model.optimizer)
    run_inria(model, phases, densify_and_prune, 0, FIRST_EDIT + 1)
    assert phases.switched_off == {}
    run_inria(model, phases, densify_and_prune, FIRST_EDIT + 1, FIRST_EDIT + 2)
    assert set(phases.switched_off) == {"Fading"}


@pytest.mark.parametrize("kind", ["simulated", "3dgs-mcmc"])
def test_relocation_of_3dgs_mcmc_is_none(kind: str) -> None:
    model, phases = inria_model(kind), PhaseScheduler(TOTAL)
    phases.upgrade(model.optimizer)
    run_inria(model, phases, relocate_and_grow, 0, TOTAL)
    assert len(model._xyz) > POINTS
    assert phases.switched_off == {}


# -- going on from a checkpoint -------------------------------------------------------------------


def saved(model: Any) -> Any:
    buffer = io.BytesIO()
    torch.save(model.optimizer.state_dict(), buffer)
    buffer.seek(0)
    return torch.load(buffer)


@pytest.mark.parametrize("at", [FIRST_EDIT, FIRST_EDIT + 1, FIRST_EDIT + 2, 30])
@pytest.mark.parametrize("chosen", [None, DEFAULTS])
def test_a_resumed_training(at: int, chosen: Any) -> None:
    """Saved before the first edit, right after it, after it was seen, and long after that."""
    model, phases = inria_model("simulated"), PhaseScheduler(TOTAL, parts=chosen)
    phases.upgrade(model.optimizer)
    run_inria(model, phases, densify_and_prune, 0, at)
    state, resumed = saved(model), copy.deepcopy(model)
    resumed.training_setup(OPTIONS)
    again = PhaseScheduler(TOTAL, parts=chosen)
    again.upgrade(resumed.optimizer)
    resumed.optimizer.load_state_dict(state)
    # Rows that went before the checkpoint are known to it.
    assert set(again.switched_off) == ({"Fading"} if at > FIRST_EDIT and chosen is None else set())
    run_inria(model, phases, densify_and_prune, at, TOTAL)
    run_inria(resumed, again, densify_and_prune, at, TOTAL)
    assert phases.switched_off == again.switched_off
    assert torch.equal(model._xyz, resumed._xyz)
    assert torch.equal(model._scaling, resumed._scaling)


def test_an_earlier_checkpoint_is_gone_on_with_by_the_same_scheduler() -> None:
    """What it does not know of yet is seen again."""
    model, phases = inria_model("simulated"), PhaseScheduler(TOTAL)
    phases.upgrade(model.optimizer)
    state = saved(model)
    run_inria(model, phases, densify_and_prune, 0, 30)
    assert set(phases.switched_off) == {"Fading"}
    model.training_setup(OPTIONS)
    phases.upgrade(model.optimizer)
    model.optimizer.load_state_dict(state)
    assert phases.switched_off == {}
    run_inria(model, phases, densify_and_prune, 0, 30)
    assert set(phases.switched_off) == {"Fading"}


def test_what_a_checkpoint_says_does_not_switch_off_what_was_chosen() -> None:
    model, phases = inria_model("simulated"), PhaseScheduler(TOTAL)
    phases.upgrade(model.optimizer)
    run_inria(model, phases, densify_and_prune, 0, 30)
    state = saved(model)
    assert set(phases.switched_off) == {"Fading"}
    model.training_setup(OPTIONS)
    again = PhaseScheduler(TOTAL, parts=DEFAULTS)
    again.upgrade(model.optimizer)
    model.optimizer.load_state_dict(state)
    assert again.switched_off == {}
    assert again.iteration == 30


def test_fewer_gaussians_of_a_checkpoint_are_no_removal() -> None:
    """A trainer that loads another model and sets its clock back."""
    model, phases = inria_model("simulated"), PhaseScheduler(TOTAL)
    phases.upgrade(model.optimizer)
    run_inria(model, phases, relocate_and_grow, 0, 20)
    model.prune_points(torch.arange(len(model._xyz)) >= POINTS)
    run_inria(model, phases, relocate_and_grow, 0, 20)
    assert phases.switched_off == {}


def test_a_copy_looks_for_itself() -> None:
    model, phases = inria_model("simulated"), PhaseScheduler(TOTAL)
    phases.upgrade(model.optimizer)
    run_inria(model, phases, densify_and_prune, 0, FIRST_EDIT)
    other = copy.deepcopy(model)
    run_inria(other, other.optimizer.course, densify_and_prune, FIRST_EDIT, TOTAL)
    assert set(other.optimizer.course.switched_off) == {"Fading"}
    assert phases.switched_off == {}


@pytest.mark.parametrize("how", ["in place", "another dict", "another list"])
def test_rows_that_are_removed_by_another_group(how: str) -> None:
    """Trainers that make their groups anew where they prune."""
    splats = make_splats(40)
    adam = inria_optimizer(splats)
    phases = PhaseScheduler(TOTAL)
    phases.upgrade(adam)
    for pruned in (False, True):
        if pruned:
            groups = []
            for group in adam.param_groups:
                old = group["params"][0]
                new = Parameter(old.detach()[10:].clone())
                state = adam.state.pop(old)
                adam.state[new] = {
                    key: value[10:].clone() if value.dim() else value
                    for key, value in state.items()
                }
                if how == "in place":
                    group["params"][0] = new
                groups.append(group if how == "in place" else {**group, "params": [new]})
            if how == "another list":
                adam.param_groups = groups
            else:
                adam.param_groups[:] = groups
        for group in adam.param_groups:
            for param in group["params"]:
                param.grad = torch.ones_like(param)
        phases.observe(0.1)
        adam.step()
    assert "Fading" in phases.switched_off
