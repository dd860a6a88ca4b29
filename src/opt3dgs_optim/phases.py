"""The phase scheduler: the clock of a 3DGS training, its two phases, and what its steps have."""

from __future__ import annotations

import math
import weakref
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim.adam import StepAdam, upgraded_class
from opt3dgs_optim.checkpoint import check_groups, numbers_of, restore_parts
from opt3dgs_optim.checks import check_count, check_energy, check_number
from opt3dgs_optim.clock import CALL, Phase
from opt3dgs_optim.contract import (
    Slots,
    check_held_together,
    check_parts,
    check_slots,
    check_supported,
    line_of_unknown_groups,
    named,
    slots_of,
)
from opt3dgs_optim.device import num_ranks
from opt3dgs_optim.messages import LOGGER, End, say
from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.averaging import Averaging
from opt3dgs_optim.parts.own_frame import OwnFrame
from opt3dgs_optim.plateau import Plateau
from opt3dgs_optim.presets import DEFAULTS, PAPER_STEPS, PAPER_SWITCH, paper_parts
from opt3dgs_optim.training import Training

Optimizers = TypeVar(
    "Optimizers", bound="Optimizer | Mapping[str, Optimizer] | Sequence[Optimizer]"
)


class PhaseScheduler(Training):
    """Put parts into the steps of a 3DGS trainer's optimizers, in two phases.

    The default, `DEFAULTS`, suits both relocation (3DGS-MCMC) and clone, split and prune.
    `PhaseScheduler.paper` is Opt3DGS.

    The optimizers count their own steps, so nothing else need be called: the positions' optimizer
    sets the clock, whatever steps others make in between. The state travels in their
    `state_dict()`.

    Args:
        total_steps: iterations of the training, each with one step of the positions' optimizer;
            None: it goes on until `finish_in` is called, or `phases.total_steps` set.
        parts: what the steps have, in order; None: `DEFAULTS`.
        switch: where exploitation starts, which only the paper's parts read: a share of
            `total_steps` in [0, 1] (1: never). The paper: 29/30. Without `total_steps` it starts
            where the fall to the end begins.
        moments: bits per number of each of Adam's two moments, and of the mean of the last
            thirtieth; 16 halves the memory, and is for the Gaussians alone (see
            docs/performance.md).

    Memory: Adam's; in the last thirtieth `Averaging` keeps a copy of the parameters, too.
    `moments=16` halves Adam's, and that copy but for the positions'.

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
        total_steps: int | None = None,
        *,
        parts: Sequence[Part] | None = None,
        switch: float = PAPER_SWITCH,
        moments: Literal[32, 16] = 32,
    ) -> None:
        if total_steps is not None:
            total_steps = check_count(CALL, "total_steps", total_steps, 1)
        share = check_number(CALL, "switch", switch, 0.0, 1.0)
        switch_step = None if total_steps is None else round(share * total_steps)
        parts = DEFAULTS if parts is None else check_parts(CALL, parts)
        super().__init__(parts, total_steps, switch_step, moments)
        own = (part for part in self.parts if part.overrides("pixel_loss"))
        self._pixel: Part | None = next(own, None)
        self._end, self._plateau = End(self.open_end), Plateau()
        self._plan_end()
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
        self._end.asked = True
        given = named(optimizers)
        slots = [slots_of(key, optimizer) for key, optimizer in given]
        saved: list[Any] = []
        for (key, optimizer), its in zip(given, slots, strict=True):
            ours = isinstance(optimizer, StepAdam)
            if ours and not isinstance(optimizer.training, PhaseScheduler):
                raise TypeError(
                    f"{CALL}.upgrade: {type(optimizer).__name__} has parts of its own; upgrade a "
                    "torch.optim.Adam, with parts=[...] for what its steps are to have"
                )
            try:
                check_supported(f"{CALL}.upgrade", optimizer, its, self.moments)
            except (TypeError, ValueError) as error:
                if len(given) == 1 or (key is None and not its) or any(name for _, name in its):
                    raise
                which = "it" if key is None else repr(key)
                raise type(error)(
                    f"{error}; or leave {which} out, which holds no Gaussians"
                ) from None
            if ours and optimizer.training is not self:
                check_slots(f"{CALL}.upgrade", optimizer.param_groups, optimizer._slots)
                saved.append(numbers_of(optimizer.training, 0, 0, 0))  # as a checkpoint of now
            else:
                saved.append(check_groups(f"{CALL}.upgrade", optimizer.param_groups))
        check_held_together(f"{CALL}.upgrade", given, slots, self.moments)
        restore_parts(self, [each for each in saved if each is not None])
        for (_, optimizer), its in zip(given, slots, strict=True):
            self._upgrade(optimizer, its)
        self._end.upgraded = True
        others = line_of_unknown_groups(f"{CALL}.upgrade", given, slots)
        if others and any(part.names is not None for part in self.parts):
            self.messages.warn_once("names", others)
        self._say_upgraded(" ".join(name for its in slots for _, name in its if name))
        return optimizers

    def _say_upgraded(self, names: str) -> None:
        """One line, so that a user sees that something has happened."""
        listed = ", ".join(type(part).__name__ for part in self.parts) or "no parts"
        length = "no planned end" if self.open_end else f"{self.end_step} iterations"
        say(f"opt3dgs_optim: {length}, {listed}, in the steps of {names}")

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
        self._end.hold(optimizer)
        optimizer.follow(self, slots)
        optimizer.resume()

    # -- the trainer's calls -----------------------------------------------------------------------

    @torch.no_grad()
    def observe(self, loss: Tensor | float | None = None, *, iteration: int | None = None) -> None:
        """Give the loss to parts that read it, or put the clock where the trainer's count is.

        Args:
            loss: this iteration's, 0-d, before its steps; with several ranks its mean over them. No
                part in `DEFAULTS` reads it.
            iteration: from 0; for trainers whose count differs from the number of their steps.

        Raises:
            ValueError: the loss is not a single number, or a count; or the clock would go back, or
                beyond 2 * `total_steps`, or has no optimizers yet.
        """
        if type(loss) is int and loss > 0:
            raise ValueError(
                f"{CALL}.observe: loss={loss}, an integer; for the trainer's count write "
                f"observe(iteration={loss})"
            )
        if iteration is not None:
            if not self.all_optimizers:
                raise ValueError(
                    f"{CALL}.observe: iteration={iteration} before upgrade(optimizers), where a "
                    "checkpoint sets the clock; call it below"
                )
            iteration = check_count(f"{CALL}.observe", "iteration", iteration, 0)
            most = math.inf if self.end_step is None else 2 * self.end_step
            cure = "make a new PhaseScheduler for another run"
            if self.fall_step is not None:  # a jump would leave out its end
                most = max(self.iteration + 1, self.fall_step)
                cure = "the end counts steps: leave out iteration="
            if not self.iteration <= iteration <= most:
                raise ValueError(
                    f"{CALL}.observe: iteration={iteration}, but the clock stands at "
                    f"{self.iteration} of {self.end_step or 'no planned end'} and goes forward"
                    f"{f', to {most} at most' * (most < math.inf)}; {cure}"
                )
            self.put_on(iteration)
        if loss is None:
            return
        energy = check_energy(f"{CALL}.observe", "loss", loss)
        if self.open_end and self.fall_step is None:
            line = self._plateau.line(energy, self.iteration)
            if line is not None:
                self.messages.say_once(line)
        if self.observers:
            with torch.autocast(energy.device.type, enabled=False):  # Lightning's is around it
                super().observe(energy)

    def pixel_loss(self, render: Tensor, target: Tensor) -> Tensor:
        """The photometric term of two images in 0..1: mean |error|, unless a part says another.

        It is for the iteration of the next step. `SquaredLoss` has the paper's mean squared error
        while exploiting.
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

    def plan_fall(self, start: int | None, end: int | None) -> None:
        """Have the training fall to its end, and know where its mean is."""
        super().plan_fall(start, end)
        self._plan_end()

    def go_on(self) -> None:
        """Have no end any more, after one."""
        if self.ended:
            self._end.passed = self.end_step
            self.messages.say_once(
                f"opt3dgs_optim: the end that was planned, at iteration {self.end_step}, is over; "
                "the training goes on, and the parameters are no mean any more"
            )
        super().go_on()

    def _plan_end(self) -> None:
        total, averaging = self.end_step, self.part(Averaging)
        at = None if averaging is None else math.inf
        if averaging is not None and total is not None:
            put = averaging.put_from(total, self.fall_step)
            at = put if put < total else None
        self._end.total_steps, self._end.mean_at = total, at
        self._end.finished = self.finished

    @torch.no_grad()
    def finish(self) -> None:
        """End the run here: the mean of the last iterates takes the parameters' place.

        Before the last thirtieth, or the last fifth of `finish_in`, there is no mean, and the
        parameters stay as they are. They stay, too, if the training went on past its end or past an
        earlier `finish()`.
        """
        if not self.finished:
            found, total = sum(each.put_means() for each in self.optimizers()), self.end_step
            last = self._end.mean_at
            if not found and last is not None and self.iteration < last:
                begins = "with the end that finish_in plans"
                if total is not None:
                    start = Averaging.start(total, self.fall_step)
                    begins = f"at {start} of {total}, anew where rows are edited"
                LOGGER.warning(
                    "opt3dgs_optim: finish() at iteration %d: averaging begins %s, and the "
                    "parameters stay the last iterate", self.iteration + 1, begins,
                )  # fmt: skip
        self.finished = self._end.finished = True

    # -- what it watches ---------------------------------------------------------------------------

    def resume(self, iteration: int, by_count: bool = False) -> None:
        """Go on from a checkpoint, which may have been loaded to be looked at alone."""
        super().resume(iteration)
        if by_count and self.changes_steps:
            self.messages.say_once(
                f"opt3dgs_optim: the training goes on at iteration {iteration}, by Adam's count of "
                "steps; where the trainer has left out steps, call phases.observe(iteration=...)"
            )
        self._end.upgraded, self._end.done, self._end.finished = False, 0, False

    def advanced(self) -> None:
        """Say what is wrong with the training as it goes."""
        if (
            self.members and not self.counts_positions and self.part(OwnFrame) is not None
            and not any(name == "means" for _, name in self.members)  # they have not gone
        ):  # fmt: skip
            self.messages.warn_once(
                "positions",
                f"{CALL}: no optimizer holds positions, so that OwnFrame does nothing; name their "
                "group, or its key in the dict, 'means' (other trainers' names are known, too)",
            )
        self._end.done = self.iteration + 1
        total, ends = self.end_step, not self.averages or self.finished
        if self.iteration == self._end.mean_at and not ends:
            say(
                f"opt3dgs_optim: iteration {self.iteration + 1} of {total}: from this step on the "
                "parameters are the mean of the last iterates"
            )
        # Trainers that count from 1 end at total_steps.
        if total is not None and self.iteration > total:
            self.messages.warn_once(
                "overrun",
                f"{CALL}: iteration {self.iteration} of total_steps={self.end_step}: the "
                "training is longer than that, so that all schedules ended early; pass the number "
                "of steps that it makes as total_steps, and make a scheduler for each training",
            )
        if self.finished:
            self.messages.warn_once(
                "finished",
                f"{CALL}: iteration {self.iteration} comes after finish(): the parameters are no "
                "mean any more; call it after the last step",
            )
        if self.iteration == 0 and self.observers and num_ranks() > 1:
            reader = type(self.observers[0]).__name__
            self.messages.say_once(
                f"opt3dgs_optim: {num_ranks()} ranks train: {reader} needs the same loss in all; "
                "give observe() its mean (torch.distributed.all_reduce)"
            )

    def end_line(self) -> str | None:
        """The warning if the training stops now, before its end; None if there is none."""
        return self._end.line()

    def __repr__(self) -> str:
        end = "no planned end" if self.end_step is None else self.end_step
        clock = f"iteration {self.iteration} of {end}"
        if any(part.during is not None for part in self.parts):
            clock += f", {self.phase.value}"
        return "\n".join([f"{CALL}(", f"  {clock}", *(f"  {part!r}" for part in self.parts), ")"])
