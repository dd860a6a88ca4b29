"""What torch does around a step stays as it is: hooks, wrappers, loads, copies, and memory."""

from __future__ import annotations

import copy
import gc
import math
import pickle
import weakref
from typing import Any

import pytest
import torch
from gaussians import adam_of, adams_of, parameters, same_tensors, steps
from masked_adams import SelectiveAdam
from row_edits import added, apply, relocated
from torch.nn import Parameter
from torch.optim import Adam, Optimizer
from torch.optim.optimizer import (
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)

from opt3dgs_optim import (
    Averaging,
    Curvature,
    EnergyHistogram,
    LQNAdam,
    OwnFrame,
    PhaseScheduler,
    paper_parts,
    stepper,
)

TOTAL, ROWS = 60, 30


def upgraded(parts: Any = None, one: bool = True, **options: Any) -> tuple[Any, Any, Any]:
    params, phases = parameters(ROWS), PhaseScheduler(TOTAL, parts=parts, **options)
    optimizers = phases.upgrade((adam_of if one else adams_of)(params))
    return params, {"all": optimizers} if one else optimizers, phases


# -- hooks, and what wraps a step ------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Adam, SelectiveAdam])
def test_hooks_of_one_optimizer_and_of_all_run_with_torchs_arguments(kind: Any) -> None:
    given = () if kind is Adam else (torch.ones(ROWS, dtype=torch.bool),)
    seen: dict[bool, list[Any]] = {True: [], False: []}
    for ours in (True, False):
        params = parameters(ROWS)
        adam = adam_of(params, kind)
        if ours:
            PhaseScheduler(TOTAL).upgrade(adam)

        def note(when: str, ours: bool = ours) -> Any:
            return lambda o, args, kwargs: seen[ours].append((when, args[0] is o, args[1:], kwargs))

        handles = [
            register_optimizer_step_pre_hook(note("all, before")),
            register_optimizer_step_post_hook(note("all, after")),
            adam.register_step_pre_hook(note("one, before")),
            adam.register_step_post_hook(note("one, after")),
        ]
        for param in params.values():
            param.grad = torch.ones_like(param)
        adam.step(*given)
        for handle in handles:
            handle.remove()
    assert [each[:2] for each in seen[True]] == [each[:2] for each in seen[False]]
    assert [len(each[2]) for each in seen[True]] == [len(each[2]) for each in seen[False]]
    assert len(seen[True]) == 4


def test_a_pre_hook_may_give_other_arguments() -> None:
    _, optimizers, _ = upgraded()
    closures = []
    optimizers["all"].register_step_pre_hook(
        lambda o, args, kwargs: ((o, lambda: closures.append(1)), {})
    )
    optimizers["all"].step()
    assert closures == [1]


def test_a_profile_shows_the_range_of_a_step() -> None:
    _, optimizers, _ = upgraded()
    with torch.profiler.profile() as profile:
        optimizers["all"].step()
    assert "Optimizer.step#Adam.step" in {each.key for each in profile.key_averages()}


def test_a_function_over_the_step_is_refused_before_an_upgrade_and_stays_after_it() -> None:
    params = parameters(ROWS)
    adam, ran = adam_of(params), []
    plain = adam.step
    adam.step = lambda: ran.append(plain())
    before = type(adam)
    with pytest.raises(ValueError, match="upgrade the optimizer first"):
        PhaseScheduler(TOTAL).upgrade(adam)
    assert type(adam) is before
    del adam.step
    torch.optim.lr_scheduler.ExponentialLR(adam, 0.9)  # puts one over it, too
    phases = PhaseScheduler(TOTAL)
    phases.upgrade(adam)
    ours = adam.step
    adam.step = lambda: ran.append(ours())
    phases.upgrade(adam)  # again, as where groups are new
    steps({"all": adam}, params, 3)
    assert (len(ran), phases.iteration) == (3, 2)


@pytest.mark.parametrize("attribute", ["optimizer", "_optimizer"])
@pytest.mark.parametrize("order", ["wrapper first", "Adam first"])
def test_an_optimizer_within_another_is_refused(attribute: str, order: str) -> None:
    class Wrapper:
        pass

    inner = adam_of(parameters(ROWS))
    bases = (Wrapper, Adam) if order == "wrapper first" else (Adam, Wrapper)
    outer = object.__new__(type("WrappedAdam", bases, {}))
    outer.__dict__.update(vars(inner))
    setattr(outer, attribute, inner)
    with pytest.raises(TypeError, match=r"`\.optimizer`"):
        PhaseScheduler(TOTAL).upgrade(outer)


