"""Whole trainings on GPUs that are not there; before them, that the simulation is one."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from placed_training import ARMS, GPU, Training, distance, is_brief, some_of
from simulated_device import DeviceTensor, SimulatedDevice, on_device, on_host
from torch import Tensor
from torch.nn import Parameter

import opt3dgs_optim
from opt3dgs_optim import Part

# -- the simulation --------------------------------------------------------------------------------


def ones(*shape: int, device: str = GPU) -> Tensor:
    return torch.ones(shape, device=device)


MIXED = {
    "add": lambda: ones(3) + torch.ones(3),
    "of two GPUs": lambda: ones(3) + ones(3, device="cuda:1"),
    "0-d of another GPU": lambda: ones(3) * ones(device="cuda:1"),
    "0-d of a GPU and the host's": lambda: torch.ones(3) * ones(),
    "in place on the host": lambda: torch.ones(3).mul_(ones()),
    "in place, 0-d on the host": lambda: torch.ones(()).add_(ones()),
    "cat": lambda: torch.cat([ones(3), torch.ones(3)]),
    "stack of 0-d": lambda: torch.stack([ones(), torch.ones(())]),
    "matmul": lambda: ones(3, 3) @ torch.ones(3, 3),
    "where": lambda: torch.where(ones(3) > 0, torch.ones(3), ones(3)),
    "where, condition of the GPU": lambda: torch.where(ones() > 0, torch.ones(3), 0.0),
    "lerp, weight of the host": lambda: ones(3).lerp_(ones(3), torch.ones(())),
    "addcmul, 0-d of the host": lambda: ones(3).addcmul_(ones(3), torch.ones(())),
    "put": lambda: ones(3).__setitem__(slice(None), torch.ones(())) or ones(3).index_put_(
        (torch.zeros(1, dtype=torch.long, device=GPU),), torch.ones(1)
    ),
    "gradient": lambda: setattr(Parameter(ones(3)), "grad", torch.ones(3)),
    "gradient of another GPU": lambda: setattr(
        Parameter(ones(3)), "grad", ones(3, device="cuda:1")
    ),
    "generator": lambda: torch.rand(3, generator=torch.Generator(), device=GPU),
    "generator of the GPU": lambda: torch.rand(3, generator=torch.Generator(GPU)),
    "foreach": lambda: vars(torch)["_foreach_add_"]([ones(3)], [torch.ones(3)]),
    "fused Adam": lambda: vars(torch)["_fused_adam_"](
        [ones(3)], [ones(3)], [ones(3)], [ones(3)], [], [torch.ones(())],
        lr=0.1, beta1=0.9, beta2=0.999, weight_decay=0.0, eps=1e-8, amsgrad=False, maximize=False,
        found_inf=torch.zeros(3),
    ),
}  # fmt: skip
FINE = {
    "0-d of the host": lambda: ones(3) * torch.ones(()),
    "0-d of both": lambda: torch.ones(()) + ones(),
    "number": lambda: ones(3) * 2.0,
    "where, numbers": lambda: torch.where(ones(3) > 0, 1.0, 0.0),
    "fill": lambda: ones(3).fill_(torch.ones(())),
    "copy": lambda: ones(3).copy_(torch.ones(3)),
    "slice": lambda: ones(3)[1:],
    "index": lambda: ones(3)[torch.tensor([0])],
    "zeros like": lambda: torch.zeros_like(ones(3)),
    "new": lambda: ones(3).new_zeros(2),
    "out": lambda: torch.mul(ones(3), 2.0, out=ones(3)),
    "in place on a view": lambda: ones(3)[:2].add_(1.0),
    "of the other": lambda: ones(3).to("cuda:1"),
    "as its like": lambda: torch.ones(3).to(ones()),
    "generator": lambda: torch.rand(3, generator=torch.Generator(GPU), device=GPU),
    "normal": lambda: ones(3).normal_(generator=torch.Generator(GPU)),
    "made there": lambda: torch.tensor([1.0, 2.0], device=GPU),
}


@pytest.mark.parametrize("name", MIXED)
def test_it_raises_where_devices_mix(name: str) -> None:
    with SimulatedDevice(), pytest.raises(RuntimeError, match="device"):
        MIXED[name]()


@pytest.mark.parametrize("name", FINE)
def test_it_does_not_raise_where_a_gpu_does_not(name: str) -> None:
    with SimulatedDevice():
        found = FINE[name]()
        assert isinstance(found, DeviceTensor)
        assert found.device.type == "cuda"
        assert found.is_cuda
        assert not found.is_cpu


WAITS: dict[str, tuple[Any, int]] = {
    "item": (lambda x: x.sum().item(), 1),
    "bool": (lambda x: bool(x.sum() > 0), 1),
    "if": (lambda x: 1 if x.sum() > 0 else 0, 1),
    "float": (lambda x: float(x.sum()), 1),
    "int": (lambda x: int(x.sum()), 1),
    "format": (lambda x: f"{x.sum():.3f}", 1),
    "tolist": (lambda x: x.tolist(), 1),
    "cpu": (lambda x: x.cpu(), 1),
    "to the host": (lambda x: x.to("cpu", torch.float64), 1),
    "copied to the host": (lambda x: torch.zeros(3).copy_(x), 1),
    "from the host": (lambda x: torch.zeros(3).to(GPU), 1),
    "copied from the host": (lambda x: x.copy_(torch.zeros(3)), 1),
    "a number made there": (lambda x: torch.tensor(1.0, device=GPU), 1),
    "nonzero": (lambda x: x.nonzero(), 1),
    "where alone": (lambda x: torch.where(x > 0), 1),
    "where, 0-d of the host": (lambda x: torch.where(x > 0, x, torch.zeros(())), 1),
    "boolean indexing": (lambda x: x[x > 0], 1),
    "boolean assignment of a tensor": (lambda x: x.__setitem__(x > 0, x * 2), 1),
    "masked_select": (lambda x: x.masked_select(x > 0), 1),
    "equal": (lambda x: torch.equal(x, x), 1),
    "allclose": (lambda x: torch.allclose(x, x), 1),
    "unique": (lambda x: x.unique(), 1),
    "indices of the host": (lambda x: x[torch.tensor([0, 1])], 1),
    "synchronize": (lambda x: torch.cuda.synchronize(), 1),
    "boolean assignment of a number": (lambda x: x.__setitem__(x > 0, 1.0), 0),
    "arithmetic": (lambda x: (x * 2 + torch.ones(())).sum(), 0),
    "where": (lambda x: torch.where(x > 0, x, 0.0), 0),
    "indices": (lambda x: x[torch.zeros(2, dtype=torch.long, device=GPU)], 0),
    "from the host, not blocking": (lambda x: torch.zeros(3).to(GPU, non_blocking=True), 0),
    "to the host, not blocking": (lambda x: x.to("cpu", non_blocking=True), 0),
    "to another GPU": (lambda x: x.to("cuda:1"), 0),
    "random": (lambda x: torch.rand(3, generator=torch.Generator(GPU), device=GPU), 0),
    "shapes": (lambda x: (x.shape, x.numel(), x.dtype, x.device, x.data_ptr(), repr(x)), 0),
}  # fmt: skip


@pytest.mark.parametrize("name", WAITS)
def test_it_notes_what_the_host_waits_for(name: str) -> None:
    wait, expected = WAITS[name]
    with SimulatedDevice() as gpu:
        x = on_device(torch.tensor([1.0, 2.0, 3.0]))
        gpu.forget()
        wait(x)
        assert len(gpu.synchronisations) == expected, gpu.synchronisations
        assert gpu.ours == []
        assert all("test_simulated_device.py:" in each.line for each in gpu.synchronisations)


def test_it_names_the_line_of_the_package_that_waits() -> None:
    from opt3dgs_optim import checks

    with SimulatedDevice() as gpu:
        checks.check_number("f", "x", 1.0)
        # The package's line, however deep in torch the wait is, and whoever has called it.
        compiled = compile("float(x)", checks.__file__, "exec")
        exec(compiled, {"x": on_device(torch.ones(()))})
        assert gpu.ours == ["_local_scalar_dense at checks.py:1"]


def test_a_copy_to_the_host_is_unfinished_until_the_host_waits() -> None:
    with SimulatedDevice():
        x = on_device(torch.ones(3))
        host = x.to("cpu", non_blocking=True)
        into = torch.zeros(3)
        into.copy_(x, non_blocking=True)
        for each in (host, into, into[1:]):
            with pytest.raises(RuntimeError, match="non_blocking"):
                _ = each + 1
        x.sum().item()
        assert host.tolist() == (into + 0).tolist() == [1.0] * 3


def test_it_has_no_numpy() -> None:
    with SimulatedDevice(), pytest.raises(TypeError, match="cuda:0"):
        on_device(torch.ones(3)).numpy()


def test_what_a_generator_draws_is_what_the_cpus_draws() -> None:
    expected = torch.rand(5, generator=torch.Generator().manual_seed(3))
    with SimulatedDevice():
        generator = torch.Generator("cuda").manual_seed(3)
        assert generator.device == torch.device(GPU)
        assert isinstance(generator, torch.Generator)
        assert isinstance(torch.default_generator, torch.Generator)
        drawn = torch.rand(5, generator=generator, device=GPU)
    assert torch.equal(on_host(drawn), expected)


def test_gradients_flow_on_and_between_devices() -> None:
    with SimulatedDevice():
        x, y = Parameter(ones(3)), Parameter(torch.ones(3))
        z = Parameter(on_device(torch.ones(3), "cuda:1"))
        loss = (x * y.to(GPU) * z.to(GPU)).sum() + (x**2).sum()
        loss.backward()
        found = [each.grad for each in (x, y, z)]
        assert [each.device.type for each in found if each is not None] == ["cuda", "cpu", "cuda"]
        assert found[2] is not None
        assert found[2].device.index == 1
        assert on_host(x.grad).tolist() == [3.0] * 3
        assert on_host(z.grad).tolist() == [1.0] * 3


def test_parameters_are_copied_pickled_and_written() -> None:
    with SimulatedDevice():
        x = Parameter(ones(3))
        x.grad = ones(3)
        for twin in (copy.deepcopy(x), pickle.loads(pickle.dumps(x))):
            assert isinstance(twin, Parameter)
            assert twin.device == x.device
            assert on_host(twin).tolist() == [1.0] * 3
        view, version = x.data[1:], x._version
        view.fill_(2.0)
        assert on_host(x).tolist() == [1.0, 2.0, 2.0]
        with torch.no_grad():
            x.add_(1.0)
        assert x._version > version
        x.data = ones(4) * 5
        assert on_host(x).tolist() == [5.0] * 4


def test_nothing_of_it_is_left_afterwards() -> None:
    before = torch.Generator, torch.cuda._lazy_init, torch.cuda.synchronize
    with SimulatedDevice():
        assert torch.Generator is not before[0]
    assert (torch.Generator, torch.cuda._lazy_init, torch.cuda.synchronize) == before
    with pytest.raises((AssertionError, RuntimeError)):
        torch.zeros(1, device="cuda")
    assert torch.ones(3).to("cpu").tolist() == [1.0] * 3


ADAMS: dict[str, dict[str, Any]] = {
    "as it comes": {},
    "fused": {"fused": True},
    "foreach": {"foreach": True},
    "single tensor": {"foreach": False},
    "capturable": {"capturable": True},
    "amsgrad": {"amsgrad": True, "weight_decay": 0.1},
}


@pytest.mark.parametrize("name", ADAMS)
def test_torchs_own_adam_runs_on_it_and_never_waits(name: str) -> None:
    def stock(**places: Any) -> Training:
        return Training("no parts", upgrade=False, adam=ADAMS[name], **places).run()

    with SimulatedDevice():
        there = stock(places=GPU, loss_on=GPU)
    assert there.waits == {}
    path = {"fused": "_fused_adam_", "single tensor": "addcdiv_"}
    assert there.operators[path.get(name, "_foreach_addcdiv_")] >= 48
    if name == "capturable":  # which torch refuses on a CPU
        return
    here = stock()
    assert distance(there.values(), here.values()) == 0.0


# -- whole trainings -------------------------------------------------------------------------------

SOME = {"": GPU, "means": "cpu", "sh0": "cpu"}
TWO = {"": GPU, "means": "cuda:1", "sh0": "cuda:1"}
FUSED: dict[str, Any] = {"fused": True}
FOREACH: dict[str, Any] = {"foreach": True}
SINGLE: dict[str, Any] = {"foreach": False}
EXACT, ROUNDED = 0.0, 2e-6  # the latter where nu is a float32 of the device, a float of the host
OTHER_PATH = 1e-5  # of another path of torch's Adam, whose last digits differ
UNLIKE = {"EnergyHistogram": ROUNDED, "EnergyHistogram.paper": ROUNDED, "paper": ROUNDED}


def compared(arm: str, there: dict[str, Any], here: dict[str, Any], **both: Any) -> Training:
    """The training there; AssertionError unless it ends where that of the CPU does."""
    with SimulatedDevice():
        training = Training(arm, **there, **both).run()
    twin = Training(arm, **here, **both).run()
    assert distance(training.values(), twin.values()) <= UNLIKE.get(arm, EXACT)
    return training


def assert_never_waits(training: Training) -> None:
    """Only to bring numbers to the device: with the first energy, and when parts change."""
    allowed = {0, training.phases.switch_step}
    assert set(training.waits) <= allowed, training.waits


def assert_waits_once(training: Training, times: int = 1) -> None:
    """At most so often per iteration, but where numbers are brought to the device."""
    begins = {0, training.phases.switch_step}
    later = [waits for at, waits in training.waits.items() if at not in begins]
    assert max(map(len, later), default=0) <= times, training.waits


def test_every_part_has_an_arm() -> None:
    training = Training("no parts")
    covered = {type(part) for arm in ARMS.values() for part in arm(training)}
    exported = [getattr(opt3dgs_optim, name) for name in opt3dgs_optim.__all__]
    parts = [each for each in exported if isinstance(each, type) and issubclass(each, Part)]
    missing = [p for p in parts if p is not Part and not any(issubclass(c, p) for c in covered)]
    assert missing == []


@pytest.mark.parametrize("arm", ARMS)
def test_all_on_one_gpu(arm: str) -> None:
    on_gpu = {"places": GPU, "loss_on": GPU}
    path = {} if arm == "no parts" else {"adam": FUSED}  # without parts the trainer's stays
    training = compared(arm, on_gpu, path, layout="single")
    assert_never_waits(training)


@pytest.mark.parametrize("arm", some_of(ARMS, is_brief))
def test_some_parameters_on_the_host(arm: str) -> None:
    """The host must wait once to know whether the loss is finite, and once for nu."""
    with SimulatedDevice():
        training = Training(arm, places=SOME, loss_on=GPU).run()
    # Other paths of torch's on the host than on a GPU, whose last digits differ.
    twin = Training(arm).run()
    assert distance(training.values(), twin.values()) <= max(UNLIKE.get(arm, EXACT), OTHER_PATH)
    counts = [len(waits) for waits in training.waits.values()]
    # Noise and own frames of positions on the host need the tensors that lie on the GPU.
    copied = {"PositionNoise": 3, "OwnFrame": 2, "everything": 5}.get(arm, 0)
    assert max(counts[1:], default=0) <= 2 + copied, training.waits


@pytest.mark.parametrize("arm", some_of(ARMS, is_brief))
def test_parameters_on_two_gpus_and_the_loss_on_a_third(arm: str) -> None:
    path = {} if arm == "no parts" else {"adam": FUSED}
    training = compared(arm, {"places": TWO, "loss_on": "cuda:2"}, path)
    assert_never_waits(training)


ALL = ("everything", "DEFAULTS_ADC", "paper")
ON_GPU: dict[str, Any] = {"places": GPU, "loss_on": GPU}
WAYS: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "a dict": (ON_GPU, {"adam": FUSED}, {}),
    "masks": (ON_GPU, {"adam": FUSED}, {"masked": True}),
    "GradScaler": (ON_GPU, {"adam": FUSED}, {"scaled": True}),
    "GradScaler, steps dropped": (ON_GPU, {"adam": FUSED}, {"scaled": True, "dropped": (7, 40)}),
    "fused": ({**ON_GPU, "adam": FUSED}, {"adam": FUSED}, {}),
    "loss on the host": ({"places": GPU}, {"adam": FUSED}, {}),
    "all offloaded": ({"loss_on": GPU}, {}, {}),
    "foreach": ({**ON_GPU, "adam": FOREACH}, {"adam": FOREACH}, {}),
    "single tensor": ({**ON_GPU, "adam": SINGLE}, {"adam": SINGLE}, {}),
    "amsgrad": (
        {**ON_GPU, "adam": {"amsgrad": True, "weight_decay": 0.01}},
        {"adam": {"amsgrad": True, "weight_decay": 0.01, "fused": True}},
        {},
    ),
}
ASKED = ("foreach", "single tensor")  # a step that a device cannot drop: the host is asked
PRESETS_WAYS = ("masks", "GradScaler", "all offloaded", "foreach")  # the others are long enough
CASES = [(arm, way) for arm in ALL for way in (WAYS if arm == "everything" else PRESETS_WAYS)]


@pytest.mark.parametrize(("arm", "way"), some_of(CASES, lambda case: case[0] == "everything"))
def test_every_way_to_step(arm: str, way: str) -> None:
    there, here, both = WAYS[way]
    training = compared(arm, there, here, **both)
    if way == "all offloaded" or way in ASKED:
        # Whether the loss is finite, and where there is a histogram, nu.
        assert_waits_once(training, 2 if way == "all offloaded" or arm == "paper" else 1)
    else:
        assert_never_waits(training)


@pytest.mark.parametrize("arm", ALL)
def test_capturable_steps_wait_once(arm: str) -> None:
    with SimulatedDevice():
        training = Training(arm, **ON_GPU, adam={"capturable": True}).run()
    assert_waits_once(training)
    assert all(bool(value.isfinite().all()) for value in training.values().values())


@pytest.mark.parametrize("arm", ["EnergyHistogram", "Curvature", "paper"])
def test_adaptive_waits_when_it_judges(arm: str) -> None:
    with SimulatedDevice():
        training = Training(arm, **ON_GPU, adaptive=True, total=130, switch=110).run()
    judged = {0, 99, 110, 119, 129}
    assert set(training.waits) <= judged, training.waits


# -- what was suspected, one by one ----------------------------------------------------------------


STOCK: dict[str, dict[str, Any]] = {"as it comes": {}, "fused": FUSED, "foreach": FOREACH}
STOCK["single tensor"] = SINGLE
STOCK |= {"capturable": {"capturable": True}, "amsgrad": {"amsgrad": True, "weight_decay": 0.01}}


@pytest.mark.parametrize("name", STOCK)
def test_without_parts_a_gpu_runs_the_trainers_own_adam_and_nothing_else(name: str) -> None:
    with SimulatedDevice():
        runs = [
            Training("no parts", **ON_GPU, adam=STOCK[name], upgrade=upgraded).run()
            for upgraded in (False, True)
        ]
    assert distance(runs[0].values(), runs[1].values()) == 0.0
    # All that is ours: whether the loss is finite.
    mine = runs[1].operators - runs[0].operators
    assert set(mine) <= {"eq", "abs", "ne", "mul", "isfinite", "detach"}
    assert all(count <= 48 for count in mine.values()), mine
    assert not runs[0].operators - runs[1].operators
    assert runs[1].waits == {}


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
@pytest.mark.parametrize("place", ["cpu", GPU])
def test_without_parts_numbers_that_are_not_finite_go_where_adam_takes_them(
    place: str, number: float
) -> None:
    ends = []
    with SimulatedDevice():
        for upgraded in (False, True):
            p = Parameter(torch.ones(3, 3, device=place))
            adam = torch.optim.Adam([{"params": [p], "name": "means"}], **FUSED)
            phases = opt3dgs_optim.PhaseScheduler(60, parts=[])
            if upgraded:
                phases.upgrade(adam)
            p.grad = torch.ones_like(p)
            p.grad[0, 0] = number
            phases.observe(torch.tensor(0.1))
            adam.step()
            ends.append(on_host(p.detach()))
    assert torch.equal(ends[0].isnan(), ends[1].isnan())
    assert torch.equal(ends[0].nan_to_num(), ends[1].nan_to_num())


def test_gradients_that_are_not_finite_are_reported_on_a_gpu(
    caplog: pytest.LogCaptureFixture, recwarn: pytest.WarningsRecorder
) -> None:
    """Some time later, since asking costs a synchronisation; and not in every step."""
    with SimulatedDevice() as gpu:
        training = Training("Fading", **ON_GPU, total=400, switch=390)
        waits = 0
        for _ in range(300):
            training.loss().backward()
            grad = training.splats["means"].grad
            assert grad is not None
            grad[0, 0] = float("nan")
            gpu.forget()
            training.phases.observe(torch.tensor(0.1, device=GPU))
            for optimizer in training.every:
                optimizer.step()
                optimizer.zero_grad()
            waits += len(gpu.ours)
        training.every[0].state_dict()
    said = caplog.text + "".join(str(each.message) for each in recwarn)
    assert "not finite" in said
    assert waits <= 10


@pytest.mark.parametrize("name", ["foreach", "single tensor"])
def test_an_explicit_path_copies_nothing_and_waits_once(name: str) -> None:
    with SimulatedDevice() as gpu:
        training = Training("DEFAULTS", **ON_GPU, adam=STOCK[name]).run(20)
        largest = max(each.numel() * 4 for each in training.splats.values())
        training.loss().backward()
        training.phases.observe(torch.tensor(0.1, device=GPU))
        gpu.forget()
        for optimizer in training.every:
            optimizer.step()
        assert len(gpu.ours) <= 1  # whether the loss is finite, asked once for all optimizers
        assert gpu.copied < largest


HISTOGRAMS = ["EnergyHistogram", "EnergyHistogram.paper", "paper"]


@pytest.mark.parametrize("arm", HISTOGRAMS)
def test_an_explicit_foreach_with_a_histogram_works_or_is_refused_at_once(arm: str) -> None:
    with SimulatedDevice():
        refused = None
        try:
            Training(arm, **ON_GPU, adam=FOREACH).run(5)
        except ValueError as error:
            refused = str(error)
    assert refused is None or ("foreach" in refused and "upgrade" in refused)


def test_differentiable_steps_have_gradients_on_a_gpu() -> None:
    ends = []
    with SimulatedDevice():
        for place in ("cpu", GPU):
            start = torch.ones(3, 3, device=place, requires_grad=True)
            moved = start * 1.0
            adam = torch.optim.Adam(
                [{"params": [moved], "name": "means"}], lr=0.1, differentiable=True
            )
            phases = opt3dgs_optim.PhaseScheduler(60, parts=[opt3dgs_optim.Annealing()])
            phases.upgrade(adam)
            moved.grad = torch.full_like(moved, 0.5)
            phases.observe(torch.tensor(0.1, device=place))
            adam.step()
            (moved**2).sum().backward()
            assert start.grad is not None
            ends.append((on_host(moved.detach()), on_host(start.grad)))
    assert torch.equal(ends[0][0], ends[1][0])
    assert torch.equal(ends[0][1], ends[1][1])


def test_complex_parameters_beside_gaussians_are_stepped() -> None:
    with SimulatedDevice():
        means = Parameter(torch.ones(3, 3, device=GPU))
        phases_of_light = Parameter(torch.ones(5, device=GPU).to(torch.complex64))
        adam = torch.optim.Adam(
            [
                {"params": [means], "name": "means"},
                {"params": [phases_of_light], "name": "light"},
            ]
        )
        phases = opt3dgs_optim.PhaseScheduler(60)
        phases.upgrade(adam)
        for _ in range(3):
            means.grad = torch.ones_like(means)
            phases_of_light.grad = torch.ones_like(phases_of_light)
            phases.observe(torch.tensor(0.1, device=GPU))
            adam.step()
        assert float(on_host(phases_of_light.detach()).real.max()) < 1.0


RESUMED = ["EnergyHistogram", "EnergyHistogram.paper", "Curvature", "Averaging", "Fading"]
RESUMED += ["FreshMoments", "everything", *("DEFAULTS", "DEFAULTS_ADC", "paper")]


def resumed(arm: str, **other: Any) -> tuple[Training, Any]:
    """A training up to its middle, and the states of its optimizers."""
    first = Training(arm, **other)
    first.run(first.phases.total_steps // 2 + 2)
    states = [optimizer.state_dict() for optimizer in first.every]
    return first, states


def goes_on(arm: str, first: Training, states: Any, **places: Any) -> Training:
    """Another training that goes on where the first was."""
    second = Training(arm, **places)
    values = first.values()
    with torch.no_grad():
        for name, param in second.splats.items():
            param.copy_(on_device(values[name], param.device) if param.is_cuda else values[name])
    for optimizer, state in zip(second.every, states, strict=True):
        optimizer.load_state_dict(state)
    second.iteration = first.iteration
    return second.run()


@pytest.mark.parametrize("arm", some_of(RESUMED, lambda arm: arm == "DEFAULTS"))
def test_a_checkpoint_of_another_gpu_is_gone_on_with(arm: str) -> None:
    with SimulatedDevice():
        first, states = resumed(arm, places="cuda:1", loss_on="cuda:1")
        second = goes_on(arm, first, states, **ON_GPU)
        whole = Training(arm, **ON_GPU).run()
        torch.manual_seed(0)  # noise is drawn anew in the second half
    if arm != "everything":
        assert distance(second.values(), whole.values()) == 0.0


@pytest.mark.parametrize("arm", some_of(RESUMED, lambda arm: arm == "DEFAULTS"))
def test_a_checkpoint_of_the_host_is_gone_on_with_on_a_gpu(arm: str) -> None:
    """`torch.load(..., map_location="cpu")`: everything in it is the host's."""
    with SimulatedDevice():
        first, states = resumed(arm, **ON_GPU)
        second = goes_on(arm, first, on_host(states), **ON_GPU)
        whole = Training(arm, **ON_GPU).run()
    if arm != "everything":
        assert distance(second.values(), whole.values()) == 0.0


