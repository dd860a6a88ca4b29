"""StepAdam: torch's Adam on every path, with what a step lends taken back whatever happens."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
from devices import on_a_device
from torch import Tensor
from torch.nn import Parameter
from trainers import (
    AveragedThroughout,
    assert_same,
    begun,
    everything,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    step_all,
    train,
    upgraded,
    values_of,
    view_loss,
)

from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    ConstantMultiplier,
    EnergyHistogram,
    Fading,
    FreshMoments,
    IsotropicNoise,
    LQNAdam,
    OwnFrame,
    Part,
    PhaseScheduler,
    PositionNoise,
)
from opt3dgs_optim.names import GAUSSIAN

PATHS: list[dict[str, Any]] = [
    {},
    {"foreach": True},
    {"foreach": False},
    {"fused": True},
    {"amsgrad": True},
    {"weight_decay": 0.1},
    {"maximize": True},
    {"capturable": False, "foreach": True, "maximize": True, "weight_decay": 0.1},
    {"fused": True, "amsgrad": True, "weight_decay": 0.1},
    {"decoupled_weight_decay": True, "weight_decay": 0.1},
]
BAD = [math.nan, math.inf, -math.inf]
TOTAL = 40


class Nothing(Part):
    """A part that has every hook and changes nothing."""

    def factor(self, group: Any, course: Any) -> float:
        return 1.0

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        return grad

    def after(self, group: Any, param: Any, state: Any, course: Any) -> None:
        assert param.dim() >= 0


# -- torch's Adam --------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PATHS, ids=str)
@pytest.mark.parametrize("parts", [[], [Nothing()]], ids=["no parts", "a part that does nothing"])
def test_it_is_torchs_adam_bit_for_bit(parts: list[Part], path: dict[str, Any]) -> None:
    ours, phases, optimizers = upgraded(TOTAL, *parts, **path)
    theirs = make_splats()
    stock = gsplat_optimizers(theirs, **path)
    train(ours, optimizers, phases, 0, TOTAL)
    train(theirs, stock, None, 0, TOTAL)
    assert_same(ours, theirs)
    for name in ours:
        assert_same(state_of(stock, theirs[name]), state_of(optimizers, ours[name]))


@pytest.mark.parametrize("path", [{}, {"foreach": True}, {"fused": True}], ids=str)
@pytest.mark.parametrize("lr", [0.01, torch.tensor(0.01)], ids=["float", "tensor"])
def test_a_factor_is_a_learning_rate(path: dict[str, Any], lr: Any) -> None:
    if isinstance(lr, Tensor) and path.get("foreach"):
        pytest.skip("torch's foreach path takes no tensor rates unless capturable")
    ends = []
    for factor, rate in ((3.0, lr), (1.0, lr * 3.0)):
        x = Parameter(torch.ones(4, 3))
        phases = only(TOTAL, ConstantMultiplier(factor))
        adam = phases.upgrade({"means": torch.optim.Adam([x], lr=rate, **path)})["means"]
        for step in range(8):
            phases.observe(0.1)
            x.grad = torch.full((4, 3), 1.0 + step)
            adam.step()
        assert adam.param_groups[0]["lr"] is rate
        ends.append(x.detach())
    torch.testing.assert_close(*ends, rtol=1e-6, atol=0)


def test_step_hooks_of_torch_run_once() -> None:
    calls = []
    splats, phases, optimizers = upgraded(TOTAL, Annealing(names=GAUSSIAN))
    means = optimizers["means"]
    torch.optim.Adam([Parameter(torch.ones(1))])  # torch wraps Adam.step when one is made
    means.register_step_pre_hook(lambda *_: calls.append("pre"))
    means.register_step_post_hook(lambda *_: calls.append("post"))
    train(splats, optimizers, phases, 0, 1)
    assert calls == ["pre", "post"]


def test_hooks_registered_before_the_upgrade_go_on() -> None:
    splats, calls = make_splats(), []
    stock = gsplat_optimizers(splats)
    stock["means"].register_step_post_hook(lambda *_: calls.append("post"))
    phases = only(TOTAL, Annealing(names=GAUSSIAN))
    train(splats, phases.upgrade(stock), phases, 0, 1)
    assert calls == ["post"]


class Fails(Part):
    """Raises in the middle of a step, in one of the hooks."""

    def __init__(self, hook: str) -> None:
        self.hook = hook

    def fail(self, hook: str) -> None:
        if hook == self.hook:
            raise ArithmeticError(hook)

    def factor(self, group: Any, course: Any) -> float:
        self.fail("factor")
        return 2.0

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        self.fail("before")
        return 2 * grad

    def after(self, group: Any, param: Any, state: Any, course: Any) -> None:
        self.fail("after")


@pytest.mark.parametrize("hook", ["factor", "before", "after", "torch"])
def test_what_is_lent_is_taken_back_after_an_exception(
    hook: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from opt3dgs_optim import stepadam

    splats, phases, optimizer = upgraded(
        TOTAL, Annealing(names=GAUSSIAN), Fails(hook), make=inria_optimizer
    )
    phases.observe(0.1)
    for param in splats.values():
        param.grad = torch.ones_like(param)
    grads = [param.grad for param in splats.values()]
    rates = [group["lr"] for group in optimizer.param_groups]
    if hook == "torch":

        def broken(*_: Any) -> None:
            raise ArithmeticError("torch")

        monkeypatch.setattr(stepadam, "own_step", lambda base: (broken, False))
    with pytest.raises(ArithmeticError, match=hook):
        optimizer.step()
    assert [param.grad for param in splats.values()] == grads
    assert all(bool((grad == 1).all()) for grad in grads if grad is not None)
    assert [group["lr"] for group in optimizer.param_groups] == rates


def test_a_parameter_without_gradient_is_left_alone() -> None:
    splats, phases, optimizers = upgraded(
        TOTAL, Annealing(names=GAUSSIAN), Fading(), AveragedThroughout()
    )
    before = splats["means"].detach().clone()
    for _ in range(3):
        phases.observe(0.1)
        optimizers["means"].step()
    assert torch.equal(splats["means"], before)
    assert not optimizers["means"].state


def test_sparse_gradients_are_refused_by_torch() -> None:
    x = Parameter(torch.ones(4, 3))
    phases = only(TOTAL, Annealing(names=GAUSSIAN))
    means = phases.upgrade({"means": torch.optim.Adam([x])})["means"]
    phases.observe(0.1)
    x.grad = torch.ones(4, 3).to_sparse()
    with pytest.raises(RuntimeError, match="sparse gradients"):
        means.step()


def with_a_part(cls: Any, x: Parameter, **path: Any) -> Any:
    """An optimizer of ours that has a part; without any it is torch's Adam, which takes NaN."""
    options = {"noise": IsotropicNoise(std=0.0)} if cls is AWSGLD else {}
    return cls([x], lr=0.01, **options, **path)


