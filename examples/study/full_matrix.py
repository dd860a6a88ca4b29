"""Adam with a whole matrix of second moments per point, in place of one number per coordinate.

The square root of that matrix turns with the gradients, so that a step does not depend on the
axes that the scene happens to lie along. An eigenvalue that the gradients of a few views leave
near zero would make the step across them arbitrarily long: hence the floor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

SECOND_MOMENT = "second_moment"  # state key, [N, D (D + 1) / 2]: the upper triangle, row by row


class FullMatrixAdam(Optimizer):
    """Adam whose second moment is the moving mean of g g^T of every point.

    Takes the state of a `torch.optim.Adam`: its second moments become the diagonals. The state's
    tensors have points first, "step" apart, so that density control can edit them by rows. A row
    whose gradient, or its square, is not finite is not stepped.

    Memory: 12 bytes per point beyond Adam's (D = 3, float32).

    Args:
        params: tensors [N, D], points first, or parameter groups of such.
        lr, betas, eps: as in `torch.optim.Adam`.
        floor: no eigenvalue counts as less than this share of the point's largest, in (0, 1].

    Raises:
        ValueError: an option is outside what is allowed, or a parameter has another shape.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        *,
        floor: float = 1e-3,
    ) -> None:
        call = type(self).__name__
        if not 0.0 < floor <= 1.0:
            raise ValueError(f"{call}: floor={floor!r}, but a number in (0, 1] is needed")
        for name, value in (("lr", lr), ("eps", eps)):
            if not value >= 0.0:
                raise ValueError(f"{call}: {name}={value!r}, but a number from 0 on is needed")
        if not all(0.0 <= beta < 1.0 for beta in betas):
            raise ValueError(f"{call}: betas={betas!r}, but numbers in [0, 1) are needed")
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps, "floor": floor})
        shapes = [tuple(p.shape) for group in self.param_groups for p in group["params"]]
        if any(len(shape) != 2 for shape in shapes):
            raise ValueError(f"{call}: parameters of shapes {shapes}, but [N, D] is needed")

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        for group in self.param_groups:
            group.setdefault("floor", self.defaults["floor"])  # an Adam's checkpoint has none
        for own in self.state.values():
            if "exp_avg_sq" in own:
                own[SECOND_MOMENT] = packed(torch.diag_embed(own.pop("exp_avg_sq")))

    @torch.no_grad()
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, closure: Callable[[], Any] | None = None
    ) -> Any:
        """One step; returns the closure's value, or None."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for param in group["params"]:
                if param.grad is not None and param.numel():
                    self._step_points(group, param, param.grad)
        return loss

    def _step_points(self, group: dict[str, Any], param: Tensor, grad: Tensor) -> None:
        state = self.state[param]
        square = packed(grad[:, :, None] * grad[:, None, :])
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"], state[SECOND_MOMENT] = (
                torch.zeros_like(grad),
                torch.zeros_like(square),
            )
        state["step"] += 1
        beta1, beta2 = group["betas"]
        steps = float(state["step"])
        # eigh raises on a single bad matrix.
        usable = torch.isfinite(square).all(dim=1, keepdim=True)
        for key, new, beta in (("exp_avg", grad, beta1), (SECOND_MOMENT, square, beta2)):
            state[key] = torch.where(usable, state[key].lerp(new, 1 - beta), state[key])
        direction = whitened(
            state["exp_avg"] / (1 - beta1**steps),
            unpacked(state[SECOND_MOMENT] / (1 - beta2**steps), param.shape[1]),
            group["floor"],
            group["eps"],
        )
        param.sub_(torch.where(usable, group["lr"] * direction, 0.0))


def whitened(vectors: Tensor, second_moment: Tensor, floor: float, eps: float) -> Tensor:
    """V^(-1/2) m of every point, eigenvalues of V below `floor` times its largest raised to that.

    Args:
        vectors: [N, D], m.
        second_moment: [N, D, D], V: symmetric and positive semi-definite up to rounding.
        floor: the least share of the largest eigenvalue.
        eps: added to the square roots, as Adam adds it.
    """
    # The largest entry of a positive semi-definite matrix is on its diagonal.
    scale = second_moment.diagonal(dim1=1, dim2=2).amax(dim=1)
    scale = torch.where(scale > 0, scale, 1.0)  # of a point that has had no gradient
    values, axes = torch.linalg.eigh(second_moment / scale[:, None, None])
    values = torch.maximum(values, floor * values[:, -1:])
    roots = values.sqrt() * scale.sqrt()[:, None] + eps
    along = (axes.mT @ vectors[:, :, None]) / roots[:, :, None]
    return (axes @ along).squeeze(2)


def packed(matrices: Tensor) -> Tensor:
    """The upper triangles of symmetric matrices [N, D, D], row by row: [N, D (D + 1) / 2]."""
    rows, columns = torch.triu_indices(*matrices.shape[1:], device=matrices.device)
    return matrices[:, rows, columns]


def unpacked(triangles: Tensor, dim: int) -> Tensor:
    """The symmetric matrices [N, D, D] that `packed` took apart."""
    rows, columns = torch.triu_indices(dim, dim, device=triangles.device)
    place = torch.empty(dim, dim, dtype=torch.long, device=triangles.device)
    place[rows, columns] = place[columns, rows] = torch.arange(len(rows), device=triangles.device)
    return triangles[:, place]
