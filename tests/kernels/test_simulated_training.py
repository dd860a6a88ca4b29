"""Whole trainings on a GPU that is not there: what is launched, and what comes out of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from masked_adams import SelectiveAdam
from simulated_device import DeviceTensor, SimulatedDevice, on_device, on_host
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import (
    DEFAULTS,
    Averaging,
    EnergyHistogram,
    PhaseScheduler,
    triton,
)
from opt3dgs_optim.device import Reading
from opt3dgs_optim.part import Part

SHAPES = {
    "means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3),
}  # fmt: skip
STEPS, POINTS = 60, 20
MOST_LAUNCHES = 8


class Training:
    """Gradients of views that each see some of the points, and gsplat's edits of rows."""

    def __init__(
        self, parts: Sequence[Part], gpu: SimulatedDevice | None, seen: float, moments: Any = 32
    ) -> None:
        self.draw, self.gpu, self.seen = torch.Generator().manual_seed(0), gpu, seen
        self.adams: dict[str, Adam] = {}
        for name, shape in SHAPES.items():
            param = Parameter(self.placed(self.noise(POINTS, *shape)))
            self.adams[name] = Adam([param], lr=1e-2, eps=1e-15)
        self.phases = PhaseScheduler(STEPS, parts=parts, moments=moments)
        self.phases.upgrade(self.adams)
        self.launched: list[int] = []

    def placed(self, tensor: Tensor) -> Tensor:
        return tensor if self.gpu is None else on_device(tensor)

    def noise(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.draw)

    def params(self) -> dict[str, Parameter]:
        return {name: adam.param_groups[0]["params"][0] for name, adam in self.adams.items()}

    def iterate(self, bad: bool = False) -> None:
        rows = len(self.params()["means"])
        view = torch.rand(rows, generator=self.draw) < self.seen
        for param in self.params().values():
            grad = self.noise(*param.shape) + 0.3 * on_host(param)
            grad *= view.view(-1, *[1] * (param.dim() - 1))
            if bad:
                grad.view(-1)[:2] = torch.tensor([float("nan"), float("inf")])
            param.grad = self.placed(grad)
        if self.gpu is not None:
            self.gpu.forget()
        for adam in self.adams.values():
            adam.step()
        if self.gpu is not None:
            assert self.gpu.synchronisations == []
            self.launched.append(
                self.gpu.launches.total()
                + sum(n for name, n in self.gpu.operators.items() if name != "zeros_like")
            )

    def edit(self, edit: Any) -> None:
        """Edit rows of parameters and all that the state keeps for them, as gsplat does."""
        for adam in self.adams.values():
            group = adam.param_groups[0]
            old = group["params"][0]
            state = adam.state.pop(old)
            new = Parameter(edit(old.detach(), False))
            for key, value in state.items():
                if key != "step":
                    state[key] = edit(value, True)
            group["params"], adam.state[new] = [new], state


def append(rows: Tensor, is_state: bool) -> Tensor:
    more = torch.zeros_like(rows[:5]) if is_state else rows[:5] * 0.5
    return torch.cat([rows, more])


def prune(rows: Tensor, is_state: bool) -> Tensor:
    return rows[3:]


def train(gpu: SimulatedDevice | None, seen: float, moments: Any = 32) -> Training:
    """The defaults."""
    made = Training(DEFAULTS, gpu, seen, moments)
    for i in range(STEPS):
        made.iterate(bad=i == 25)
        if i in (10, 40):
            made.edit(append)
        if i == STEPS - 2:
            made.edit(prune)
        if i == 30:
            made.edit(prune)
    return made


