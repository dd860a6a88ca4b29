"""The phase scheduler: one object that owns iteration, phase and energy for a whole training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim.checks import (
    check_choice,
    check_count,
    check_energy,
    check_number,
    warn_user,
)
from opt3dgs_optim.course import Course
from opt3dgs_optim.names import NamedGroup, block, gaussian_of, group_name
from opt3dgs_optim.overrides import uncompiled
from opt3dgs_optim.part import Part, Phase
from opt3dgs_optim.presets import (
    DEFAULTS,
    LEFT_OUT_WITH_REMOVAL,
    PAPER_STEPS,
    PAPER_SWITCH,
    paper_parts,
)
from opt3dgs_optim.removed_rows import EDITS, RemovedRows, is_told_of_edits
from opt3dgs_optim.upgrading import say, upgrade

if TYPE_CHECKING:
    from opt3dgs_optim.runs import RunLog
    from opt3dgs_optim.stepadam import StepAdam

CALL = "PhaseScheduler"
# How long a trainer may do something by design before it is taken for a mistake.
PATIENCE = 20  # iterations without a step, steps without an energy, or losses that are not finite
LONG_PATIENCE = 200  # iterations without a step in a training that has stepped
LOOK_INTERVAL = 10  # iterations between two looks at all optimizers
MAX_REWINDS = 5  # how often a trainer may go back to an earlier iteration
REMOVAL = "the trainer removes Gaussians, as clone, split and prune does"  # why a part is off
Optimizers = TypeVar("Optimizers", bound="Optimizer | Mapping[str, Optimizer] | list[Optimizer]")


class PhaseScheduler(Course):
    """Put parts into the steps of a 3DGS trainer's optimizers, in two phases.

    By default `DEFAULTS`, what paid (docs/evidence.md); with `PhaseScheduler.paper`, Opt3DGS.

    Args:
        total_steps: iterations of the training.
        switch: where exploitation starts: a fraction of `total_steps` in (0, 1] if a float, an
            iteration if an int (`total_steps`: never). The paper: 29/30.
        parts: what the steps have, in order; None: `DEFAULTS`, whose `Fading` is switched off as
            soon as the trainer removes Gaussians (clone, split and prune), since it loses there.
            One that learns (`EnergyHistogram`, `Curvature`, `PositionNoise`) serves one run.
        adaptive: whether parts that this training shows no need of are switched off, see
            `switched_off`. Every 100 iterations that is one synchronisation with the GPU.
        log: a `RunLog` that gets one line per `observe`, with what the parts say of themselves. A
            copy, or what comes out of a pickle, has none.
        process_group: a `torch.distributed` process group over whose ranks the energy is averaged;
            every rank must call `observe` as often, and a loss that is not finite skips all steps.
            What comes out of a pickle has none.

    Call order in each iteration: `pixel_loss`, backward, `observe(loss)`, `step()` of every
    optimizer. The state travels inside `param_groups[0]` of every upgraded optimizer's
    `state_dict()`, so that a trainer which saves its optimizers resumes bit for bit.

    Memory: that of Adam. In the last thirtieth of a run the defaults keep a copy of the parameters.
    `Curvature` takes 160 bytes for each point.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import PhaseScheduler
        >>> means = torch.nn.Parameter(torch.ones(4, 3))
        >>> adam = torch.optim.Adam([{"params": means, "lr": 0.01, "name": "means"}], eps=1e-15)
        >>> phases = PhaseScheduler(total_steps=60)
        >>> adam = phases.upgrade(adam)
        >>> (loss := phases.pixel_loss(means, torch.zeros(4, 3))).backward()
        >>> phases.observe(loss)
        >>> adam.step()

    Raises:
        ValueError: an option is outside what is allowed.
        TypeError: one of the parts is none.
    """

    def __init__(
        self,
        total_steps: int,
        switch: float | int = PAPER_SWITCH,
        parts: Sequence[Part] | None = None,
        *,
        adaptive: bool = False,
        log: RunLog | None = None,
        process_group: Any = None,
    ) -> None:
        total_steps = check_count(CALL, "total_steps", total_steps, 1)
        if isinstance(switch, Integral) and not isinstance(switch, bool):
            switch_step = check_count(CALL, "switch", switch, 0, total_steps)
        else:
            switch_step = round(check_number(CALL, "switch", switch, 0.0, 1.0) * total_steps)
        super().__init__(
            DEFAULTS if parts is None else parts,
            total_steps=total_steps,
            switch_step=switch_step,
            adaptive=check_choice(CALL, "adaptive", adaptive),
        )
        if log is not None and not hasattr(log, "step"):
            raise ValueError(f"{CALL}: log={log!r}, but a RunLog or None is needed")
        self.log, self.needs_energies = log, True
        self._chosen = parts is not None  # by the user: they stay as they are
        self._removed_rows = RemovedRows()
        self._over_ranks = None if process_group is None else RankMean(CALL, process_group)
        self._iterations_without_step = 1  # that has moved Gaussians
        self._has_moved_gaussians = False
        self._looked_at = -1  # the iteration of the last look at all optimizers
        self._steps_without_energy = 0
        self._losses_not_finite = 0  # in a row
        self._iterations_incomplete = 0  # since an upgraded optimizer does not exist any more
        self._iterations_since_look = 0
        self._num_optimizers = 0
        self._observed_again = 0  # the same iteration, in a row
        self._times_set_back = 0  # by `observe`
        self._adam_steps: int | None = None  # of moments that came without a state of ours

    @classmethod
    def paper(
        cls,
        total_steps: int = PAPER_STEPS,
        switch: float | int = PAPER_SWITCH,
        *,
        adaptive: bool = False,
        log: RunLog | None = None,
        process_group: Any = None,
    ) -> PhaseScheduler:
        """All of Opt3DGS with the paper's settings, its schedule scaled to `total_steps`.

        Fixed energy range [0, 0.2] and temperature, warm-up 2,500 of 30,000, switch at 29,000,
        K = 5 consecutive pairs, L2, fresh moments. Single parts: `paper_parts`.
        """
        total_steps = check_count(f"{CALL}.paper", "total_steps", total_steps, 1)
        options = {"adaptive": adaptive, "log": log, "process_group": process_group}
        return cls(total_steps, switch, paper_parts(total_steps), **options)

    @property
    def phase(self) -> Phase:
        """The phase of the iteration whose loss comes next; what `pixel_loss` goes by."""
        return cast(Phase, self.phase_of(self.iteration))

    def upgrade(self, optimizers: Optimizers, *, scene: Any = None) -> Optimizers:
        """Put the parts into the trainer's optimizer(s), in place; return the argument.

        Options and state are kept, and a learning-rate scheduler built before goes on working. May
        be called again, for another optimizer or one that the trainer has made anew.

        Args:
            optimizers: a dict of `torch.optim.Adam`, one per parameter (gsplat, nerfstudio), whose
                keys say what they hold; one Adam with named groups (INRIA, 3dgs-mcmc); or a list
                of such (gaussian-splatting-lightning). What holds no Gaussian parameter (camera
                poses, exposures) stays as it is.
            scene: the object that a trainer tells of its row edits, as gsplat's main branch tells
                its `GaussianScene` (`on_remove`, `on_split`, ...). It is listened to; whether
                Gaussians were removed is then known without a look at them, and without a wait
                for the GPU. None: the opacities are looked at.

        Raises:
            TypeError: an optimizer of Gaussian parameters is no Adam, has parts of another
                scheduler, or is of a class that cannot be kept; or `scene` is no such object.
            ValueError: nothing holds a Gaussian parameter, a name occurs twice, or what an
                optimizer has loaded is damaged. Then none of them has parts.
        """
        if scene is not None and not is_told_of_edits(scene):
            raise TypeError(
                f"{CALL}.upgrade: scene is a {type(scene).__name__} that has none of "
                f"{', '.join(EDITS)}, but an object that a strategy tells of its row edits, or "
                "None, is needed"
            )
        newly = scene is not None and not self._removed_rows.listens_to(scene)
        if scene is not None:
            try:
                self._removed_rows.listen(scene)
            except (AttributeError, TypeError) as error:
                raise TypeError(
                    f"{CALL}.upgrade: the methods of scene, a {type(scene).__name__}, cannot be "
                    f"replaced ({error}); leave scene out"
                ) from None
        try:
            found = upgrade(optimizers, self)
        except BaseException:
            if newly:
                self._removed_rows.leave(scene)
            raise
        self._num_optimizers += found
        return optimizers

    # In a compiled function it runs as it is: what it looks at changes from iteration to iteration.
    @uncompiled
    def observe(self, loss: Tensor | float, *, iteration: int | None = None) -> None:
        """Take the loss of this iteration: once, after backward, before the optimizers step.

        Never synchronises with the GPU. After a non-finite loss the steps are skipped.

        Args:
            loss: the total training loss, 0-d; detached here. With gradient accumulation, once
                per optimizer step, with the mean over its batches; with a GradScaler, unscaled.
            iteration: the trainer's own count from 0, where it may differ from the number of
                calls: in a training that goes on from a checkpoint of the unchanged trainer, say.

        Raises:
            ValueError: the loss is no number, `iteration` no whole one, or the log is closed.
        """
        value = check_energy(f"{CALL}.observe", "loss", loss)
        if iteration is not None:
            iteration = check_count(f"{CALL}.observe", "iteration", iteration, 0)
        if getattr(self.log, "closed", False):
            raise ValueError(f"{CALL}.observe: its log is closed; set log to None, or to another")
        if self._over_ranks is not None:
            value = self._averaged(value)
        if iteration is not None:
            if iteration < self.current:
                self.set_back()
                self._times_set_back += 1
                self._removed_rows.forget()
            self._watch_count(iteration)
        before = max(self.current, 0)
        self.current = self.iteration if iteration is None else iteration
        self._watch_clock(before)
        self._watch_rows()
        self.take(value)
        self._watch_losses()
        if self.log is not None:
            phase = self.phase_of(self.current)
            self.log.step(self.current, phase=phase, energy=value, **self.numbers())
        if self.adaptive and self.num_observed % self.evidence_interval == 0:
            for event, part, reason in self.judge(self._over_ranks):
                if self.log is not None:
                    self.log.event(event, self.current, part=part, reason=reason)

    def _averaged(self, energy: Tensor) -> Tensor:
        """The mean energy over the ranks."""
        assert self._over_ranks is not None
        try:
            return self._over_ranks(energy)
        except RuntimeError:  # NCCL takes no numbers of the host
            groups = (group for each in self.followers for group in each.param_groups)
            devices = {param.device for group in groups for param in group["params"]}
            device = next((each for each in devices if each.type != "cpu"), None)
            if device is None or energy.device.type != "cpu":
                raise
            return self._over_ranks(energy.to(device))

    def pixel_loss(self, render: Tensor, target: Tensor) -> Tensor:
        """The photometric term of two images in 0..1: mean |error|, unless a part says another.

        Raises:
            ValueError: their shapes differ, or a part returns something else than a number.
        """
        if render.shape != target.shape:
            raise ValueError(
                f"{CALL}.pixel_loss: render has shape {tuple(render.shape)} and target "
                f"{tuple(target.shape)}, but one shape is needed"
            )
        error = render - target
        part = self.pixel_part()
        if part is None:
            return error.abs().mean()
        found: Any = part.pixel_loss(error)
        if not isinstance(found, Tensor) or found.dim():
            got = f"a tensor of {tuple(found.shape)}" if isinstance(found, Tensor) else repr(found)
            raise ValueError(
                f"{self.name_of(part)}.pixel_loss: returned {got}, but a 0-d tensor is needed"
            )
        return found

    def pixel_part(self) -> Part | None:
        """The part whose photometric term holds for the iteration whose loss comes next."""
        return self.pixel_parts[-1] if self.pixel_parts else None

    def stepping(self, closure_value: Any, optimizer: StepAdam) -> bool:
        """As `Course.stepping`; before the first energy the steps are plain Adam's.

        Of several optimizers that are given a closure, the one that has stepped in the present
        iteration already begins the next one.
        """
        if closure_value is not None and optimizer.clock_at == self.current:
            self.observe(closure_value)
        self.steps += 1
        if not self._has_moved_gaussians:  # in a warm-up of rates that begin at 0, say
            self._iterations_without_step = 0
        self._steps_without_energy += 1
        if self._steps_without_energy > PATIENCE * max(self._num_optimizers, 1):
            self._report(
                "no energy",
                f"the optimizers have stepped {PATIENCE} times without a loss: {self._names()} "
                "stand still; call observe(loss) once per iteration, before the steps",
            )
        return self.num_observed > 0

    def _names(self) -> str:
        return ", ".join(self.named())

    def _report(self, kind: str, mistake: str) -> None:
        """Say once what keeps the parts from acting as they are meant to."""
        if self.parts:
            self.warn_once(kind, f"{CALL}: {mistake}")

    def _watch_clock(self, before: int) -> None:
        """Look for mistakes that an iteration shows; called with each energy.

        Args:
            before: the iteration of the energy before this one, whose steps have been made.
        """
        adam_steps, self._adam_steps = self._adam_steps, None
        name = self.followers.stepped_together(before) if self.followers.holds_twice else None
        if name is not None:
            self._report(
                "twice",
                f"two optimizers that were upgraded by different calls hold {name!r} and step in "
                "the same iteration: parts take the Gaussians of one of them for those of both; "
                "upgrade them in one call, as a dict whose keys say which set they belong to, "
                f"such as 'first#{name}' and 'second#{name}'",
            )
        if self.num_observed == 0 and self._stepped_before_first_energy():
            self._report(
                "late",
                "the optimizers had stepped before the first observe(loss), so each step has the "
                "loss of the iteration before; call observe after backward, before the steps",
            )
        self._iterations_since_look += 1
        begins = self.num_observed < LOOK_INTERVAL or not self.steps
        if begins or self._iterations_since_look >= LOOK_INTERVAL:
            self._look_at_optimizers()
        self._iterations_without_step += not self._has_ended()
        self._steps_without_energy = 0
        # Trainers that count from 1 end at total_steps. Frozen Gaussians may be rendered longer.
        beyond = self.total_steps + 1
        if self.current > beyond and self._gaussians_have_moved_since(beyond):
            self._report(
                "overrun",
                f"iteration {self.current} of total_steps={self.total_steps}: the schedule came "
                "too early for this run; pass the training's number of iterations",
            )
        if adam_steps is not None and abs(adam_steps - self.current) > max(
            PATIENCE, 0.1 * adam_steps
        ):
            warn_user(
                f"{CALL}: Adam's moments have made {adam_steps} steps, but this is iteration "
                f"{self.current} of {self.total_steps}; a training that goes on from a checkpoint "
                "of the unchanged trainer needs observe(loss, iteration=...)"
            )

    def _has_ended(self) -> bool:
        """Whether the schedule is over: no step is missed from there on.

        A trainer that follows the advice to end it where it freezes the Gaussians observes longer.
        """
        return self.current >= self.total_steps and self.steps > 0

    def _look_at_optimizers(self) -> None:
        """Look for optimizers that stand still, have gone, or go on for too long.

        Not in every iteration, of whose time it would take a part that shows.
        """
        looked_at, self._looked_at = self._looked_at, self.current
        passed, self._iterations_since_look = self._iterations_since_look, 0
        if self._gaussians_have_moved_since(looked_at):
            self._has_moved_gaussians, self._iterations_without_step = True, 0
        elif self.current < looked_at:  # the clock was set back
            self._iterations_without_step = 0
        patience = LONG_PATIENCE if self.steps else PATIENCE
        if self._iterations_without_step > patience:
            self._report(
                "no step",
                f"{patience} losses were observed and no upgraded optimizer has moved Gaussians: "
                f"{self._names()} do nothing; call upgrade(...) again where the trainer makes its "
                "optimizers anew; where it freezes the Gaussians before the end, give total_steps "
                "as the iteration after their last step, since the last thirtieth is averaged",
            )
        self._watch_groups()
        lost, alive = self.followers.num_lost, len([*self.followers])
        if not self._has_ended():
            self._watch_optimizers()
        incomplete = lost and alive and not self._has_ended()
        self._iterations_incomplete = self._iterations_incomplete + passed if incomplete else 0
        if self._iterations_incomplete > LONG_PATIENCE:
            self._report(
                "lost",
                f"{lost} of {lost + alive} upgraded optimizers do not exist any more: the "
                "trainer has made some of them anew, whose steps have no parts; call upgrade(...) "
                "again there",
            )

    def _watch_count(self, iteration: int) -> None:
        """Say once that the trainer's count stands still, or begins anew again and again."""
        stands = iteration == self.current and self.steps > 0
        self._observed_again = self._observed_again + 1 if stands else 0
        if self._observed_again > PATIENCE or self._times_set_back > MAX_REWINDS:
            what = f"was {iteration} {PATIENCE} times in a row" if stands else "was set back again"
            self._report(
                "count",
                f"observe(iteration=...) {what}, so that the schedule does not advance; give the "
                "iteration of the whole training, from 0",
            )

    def _watch_groups(self) -> None:
        """Say once that somebody goes on to write into a group that another has replaced."""
        for optimizer in self.followers:
            for i, group in enumerate(optimizer.param_groups):
                key = group.written_elsewhere() if type(group) is NamedGroup else None
                if key is not None:
                    self._report(
                        "held group",
                        f"{key!r} of {group_name(i, group)} was changed in a dict that stood in "
                        "param_groups before the upgrade, which changes nothing any more; take the "
                        "group from optimizer.param_groups after the upgrade",
                    )

    def _watch_optimizers(self) -> None:
        """Say once that one of several optimizers has stopped, as one that was made anew has."""
        # One that has stepped later than now has not stepped since the clock was set back.
        every = {id(each): each.stepped_at for each in self.followers}
        last = max((at for at in every.values() if at <= self.current), default=-1)
        stopped = [at for at in every.values() if 0 <= at < last - LONG_PATIENCE]
        if stopped:
            self._report(
                "stopped",
                f"{len(stopped)} of {len(every)} upgraded optimizers have made no step for more "
                f"than {LONG_PATIENCE} iterations, while others have: where the trainer has made "
                "them anew, their steps have no parts; call upgrade(...) again there",
            )

    def _gaussians_have_moved_since(self, iteration: int) -> bool:
        """Whether an upgraded optimizer has moved Gaussians in that iteration or later.

        Frozen are those that require no gradient, and those whose learning rate is 0. Those without
        a gradient make no step.
        """
        return any(
            record.last_moved is not None and record.last_moved >= iteration
            for optimizer in self.followers
            for group in optimizer.param_groups
            if gaussian_of(group) is not None
            for record in getattr(group, "records", ())
        )

    def _watch_rows(self) -> None:
        """Switch off what loses with clone, split and prune once the trainer removes Gaussians."""
        if self._chosen or (self.followers.are_sought and self._removed_rows.are_known()):
            return
        if REMOVAL in self.switched_off.values():
            return
        if not self._removed_rows.found(self.followers.holders_of_opacities()):
            return
        self._removed_rows.forget()  # gives the opacities back that it holds
        off = [
            name
            for name, part in self._named.items()
            if isinstance(part, LEFT_OUT_WITH_REMOVAL) and name not in self.switched_off
        ]
        self.switched_off.update(dict.fromkeys(off, REMOVAL))
        self._plan()
        for name in off:
            say(
                f"opt3dgs_optim: iteration {self.current}: {name} is switched off, since "
                f"{REMOVAL}; parts that are given to PhaseScheduler stay on"
            )
            # A log may be closed before the last checkpoint is saved.
            if self.log is not None and not getattr(self.log, "closed", False):
                self.log.event("switched_off", self.current, part=name, reason=REMOVAL)

    def state_dict(self) -> dict[str, Any]:
        """As `Course.state_dict`; a resumed run cannot see what was removed before."""
        self._watch_rows()
        return super().state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """As `Course.load_state_dict`; what nobody would switch on again is not off.

        Those are parts that the user has chosen, for removal, and parts that an adaptive run did
        not need, in one that is not adaptive.
        """
        super().load_state_dict(state)
        self._removed_rows.forget()
        left = {
            name: why
            for name, why in self.switched_off.items()
            if (not self._chosen if why == REMOVAL else self.adaptive)
        }
        if left != self.switched_off:
            self.switched_off = left
            self._plan()

    def _stepped_before_first_energy(self) -> bool:
        """Whether optimizers made one step each before there was a loss; some may step rarely."""
        return 0 < self.steps <= self._num_optimizers

    def _watch_losses(self) -> None:
        """Say once that losses have not been finite for long, as far as the host knows them."""
        self._losses_not_finite = self._losses_not_finite + 1 if self.valid is False else 0
        if self._losses_not_finite > PATIENCE:
            self._report(
                "not finite",
                f"{self._losses_not_finite} losses in a row were not finite, the last in iteration "
                f"{self.current}: none of these steps was made; look for the first NaN",
            )

    def expect(self, steps: int) -> None:
        """Moments came without a state of ours; the next energy's iteration should fit them."""
        self._adam_steps = steps or self._adam_steps

    def __getstate__(self) -> dict[str, Any]:
        # Two would write into one file; a copy begins without a log.
        return {**super().__getstate__(), "log": None}

    def __repr__(self) -> str:
        switch = f"switch at {self.switch_step}"
        if self.switch_step >= self.total_steps:
            switch = "no switch"
        clock = f"iteration {self.iteration} of {self.total_steps}, {self.phase.value}, {switch}"
        return block(CALL, [clock, *self.lines()])


