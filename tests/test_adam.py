"""The upgraded optimizer is still the trainer's: its class, its options, its hooks, its step."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gaussians import RATES, adam_of, adams_of, parameters, same_tensors, steps
from masked_adams import MaskedAdam, SelectiveAdam, SparseGaussianAdam, masked
from torch.nn import Parameter
from torch.optim import Adam, AdamW

from opt3dgs_optim import DEFAULTS, Averaging, Fading, OutOfView, OwnFrame, Part, PhaseScheduler
from opt3dgs_optim.step import Step

TOTAL, ROWS = 90, 8
IDLE: list[Part] = [Fading(start=0.99, stop=1.0)]  # a part that never acts here
KINDS = [SelectiveAdam, SparseGaussianAdam]


@pytest.mark.parametrize("parts", [[], IDLE], ids=["no parts", "idle"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"weight_decay": 0.1},
        {"betas": (0.5, 0.9), "eps": 1e-8},
        {"fused": True},
        {"foreach": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", [Adam, AdamW])
def test_without_parts_it_is_the_trainers_adam(kind: Any, options: dict, parts: list[Part]) -> None:
    """Bit for bit; where there are parts, of the loop that torch has without `fused`."""
    same_loop = parts == [] or not options.get("fused")
    ours, theirs = parameters(ROWS), parameters(ROWS)
    upgraded = PhaseScheduler(1000, parts=parts).upgrade(adams_of(ours, kind, **options))
    steps(upgraded, ours, 30)
    steps(adams_of(theirs, kind, **(options if same_loop else {})), theirs, 30)
    assert same_tensors(ours, theirs)


def test_other_groups_are_stepped_by_plain_adam() -> None:
    """Cameras, exposures, networks: also 0-d, and several tensors in a group."""
    ends = []
    for upgrade in (True, False):
        torch.manual_seed(0)
        more = {"mlp": Parameter(torch.randn(3, 5)), "scalar": Parameter(torch.ones(()))}
        params: dict[str, Any] = {**parameters(ROWS), **more}
        adam = adam_of(params)
        adam.add_param_group({"params": [Parameter(torch.ones(2)) for _ in range(3)], "lr": 0.1})
        if upgrade:
            adam = PhaseScheduler(30, parts=DEFAULTS).upgrade(adam)
        several = {str(i): p for i, p in enumerate(adam.param_groups[-1]["params"])}
        steps({"all": adam}, params | several, 30)
        ends.append(
            {str(n): params[n].detach() for n in ("mlp", "scalar")}
            | {str(n): p for n, p in several.items()}
        )
    assert same_tensors(*ends)


@pytest.mark.parametrize("given", ["dict", "list", "tuple", "one"])
def test_upgrade_returns_what_was_given(given: str) -> None:
    adams = adams_of(parameters(ROWS))
    lists = {"dict": dict, "list": lambda d: list(d.values()), "tuple": lambda d: tuple(d.values())}
    made: Any = lists.get(given, lambda d: d["means"])(adams)
    assert PhaseScheduler(TOTAL).upgrade(made) is made


@pytest.mark.parametrize(
    "names",
    [
        ["xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"],
        ["means", "features_dc", "features_rest", "opacities", "scales", "quats"],
        ["positions", "features_albedo", "features_specular", "density", "scale", "rotation"],
        ["means", "sh0", "shN", "logit_opacities", "log_scales", "quats"],
        ["means", "shs_dc", "shs_rest", "opacities", "scales", "rotations"],
        ["means", "sh_coefficients_0", "sh_coefficients_rest", "opacities", "scales", "rotations"],
        ["means3d", "colors", "shN", "opacities", "scales", "quats"],
        [f"Background#{n}" for n in ("xyz", "sh_dc", "sh_rest", "opacity", "scaling", "rotation")],
    ],
)
def test_the_names_of_other_trainers(names: list[str]) -> None:
    groups = [{"params": [Parameter(torch.ones(ROWS, 3))], "name": name} for name in names]
    optimizer = PhaseScheduler(TOTAL).upgrade(Adam(groups))
    known = ["means", "sh0", "shN", "opacities", "scales", "quats"]
    assert [name for _, name in optimizer._slots] == known  # pyright: ignore


@pytest.mark.parametrize("before", [True, False])
def test_a_scheduler_of_rates_is_made_before_or_after(before: bool) -> None:
    """Without torch's warning that it was not stepped. It compounds: no part writes into it."""
    params = parameters(ROWS)
    optimizer = adam_of(params)
    if before:
        decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.9)
    PhaseScheduler(20).upgrade(optimizer)
    if not before:
        decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.9)
    for _ in range(20):
        steps({"all": optimizer}, params, 1)
        decay.step()  # pyright: ignore
    for group, (_, name) in zip(
        optimizer.param_groups,
        optimizer._slots,  # pyright: ignore
        strict=True,
    ):
        assert group["lr"] == pytest.approx(RATES[name] * 0.9**20)


