"""A step that is dropped leaves no trace, whoever knows of it: the host, the device or the trainer.

After a loss that is not finite no step is made. Where the loss lies on the host that is known in
time; where it lies on a GPU only the device knows, and the step is prepared, and then taken back.
All three must end alike: so, and as if the trainer had left the step out.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from placed_training import (
    ARMS,
    GPU,
    LATE,
    LONG,
    PRESETS,
    SWITCH,
    TOTAL,
    Training,
    distance,
    is_brief,
    some_of,
)
from simulated_device import SimulatedDevice, on_host

FUSED = {"fused": True}
ROUNDED = 2e-6  # nu is float32 on a device: see test_simulated_device.py
UNLIKE = {"EnergyHistogram": ROUNDED, "EnergyHistogram.paper": ROUNDED, "paper": ROUNDED}
WHEN = {
    "one": {9},
    "the first": {0},
    "at the switch": {SWITCH, LATE},
    "around the switch": {SWITCH - 1, SWITCH + 1, LATE - 1, LATE + 1},
    "many in a row": set(range(8, 15)),
    "every third": set(range(0, LONG, 3)),
    "the last but one": {TOTAL - 2, LONG - 2},
    "the last": {TOTAL - 1, LONG - 1},
}


def kept_alike(ours: Training, theirs: Training, tolerance: float) -> None:
    """The parameters, and all that the optimizers keep of them."""
    assert distance(ours.values(), theirs.values()) <= tolerance
    if tolerance:  # nu's last digits are other ones in everything that is kept
        return
    kept, expected = ours.kept(), theirs.kept()
    assert set(kept) == set(expected)
    assert [name for name in kept if not torch.equal(kept[name], expected[name])] == []


def trained(arm: str, dropped: set[int], place: str, **options: Any) -> tuple[Training, Any]:
    """The training, and the next number of torch's generator after it."""
    path = {} if place == GPU else {"adam": FUSED}
    training = Training(arm, dropped=dropped, places=place, loss_on=place, **path, **options).run()
    return training, on_host(torch.rand(()))


ACTING = [arm for arm in ARMS if arm != "no parts"]  # without parts nothing of ours is done


# Presets are long, and made of the others.
SOME = ("around the switch", "every third", "the last")
CASES = [(arm, when) for arm in ACTING for when in (SOME if arm in PRESETS else WHEN)]
BRIEF = ("around the switch",)
LONGER = (*BRIEF, "every third", "the last")  # of all parts at once


@pytest.mark.parametrize(
    ("arm", "when"),
    some_of(CASES, lambda case: case[1] in (LONGER if case[0] == "everything" else BRIEF)),
)
def test_the_device_drops_what_the_host_drops(arm: str, when: str) -> None:
    with SimulatedDevice():
        there, drawn_there = trained(arm, WHEN[when], GPU)
    here, drawn_here = trained(arm, WHEN[when], "cpu")
    kept_alike(there, here, UNLIKE.get(arm, 0.0))
    assert torch.equal(drawn_there, drawn_here)


QUIET = [arm for arm in ACTING if "Noise" not in arm and arm != "everything"]


@pytest.mark.parametrize("arm", QUIET)  # noise of a dropped step is drawn, on both devices
def test_the_host_drops_what_a_trainer_leaves_out(arm: str) -> None:
    when = WHEN["every third"]
    dropped, drawn = trained(arm, when, "cpu")
    left_out, drawn_then = trained(arm, when, "cpu", skips=True)
    kept_alike(dropped, left_out, 0.0)
    assert torch.equal(drawn, drawn_then)


WAYS: dict[str, dict[str, Any]] = {
    "masks": {"masked": True},
    "GradScaler": {"scaled": True},
    "single": {"layout": "single"},
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("arm", some_of(["everything", "DEFAULTS_ADC"], is_brief))
def test_however_it_is_stepped(arm: str, way: str) -> None:
    when = WHEN["every third"]
    with SimulatedDevice():
        there, _ = trained(arm, when, GPU, **WAYS[way])
    here, _ = trained(arm, when, "cpu", **WAYS[way])
    kept_alike(there, here, 0.0)


KEEPS_NOTHING = ("ConstantMultiplier", "Annealing", "SquaredLoss")


@pytest.mark.parametrize("arm", [arm for arm in ACTING if arm not in (*KEEPS_NOTHING, *PRESETS)])
def test_nothing_is_left_that_is_not_finite(arm: str) -> None:
    """The gradients of a dropped step are NaN; nothing that is kept may be."""
    with SimulatedDevice():
        training, _ = trained(arm, WHEN["every third"], GPU)
    kept = {**training.values(), **training.kept()}
    assert [name for name, value in kept.items() if not value.isfinite().all()] == []