def test_without_parts_nothing_of_ours_touches_the_step() -> None:
    """What torch's own Adam makes of NaN and of a broken loss, this one makes of it, too."""
    x, y = Parameter(torch.ones(4, 3)), Parameter(torch.ones(4, 3))
    phases = PhaseScheduler(100, parts=[])
    ours: Any = phases.upgrade({"means": torch.optim.Adam([x], lr=0.1)})["means"]
    theirs = torch.optim.Adam([y], lr=0.1)
    for slope, loss in ((1.0, 0.1), (2.0, math.nan), (math.nan, 0.1)):
        for param, optimizer in ((x, ours), (y, theirs)):
            param.grad = torch.full((4, 3), 1.0)
            param.grad[0] = slope
            if optimizer is ours:
                phases.observe(loss)
            optimizer.step()
        torch.testing.assert_close(x, y, rtol=0, atol=0, equal_nan=True)


# -- gradients that are not finite -----------------------------------------------------------------


@pytest.mark.parametrize("path", [{}, {"foreach": True}, {"foreach": False}, {"fused": True}])
@pytest.mark.parametrize("make", [AWSGLD, LQNAdam, "phases"], ids=str)
@pytest.mark.parametrize("rows", [20_000, pytest.param(2_000_000, marks=pytest.mark.slow)])
def test_numbers_that_are_not_finite_are_zero_and_nobody_else_notices(
    make: Any, path: dict[str, Any], rows: int
) -> None:
    """Among many rows a few break, also more of them than any fixed list would hold."""

    def gradient(x: Tensor, step: int) -> Tensor:
        noise = torch.randn(rows, 3, generator=torch.Generator().manual_seed(step))
        return 2 * x.detach() + 0.1 * noise

    def optimizer(x: Parameter) -> tuple[Any, Any]:
        if make != "phases":
            return with_a_part(make, x, **path), None
        phases = only(TOTAL, Annealing(names=GAUSSIAN), AveragedThroughout())
        adam = torch.optim.Adam([x], lr=0.01, **path)
        return phases.upgrade({"means": adam})["means"], phases

    start = torch.randn(rows, 3, generator=torch.Generator().manual_seed(9))
    x, y = Parameter(start.clone()), Parameter(start.clone())
    (hostile, one), (clean, other) = optimizer(x), optimizer(y)
    for step in range(9):
        x.grad, y.grad = gradient(x, step), gradient(y, step)
        if step % 3 == 1:
            count = 7 if step < 7 else 5_000
            broken = torch.randperm(rows, generator=torch.Generator().manual_seed(step))[:count]
            x.grad[broken, step % 3] = BAD[step % len(BAD)]
            y.grad[broken, step % 3] = 0.0
        for phases in (one, other):
            if phases is not None:
                phases.observe(0.1)
        hostile.step()
        clean.step()
    assert bool(torch.isfinite(x).all())
    assert torch.equal(x, y)
    assert_same(clean.state[y], hostile.state[x])