def test_a_plain_subclass_is_taken_though_torch_has_wrapped_its_step_first() -> None:
    plain = type("Mine", (Adam,), {})
    bare = getattr(Adam.step, "__wrapped__", Adam.step)
    plain.step = Optimizer.profile_hook_step(bare)  # pyright: ignore
    plain.step.hooked = True  # pyright: ignore
    adam = adam_of(parameters(ROWS), plain)
    assert isinstance(PhaseScheduler(TOTAL).upgrade(adam), plain)


@pytest.mark.compiles
def test_a_compiled_step_lives_to_the_end() -> None:
    params, optimizers, _ = upgraded(one=False)
    others, theirs, _ = upgraded(one=False)
    compiled = {n: torch.compile(each.step, backend="eager") for n, each in optimizers.items()}
    for iteration in range(TOTAL):
        for tensors, made in ((params, compiled), (others, {n: o.step for n, o in theirs.items()})):
            draw = torch.Generator().manual_seed(iteration)
            for param in tensors.values():
                param.grad = torch.randn(param.shape, generator=draw)
            for step in made.values():
                step()
    assert same_tensors(params, others)


@pytest.mark.parametrize("parts", [None, paper_parts(TOTAL)], ids=["defaults", "paper"])
def test_steps_in_inference_mode_live_to_the_end(parts: Any) -> None:
    params, optimizers, phases = upgraded(copy.deepcopy(parts), one=False)
    with torch.inference_mode():
        for _ in range(TOTAL):
            phases.observe(0.1)
            steps(optimizers, params, 1)
    assert phases.iteration == TOTAL - 1


# -- checkpoints and copies ------------------------------------------------------------------------


def test_a_load_hook_may_order_and_drop_groups() -> None:
    params, optimizers, _ = upgraded()
    steps(optimizers, params, 20)
    saved = copy.deepcopy(optimizers["all"].state_dict())
    saved["param_groups"].append({**saved["param_groups"][0], "name": "exposure", "params": [99]})
    names = list(params)[::-1]
    mine = {name: Parameter(params[name].detach().clone()) for name in names}
    adam = PhaseScheduler(TOTAL).upgrade(adam_of(mine))

    def in_order(optimizer: Any, state: dict[str, Any]) -> dict[str, Any]:
        groups = {group["name"]: group for group in state["param_groups"]}
        return {**state, "param_groups": [groups[g["name"]] for g in optimizer.param_groups]}

    adam.register_load_state_dict_pre_hook(in_order)
    adam.load_state_dict(saved)
    for iteration in range(20, TOTAL):
        for tensors, made in ((params, optimizers["all"]), (mine, adam)):
            for name, param in tensors.items():
                draw = torch.Generator().manual_seed(iteration + 100 * list(params).index(name))
                param.grad = torch.randn(param.shape, generator=draw)
            made.step()
    assert same_tensors(params, mine)


def test_groups_that_a_checkpoint_names_otherwise_are_told(caplog: Any) -> None:
    params, optimizers, _ = upgraded()
    steps(optimizers, params, 3)
    state = optimizers["all"].state_dict()
    state["param_groups"][0]["name"] = "positions"
    with caplog.at_level("INFO", "opt3dgs_optim"):
        optimizers["all"].load_state_dict(state)
    assert "'positions' is loaded into the group 'xyz'" in caplog.text


def test_sets_that_are_named_after_a_checkpoint_take_it() -> None:
    params, optimizers, _ = upgraded()
    steps(optimizers, params, 3)
    adam = adam_of(params)
    for group in adam.param_groups:
        group["name"] = f"first#{group['name']}"
    phases = PhaseScheduler(TOTAL)
    phases.upgrade(adam)
    adam.load_state_dict(optimizers["all"].state_dict())
    steps({"all": adam}, params, 3)
    assert phases.iteration == 5


class Model(torch.nn.Module):
    def __init__(self, params: dict[str, Parameter]) -> None:
        super().__init__()
        for name, param in params.items():
            self.register_parameter(name, param)


