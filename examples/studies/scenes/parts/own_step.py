"""Steps whose size follows a schedule of its own, whatever the trainer's learning rates are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from opt3dgs_optim import Course, Part
from opt3dgs_optim.names import SLOT
from opt3dgs_optim.part import Group

STRIDE = 10  # iterations between two looks at the steps' size
LEAST = 1 / 16  # of a learning rate: Adam's steps are taken as no shorter
# Root mean square of the first steps and of the last, over the first. Positions in spreads of the
# scene; log scales, quaternions, logits and colours as they are. Their ratios are 3DGS's own
# learning rates, those of the opacities a quarter (see Annealing), the positions' decay included.
SIZES = {
    "means": (4.6e-4, 1e-3),
    "scales": (5e-3, 0.1),
    "quats": (1e-3, 0.1),
    "opacities": (1.25e-2, 0.4),
    "sh0": (2.5e-3, 0.1),
    "shN": (1.25e-4, 0.1),
}


class OwnStep(Part):
    """Hold the root mean square of every parameter's steps on a schedule.

        rms(t) = size * share^t,    t = iteration / total_steps in 0..1

    The factor on the step is what that takes: rms(t) over the learning rate times the root mean
    square of exp_avg / sqrt(exp_avg_sq), which is looked at every ten iterations. So the trainer's
    learning rates cancel, their decay too, and there is no peak to choose. The spread is the
    points' median distance from their median, when the training starts.

    Args:
        scale: a factor on all sizes.
    """

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale
        self._spread = 0.0  # 0: not measured yet
        self._looked = -1  # at which iteration
        self._sizes: dict[str, float] = {}  # parameter -> rms of Adam's step, in learning rates

    def __repr__(self) -> str:
        return f"OwnStep({self.scale:g})"

    def wanted(self, name: str, progress: float) -> float:
        """The root mean square that a parameter's next step is to have, in its own units."""
        size, share = SIZES[name]
        unit = self._spread if name == "means" else 1.0
        return self.scale * unit * size * share**progress

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """Look at the size of the step that Adam's moments would make."""
        name = group[SLOT]
        assert name is not None
        if name == "means" and not self._spread:
            points = param.detach()
            distances = (points - points.median(0).values).norm(dim=1)
            self._spread = float(distances.median())
        if name not in self._sizes or course.current % STRIDE == 0:
            self._sizes[name] = rms_of_step(state, group["betas"], grad)
        return grad

    def factor(self, group: Group, course: Course) -> float:
        name = group[SLOT]
        lr = float(group["lr"])
        if name not in self._sizes or lr == 0:
            return 1.0
        return self.wanted(name, course.progress) / (lr * self._sizes[name])

    def numbers(self, course: Course) -> Mapping[str, float]:
        """`own_step`: the positions' step, in learning rates, without the factor."""
        return {"own_step": self._sizes["means"]} if "means" in self._sizes else {}

    def state_dict(self) -> dict[str, Any]:
        return {"spread": self._spread, "sizes": dict(self._sizes)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._spread, self._sizes = float(state["spread"]), dict(state["sizes"])


def rms_of_step(state: dict[str, Any], betas: tuple[float, float], grad: Tensor) -> float:
    """Root mean square of the step with this gradient, in learning rates; at least `LEAST`.

    Rows that have had no gradient so far do not count; 1 where none has.
    """
    steps = float(state["step"]) + 1
    first = state["exp_avg"].lerp(grad, 1 - betas[0]) / (1 - betas[0] ** steps)
    second = state["exp_avg_sq"].lerp(grad.square(), 1 - betas[1]) / (1 - betas[1] ** steps)
    known = second > 0
    squares = first[known].square() / second[known]
    return max(float(squares.mean().sqrt()), LEAST) if len(squares) else 1.0