@pytest.mark.parametrize("fused", [False, True])
def test_a_grad_scaler_unscales_and_leaves_steps_out(fused: bool) -> None:
    """A fused Adam of torch's does that itself, and its kernel makes no step of ours."""
    params = parameters(ROWS)
    phases = PhaseScheduler(TOTAL)
    optimizers = phases.upgrade(adams_of(params, fused=fused))
    scaler = torch.amp.GradScaler("cpu", init_scale=1024.0)  # pyright: ignore
    for bad in (False, True, False):
        total = torch.stack([p.square().sum() for p in params.values()]).sum()
        loss = total * (torch.inf if bad else 1.0)
        scaler.scale(loss).backward()
        for optimizer in optimizers.values():
            scaler.step(optimizer)
            optimizer.zero_grad()
        scaler.update()
    assert phases.iteration == 1
    assert all(bool(torch.isfinite(param).all()) for param in params.values())


@pytest.mark.parametrize("parts", [DEFAULTS, [Averaging()]], ids=["defaults", "averaging"])
def test_float64_is_stepped_in_float64(parts: Any) -> None:
    """Georeferenced positions."""
    params = {name: Parameter(param.detach().double()) for name, param in parameters(ROWS).items()}
    optimizers = PhaseScheduler(TOTAL, parts=parts).upgrade(adams_of(params))
    steps(optimizers, params, TOTAL)
    assert all(param.dtype == torch.float64 for param in params.values())
    held = optimizers["means"].state[params["means"]]
    assert all(v.dtype == torch.float64 for k, v in held.items() if k != "step")


def test_another_default_dtype_is_not_followed() -> None:
    params = parameters(ROWS)
    torch.set_default_dtype(torch.float64)
    try:
        optimizers = PhaseScheduler(TOTAL).upgrade(adams_of(params))
        steps(optimizers, params, TOTAL)
    finally:
        torch.set_default_dtype(torch.float32)
    other = parameters(ROWS)
    steps(PhaseScheduler(TOTAL).upgrade(adams_of(other)), other, TOTAL)
    assert same_tensors(params, other)


def test_more_or_fewer_points_between_none_and_one() -> None:
    for rows in (0, 1):
        params = parameters(rows)
        steps(PhaseScheduler(60).upgrade(adams_of(params)), params, 60)
        assert all(len(param) == rows for param in params.values())


# -- masked steps: the arithmetic and the mask stay theirs -----------------------------------------


def run_masked(kind: type[MaskedAdam], parts: Any, count: int = 60) -> dict[str, Any]:
    params = parameters(ROWS)
    optimizer = adam_of(params, kind)
    if parts is not None:
        optimizer = PhaseScheduler(60, parts=parts).upgrade(optimizer)
    generator = torch.Generator().manual_seed(0)
    for _ in range(count):
        for param in params.values():
            param.grad = torch.randn(param.shape, generator=generator)
        visible = torch.rand(ROWS, generator=generator) < 0.5
        visible[0] = False
        optimizer.step(*masked(kind, visible))
    return params


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("parts", [[], IDLE], ids=["no parts", "idle"])
def test_without_parts_a_masked_step_is_its_own(kind: Any, parts: Any) -> None:
    assert same_tensors(run_masked(kind, parts), run_masked(kind, None))