@pytest.mark.parametrize("arm", some_of(ARMS, is_brief))
def test_parameter_groups_hold_plain_numbers(arm: str) -> None:
    with SimulatedDevice():
        training = Training(arm, **ON_GPU).run(40)
        groups = [g for o in training.every for g in o.state_dict()["param_groups"]]
    tensors = {key for group in groups for key, value in group.items() if isinstance(value, Tensor)}
    assert tensors == set()


def test_the_pairs_of_parameters_on_two_gpus_are_counted() -> None:
    with SimulatedDevice() as gpu:
        params = [Parameter(torch.ones(5, 3, device=f"cuda:{i}")) for i in (0, 1)]
        optimizer = opt3dgs_optim.LQNAdam(params, lr=0.01)
        for _ in range(5):
            for param in params:
                param.grad = 2 * param.detach()
            gpu.forget()
            optimizer.step()
        assert gpu.ours == []
        share = optimizer.accepted_share
        assert share is not None
        assert 0.0 <= float(share) <= 1.0


def nus(histogram: Any, energies: list[float], place: str) -> list[float]:
    """The multiplier after each energy."""
    with SimulatedDevice():
        seen = [histogram.observe(torch.tensor(each, device=place)) for each in energies]
        return [float(on_host(each)) for each in seen]