@pytest.mark.parametrize("cls", [AWSGLD, LQNAdam])
def test_rows_broken_for_ever_stand_still_for_ever(cls: Any) -> None:
    x = Parameter(torch.randn(5, 3, generator=torch.Generator().manual_seed(0)))
    start = x.detach().clone()
    optimizer = with_a_part(cls, x)
    for step in range(50):
        x.grad = torch.randn(5, 3, generator=torch.Generator().manual_seed(step))
        x.grad[2] = math.nan
        optimizer.step()
    assert torch.equal(x[2], start[2])
    assert not bool((x[[0, 1, 3, 4]] == start[[0, 1, 3, 4]]).any())
    for _ in range(3):
        x.grad = torch.full((5, 3), math.nan)
        optimizer.step()
    assert bool(torch.isfinite(x).all())


def test_it_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    x = Parameter(torch.ones(4, 3))
    optimizer = with_a_part(AWSGLD, x)
    for _ in range(3):
        x.grad = torch.full((4, 3), math.nan)
        optimizer.step()
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert "shape (4, 3) is not finite" in record.getMessage()


def test_a_sum_that_overflows_is_no_broken_gradient() -> None:
    x, y = Parameter(torch.ones(4, 3)), Parameter(torch.ones(4, 3))
    for param, optimizer in ((x, AWSGLD([x], lr=0.01)), (y, torch.optim.Adam([y], lr=0.01))):
        param.grad = torch.full((4, 3), 3e38)
        optimizer.step()
    assert torch.equal(x, y)


# -- losses that are not finite --------------------------------------------------------------------


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_a_broken_loss_skips_the_step(make: Any, bad: float) -> None:
    """A run with broken losses thrown in is the run without them, in both phases."""
    ends, histograms = [], []
    for hostile in (False, True):
        histogram = EnergyHistogram(warmup=10)
        others = Annealing(names=GAUSSIAN), Fading(), AveragedThroughout()
        phases = everything(60, 40, *others, nu=histogram, settling=0)
        splats, optimizers = begun(phases, make)
        for iteration in range(60):
            if hostile and iteration in (0, 5, 22, 38, 40, 55):
                (view_loss(splats, 1, phases) * bad).backward()
                phases.observe(bad, iteration=iteration)
                step_all(optimizers)
            loss = view_loss(splats, iteration % 5, phases)
            loss.backward()
            phases.observe(loss, iteration=iteration)
            step_all(optimizers)
        ends.append(splats)
        histograms.append({**histogram.state_dict(), "num_observed": 0})
    assert histograms[0] == histograms[1]
    assert_same(ends[0], ends[1])