@pytest.mark.parametrize("kind", KINDS)
def test_a_row_that_is_masked_stays_where_it_is(kind: Any) -> None:
    """In own frames, too; and the mean of what does not move is where it is."""
    start = parameters(ROWS)
    for name, param in run_masked(kind, DEFAULTS).items():
        assert torch.equal(param[0], start[name][0]), name
        assert bool((param[1:] != start[name][1:]).any())


@pytest.mark.parametrize("kind", KINDS)
def test_parts_act_around_a_masked_step(kind: Any) -> None:
    """Fading and OwnFrame change where it ends; Averaging puts the mean."""
    plain = run_masked(kind, None)
    for part, name in ((Fading(), "sh0"), (OwnFrame(), "means"), (Averaging(), "scales")):
        found = run_masked(kind, [part])
        assert not torch.equal(found[name], plain[name]), part
        assert bool(torch.isfinite(found[name]).all())


@pytest.mark.parametrize("kind", KINDS)
def test_the_mean_of_what_is_stepped_seldom_is_of_all_its_iterates(kind: Any) -> None:
    """As harmonics that are stepped in every fourth iteration; neither Adam counts its steps."""
    params, total, iterates = parameters(ROWS, "means", "sh0"), 600, []
    optimizer = PhaseScheduler(total, parts=[Averaging()]).upgrade(adam_of(params, kind))
    start, generator = Averaging.start(total), torch.Generator().manual_seed(0)
    for iteration in range(Averaging.put_from(total)):
        stepped = iteration % 4 == 0
        for name, param in params.items():
            given = torch.randn(param.shape, generator=generator)
            param.grad = given if name == "means" or stepped else None
        optimizer.step(*masked(kind, torch.ones(ROWS, dtype=torch.bool)))
        if stepped and iteration >= start:
            iterates.append(params["sh0"].detach().clone())
    assert len(iterates) == 5
    mean = optimizer.state[params["sh0"]]["averaging.mean"]
    assert torch.allclose(mean, torch.stack(iterates).mean(0), atol=1e-6)