@pytest.mark.parametrize("seen", [0.1, 0.6], ids=["few in view", "most in view"])
@pytest.mark.filterwarnings("ignore:opt3dgs_optim. iteration 5[69]. 12 numbers")
def test_a_training_ends_as_on_a_cpu(seen: float) -> None:
    ours = train(None, seen)
    with SimulatedDevice() as gpu:
        theirs = train(gpu, seen)
        assert all(isinstance(p, DeviceTensor) for p in theirs.params().values())
    for name, param in theirs.params().items():
        mean = theirs.adams[name].state[param]["averaging.mean"]
        assert isinstance(mean, DeviceTensor)
        # Roundings grow in 60 steps of Adam, of gradients that depend on where it is.
        torch.testing.assert_close(on_host(param), ours.params()[name].data, rtol=1e-3, atol=1e-3)
    # A share counts after as many iterations as on a CPU, whatever the device has done by then.
    shares = [t.phases.numbers()["visible_share"] for t in (ours, theirs)]
    assert shares[0] == shares[1]
    steps = [n for i, n in enumerate(theirs.launched) if i not in (0, 11, 31, 41, STEPS - 1)]
    assert max(steps) <= MOST_LAUNCHES
    assert min(steps) == 6  # one a parameter


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:opt3dgs_optim. iteration 5[69]. 12 numbers")
def test_a_training_with_moments_of_16_bits_ends_as_on_a_cpu() -> None:
    ours = train(None, 0.3, moments=16)
    with SimulatedDevice() as gpu:
        theirs = train(gpu, 0.3, moments=16)
    for name, param in theirs.params().items():
        assert theirs.adams[name].state[param]["exp_avg"].dtype == torch.int16
        torch.testing.assert_close(on_host(param), ours.params()[name].data, rtol=1e-3, atol=1e-3)
    # Codes that an edit has made float32 are made integers again, an operator for each of two.
    steps = [n for i, n in enumerate(theirs.launched) if i not in (0, 11, 31, 41, STEPS - 1)]
    assert max(steps) <= MOST_LAUNCHES


def test_numbers_that_are_not_finite_are_told_without_a_wait() -> None:
    with SimulatedDevice() as gpu:
        made = Training(DEFAULTS, gpu, 0.5)
        made.phases = PhaseScheduler(1000)
        made.phases.upgrade(made.adams)
        made.iterate(bad=True)
        for iteration in (99, 100):
            made.phases.observe(iteration=iteration)
            made.iterate()
        with pytest.warns(UserWarning, match="12 numbers of gradients have not been finite"):
            made.phases.observe(iteration=200)
        made.iterate()
        made.phases.observe(iteration=300)  # once


def test_a_strangers_rate_on_the_device_is_read_there() -> None:
    class Rate(Part):
        names = None

        def plan(self, step: Any, training: Any) -> None:
            step.factor = step.param.new_full((), 0.5) if step.name != "means" else 1.0

    with SimulatedDevice() as gpu:
        made = Training([Rate()], gpu, 1.0)
        before = {name: on_host(p).clone() for name, p in made.params().items()}
        made.iterate()
        assert gpu.launches == {"step_rows": 6}
    for name, param in made.params().items():
        moved = (on_host(param) - before[name]).abs().amax().item()
        assert moved == pytest.approx(1e-2 if name == "means" else 0.5e-2, rel=1e-4)


# -- what only a device has ------------------------------------------------------------------------


def test_a_step_in_the_capture_of_a_graph_is_refused() -> None:
    with SimulatedDevice() as gpu:
        made = Training(DEFAULTS, gpu, 1.0)
        made.iterate()
        gpu.capturing = True
        before = {name: on_host(p).clone() for name, p in made.params().items()}
        with pytest.raises(RuntimeError, match="a CUDA graph is being captured"):
            made.iterate()
        assert made.phases.iteration == 0
    assert all(torch.equal(on_host(p), before[name]) for name, p in made.params().items())


def test_a_count_of_steps_on_the_device_is_taken() -> None:
    """As a fused Adam keeps it, or a trainer's edit of the state leaves it."""
    with SimulatedDevice() as gpu:
        made = Training(DEFAULTS, gpu, 1.0)
        made.iterate()
        for adam, param in zip(made.adams.values(), made.params().values(), strict=True):

            class Elsewhere(DeviceTensor):
                def numpy(self, *_: Any, **__: Any) -> Any:
                    raise TypeError("can't convert cuda:0 device type tensor to numpy")

            adam.state[param]["step"] = on_device(torch.tensor(1.0)).as_subclass(Elsewhere)
        for adam in made.adams.values():
            adam.step()
    counts = [
        adam.state[p]["step"]
        for adam, p in zip(made.adams.values(), made.params().values(), strict=True)
    ]
    assert [(type(each), each.item()) for each in counts] == [(Tensor, 2.0)] * 6


