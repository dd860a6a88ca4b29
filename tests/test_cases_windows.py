"""What parts keep is about a window of iterations: another run, or another pass, begins anew.

From people who train on (graphdeco-inria/gaussian-splatting #379, #459), and who run a notebook's
cell twice. What a part has kept in one window must not be in another: a training that goes on, from
a finished one's checkpoint or on the same objects, ends where it would with Adam's own state alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from placed_training import ADAMS, Training, distance
from torch.nn import Parameter
from trainers import AveragedThroughout

from opt3dgs_optim import Averaging, Curvature, Fading, FreshMoments, Part, PhaseScheduler
from opt3dgs_optim.names import GAUSSIAN

pytestmark = pytest.mark.filterwarnings("ignore:PhaseScheduler")
SHORT, LONGER = 60, 150
KEEPERS: dict[str, Any] = {  # whose memory is of a window, not of the run's energies or views
    "Averaging": lambda training: [Averaging()],
    "averaging throughout": lambda training: [AveragedThroughout()],
    "Curvature": lambda training: [Curvature()],
    "curvature of all": lambda training: [Curvature(3, names=GAUSSIAN)],
    "FreshMoments": lambda training: [FreshMoments()],
    "Fading": lambda training: [Fading(start=0.0, stop=1.0)],
    "late fading": lambda training: [Fading(start=0.5, stop=1.0)],
    "all": lambda training: [
        Fading(start=0.0, stop=1.0),
        FreshMoments(),
        Curvature(),
        Averaging(),
    ],
}
STOPPED = (SHORT, SHORT - 1, SHORT * 2 // 3 + 5)


def begun(keeper: str, total: int, **options: Any) -> Training:
    return Training(KEEPERS[keeper], total=total, switch=total * 2 // 3, **options)


@pytest.mark.parametrize("keeper", KEEPERS)
@pytest.mark.parametrize("at", STOPPED)
def test_a_training_that_goes_on_longer(keeper: str, at: int) -> None:
    """A finished one, or one that is stopped within its windows, loaded into a longer one."""
    first = begun(keeper, SHORT).run(at)
    resumed = begun(keeper, LONGER).resume(first).run()
    anew = begun(keeper, LONGER, counts=True).resume_moments(first).run()
    assert distance(resumed.values(), anew.values()) == 0.0


@pytest.mark.parametrize("keeper", KEEPERS)
def test_a_clock_that_starts_again_on_the_same_objects(keeper: str) -> None:
    first = begun(keeper, SHORT, counts=True).run()
    anew = begun(keeper, SHORT, counts=True).resume_moments(first)
    for training in (first, anew):
        training.iteration = 0
        training.run()
    assert distance(first.values(), anew.values()) == 0.0


@pytest.mark.parametrize("keeper", KEEPERS)
@pytest.mark.parametrize("back", [30, 10, 3])
def test_a_clock_that_goes_back_within_a_training(keeper: str, back: int) -> None:
    """A trainer that goes back to an older state of its own, without a checkpoint."""
    first = begun(keeper, SHORT, counts=True).run(SHORT - 2)
    anew = begun(keeper, SHORT, counts=True).resume_moments(first)
    for training in (first, anew):
        training.iteration = SHORT - 2 - back
        training.run()
    assert bool(torch.isfinite(first.splats["means"]).all())
    if back > SHORT // 3:  # before the windows: nothing of theirs is left
        assert distance(first.values(), anew.values()) == 0.0


def kept_keys(training: Training) -> set[str]:
    return {key for key in training.kept() if key.split(".", 1)[1] not in ADAMS}


@pytest.mark.parametrize("keeper", ["Averaging", "Curvature"])
def test_memory_is_given_back_when_a_window_is_over(keeper: str) -> None:
    training = begun(keeper, SHORT, counts=True).run(SHORT - 1)
    assert kept_keys(training)
    training.iteration = 0
    training.run(2)
    assert kept_keys(training) == set()


def test_a_new_end_is_the_mean_of_the_new_run_alone() -> None:
    """From 0 to 1 in 300 iterations; then on to 3 until 900."""
    ends = []
    for load in (True, False):
        p = Parameter(torch.zeros(4, 3))
        phases = PhaseScheduler(300)
        adam = phases.upgrade({"means": torch.optim.Adam([p], lr=0.01)})["means"]
        go(phases, adam, p, range(300), 1.0)
        longer = PhaseScheduler(900)
        again = longer.upgrade({"means": torch.optim.Adam([p], lr=0.01)})["means"]
        if load:
            again.load_state_dict(adam.state_dict())
        go(longer, again, p, range(300, 900), 3.0)
        ends.append(p[0, 0].item())
    assert ends == pytest.approx([3.0, 3.0], abs=0.05)


def go(phases: Any, adam: Any, p: Parameter, iterations: range, goal: float) -> None:
    for i in iterations:
        p.grad = p.detach() - goal
        phases.observe(0.1, iteration=i)
        adam.step()


class InWindow(Part):
    """Notes in which iteration which of its hooks is called; keeps nothing."""

    def __init__(self, first: int, end: int) -> None:
        self.first, self.end = first, end
        self.called: dict[str, list[int]] = {}

    def note(self, hook: str, course: Any) -> None:
        self.called.setdefault(hook, []).append(course.current)

    def window(self, course: Any) -> tuple[int, int]:
        return self.first, self.end

    def factor(self, group: Any, course: Any) -> float:
        self.note("factor", course)
        return 1.0

    def before(self, group: Any, param: Any, grad: Any, state: Any, course: Any) -> Any:
        self.note("before", course)
        return grad

    def displacement(self, group: Any, param: Any, step: Any, state: Any, course: Any) -> Any:
        self.note("displacement", course)
        return step

    def after(self, group: Any, param: Any, state: Any, course: Any) -> None:
        self.note("after", course)


@pytest.mark.parametrize("order", [range(8), (0, 3, 6, 2, 5, 7), (5, 2)])
def test_a_part_acts_in_no_step_outside_of_its_window(order: Sequence[int]) -> None:
    """Also where the clock jumps, or is set back."""
    means, part = Parameter(torch.ones(4, 3)), InWindow(2, 5)
    phases = PhaseScheduler(8, parts=[part])
    adam = phases.upgrade(torch.optim.Adam([{"params": [means], "lr": 0.01, "name": "means"}]))
    for iteration in order:
        means.grad = torch.ones_like(means)
        phases.observe(torch.tensor(0.1), iteration=iteration)
        adam.step()
    inside = [iteration for iteration in order if 2 <= iteration < 5]
    hooks = ("factor", "before", "displacement", "after")
    assert part.called == dict.fromkeys(hooks, inside)