@pytest.mark.processes  # it imports much
@pytest.mark.filterwarnings("ignore:torch.distributed is")
@pytest.mark.parametrize("flat", [False, True])
def test_states_of_distributed_checkpoints_resume(flat: bool, tmp_path: Any) -> None:
    from torch.distributed import checkpoint
    from torch.distributed.checkpoint import state_dict as of

    options = of.StateDictOptions(flatten_optimizer_state_dict=flat)
    params, optimizers, _ = upgraded()
    steps(optimizers, params, 20)
    saved = of.get_optimizer_state_dict(Model(params), optimizers["all"], options=options)
    checkpoint.save(  # pyright: ignore
        {"optimizer": saved}, checkpoint_id=tmp_path
    )
    mine = {name: Parameter(param.detach().clone()) for name, param in params.items()}
    adam, model = PhaseScheduler(TOTAL).upgrade(adam_of(mine)), Model(mine)
    found = {"optimizer": of.get_optimizer_state_dict(model, adam, options=options)}
    checkpoint.load(  # pyright: ignore
        found, checkpoint_id=tmp_path
    )
    of.set_optimizer_state_dict(model, adam, found["optimizer"], options=options)
    steps(optimizers, params, 20, seed=1)
    steps({"all": adam}, mine, 20, seed=1)
    assert same_tensors(params, mine)


@pytest.mark.parametrize("fused", [True, False])
def test_a_stock_adam_that_loads_ours_steps_as_the_trainers_did(fused: bool) -> None:
    params = parameters(ROWS)
    made = {"fused": fused, "foreach": None if fused else True}
    adam = PhaseScheduler(TOTAL).upgrade(adam_of(params, **made))
    steps({"all": adam}, params, 2)
    stock = adam_of(params, **made)
    stock.load_state_dict(copy.deepcopy(adam.state_dict()))
    assert all({k: group[k] for k in made} == made for group in stock.param_groups)


def test_a_hook_of_state_dict_may_write_into_the_groups() -> None:
    _, optimizers, _ = upgraded()
    adam = optimizers["all"]
    adam.register_state_dict_pre_hook(lambda each: each.param_groups[0].update(epoch=3))
    assert adam.state_dict()["param_groups"][0]["epoch"] == 3
    assert adam.param_groups[0]["epoch"] == 3


def test_two_optimizers_of_one_state_are_refused() -> None:
    """The copy would take the clock and the names with it."""
    _, optimizers, _ = upgraded()
    with pytest.raises(TypeError, match=r"Adam: two optimizers of one state; use copy\.deepcopy"):
        copy.copy(optimizers["all"])


def test_a_copy_of_one_of_six_optimizers_does_not_carry_the_others() -> None:
    _, optimizers, _ = upgraded(one=False)
    assert len(pickle.dumps(optimizers["opacities"])) < 8_000
    copied = pickle.loads(pickle.dumps(optimizers))
    (training,) = {id(each.training): each.training for each in copied.values()}.values()
    assert training.members["", "shN"][0]() is copied["shN"]


@pytest.mark.parametrize("kind", [LQNAdam, "Curvature(names=None)"])
def test_a_scalar_beside_the_rows_resumes(kind: Any) -> None:
    def made(param: Parameter) -> Any:
        if kind is LQNAdam:
            return LQNAdam([param], 1e-2)
        group = {"params": [param], "name": "exposure"}
        means = {"params": [Parameter(torch.zeros(4, 3))], "name": "means"}
        return PhaseScheduler(TOTAL, parts=[Curvature(names=None)], switch=0).upgrade(
            Adam([group, means])
        )

    param = Parameter(torch.tensor(0.3))
    ours = made(param)
    for number in range(6):
        param.grad = torch.tensor(1.0 + number)
        ours.step()
    made(Parameter(param.detach().clone())).load_state_dict(ours.state_dict())


# -- rows and memory -------------------------------------------------------------------------------