@pytest.mark.parametrize("moments", [32, 16])
def test_the_first_step_compiles_what_later_ones_need(
    moments: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is left to fail in the last thirtieth of a training."""
    run, forms = triton._run, []

    def noted(name: str, programs: int, tensors: Any, numbers: Any, coded: Any) -> None:
        forms[-1].add((name, coded, *(tensor is None for tensor in tensors)))
        run(name, programs, tensors, numbers, coded)

    with SimulatedDevice() as gpu:
        monkeypatch.setattr(triton, "_run", noted)
        made = Training(DEFAULTS, gpu, 0.1, moments)
        forms.append(set())
        made.iterate()
        first = forms[0]
        for iteration in (*range(1, 9), *range(STEPS - 4, STEPS)):
            made.phases.observe(iteration=iteration)
            forms.append(set())
            made.iterate()
    steps = {form for each in forms for form in each if form[0] != "look_at_positions"}
    assert steps <= first
    assert len(steps) > len({form for form in forms[1] if form[0] != "look_at_positions"})


def test_numbers_of_any_kind_reach_a_kernel_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Triton compiles by the types of arguments, which the key of a compiled kernel has not."""
    run, kinds = triton._run, set()

    def noted(name: str, programs: int, tensors: Any, numbers: Any, coded: Any) -> None:
        kinds.add((name, *map(type, numbers)))
        run(name, programs, tensors, numbers, coded)

    with SimulatedDevice() as gpu:
        monkeypatch.setattr(triton, "_run", noted)
        made = Training([Averaging()], gpu, 1.0)
        made.iterate()
        for adam in made.adams.values():
            adam.param_groups[0].update(
                lr=0, weight_decay=np.float32(0.1), betas=(np.float64(0.9), 0), eps=True
            )
        made.iterate()
    assert len({kind for kind in kinds if kind[0] == "step_rows"}) == 1


def test_a_masked_adam_does_not_wait_for_a_factor_on_the_device() -> None:
    """Nu lies there, of losses that do; the step is made from zeros, and scaled there."""
    ends = []
    for on_gpu in (False, True):
        with SimulatedDevice() as gpu:
            draw = torch.Generator().manual_seed(0)
            start = torch.randn(POINTS, 3, generator=draw)
            param = Parameter(on_device(start) if on_gpu else start.clone())
            adam = SelectiveAdam([{"params": [param], "lr": 0.1, "name": "scales"}])
            phases = PhaseScheduler(STEPS, parts=[EnergyHistogram(warmup=4)])
            phases.upgrade(adam)
            rows = on_device(torch.arange(POINTS)) if on_gpu else torch.arange(POINTS)
            for _ in range(20):
                loss = torch.rand((), generator=draw)
                phases.observe(on_device(loss) if on_gpu else loss)
                grad = torch.randn(POINTS, 3, generator=draw)
                param.grad = on_device(grad) if on_gpu else grad
                gpu.forget()
                adam.step(rows)
                assert gpu.synchronisations == []
            ends.append(on_host(param).clone())
    torch.testing.assert_close(*ends, rtol=1e-4, atol=1e-4)


def test_a_reading_is_pinned_on_the_host_and_waits_on_its_own_devices_stream(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever torch's default device is, and whichever is the current one."""
    asked, recorded = [], []
    with SimulatedDevice():
        empty, source = torch.empty, torch.ones(1, device="cuda")
        monkeypatch.setattr(torch, "empty", lambda *a, **k: [asked.append(k), empty(*a, **k)][1])
        monkeypatch.setattr(torch.cuda, "current_stream", recorded.append)
        reading = Reading(source)
        reading.ask()
        assert reading.take() is None  # on its way
        assert reading.take(wait=True) == [1.0]
    assert (asked[0]["device"], asked[0]["pin_memory"]) == ("cpu", True)
    assert recorded == [torch.device("cuda", 0)]