def test_a_masked_step_in_the_own_frame_is_theirs_in_standard_deviations() -> None:
    params = parameters(ROWS, "means", "scales", "quats")
    params["scales"].data.fill_(2.0)
    params["quats"].data[:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    start = params["means"].detach().clone()
    optimizer = PhaseScheduler(60, parts=[OwnFrame(rate=0.1)]).upgrade(
        adam_of(params, SelectiveAdam)
    )
    params["means"].grad = torch.ones(ROWS, 3)
    optimizer.step(torch.ones(ROWS, dtype=torch.bool))
    full = 0.1 * 0.1 / 0.001**0.5  # without bias correction, of the first step
    moved = (start - params["means"]) / torch.tensor(2.0).exp()
    assert torch.allclose(moved, torch.full_like(moved, full), rtol=1e-4)
    assert optimizer.param_groups[0]["lr"] == RATES["means"]


# -- strangers' parts ------------------------------------------------------------------------------


class Signs(Part):
    """Feeds Adam the sign of the gradient, and clamps what comes out."""

    names = ("scales",)

    def plan(self, step: Step, training: Any) -> None:
        step.grad = step.grad.sign()

    def after(self, step: Step, training: Any) -> None:
        step.param.clamp_(-1.0, 1.0)


class Counts(Part):
    """Learns, in the notes of the training."""

    def plan(self, step: Step, training: Any) -> None:
        notes = training.notes_of(self)
        notes["steps"] = notes.get("steps", 0) + 1
        step.factor = step.factor * 0.5


def test_a_strangers_part_has_hooks_and_notes() -> None:
    params = parameters(ROWS, "means", "scales")
    phases = PhaseScheduler(TOTAL, parts=[Signs(), Counts()])
    optimizers = phases.upgrade(adams_of(params))
    start = params["means"].detach().clone()
    steps(optimizers, params, 1)
    assert bool((params["scales"].abs() <= 1).all())
    moment = optimizers["scales"].state[params["scales"]]["exp_avg"]
    assert torch.allclose(moment.abs(), torch.tensor(0.1))
    assert torch.allclose(
        (params["means"] - start).abs(), torch.tensor(RATES["means"] / 2), rtol=1e-3
    )
    again = PhaseScheduler(TOTAL, parts=[Counts()])
    fresh = again.upgrade(adams_of(params))
    fresh["means"].load_state_dict(optimizers["means"].state_dict())
    assert again.notes_of(again.parts[0]) == {"steps": 2}


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("grad", None, r"None in .* of sh0, but a tensor of \(8, 1, 3\) is needed"),
        ("grad", torch.ones(2, 2), r".*2, 2.* of sh0, but a tensor of \(8, 1, 3\) is needed"),
        ("grad", 1.0, r"1.0 in .* of sh0, but a tensor of \(8, 1, 3\) is needed"),
        ("factor", torch.ones(ROWS), "8 numbers as factor of sh0, but one is needed"),
        ("param", torch.ones(ROWS, 1, 3), "another tensor in the place of sh0; change it in place"),
    ],
)
def test_what_a_step_cannot_have_is_refused(field: str, value: Any, said: str) -> None:
    class Wrong(Part):
        def plan(self, step: Step, training: Any) -> None:
            setattr(step, field, value)

    params = parameters(ROWS, "sh0")
    optimizers = PhaseScheduler(TOTAL, parts=[Wrong()]).upgrade(adams_of(params))
    with pytest.raises(ValueError, match=f"Adam.step: a part has put {said}"):
        steps(optimizers, params, 1)


# -- what changes without a new Parameter ----------------------------------------------------------


def test_a_group_that_was_taken_away_is_told() -> None:
    params = parameters(ROWS)
    optimizer = PhaseScheduler(TOTAL).upgrade(adam_of(params))
    steps({"all": optimizer}, params, 2)
    optimizer.param_groups.pop()
    start = {name: param.detach().clone() for name, param in params.items()}
    for call in (
        lambda: steps({"all": optimizer}, params, 1),
        lambda: optimizer.add_param_group({"params": [Parameter(torch.zeros(2))]}),
        lambda: PhaseScheduler(TOTAL).upgrade(optimizer),
    ):
        with pytest.raises(ValueError, match="5 parameter groups, but 6 when it was upgraded"):
            call()
    assert all(torch.equal(params[name], start[name]) for name in params)


def test_a_list_of_other_tensors_may_grow() -> None:
    """A list of poses beside the Gaussians, and before them."""
    params, poses = parameters(ROWS), [Parameter(torch.zeros(6))]
    groups = [{"params": poses, "lr": 0.01, "name": "poses"}, *adam_of(params).param_groups]
    optimizer = PhaseScheduler(TOTAL).upgrade(Adam(groups, eps=1e-15))
    steps({"all": optimizer}, params | {"first": poses[0]}, 5)
    poses.append(Parameter(torch.zeros(6)))
    optimizer.param_groups[0]["params"].append(poses[1])
    every = params | {"first": poses[0], "second": poses[1]}
    steps({"all": optimizer}, every, 5)
    assert [int(optimizer.state[each]["step"]) for each in every.values()] == [10] * 7 + [5]


def test_an_upgrade_after_an_edit_drops_the_mean_of_the_old_rows() -> None:
    """A trainer may upgrade again after each edit."""
    found = []
    for again in (False, True):
        params = parameters(ROWS)
        optimizer = adam_of(params)
        phases = PhaseScheduler(TOTAL, parts=[Averaging()])
        phases.upgrade(optimizer)
        phases.observe(iteration=TOTAL - 2)
        steps({"all": optimizer}, params, 1)
        for group in optimizer.param_groups:  # relocation: rows written, in the same memory
            (old,) = group["params"]
            group["params"] = [new := Parameter(old.detach())]
            new.data[0] = 10.0
            optimizer.state[new] = optimizer.state.pop(old)
            params[next(name for name, param in params.items() if param is old)] = new
        if again:
            phases.upgrade(optimizer)
        steps({"all": optimizer}, params, 1)
        assert "averaging.mean" in optimizer.state[params["means"]]
        found.append({name: param.detach() for name, param in params.items()})
    assert same_tensors(*found)