@pytest.mark.parametrize("inria", [False, True])
@pytest.mark.parametrize("moments", [32, 16])
@pytest.mark.parametrize("parts", [None, [Averaging()], paper_parts(TOTAL)])
def test_nothing_keeps_an_old_parameter_state_or_mean_alive(
    parts: Any, moments: int, inria: bool
) -> None:
    params, optimizers, phases = upgraded(copy.deepcopy(parts), one=inria, moments=moments)
    for _ in range(TOTAL - 1):
        phases.observe(0.1)
        steps(optimizers, params, 1)
    old = [weakref.ref(param) for param in params.values()]
    for optimizer in optimizers.values():
        old += [weakref.ref(v) for s in optimizer.state.values() for v in s.values() if v.dim()]
    apply(added(torch.arange(5)), params, optimizers.values(), list(params), False)
    gc.collect()
    assert not [each().shape for each in old if each() is not None]  # pyright: ignore


@pytest.mark.parametrize("edit", ["a new Parameter", "other moments"])
def test_what_is_kept_begins_anew_after_an_edit(edit: str) -> None:
    """Of the same rows, in gsplat's way, which edits what is kept, too."""
    params, optimizers, _ = upgraded([Curvature(names=("means",))], switch=0)
    steps(optimizers, params, 4)
    adam = optimizers["all"]
    state = adam.state[params["means"]]
    assert state["curvature.history"].any()
    if edit == "a new Parameter":
        old, new = params["means"], Parameter(params["means"].detach())  # of the same storage
        adam.state[new] = adam.state.pop(old)
        params["means"] = adam.param_groups[0]["params"][0] = new
    else:
        state["exp_avg"] = state["exp_avg"].clone()
    fed: list[Any] = []
    before = stepper.take_step  # pyright: ignore
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stepper, "take_step", lambda s: [fed.append(s.grad.clone()), before(s)][1])
        steps(optimizers, {"means": params["means"]}, 1)
    assert torch.equal(fed[0], params["means"].grad)  # no pair is known: Adam is fed the gradient


def test_an_edit_between_a_load_and_the_first_step_shows() -> None:
    """As in INRIA's trainer, which densifies before it steps: the mean is of other rows."""
    params, optimizers, _ = upgraded()
    steps(optimizers, params, TOTAL - 1)
    adam = PhaseScheduler(TOTAL).upgrade(adam_of(params))
    adam.load_state_dict(copy.deepcopy(optimizers["all"].state_dict()))
    apply(relocated(torch.tensor([0]), torch.tensor([9])), params, [adam], list(params), False)
    steps({"all": adam}, params, 1)
    began = adam.state[params["means"]]["averaging.began"]
    assert began.tolist() == [TOTAL] * ROWS


def test_rows_of_a_stranger_are_not_reset() -> None:
    params, optimizers, _ = upgraded(one=False)
    steps(optimizers, params, 2)
    with pytest.raises(ValueError, match=r"reset_rows: a tensor \(30, 3\) that is none of"):
        optimizers["means"].reset_rows(params["scales"], torch.arange(3))
    optimizers["means"].state_dict()


def usual(rows: list[int]) -> list[Any]:
    """What trainers write for rows."""
    at = torch.tensor(rows)
    mask = torch.zeros(30, dtype=torch.bool)
    mask[at] = True
    return [at, mask, torch.where(mask), mask.nonzero(), mask.nonzero().squeeze(), rows, at.numpy()]


@pytest.mark.parametrize("meant", [[4], [0, 7, 29]], ids=str)
def test_rows_to_reset_are_indices_or_a_mask(meant: list[int]) -> None:
    params, optimizers, _ = upgraded(one=False)
    for rows in usual(meant):
        steps(optimizers, params, 2)
        optimizers["scales"].reset_rows(params["scales"], rows)
        kept = optimizers["scales"].state[params["scales"]]["exp_avg"].any(1)
        assert (~kept).nonzero().flatten().tolist() == meant


@pytest.mark.parametrize(
    "rows", [None, (0, 1), torch.ones(3), torch.ones(29, dtype=torch.bool), [30], "1"], ids=str
)
def test_other_rows_to_reset_are_refused(rows: Any) -> None:
    params, optimizers, _ = upgraded(one=False)
    steps(optimizers, params, 2)
    before = optimizers["scales"].state[params["scales"]]["exp_avg"].clone()
    with pytest.raises(ValueError, match=r"reset_rows: rows=.*, but indices below 30, or a bool m"):
        optimizers["scales"].reset_rows(params["scales"], rows)
    assert torch.equal(optimizers["scales"].state[params["scales"]]["exp_avg"], before)


