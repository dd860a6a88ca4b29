"""torch.set_default_device: nothing of the package follows it.

"meta" stands for a GPU here: what lies there by mistake cannot be read, or mixed with a parameter.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
from placed_training import ADAMS, ARMS, Training, distance, is_brief, some_of
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import (
    AWSGLD,
    EnergyHistogram,
    IsotropicNoise,
    LQNAdam,
    PhaseScheduler,
    RunLog,
    two_loop,
)

WAYS: dict[str, dict[str, Any]] = {
    "as they are": {},
    "a loss of Python's": {},
    "adaptive": {"adaptive": True},
    "masks": {"masked": True},
    "single": {"layout": "single"},
    "steps dropped": {"dropped": (7, 40)},
}


@contextmanager
def default_device(device: str | None) -> Iterator[None]:
    torch.set_default_device(device)
    try:
        yield
    finally:
        torch.set_default_device(None)


class Away(Training):
    """A training whose parts are made, and whose steps are made, under another default device.

    The trainer's own tensors are not: a trainer says where they are to lie, or wants them there.
    """

    def __init__(self, arm: str, device: str | None, way: str) -> None:
        self.device, self.plain_loss = device, way == "a loss of Python's"
        # Long enough for the parts of the presets.
        long = {"total": 90, "switch": 60} if arm in ("DEFAULTS", "DEFAULTS_ADC", "paper") else {}

        def parts(training: Any) -> list[Any]:
            with default_device(device):
                return list(ARMS[arm](training))

        super().__init__(parts, **long, **WAYS[way])
        self.observe, self.phases.observe = self.phases.observe, self._observe

    def _observe(self, loss: Any, **options: Any) -> None:
        self.observe(loss.item() if self.plain_loss else loss, **options)

    def step(self) -> None:
        with default_device(self.device):
            super().step()


def resumed(arm: str, device: str | None, way: str) -> Training:
    """A training that ends in another process than it began in."""
    first = Away(arm, device, way).run(45)
    states = [each.state_dict() for each in first.every]
    second = Away(arm, device, way).follow(first)
    with default_device(device):
        for ours, state in zip(second.every, states, strict=True):
            ours.load_state_dict(state)
    return second.run()


def assert_same_state(ours: Training, theirs: Training) -> None:
    kept = ours.kept()
    for key, each in theirs.kept().items():
        assert kept[key].device == each.device, key
        assert key.split(".", 1)[1] in ADAMS or torch.equal(kept[key], each), key
    assert distance(ours.values(), theirs.values()) == 0.0


CASES = [
    (arm, way)
    for arm, way in itertools.product(ARMS, WAYS)
    if (arm, way) != ("no parts", "steps dropped")  # torch's own Adam drops none
]


@pytest.mark.parametrize(
    ("arm", "way"), some_of(CASES, lambda case: is_brief(case[0]) or case[1] == "as they are")
)
def test_nothing_follows_the_default_device(arm: str, way: str) -> None:
    ours, theirs = (Away(arm, device, way).run() for device in ("meta", None))
    assert_same_state(ours, theirs)
    assert ours.phases.energy_device == torch.device("cpu")
    with default_device("meta"):
        assert repr(ours.phases) == repr(theirs.phases)
        assert str(ours.phases.state_dict()) == str(theirs.phases.state_dict())


@pytest.mark.parametrize("way", some_of(["as they are", "adaptive"], lambda way: way == "adaptive"))
@pytest.mark.parametrize("arm", ARMS)
def test_a_training_is_resumed(arm: str, way: str) -> None:
    assert_same_state(*(resumed(arm, device, way) for device in ("meta", None)))


@pytest.mark.parametrize("arm", ["EnergyHistogram", "EnergyHistogram.paper", "Curvature"])
def test_what_a_part_has_learnt_is_read_and_restored(arm: str) -> None:
    training = Away(arm, "meta", "adaptive").run()
    with default_device("meta"):
        for part in training.phases.parts:
            learnt = part.state_dict()
            part.load_state_dict(learnt)
            assert part.state_dict() == learnt
            evidence = part.evidence(training.phases)
            assert evidence is not None
            assert evidence.is_cpu
            json.dumps(learnt)


@pytest.mark.parametrize("make", [EnergyHistogram, EnergyHistogram.paper])
def test_a_histogram_alone(make: Any) -> None:
    found = []
    for device in (None, "meta"):
        with default_device(device):
            histogram = make(warmup=4)
            assert not histogram.multiplier.is_meta
            nu = [float(histogram.observe(0.01 * (i % 7))) for i in range(20)]
            mean, deviation = float(histogram.mean_multiplier), float(histogram.multiplier_std)
            found.append((nu, mean, deviation, histogram.weights.tolist(), repr(histogram)))
            again = make(warmup=4)
            again.load_state_dict(histogram.state_dict())
            assert repr(again) == repr(histogram)
    assert found[0] == found[1]


def gradients(count: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return list(torch.randn(count, 4, 3, generator=generator, device="cpu"))


def langevin(x: Parameter) -> Any:
    noise = IsotropicNoise(std=0.01)
    return AWSGLD([x], 0.01, histogram=EnergyHistogram(warmup=4), noise=noise)


@pytest.mark.parametrize(
    "make", [langevin, lambda x: LQNAdam([x], 0.01)], ids=["AWSGLD", "LQNAdam"]
)
def test_the_optimizers_that_need_no_scheduler(make: Any) -> None:
    ends = []
    for device in (None, "meta"):
        torch.manual_seed(0)
        x = Parameter(torch.ones(4, 3))
        with default_device(device):
            optimizer = make(x)
            for i, grad in enumerate(gradients(12)):
                x.grad = grad.clone()
                optimizer.step(lambda i=i: 0.1 + 0.01 * (i % 5))
            ends.append((x.detach().tolist(), repr(optimizer)))
            if isinstance(optimizer, LQNAdam):
                share = optimizer.accepted_share
                assert share is not None
                assert share.is_cpu
    assert ends[0] == ends[1]


def test_the_recursion() -> None:
    grad, history = torch.ones(4, 3), torch.rand(4, 5, 8)
    expected = two_loop(grad, history, 5)
    with default_device("meta"):
        assert torch.equal(two_loop(grad, history, 5), expected)


def test_a_run_log(tmp_path: Path) -> None:
    means = Parameter(torch.ones(4, 3))
    with default_device("meta"), RunLog(tmp_path / "run.jsonl") as log:
        parts = [EnergyHistogram(warmup=4)]
        phases = PhaseScheduler(40, parts=parts, log=log)
        adam = phases.upgrade(Adam([{"params": [means], "name": "means"}]))
        for i in range(20):
            means.grad = torch.ones(4, 3, device="cpu")
            phases.observe(0.1 + 0.01 * (i % 3))
            adam.step()
    lines = (tmp_path / "run.jsonl").read_text(encoding="utf-8").splitlines()
    energies = [json.loads(line).get("energy") for line in lines]
    assert sum(each is not None for each in energies) == 20