@pytest.mark.parametrize("path", [{}, {"foreach": True}, {"foreach": False}, {"fused": True}])
def test_a_broken_loss_is_dropped_on_a_device_too(
    path: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where only the device knows: no step, no fading, no noise, no decay, no pair."""
    on_a_device(monkeypatch)
    torch.manual_seed(0)
    splats = make_splats()
    splats["opacities"].data.fill_(-9.0)
    noise = PositionNoise(splats, scale=1.0)
    fading = Fading(share=1.0, events=TOTAL, start=0.0, stop=1.0)
    phases = everything(
        TOTAL,
        20,
        Annealing(names=GAUSSIAN),
        fading,
        AveragedThroughout(),
        noise,
        nu=ConstantMultiplier(2.0),
    )
    options: dict[str, Any] = {"decoupled_weight_decay": True, "weight_decay": 0.1, **path}
    optimizers = phases.upgrade(gsplat_optimizers(splats, **options))
    for at in (10, 25):
        train(splats, optimizers, phases, phases.iteration, at)
        before = values_of(splats)
        states = {
            name: {k: v.clone() for k, v in state_of(optimizers, p).items()}
            for name, p in splats.items()
        }
        (view_loss(splats, 0, phases) * math.nan).backward()
        phases.observe(torch.tensor(math.nan))
        step_all(optimizers)
        assert_same(before, splats)
        for name, param in splats.items():
            assert_same(states[name], state_of(optimizers, param))
    train(splats, optimizers, phases, phases.iteration, TOTAL)
    assert all(bool(torch.isfinite(p).all()) for p in splats.values())


@pytest.mark.parametrize("path", [{"foreach": False}, {"fused": True}], ids=str)
def test_a_finite_loss_on_a_device_is_the_step_on_a_host(
    path: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = []
    for device in (False, True):
        if device:
            on_a_device(monkeypatch)
        others = Annealing(names=GAUSSIAN), Fading(), AveragedThroughout()
        phases = everything(TOTAL, 20, *others, nu=ConstantMultiplier(2.0))
        splats, optimizers = begun(phases, **path)
        train(splats, optimizers, phases, 0, TOTAL)
        ends.append(splats)
    assert_same(ends[0], ends[1])


@pytest.mark.parametrize("path", [{}, {"fused": True}], ids=str)
def test_a_masked_step_with_a_broken_loss_on_a_device(
    path: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    on_a_device(monkeypatch)
    splats, phases, optimizers = upgraded(
        TOTAL, Annealing(names=GAUSSIAN), AveragedThroughout(), **path
    )
    train(splats, optimizers, phases, 0, 5)
    before = splats["means"].detach().clone()
    phases.observe(torch.tensor(math.inf))
    splats["means"].grad = torch.ones(12, 3)
    optimizers["means"].step(visible=torch.arange(12) % 2)
    assert torch.equal(before, splats["means"])


def test_a_closure_with_a_broken_loss() -> None:
    x = Parameter(torch.ones(4, 3))
    optimizer = AWSGLD([x], lr=0.01, histogram=EnergyHistogram.paper(warmup=0))

    def closure() -> Tensor:
        loss = (x * math.nan).sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    assert torch.equal(x, torch.ones(4, 3))


# -- CUDA graphs -----------------------------------------------------------------------------------


def test_a_capture_is_refused_where_parts_act(monkeypatch: pytest.MonkeyPatch) -> None:
    """A replay would repeat one iteration's annealing factor, phase and fading for ever."""
    splats, phases, optimizers = upgraded(TOTAL, Annealing(names=GAUSSIAN))
    _, plain, bare = upgraded(TOTAL)
    view_loss(splats, 0, phases).backward()
    phases.observe(0.1)
    plain.observe(0.1)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    before = splats["means"].detach().clone()
    with pytest.raises(RuntimeError, match=r"StepAdam\.step: a CUDA graph is being captured"):
        optimizers["means"].step()
    assert torch.equal(before, splats["means"])
    bare["means"].step()  # nothing of ours is in it


# -- GradScaler ------------------------------------------------------------------------------------


def scaled(fused: bool | None) -> tuple[Any, dict[str, Parameter], Any, Any, EnergyHistogram]:
    others = (Annealing(names=GAUSSIAN), Fading(share=1.0, events=100, start=0.0, stop=1.0))
    phases = everything(100, 50, *others, nu=(histogram := EnergyHistogram(warmup=4)))
    splats, optimizers = begun(phases, fused=fused)
    # like nerfstudio's Trainer; a first scale at which nothing overflows
    scaler = torch.amp.GradScaler("cpu", init_scale=8.0)  # pyright: ignore
    return scaler, splats, optimizers, phases, histogram


def scaled_step(scaler: Any, splats: dict, optimizers: Any, phases: Any, factor: float = 1) -> None:
    for p in splats.values():
        p.grad = None
    loss = view_loss(splats, 0, phases) * factor
    scaler.scale(loss).backward()
    phases.observe(loss)
    for optimizer in optimizers.values():
        scaler.step(optimizer)
    scaler.update()


@pytest.mark.parametrize("fused", [None, True])
@pytest.mark.parametrize("exploiting", [False, True])
def test_grad_scaler_skips_non_finite_steps(fused: bool | None, exploiting: bool) -> None:
    scaler, splats, optimizers, phases, histogram = scaled(fused)
    steps = 55 if exploiting else 9
    for _ in range(steps):
        scaled_step(scaler, splats, optimizers, phases)
    before = values_of(splats)
    theta, seen = histogram.weights, histogram.num_observed
    scaled_step(scaler, splats, optimizers, phases, factor=float("inf"))
    assert_same(before, splats)
    assert torch.equal(histogram.weights, theta)
    assert histogram.num_observed == seen + (not exploiting)
    scaled_step(scaler, splats, optimizers, phases)
    assert not torch.equal(before["means"], splats["means"])


@pytest.mark.parametrize("device", [False, True])
@pytest.mark.parametrize("fused", [None, True])
def test_a_gradient_that_overflows_at_a_finite_loss_is_skipped(
    fused: bool | None, device: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And nothing fades: the scaler drops the step, of which the loss knows nothing."""
    if device:
        on_a_device(monkeypatch)
    scaler, splats, optimizers, phases, _ = scaled(fused)
    for _ in range(5):
        scaled_step(scaler, splats, optimizers, phases)
    before = values_of(splats)
    moments = {n: state_of(optimizers, p)["exp_avg"].clone() for n, p in splats.items()}
    scaler.update(new_scale=3e38)  # the loss is finite, its scaled gradient is not
    scaled_step(scaler, splats, optimizers, phases, factor=1e3)
    assert_same(before, splats)
    assert_same(moments, {n: state_of(optimizers, p)["exp_avg"] for n, p in splats.items()})


@pytest.mark.parametrize("fused", [None, True])
def test_grad_scaler_gives_the_unscaled_steps(fused: bool | None) -> None:
    """A power of two as scale changes no bit but those of one division, in both phases."""
    scaler, splats, optimizers, phases, _ = scaled(fused)
    _, plain, own, other, _ = scaled(fused)
    for _ in range(60):
        scaled_step(scaler, splats, optimizers, phases)
        loss = view_loss(plain, 0, other)
        loss.backward()
        other.observe(loss)
        step_all(own)
    for name, p in splats.items():
        torch.testing.assert_close(p, plain[name], rtol=1e-6, atol=1e-7)


# -- gradient accumulation, torch.compile ----------------------------------------------------------


def test_gradient_accumulation_observes_the_mean_once() -> None:
    """Four views per step: the means of losses and gradients, as of one batch."""
    results = []
    for together in (True, False):
        histogram = EnergyHistogram(warmup=4)
        splats, optimizers = begun(phases := everything(20, 12, nu=histogram, settling=0))
        for _ in range(20):
            if together:
                energy = torch.stack([view_loss(splats, v, phases) for v in range(4)]).mean()
                energy.backward()
                energy = energy.detach()
            else:
                energy = torch.zeros(())
                for view in range(4):
                    loss = view_loss(splats, view, phases) / 4
                    loss.backward()
                    energy = energy + loss.detach()
            phases.observe(energy)
            step_all(optimizers)
        assert phases.iteration == 20
        results.append((splats, float(histogram.multiplier)))
    (a, nu_a), (b, nu_b) = results
    # Sums in another order. A gradient of nearly 0 has any sign in Adam with eps 1e-15.
    assert nu_a == pytest.approx(nu_b, rel=5e-2)
    assert float((a["means"] - b["means"]).detach().abs().median()) < 1e-4


@pytest.mark.compiles
def test_a_compiled_step_is_the_step_in_both_phases() -> None:
    """torch.compile runs it as it is: the same digits."""
    results = []
    for compiled in (False, True):
        splats, optimizers = begun(
            phases := everything(12, 6, Annealing(names=GAUSSIAN), settling=0)
        )
        if compiled:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                step = torch.compile(optimizers["means"].step, backend="eager")
                optimizers["means"].step = step
                train(splats, optimizers, phases, 0, 12)
        else:
            train(splats, optimizers, phases, 0, 12)
        results.append(splats["means"].detach())
    assert torch.equal(*results)


# -- what stays off costs nothing ------------------------------------------------------------------


def test_parts_that_do_not_act_store_nothing() -> None:
    splats, optimizers = begun(phases := everything(TOTAL, 20))
    train(splats, optimizers, phases, 0, 5)
    for name, param in splats.items():
        assert set(state_of(optimizers, param)) == {"step", "exp_avg", "exp_avg_sq"}, name


def test_both_phases_with_a_constant_image() -> None:
    """Loss 0 and gradient 0 from the first step to the last: nothing moves, nothing is NaN."""
    others = Annealing(names=GAUSSIAN), Fading()
    phases = everything(50, 20, *others, nu=ConstantMultiplier(2.0), settling=0)
    splats, optimizers = begun(phases)
    before = values_of(splats)
    for _ in range(40):
        for param in splats.values():
            param.grad = torch.zeros_like(param)
        phases.observe(0.0)
        step_all(optimizers)
    assert_same(before, splats)
    train(splats, optimizers, phases, 40, 45)
    assert all(bool(torch.isfinite(p).all()) for p in splats.values())


def test_the_object_is_one_for_the_whole_run() -> None:
    splats, phases, optimizers = upgraded(TOTAL, FreshMoments(), switch=20)
    ids = {name: (id(opt), id(opt.step.__func__)) for name, opt in optimizers.items()}  # pyright: ignore
    train(splats, optimizers, phases, 0, TOTAL)
    assert ids == {n: (id(o), id(o.step.__func__)) for n, o in optimizers.items()}  # pyright: ignore


def test_what_moves_a_buffer_refuses_to_be_differentiable() -> None:
    """Before anything has moved."""
    splats = make_splats()
    phases = PhaseScheduler(60, parts=[OwnFrame()])
    adams = phases.upgrade(gsplat_optimizers(splats))
    for adam in adams.values():
        adam.param_groups[0]["differentiable"] = adam.defaults["differentiable"] = True
    before = values_of(splats)
    for param in splats.values():
        param.grad = torch.ones_like(param)
    phases.observe(0.1)
    with pytest.raises(ValueError, match="differentiable=True with OwnFrame is not possible"):
        adams["means"].step()
    assert_same(before, splats)