@pytest.mark.parametrize("moments", [32, 16])
@pytest.mark.parametrize("away", [0.0, 1e3, 1e6])
def test_the_mean_of_positions_is_exact_to_one_rounding(away: float, moments: Any) -> None:
    """Of every fourth of some thousand iterates, however far they are from the origin."""
    total, params = 30_000, {"means": Parameter(torch.full((500, 3), away))}
    phases = PhaseScheduler(total, parts=[Averaging()], moments=moments)
    adam = phases.upgrade(Adam([{"params": [params["means"]], "lr": 1e-2, "name": "means"}]))
    phases.observe(iteration=Averaging.start(total))
    exact, every, count = torch.zeros(500, 3, dtype=torch.float64), 4, 225
    for number in range(1, every * count + 1):
        params["means"].grad = torch.randn(500, 3, generator=torch.Generator().manual_seed(number))
        adam.step()
        if number % every == 0:
            exact += params["means"].detach().double() / count
    phases.finish()
    rounding = torch.finfo(torch.float32).eps * max(away, 1.0)
    assert (params["means"] - exact).abs().max() <= rounding


def test_without_room_for_the_mean_a_training_goes_on(monkeypatch: Any) -> None:
    params, optimizers, phases = upgraded()
    steps(optimizers, params, TOTAL - 2)

    def full(param: Any, state: Any, name: str, *rest: Any) -> Any:
        if name == "opacities":
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return mean_of(param, state, name, *rest)

    mean_of = stepper.mean_of  # pyright: ignore
    monkeypatch.setattr(stepper, "mean_of", full)
    with pytest.warns(UserWarning, match="no room for the mean of the last iterates"):
        steps(optimizers, params, 1)
    assert not any("mean" in key for s in optimizers["all"].state.values() for key in s)
    steps(optimizers, params, 1)
    phases.finish()


# -- what is told ----------------------------------------------------------------------------------


def test_groups_with_a_row_for_each_gaussian_and_another_name_are_told() -> None:
    params = {"means": (3,), "rgb_colors": (3,), "unnorm_rotations": (4,)}
    adam = Adam([{"params": [Parameter(torch.ones(9, *s))], "name": n} for n, s in params.items()])
    adam.add_param_group({"params": [Parameter(torch.ones(9 + 1, 3))], "name": "cameras"})
    with pytest.warns(UserWarning, match=r"\['rgb_colors', 'unnorm_rotations'\] have a row"):
        PhaseScheduler(TOTAL).upgrade(adam)


@pytest.mark.parametrize("eps", [1e-15, 1e-8])
def test_the_own_frame_does_not_depend_on_eps(eps: float) -> None:
    """Torch's own is large beside a small gradient in units of a small Gaussian."""
    params = parameters(ROWS)
    params["scales"].data.fill_(math.log(0.002))
    adam = PhaseScheduler(3000, parts=[OwnFrame()]).upgrade(adam_of(params, eps=eps))
    start = params["means"].detach().clone()
    for param in params.values():
        param.grad = torch.full_like(param, 1e-7)
    adam.step()
    moved = (params["means"] - start).norm(dim=1) / 0.002
    torch.testing.assert_close(moved, torch.full((ROWS,), 0.1 * 3**0.5), rtol=1e-3, atol=0)


def test_an_upgrade_that_refuses_has_changed_nothing() -> None:
    """Not even what a part had learnt from a checkpoint, of which the second one is damaged."""
    params, optimizers, phases = upgraded([EnergyHistogram(warmup=4)], one=False)
    for _ in range(9):
        phases.observe(0.1)
        steps(optimizers, params, 1)
    stock = adams_of(params)
    for name, each in stock.items():
        each.load_state_dict(copy.deepcopy(optimizers[name].state_dict()))
    stock["shN"].param_groups[0]["opt3dgs"] = "{}"
    histogram = EnergyHistogram(warmup=4)
    with pytest.raises(ValueError, match="not of this version"):
        PhaseScheduler(TOTAL, parts=[histogram]).upgrade(stock)
    assert histogram.num_observed == 0
    assert {type(each) for each in stock.values()} == {Adam}
