"""Own frame: positions are stepped along each Gaussian's axes, in its standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim.checks import check_number, set_options
from opt3dgs_optim.course import Course
from opt3dgs_optim.frames import Frames
from opt3dgs_optim.overrides import is_moving_rate
from opt3dgs_optim.part import Group, Part, State

CALL = "OwnFrame"
FRAMES, ACTED = "frames", "own_frame_acted"  # what it publishes: until the step, and when it acted
RATE = "own_frame_rate"


@dataclass(frozen=True, repr=False)
class OwnFrame(Part):
    """Step the positions in each Gaussian's own frame, in units of its standard deviations.

        mu <- mu - rate(t) B Adam(B^T g),    B = R diag(s),    Sigma = B B^T
        rate(t) = rate * final^t,            t = iteration / total_steps in 0..1

    3DGS moves every centre by one learning rate in world units, while the sizes of the Gaussians of
    one scene differ by a factor of fifty, and the axes of one Gaussian by twenty. A step that a
    large Gaussian does not notice throws a small one out of its place. Here Adam is fed the
    gradient in the Gaussian's own frame, and what it answers is a step along the Gaussian's axes: a
    full step is `rate` standard deviations. It does not depend on the unit of the scene, nor on the
    positions' learning rate. At a rate of 0 the positions are held. Position noise, decoupled
    weight decay and everything else that reads that rate are not changed.

    Trained Gaussians are thin, often far thinner than a pixel. Steps in proportion to such an axis
    would hold the Gaussian fast across its own surface, so that an axis counts as no thinner than
    `min_aspect` of the longest.

    Adam's moments of the positions then belong to the own frame; everything else stays as it is.
    Where a training begins with it in the middle, from a checkpoint of the unchanged trainer, say,
    they begin anew, which is said. A trainer without it would have to zero them to go on.
    `load_state_dict` takes over the moments of a checkpoint with it; those that are carried by hand
    begin anew.
    What it is fed is bounded, so that Adam's moments stay finite. A Gaussian with a standard
    deviation above 9e18 (float32; 6e153 in float64) is neither fed nor moved, nor is one with a
    NaN.
    Scales and quaternions are looked up in the groups of the upgraded optimizers (gsplat's,
    INRIA's, nerfstudio's names and others). The scales must be logarithms of standard deviations
    and the quaternions wxyz, as in these trainers; nothing shows that they are something else. Nor
    does anything show that one of three scales is never trained, as in gsplat's trainer of flat
    Gaussians (2DGS), whose third one is what it began with: leave the part out there.
    Where they are not found, or are not [N, 3] and [N, 4], it is said once, and the positions of
    that group are stepped as the other parts have it.

    `Fading` leaves positions alone while this part steps them.

    It gains most where photos are many and the density control is 3DGS-MCMC's. Where photos are
    few, or Gaussians are cloned and split, it may fit the training photos better, and photos that
    were held out worse (docs/evidence.md).

    A row whose moments begin anew in the middle of a run, as those of Gaussians that are relocated
    or added, takes steps of up to six full ones at first, since Adam corrects its moments for the
    parameter's age and not for the row's. So do all rows at the start of a training whose optimizer
    makes no such correction, as gsplat's `SelectiveAdam`. Nothing was measured with that one.

    It keeps nothing from step to step. A step takes 64 bytes per point (float32), for what Adam is
    fed, the buffer that it moves, the displacement and the frames. On a CPU the displacement takes
    the buffer's place: that is 60 bytes, and room to compute in, 40 for each of up to 65,536
    points.

    Args:
        rate: standard deviations of a full step in the first iteration, above 0.
        final: share of `rate` in the last iteration, above 0; 0.01 is the decay that all 3DGS
            trainers give the positions' learning rate.
        min_aspect: share of a Gaussian's longest standard deviation that a shorter one counts as,
            at least, in 0..1; 0: every axis counts as it is, 1: a Gaussian counts as a ball.

    Raises:
        ValueError: an option is outside what is allowed.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import OwnFrame, PhaseScheduler
        >>> splats = {"means": torch.zeros(2, 3), "scales": torch.zeros(2, 3),
        ...           "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)}
        >>> splats["scales"][1] = -3.0  # the second Gaussian is twenty times smaller
        >>> splats = {name: torch.nn.Parameter(value) for name, value in splats.items()}
        >>> adams = {name: torch.optim.Adam([param]) for name, param in splats.items()}
        >>> phases = PhaseScheduler(100, parts=[OwnFrame(rate=0.1)])
        >>> adams = phases.upgrade(adams)
        >>> splats["means"].grad = torch.ones(2, 3)
        >>> phases.observe(0.1)
        >>> adams["means"].step()
        >>> [round(x, 4) for x in splats["means"][:, 0].tolist()]
        [-0.1, -0.005]
    """

    rate: float = 0.1
    final: float = 0.01
    min_aspect: float = 0.1

    names = ("means",)
    own_units = True

    def __post_init__(self) -> None:
        set_options(
            self,
            rate=check_number(CALL, "rate", self.rate, 0.0, open_low=True),
            final=check_number(CALL, "final", self.final, 0.0, open_low=True),
            min_aspect=check_number(CALL, "min_aspect", self.min_aspect, 0.0, 1.0),
        )

    def ready(self, group: Group, course: Course) -> bool:
        """Whether scales and quaternions of the same points are there; says it once if not."""
        for param in group["params"]:
            gaussians = course.gaussians_of(param)
            missing = [name for name in ("scales", "quats") if name not in gaussians]
            fits = not missing and (
                param.shape[1:] == (3,)
                and gaussians["scales"].shape == param.shape
                and gaussians["quats"].shape == (len(param), 4)
            )
            if not fits:
                shapes = {name: tuple(each.shape) for name, each in gaussians.items()}
                course.warn_once(
                    f"{CALL} {course.place_of(param)}",
                    f"{CALL}: the positions, of shape {tuple(param.shape)}, need scales [N, 3] and "
                    f"quats [N, 4] of the same points among the upgraded optimizers, which hold "
                    f"{shapes}; until then they are stepped as without this part",
                )
                return False
        return True

    def at(self, progress: float) -> float:
        """Standard deviations of a full step.

        Args:
            progress: share of the run that is over; taken as 0..1.
        """
        return self.rate * self.final ** min(max(progress, 0.0), 1.0)

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """B^T g [N, 3], which is what Adam is fed."""
        gaussians = course.gaussians_of(param)
        # To where the positions are: some trainers keep others on the host.
        quats, scales = (gaussians[name].detach().to(param.device) for name in ("quats", "scales"))
        # Kept for `displacement`: one optimizer of all groups has moved them by then.
        frames = Frames(quats, scales, param.dtype, self.min_aspect)
        course.publish(_name(self, course), param, frames)
        return frames.gradient(grad)

    def factor(self, group: Group, course: Course) -> float | Tensor:
        """What makes of the positions' learning rate the one of the own frame."""
        lr, rate = group["lr"], self.at(course.progress)
        if isinstance(lr, Tensor):
            lr = lr if lr.is_floating_point() else lr.to(torch.float32)
            return torch.where(lr < torch.finfo(lr.dtype).tiny, 1.0, rate / lr)
        tiny = np.finfo(lr.dtype if isinstance(lr, np.floating) else np.float64).tiny
        return rate / float(lr) if lr >= tiny else 1.0  # one that is subnormal counts as 0

    def displacement(
        self, group: Group, param: Tensor, step: Tensor, state: State, course: Course
    ) -> Tensor:
        """B z [N, 3], of Adam's step z in standard deviations."""
        name = _name(self, course)
        frames: Frames = course.published(name, param)
        course.publish(name, param, None)  # gives their memory back
        if is_moving_rate(group["lr"]):
            course.publish(ACTED, param, course.current)
        return frames.displacement(step)

    def numbers(self, course: Course) -> Mapping[str, float]:
        """`own_frame_rate`: standard deviations of a full step, while it acts.

        That is, if positions were stepped in this iteration or the one before, with a rate above 0.
        """
        acted = course.last_published(ACTED)
        has_acted = acted is not None and acted >= course.current - 1
        return {RATE: self.at(course.progress)} if has_acted else {}


def _name(part: OwnFrame, course: Course) -> str:
    """Under which the frames are published: two such parts have frames of their own."""
    return f"{course.name_of(part)}.{FRAMES}"