def test_parameters_that_an_edit_makes_of_another_kind_are_refused() -> None:
    for change, said in (
        (
            lambda group: group["params"].__setitem__(0, Parameter(torch.ones(5, 3).half())),
            "is torch.float16",
        ),
        (lambda group: group.update(params=[]), "holds 0 tensors"),
        (lambda group: group["params"].append(Parameter(torch.ones(5, 3))), "holds 2 tensors"),
    ):
        params = parameters(ROWS, "scales", "sh0")
        optimizers = PhaseScheduler(TOTAL, parts=[Fading()]).upgrade(adams_of(params))
        steps(optimizers, params, 2)
        change(optimizers["scales"].param_groups[0])
        with pytest.raises(ValueError, match=f"Adam.step: scales {said}"):
            steps({"scales": optimizers["scales"]}, params, 1)


def test_a_schedule_may_give_a_tensor_as_rate() -> None:
    """As LambdaLR does with a function that returns one; also where rows are edited then."""
    params = parameters(ROWS, "scales", "sh0")
    optimizers = PhaseScheduler(TOTAL, parts=[Fading()]).upgrade(adams_of(params))
    optimizers["scales"].param_groups[0]["lr"] = torch.tensor(0.1)
    steps(optimizers, params, 2)
    params["scales"] = Parameter(torch.ones(ROWS + 1, 3))
    optimizers["scales"].param_groups[0]["params"] = [params["scales"]]
    steps(optimizers, params, 2)


def test_a_checkpoint_of_numbers_for_rows_is_refused() -> None:
    """Opacities [N], as gsplat has them, in the place of nerfstudio's [N, 1]."""
    params, others = parameters(ROWS, "opacities"), {"opacities": Parameter(torch.zeros(ROWS, 1))}
    given, taken = (
        PhaseScheduler(TOTAL, parts=[Fading()]).upgrade(adams_of(each)) for each in (params, others)
    )
    steps(given, params, 2)
    taken["opacities"].load_state_dict(given["opacities"].state_dict())
    with pytest.raises(ValueError, match=r"opacities is .*, 1\), but its exp_avg is \(\d+,\)"):
        steps(taken, others, 1)


def test_other_rows_of_the_positions_are_named_where_another_steps_first() -> None:
    """What looks at their moments, in the step of the scales, leaves them to be refused."""
    params = parameters(ROWS, "scales", "means")
    optimizers = PhaseScheduler(TOTAL, parts=[OutOfView()]).upgrade(adams_of(params))
    steps(optimizers, params, 2)  # it looks in the third iteration
    for param in params.values():
        param.data, param.grad = torch.ones(2, ROWS + 3, 3)
    state = optimizers["scales"].state[params["scales"]]
    state["exp_avg"], state["exp_avg_sq"] = torch.zeros(2, ROWS + 3, 3)
    optimizers["scales"].step()
    with pytest.raises(ValueError, match=f"{ROWS} rows for {ROWS + 3}"):
        optimizers["means"].step()