class RankMean:
    """Averages tensors over a process group, every rank weighing the same.

    ValueError for `call` where there is none, or this process is not in it.
    """

    def __init__(self, call: str, process_group: Any) -> None:
        # Imported here: many builds of torch and most trainings are without it.
        from torch import distributed

        if not (distributed.is_available() and distributed.is_initialized()):
            raise ValueError(
                f"{call}: process_group={process_group!r}, but torch.distributed is not "
                "initialised; call torch.distributed.init_process_group first, or leave "
                "process_group at None"
            )
        if distributed.get_rank(process_group) < 0:
            raise ValueError(f"{call}: this process does not belong to {process_group!r}")
        self._group = process_group
        self._reduce = distributed.all_reduce
        self._size = distributed.get_world_size(process_group)

    def __call__(self, values: Tensor) -> Tensor:
        """The means over the ranks, of the shape of `values`; every rank must call as often."""
        half = values.dtype in (torch.float16, torch.bfloat16)
        total = values.detach().to(torch.float32 if half else values.dtype, copy=True)
        self._reduce(total, group=self._group)
        return total / self._size

    def __reduce__(self) -> Any:
        """Nothing: another process has groups of its own."""
        return type(None), ()

    def __deepcopy__(self, memo: Any) -> RankMean:
        """A process group is one, however often an optimizer is copied."""
        return self
