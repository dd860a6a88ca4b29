"""Fading: Adam's moments of random points are shrunk, so that their next steps are longer."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

from opt3dgs_optim.checks import check_count, check_number, set_options
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Fade, Step, mixed
from opt3dgs_optim.training import Training

CALL = "Fading"
MAX_POINTS_OF_ALL_EVENTS = 10_000  # of more points, fewer of the events happen
FEWEST_EVENTS = 1 / 3  # of all, however many points there are
# In 600 iterations, events 1 apart lose half of what events 4 apart gain.
MIN_ITERATIONS_BETWEEN_EVENTS = 4


@dataclass(frozen=True, repr=False)
class Fading(Part):
    """Shrink Adam's state of a random share of the points, again and again (after AdamW-GS).

    A point's step is lr * exp_avg / sqrt(exp_avg_sq). With the default factors the first step after
    an event is as long as before. Later ones are up to five times longer, until exp_avg_sq has
    recovered, which takes about a thousand iterations.

    The same points are faded in all of `names`. Which ones depends only on `seed`, the event and
    the point's index: a resumed run repeats them, and every device chooses the same. Where no end
    is planned, there are `events` / (3 i) events in iteration i, from 4/3 `events` on, until the
    fall to the end begins. It costs no memory. Positions that `OwnFrame` steps are left alone: a
    faded step of them would be half a standard deviation long.

    Args:
        share: each point's chance to be faded in an event, in (0, 1].
        exp_avg, exp_avg_sq: factors on the moments, in [0, 1]. exp_avg^2 <= exp_avg_sq keeps the
            next step from being longer than the last.
        events: how many over the run, but never less than 4 iterations apart. Where points are
            many, they are small, and so many events cost detail. So with N > 10,000 points only
            (10,000 / N)^(2/3) of the events happen, but at least a third of them.
        start, stop: the stretch over which they are spread, as shares of a planned run; the last
            event is at its end.
        seed: of the choice of points.
        names: the Gaussian parameters, under gsplat's names.

    Raises:
        ValueError: an option is outside what is allowed.
    """

    share: float = 0.2
    exp_avg: float = 0.2
    exp_avg_sq: float = 0.04
    events: int = 300
    start: float = 0.03
    stop: float = 0.7
    seed: int = 0
    names: tuple[str, ...] = GAUSSIAN

    def __post_init__(self) -> None:
        start = check_number(CALL, "start", self.start, 0.0, 1.0)
        set_options(
            self,
            share=check_number(CALL, "share", self.share, 0.0, 1.0, open_low=True),
            exp_avg=check_number(CALL, "exp_avg", self.exp_avg, 0.0, 1.0),
            exp_avg_sq=check_number(CALL, "exp_avg_sq", self.exp_avg_sq, 0.0, 1.0),
            events=check_count(CALL, "events", self.events, 1),
            start=start,
            stop=check_number(CALL, "stop", self.stop, start, 1.0, open_low=True),
            seed=check_count(CALL, "seed", self.seed, 0),
        )

    def plan(self, step: Step, training: Training) -> None:
        """Fade by the newest event since this parameter's last step, if there was one."""
        total = None if training.open_end else training.end_step
        options = total, training.fall_step, self.start, self.stop, self.events
        done = events_before(step.stepped_in + 1, *options)
        now = events_before(step.iteration + 1, *options)
        # Several are due where the trainer has left steps out; they are one. Most steps have none,
        # and an empty `any` costs a third of this.
        if now > done and any(self.happens(e, len(step.param)) for e in range(done, now)):
            step.fade = self.fade(now - 1)

    def happens(self, event: int, num_points: int) -> bool:
        """Whether an event happens: with more than 10,000 points only some of them do."""
        share = share_of_events(num_points)
        return int((event + 1) * share) > int(event * share)

    def fade(self, event: int) -> Fade:
        """What an event does."""
        key = mixed((event + self.seed * 0x9E3779B1) & 0xFFFFFFFF)
        return Fade(key, self.share, self.exp_avg, self.exp_avg_sq)


def share_of_events(num_points: int) -> float:
    """Of all events, those that fade any of so many points."""
    if not num_points:
        return 0.0
    return max(min(1.0, MAX_POINTS_OF_ALL_EVENTS / num_points) ** (2 / 3), FEWEST_EVENTS)


@functools.lru_cache(maxsize=64)  # every parameter asks for the same two iterations
def events_before(
    iteration: int,
    total_steps: int | None,
    fall: int | None,
    start: float,
    stop: float,
    events: int,
) -> int:
    """Number of events before the step of this iteration (from 0)."""
    if total_steps is None:  # no end is planned: `events` / (3 i) of them in iteration i
        each = events / 3
        first = MIN_ITERATIONS_BETWEEN_EVENTS * each
        last = iteration if fall is None else min(iteration, fall)
        return int(each * math.log(max(last / first, 1.0)))
    length = stop - start
    share = (iteration / total_steps - start) / length
    most = min(events, length * total_steps / MIN_ITERATIONS_BETWEEN_EVENTS)
    return int(min(max(share, 0.0), 1.0) * most)