@pytest.mark.parametrize("rows", [ROWS - 3, ROWS + 3])
def test_other_rows_in_the_same_parameter_are_named(rows: int) -> None:
    """A trainer that writes `param.data`, and leaves the moments or the gradient behind."""
    params = parameters(ROWS, "sh0")
    optimizers = PhaseScheduler(TOTAL, parts=[Averaging()]).upgrade(adams_of(params))
    steps(optimizers, params, TOTAL - 3)
    param, state = params["sh0"], optimizers["sh0"].state[params["sh0"]]
    param.data = torch.ones(rows, 1, 3)
    param.grad = torch.ones(rows, 1, 3)
    for key in ("exp_avg", "exp_avg_sq"):
        with pytest.raises(ValueError, match=f"its {key} is .*{ROWS} rows for {rows}"):
            optimizers["sh0"].step()
        state[key] = torch.zeros(rows, 1, 3)
    optimizers["sh0"].step()
    assert torch.equal(state["averaging.mean"], param)  # it began with this step
    param.data = torch.ones(ROWS, 1, 3)
    with pytest.raises(ValueError, match="have the trainer make dense gradients of these rows"):
        optimizers["sh0"].step()


# -- masks -----------------------------------------------------------------------------------------


def test_a_mask_that_is_missing_or_too_much_changes_nothing() -> None:
    for kind in (SelectiveAdam, SparseGaussianAdam, Adam):
        calls: list[str] = []
        params = parameters(ROWS)
        phases = PhaseScheduler(TOTAL)
        optimizer = phases.upgrade(adam_of(params, kind))
        optimizer.register_step_pre_hook(lambda *_, to=calls: to.append("before"))
        for param in params.values():
            param.grad = torch.ones_like(param)
        start = {name: param.detach().clone() for name, param in params.items()}
        wrong = (torch.ones(ROWS, dtype=torch.bool),) if kind is not SelectiveAdam else ()
        with pytest.raises(TypeError, match="mask"):
            optimizer.step(*wrong)
        assert same_tensors(params, start)
        assert phases.iteration == -1
        assert calls == ["before"]  # as torch's own
        assert not optimizer.state


def test_a_masked_step_that_breaks_off_leaves_the_positions(monkeypatch: Any) -> None:
    """A GPU may run out of memory before there are zeros to step from."""

    def full(*_: Any) -> Any:
        raise RuntimeError("out of memory")

    params = parameters(ROWS)
    optimizer = PhaseScheduler(TOTAL, parts=[OwnFrame()]).upgrade(adam_of(params, SelectiveAdam))
    start = params["means"].detach().clone()
    for param in params.values():
        param.grad = torch.ones_like(param)
    monkeypatch.setattr("opt3dgs_optim.sparse_adam.into_frame", full)
    with pytest.raises(RuntimeError, match="out of memory"):
        optimizer.step(torch.ones(ROWS, dtype=torch.bool))
    assert torch.equal(params["means"], start)


@pytest.mark.parametrize("kind", KINDS)
def test_nan_is_told_where_masked_steps_are_made(kind: Any) -> None:
    """And counts as zero: no row becomes NaN."""
    params = parameters(ROWS)
    phases = PhaseScheduler(1000)
    optimizer = phases.upgrade(adam_of(params, kind))
    mask = masked(kind, torch.ones(ROWS, dtype=torch.bool))
    for param in params.values():
        param.grad = torch.ones_like(param)
        param.grad[0] = torch.nan
    optimizer.step(*mask)
    assert all(bool(torch.isfinite(param).all()) for param in params.values())
    with pytest.warns(UserWarning, match="23 numbers of gradients have not been finite"):
        phases.observe(iteration=100)


@pytest.mark.parametrize("kind", KINDS)
def test_a_checkpoint_of_an_adam_that_counts_no_steps_is_told(kind: Any) -> None:
    """gsplat's SelectiveAdam keeps its step at zero: the clock would begin again, unnoticed."""
    params = parameters(ROWS)
    optimizer = adam_of(params, kind)
    for param in params.values():
        param.grad = torch.ones_like(param)
    for _ in range(3):
        optimizer.step(*masked(kind, torch.ones(ROWS, dtype=torch.bool)))
    for state in optimizer.state.values():
        state["step"].zero_()
    phases = PhaseScheduler(1000)
    with pytest.warns(UserWarning, match="does not count its steps.*observe"):
        phases.upgrade(optimizer)
    phases.observe(iteration=3)
    optimizer.step(*masked(kind, torch.ones(ROWS, dtype=torch.bool)))
    assert phases.iteration == 3
