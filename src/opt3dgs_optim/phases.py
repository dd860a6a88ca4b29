"""The phase scheduler: the clock of a 3DGS training, its two phases, and what its steps have."""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim.adam import StepAdam, upgraded_class
from opt3dgs_optim.checkpoint import check_groups, restore_parts
from opt3dgs_optim.checks import check_count, check_energy, check_number
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.contract import (
    Slots,
    check_parts,
    check_slots,
    check_supported,
    named,
    slots_of,
)
from opt3dgs_optim.device import mean_over_ranks, num_ranks
from opt3dgs_optim.messages import LOGGER, End, say
from opt3dgs_optim.names import GAUSSIAN_NAMES
from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.averaging import Averaging
from opt3dgs_optim.parts.fading import Fading
from opt3dgs_optim.parts.own_frame import OwnFrame
from opt3dgs_optim.presets import DEFAULTS, PAPER_STEPS, PAPER_SWITCH, paper_parts
from opt3dgs_optim.training import Training

if TYPE_CHECKING:
    from opt3dgs_optim.runs import RunLog

CALL = "PhaseScheduler"
Optimizers = TypeVar(
    "Optimizers", bound="Optimizer | Mapping[str, Optimizer] | Sequence[Optimizer]"
)


class PhaseScheduler(Training):
    """Put parts into the steps of a 3DGS trainer's optimizers, in two phases.

    The default, `DEFAULTS`, suits relocation as in 3DGS-MCMC and clone, split and prune alike.
    `PhaseScheduler.paper` is Opt3DGS.

    The optimizers count their own steps, so nothing else need be called: the positions' optimizer
    sets the clock, whatever steps others make in between. The state travels in their
    `state_dict()`.

    Args:
        total_steps: iterations of the training, each with one step of the positions' optimizer.
        switch: where exploitation starts: a fraction of `total_steps` in (0, 1] if a float, an
            iteration if an int (`total_steps`: never). The paper: 29/30.
        parts: what the steps have, in order; None: `DEFAULTS`.
        moments: bits per number of each of Adam's two moments, and of the mean of the last
            thirtieth; 16 halves the memory, and is for the Gaussians alone (see
            docs/performance.md).
        log: a `RunLog` that gets one line per iteration, with what the parts report.
        process_group: a `torch.distributed` process group over whose ranks the loss is averaged,
            for parts that read it.

    Memory: Adam's; in the last thirtieth `Averaging` keeps a copy of the parameters, too. With
    `moments=16` each takes half.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import PhaseScheduler
        >>> means = torch.nn.Parameter(torch.ones(4, 3))
        >>> optimizers = {"means": torch.optim.Adam([means], lr=0.01, eps=1e-15)}
        >>> phases = PhaseScheduler(total_steps=60, parts=[])
        >>> optimizers = phases.upgrade(optimizers)
        >>> (means**2).sum().backward()
        >>> optimizers["means"].step()
        >>> phases.iteration
        0

    Raises:
        ValueError: an option is outside what is allowed, or a part serves another training.
        TypeError: a part is not a `Part`.
    """

    def __init__(
        self,
        total_steps: int,
        switch: float | int = PAPER_SWITCH,
        parts: Sequence[Part] | None = None,
        *,
        moments: Literal[32, 16] = 32,
        log: RunLog | None = None,
        process_group: Any = None,
    ) -> None:
        total_steps = check_count(CALL, "total_steps", total_steps, 1)
        if isinstance(switch, (list, tuple)):
            raise TypeError(
                f"{CALL}: parts in the second place, where `switch` is; write parts=..."
            )
        if isinstance(switch, Integral) and not isinstance(switch, bool):
            switch_step = check_count(CALL, "switch", switch, 0, total_steps)
        else:
            switch_step = round(check_number(CALL, "switch", switch, 0.0, 1.0) * total_steps)
        super().__init__(
            DEFAULTS if parts is None else check_parts(CALL, parts),
            total_steps,
            switch_step,
            moments,
        )
        if log is not None and not hasattr(log, "step"):
            raise TypeError(f"{CALL}: log={log!r}, but a RunLog or None is needed")
        self.log, self._loss = log, None
        self._group = process_group
        own = (part for part in self.parts if part.overrides("pixel_loss"))
        self._pixel: Part | None = next(own, None)
        averaging = self.part(Averaging)
        put = total_steps if averaging is None else averaging.put_from(total_steps)
        self._end = End(total_steps, put)
        weakref.finalize(self, self._end.say)  # at exit, or where the function that trains ends

    @classmethod
    def paper(cls, total_steps: int = PAPER_STEPS, **options: Any) -> PhaseScheduler:
        """Opt3DGS with the paper's settings; the trainer calls `pixel_loss` and `observe(loss)`."""
        return cls(total_steps, parts=paper_parts(total_steps), **options)

    # -- upgrade -----------------------------------------------------------------------------------

    def upgrade(self, optimizers: Optimizers) -> Optimizers:
        """Put the parts into a trainer's optimizers, in place; return what was given.

        A group's `name`, or its optimizer's key in a dict, says which parameter it holds, in the
        words of gsplat, INRIA, nerfstudio, 3DGRUT, fVDB and others. Groups with other names are
        stepped by plain Adam. An optimizer that has loaded a checkpoint goes on from there.

        Args:
            optimizers: an Adam, a dict of them (by what they hold), or a list.

        Raises:
            TypeError, ValueError: an optimizer is outside of what is taken (`check_supported`), or
                none holds Gaussians; nothing has been changed.
        """
        given = named(optimizers)
        slots = [slots_of(key, optimizer) for key, optimizer in given]
        held = [slot for each in slots for slot in each if slot[1] is not None]
        saved: list[Any] = []
        for (key, optimizer), its in zip(given, slots, strict=True):
            if not isinstance(getattr(optimizer, "training", self), PhaseScheduler):
                raise TypeError(
                    f"{CALL}.upgrade: {type(optimizer).__name__} has parts of its own; upgrade a "
                    "torch.optim.Adam, with parts=[...] for what its steps are to have"
                )
            try:
                check_supported(optimizer, its, self.moments)
            except (TypeError, ValueError) as error:
                if key is None or any(name for _, name in its):
                    raise
                raise type(error)(
                    f"{error}; or leave {key!r} out, which holds no Gaussians"
                ) from None
            if isinstance(optimizer, StepAdam) and optimizer.training is not self:
                check_slots(f"{CALL}.upgrade", optimizer.param_groups, optimizer._slots)
            saved.append(check_groups(f"{CALL}.upgrade", optimizer.param_groups))
        if not held:
            names = [g.get("name") or key for key, o in given for g in o.param_groups]
            raise ValueError(
                f"{CALL}.upgrade: no Gaussians among the groups {names}; name the groups, or the "
                f"keys of a dict, as one of {', '.join(GAUSSIAN_NAMES)} (other trainers' names too)"
            )
        for (_, optimizer), its in zip(given, slots, strict=True):
            if self.moments == 16 and not any(name for _, name in its):
                raise ValueError(
                    f"{CALL}.upgrade: moments=16, but the {type(optimizer).__name__} of "
                    f"{len(optimizer.param_groups)} other groups holds no Gaussians; upgrade those "
                    "of the Gaussians alone, or take moments=32"
                )
        doubled = sorted({name for name in held if held.count(name) > 1})
        if doubled:
            raise ValueError(
                f"{CALL}.upgrade: {doubled[0][1]!r} is held twice; for two sets of Gaussians name "
                "the groups 'first#means', 'second#means', or make a scheduler for each"
            )
        restore_parts(self, [each for each in saved if each is not None])
        self._end.upgraded = True
        for (_, optimizer), its in zip(given, slots, strict=True):
            self._upgrade(optimizer, its)
        self._warn_of_what_was_given([optimizer for _, optimizer in given], slots)
        self._say_upgraded(" ".join(name for _, name in held if name))
        return optimizers

    def _say_upgraded(self, names: str) -> None:
        """One line, so that a user sees that something has happened."""
        means, fading = self.param_of("", "means"), self.part(Fading)
        parts = [type(part).__name__ for part in self.parts]
        if means is not None and fading is not None:
            events = fading.num_events(self.total_steps or 0, len(means))
            parts[self.parts.index(fading)] += f" ({events} times)"
        listed = ", ".join(parts) or "no parts"
        say(f"opt3dgs_optim: {self.total_steps} iterations, {listed}, in the steps of {names}")

    def _warn_of_what_was_given(self, optimizers: list[Any], slots: list[Slots]) -> None:
        """Say what of it will not do what a user may expect."""
        groups = [
            (group, name)
            for optimizer, its in zip(optimizers, slots, strict=True)
            for group, (_, name) in zip(optimizer.param_groups, its, strict=True)
        ]
        rows = {len(group["params"][0]) for group, name in groups if name and group["params"]}
        others = [
            str(group.get("name"))
            for group, name in groups
            if name is None
            and any(p.dim() and len(p) > 1 and len(p) in rows for p in group["params"])
        ]
        if others:
            self.messages.warn_once(
                "names",
                f"{CALL}.upgrade: the groups {others} have a row for each Gaussian, but names that "
                "are not known, so that plain Adam steps them; name them as one of "
                f"{', '.join(GAUSSIAN_NAMES)} (other trainers' names too) if they hold these",
            )

    def _upgrade(self, optimizer: Any, slots: Slots) -> None:
        if isinstance(optimizer, StepAdam):
            if optimizer.training is self:  # its groups are others now
                optimizer.follow(self, slots)
                return
            optimizer.note_in_groups()
            optimizer.training._end.finished = True  # pyright: ignore[reportAttributeAccessIssue]
        else:
            vars(optimizer).pop("step", None)  # as learning-rate schedulers of old have wrapped it
            optimizer.__class__ = upgraded_class(type(optimizer))
        optimizer.follow(self, slots)
        optimizer.resume()

    # -- the trainer's calls -----------------------------------------------------------------------

    @torch.no_grad()
    def observe(self, loss: Tensor | float | None = None, *, iteration: int | None = None) -> None:
        """Give the loss to parts that read it, or put the clock where the trainer's count is.

        Args:
            loss: this iteration's, 0-d, before its steps. No part in `DEFAULTS` reads it.
            iteration: from 0; for trainers whose count differs from the number of their steps.

        Raises:
            ValueError: the loss is not a single number; or the clock would go back, or beyond
                2 * `total_steps`.
        """
        if iteration is not None:
            iteration = check_count(f"{CALL}.observe", "iteration", iteration, 0)
            assert self.total_steps is not None
            if iteration < self.iteration or iteration > 2 * self.total_steps:
                raise ValueError(
                    f"{CALL}.observe: iteration={iteration}, but the clock stands at "
                    f"{self.iteration} of total_steps={self.total_steps} and goes forward, to "
                    f"{2 * self.total_steps} at most; make a new PhaseScheduler for another run"
                )
            self.put_on(iteration)
        if loss is None:
            return
        self._loss = energy = check_energy(f"{CALL}.observe", "loss", loss)
        if self.observers:
            if self._group is not None:
                energy = mean_over_ranks(energy, self._group)
            super().observe(energy)

    def pixel_loss(self, render: Tensor, target: Tensor) -> Tensor:
        """The photometric term of two images in 0..1: mean |error|, unless a part says another.

        It is for the iteration after the last step.

        `SquaredLoss` has the paper's mean squared error while exploiting.
        """
        if render.shape != target.shape:
            raise ValueError(
                f"{CALL}.pixel_loss: render has shape {tuple(render.shape)} and target "
                f"{tuple(target.shape)}, but one shape is needed"
            )
        error = render - target
        # Not by the iteration: torch.compile would compile a function anew for each.
        part, phase = self._pixel, Phase.EXPLOITATION if self.exploits_next else Phase.EXPLORATION
        if part is None or part.during not in (None, phase):
            return error.abs().mean()
        return part.pixel_loss(error)

    @torch.no_grad()
    def finish(self) -> None:
        """End the run here: the mean of the last iterates takes the parameters' place.

        Before the last thirtieth there is no mean, and the parameters stay as they are. They stay,
        too, if the training went on past `total_steps` or past an earlier `finish()`.
        """
        if not self.finished:
            found = sum(each.put_means() for each in self.optimizers())
            assert self.total_steps is not None
            if not found and self.iteration < self._end.mean_at < self.total_steps:
                LOGGER.warning(
                    "opt3dgs_optim: finish() at iteration %d of %d: averaging begins at %d, and "
                    "the parameters stay the last iterate", self.iteration + 1, self.total_steps,
                    Averaging.start(self.total_steps),
                )  # fmt: skip
        self.finished = self._end.finished = True

    # -- what it watches ---------------------------------------------------------------------------

    def resume(self, iteration: int) -> None:
        """Go on from a checkpoint, which may have been loaded to be looked at alone."""
        super().resume(iteration)
        self._end.upgraded, self._end.done = False, 0

    def advanced(self) -> None:
        """Say what is wrong with the training as it goes; write a line of the log."""
        if self.members and not self.counts_means and self.part(OwnFrame) is not None:
            self.messages.warn_once(
                "positions",
                f"{CALL}: no optimizer holds positions, so that OwnFrame does nothing; name their "
                "group, or its key in the dict, 'means' (other trainers' names are known, too)",
            )
        self._end.done = self.iteration + 1
        if self.log is not None:
            numbers = self.numbers()
            if self._loss is not None:
                numbers["loss"], self._loss = self._loss, None
            self.log.step(self.iteration, phase=self.phase.value, **numbers)
        assert self.total_steps is not None
        ends = not self.averages or self.finished
        if self.iteration == self._end.mean_at < self.total_steps and not ends:
            say(
                f"opt3dgs_optim: iteration {self.iteration + 1} of {self.total_steps}: from this "
                "step on the parameters are the mean of the last thirtieth's iterates"
            )
        if self.iteration > self.total_steps:  # trainers that count from 1 end at total_steps
            self.messages.warn_once(
                "overrun",
                f"{CALL}: iteration {self.iteration} of total_steps={self.total_steps}: the "
                "training is longer than that, so that all schedules ended early; pass its number "
                "of iterations as total_steps",
            )
        if self.finished:
            self.messages.warn_once(
                "finished",
                f"{CALL}: iteration {self.iteration} comes after finish(): the parameters are no "
                "mean any more; call it after the last step",
            )
        if self.iteration == 0 and self.observers and self._group is None and num_ranks() > 1:
            self.messages.warn_once(
                "ranks",
                f"{CALL}: {num_ranks()} ranks train, but process_group=None: parts that read the "
                "loss would differ between them; give process_group=torch.distributed.group.WORLD",
            )

    def end_line(self) -> str | None:
        """The warning if the training stops now, before its end; None if there is none."""
        return self._end.line()

    def __getstate__(self) -> dict[str, Any]:
        # Two would write into one file; another process has groups of its own.
        return {**super().__getstate__(), "log": None, "_group": None}

    def __repr__(self) -> str:
        clock = f"iteration {self.iteration} of {self.total_steps}"
        if any(part.during is not None for part in self.parts):
            clock += f", {self.phase.value}"
        return "\n".join([f"{CALL}(", f"  {clock}", *(f"  {part!r}" for part in self.parts), ")"])
