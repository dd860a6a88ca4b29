"""The step of visible rows only, as a part of our Adam classes."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import Adam

from opt3dgs_optim._row_steps import ROW_STEPS, RowSteps
from opt3dgs_optim._visible import masked_adam, shaped


class RowwiseAdam(Adam):
    """What `HookedAdam.step` does with a mask. Costs nothing before the first mask."""

    skip_nonfinite: bool
    skipped_rows: Tensor | int
    _row_steps: RowSteps | None = None
    _moving: list[Tensor] | None = None  # [N] of each parameter of the group being stepped

    def _trust_rows(self) -> None:
        self._row_steps = RowSteps()
        for param, state in self.state.items():
            self._row_steps.trust(param, state)

    def _count_rows(self) -> None:
        """Begin to count the steps of every row that has moments."""
        assert self._row_steps is not None
        for param, state in self.state.items():
            if "exp_avg" in state:
                self._row_steps.of(param, state)

    def _repair_rows(self) -> None:
        """Make the counts those of the present rows, as a step would: before a checkpoint."""
        for param, state in self.state.items():
            if self._row_steps is not None and ROW_STEPS in state and "exp_avg" in state:
                self._row_steps.of(param, state)

    def _takes_mask(self, group: dict[str, Any], num_points: int) -> bool:
        """Whether a mask of `num_points` rows is about this group."""
        return any(p.dim() > 0 and p.shape[0] == num_points for p in group["params"])

    def _check_mask(self, mask: Tensor | None) -> None:
        if mask is None:
            return
        call, rows = f"{type(self).__name__}.step", mask.numel()
        masked = [g for g in self.param_groups if self._takes_mask(g, rows)]
        shapes = [tuple(p.shape) for g in masked or self.param_groups for p in g["params"]]
        if not masked or any(shape[:1] != (rows,) for shape in shapes):
            raise ValueError(
                f"{call}: the mask has {rows} rows, but the parameters have shapes {shapes}; a "
                "mask of their first dimension is needed"
            )
        if self.defaults["differentiable"]:
            raise ValueError(f"{call}: a mask with differentiable=True is not possible")

    def _counts_rows(self, group: dict[str, Any], mask: Tensor | None) -> bool:
        if mask is not None:
            return self._takes_mask(group, mask.numel())
        # Once rows have counted their own steps, there is no one count for torch's Adam.
        return any(ROW_STEPS in self.state.get(p, ()) for p in group["params"])

    def _step_rows(self, group: dict[str, Any], mask: Tensor | None, bad: Tensor | None) -> None:
        params: list[Tensor] = []
        grads: list[Tensor] = []
        self._init_group(group, params, grads, [], [], [], [])
        if not params:
            return
        drop = [bad] if bad is not None else []
        found_inf, scale = getattr(self, "found_inf", None), getattr(self, "grad_scale", None)
        drop += [found_inf.reshape(()) > 0] if found_inf is not None else []
        self._moving = []
        for i, (param, grad) in enumerate(zip(params, grads, strict=True)):
            rows = torch.ones(len(param), dtype=torch.bool) if mask is None else mask
            rows = self._finite_rows(rows.to(param.device), grad)
            for flag in drop:
                rows = rows & ~flag.to(param.device)
            self._moving.append(rows)
            grads[i] = torch.where(shaped(rows, grad), grad, 0.0)
        fed = self._gradients(group, params, grads)
        for param, grad, rows in zip(params, fed, self._moving, strict=True):
            self._update_rows(group, param, grad if scale is None else grad / scale, rows)
        self._after_group(group, params)
        self._moving = None

    def _finite_rows(self, rows: Tensor, grad: Tensor) -> Tensor:
        if not self.skip_nonfinite:
            return rows
        finite = torch.isfinite(grad).reshape(grad.shape[0], -1).all(dim=1)
        self.skipped_rows = self.skipped_rows + (rows & ~finite).sum()
        return rows & finite

    def _update_rows(
        self, group: dict[str, Any], param: Tensor, grad: Tensor, rows: Tensor
    ) -> None:
        if self._row_steps is None:
            self._row_steps = RowSteps()
        beta1, beta2 = group["betas"]
        masked_adam(
            param,
            grad,
            self.state[param],
            self._row_steps.of(param, self.state[param]),
            rows,
            lr=self._scaled_lr(group, param.device),
            beta1=float(beta1),
            beta2=float(beta2),
            eps=group["eps"],
            weight_decay=group["weight_decay"],
            decoupled=bool(group.get("decoupled_weight_decay")),
            amsgrad=group["amsgrad"],
            maximize=group["maximize"],
        )

    def _add_noise(self, noise: Any, group: dict[str, Any], params: list[Tensor]) -> None:
        """Add noise to the rows that this step moves."""
        for i, param in enumerate(params):
            before = None if self._moving is None else param.detach().clone()
            noise.add_to(param, group["lr"])
            if before is not None and self._moving is not None:
                param.copy_(torch.where(shaped(self._moving[i], param), param, before))

    # -- what HookedAdam says ------------------------------------------------------------------

    def _gradients(
        self, group: dict[str, Any], params: list[Tensor], grads: list[Tensor]
    ) -> list[Tensor]:
        raise NotImplementedError

    def _after_group(self, group: dict[str, Any], params: list[Tensor]) -> None:
        raise NotImplementedError

    def _scaled_lr(self, group: dict[str, Any], device: torch.device) -> float | Tensor:
        raise NotImplementedError