def drawn_energies(number: int) -> list[float]:
    draw = torch.Generator().manual_seed(1)
    return (0.1 + 0.02 * torch.randn(number, generator=draw)).tolist()


def test_nu_on_a_gpu_is_that_of_the_host() -> None:
    energies = drawn_energies(40)
    made = [opt3dgs_optim.EnergyHistogram(warmup=4) for _ in range(2)]
    there, here = nus(made[0], energies, GPU), nus(made[1], energies, "cpu")
    # float32 has seven digits, of which the quotients of small sums lose a few.
    assert there == pytest.approx(here, abs=1e-4)


@pytest.mark.parametrize("automatic", [True, False])
def test_a_first_energy_that_is_not_finite_counts_nowhere(automatic: bool) -> None:
    energies = [float("nan"), float("inf"), *drawn_energies(10)]
    kind = opt3dgs_optim.EnergyHistogram
    make = kind if automatic else kind.paper
    there, here = nus(make(warmup=5), energies, GPU), nus(make(warmup=5), energies, "cpu")
    known = [nu == 1.0 for nu in here]
    assert [nu == 1.0 for nu in there] == known
    assert there == pytest.approx(here, abs=1e-4)


class HostRefused:
    """`torch.distributed` as NCCL has it: one rank, whose tensors must lie on a GPU."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from torch import distributed

        for name, value in {
            "is_initialized": lambda: True,
            "get_rank": lambda group=None: 0,
            "get_world_size": lambda group=None: 1,
            "all_reduce": self.all_reduce,
        }.items():
            monkeypatch.setattr(distributed, name, value)

    def all_reduce(self, tensor: Tensor, op: Any = None, group: Any = None) -> None:
        if not tensor.is_cuda:
            raise RuntimeError("No backend type associated with device type cpu")


@pytest.mark.parametrize(
    "arm", some_of(["paper", "EnergyHistogram", "Curvature"], lambda arm: arm == "paper")
)
def test_adaptive_with_ranks_over_nccl(arm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Evidence of parts that have not acted yet is averaged, too."""
    HostRefused(monkeypatch)
    with SimulatedDevice():
        options: dict[str, Any] = {"adaptive": True, "process_group": object()}
        training = Training(arm, **ON_GPU, **options, total=260, switch=240).run(210)
    assert training.phases.iteration == 210


def test_optimizers_of_ones_own_on_a_gpu() -> None:
    """AWSGLD and LQNAdam: the same as on the host, and no synchronisation."""
    ends = []
    with SimulatedDevice() as gpu:
        for place in ("cpu", GPU):
            x = Parameter(torch.linspace(-1, 1, 12).reshape(4, 3).to(place))
            histogram = opt3dgs_optim.EnergyHistogram.paper(warmup=4)
            ours = opt3dgs_optim.AWSGLD([x], lr=0.01, histogram=histogram, **FUSED)
            y = Parameter(torch.linspace(-1, 1, 12).reshape(4, 3).to(place))
            theirs = opt3dgs_optim.LQNAdam([y], lr=0.01, **FUSED)
            for step in range(30):
                if step == 2:
                    gpu.forget()
                x.grad, y.grad = 2 * x.detach(), 3 * y.detach()
                histogram.observe((x.detach() ** 2).mean() / 10)
                ours.step()
                theirs.step()
            if place == GPU:
                assert gpu.ours == []
            ends.append([on_host(each.detach()) for each in (x, y)])
    assert torch.allclose(ends[0][0], ends[1][0], rtol=0, atol=ROUNDED)
    assert torch.equal(ends[0][1], ends[1][1])
