"""torch's Adam, opened at two places: the factor on its step and the gradient it is fed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch._compile import _disable_dynamo
from torch.optim.adam import adam

from opt3dgs_optim._checkpoint import check_keys, check_optimizer_state
from opt3dgs_optim._checks import check_flag
from opt3dgs_optim._nonfinite import FrozenRows
from opt3dgs_optim._rowwise import RowwiseAdam
from opt3dgs_optim._visible import check_visible

STATE_KEY = "opt3dgs"  # in param_groups[0] of a state_dict: plain floats, lists and dicts


class HookedAdam(RowwiseAdam):
    """`torch.optim.Adam` whose subclasses override `_factor`, `_gradients` and `_after_group`.

    The arithmetic is torch's own functional `adam`; with nothing overridden, every code path
    (single tensor, foreach, fused, capturable) is torch's, bit for bit. Subclasses do not override
    `step`, so that learning-rate schedulers and step hooks wrap it once.
    """

    def __init__(
        self,
        params: Any,
        lr: float | Tensor,
        *args: Any,
        skip_nonfinite: bool = True,
        **kwargs: Any,
    ) -> None:
        self.skip_nonfinite = check_flag(type(self).__name__, "skip_nonfinite", skip_nonfinite)
        self.skipped_rows: Tensor | int = 0  # so far, for a non-finite gradient; 0-d on a GPU
        super().__init__(params, lr, *args, **kwargs)

    # Attributes of ours that a copy or a pickle takes along (torch keeps its own three only).
    _own: tuple[str, ...] = ("skip_nonfinite", "skipped_rows")

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), **{name: getattr(self, name) for name in self._own}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._trust_rows()

    # -- checkpoints -------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """torch's, with what several optimizers share inside `param_groups[0]`."""
        self._repair_rows()
        state_dict = super().state_dict()
        shared = self._shared_state()
        if shared is not None:
            state_dict["param_groups"][0][STATE_KEY] = shared
        return state_dict

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; also takes the `state_dict()` of a plain Adam.

        Raises:
            ValueError: it does not fit; then nothing has been loaded.
        """
        call = f"{type(self).__name__}.load_state_dict"
        check_optimizer_state(call, state_dict, self.param_groups)
        groups = [dict(group) for group in state_dict["param_groups"]]
        shared = groups[0].pop(STATE_KEY, None) if groups else None
        if shared is not None:
            check_keys(f"{call}: {STATE_KEY}", shared, ())
            self._load_shared_state(shared)  # checks, then loads: before torch, which checks less
        super().load_state_dict({**state_dict, "param_groups": groups})

    def _shared_state(self) -> dict[str, Any] | None:
        """What a checkpoint must hold besides torch's state, as plain numbers, or None."""
        return None

    def _load_shared_state(self, shared: Mapping[str, Any]) -> None:
        """Restore `_shared_state()`."""

    # -- what subclasses say -----------------------------------------------------------------

    def _begin_step(self, loss: Any) -> None:
        """Called once per step, with the closure's value or None."""

    def _end_step(self) -> None:
        """Called once per step that was not dropped, after all groups."""

    def _bad_step(self) -> Tensor | None:
        """0-d bool: drop this step (a non-finite loss); None where nobody can tell."""
        return None

    def _factor(self, group: dict[str, Any]) -> Tensor | float | None:
        """The factor on this group's step; None leaves the learning rate alone."""
        return None

    def _gradients(
        self, group: dict[str, Any], params: list[Tensor], grads: list[Tensor]
    ) -> list[Tensor]:
        """What Adam is fed instead of the gradients."""
        return grads

    def _after_group(self, group: dict[str, Any], params: list[Tensor]) -> None:
        """Called after this group's parameters have moved."""

    # -- the step ----------------------------------------------------------------------------

    # Under torch.compile a step runs as it is: dynamo loses what it writes to an optimizer's
    # attributes. (torch decorates its own optimizers' methods in this way.)
    @_disable_dynamo
    def step(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        closure: Callable[[], Any] | Tensor | None = None,
        num_points: int | None = None,
        *,
        visible: Tensor | None = None,
        visibility: Tensor | None = None,
    ) -> Any:
        """One step: of all rows, or only of those that a camera saw.

        With a mask, the other rows keep parameters, moments and curvature pairs, no noise reaches
        them, and every row has the bias correction of its own number of steps (4 bytes per row,
        from the first masked step on).

        Args:
            closure: evaluates the model and returns the loss; or the mask, as gsplat
                (`step(mask)`) and INRIA (`step(mask, N)`) pass it.
            num_points: number of rows, which must be the mask's.
            visible: [N] mask; anything but 0 is visible.
            visibility: another name of `visible`, gsplat's.

        Returns:
            The closure's value, or None.

        Raises:
            ValueError: several masks, or one that fits no parameter.
        """
        masks = [m for m in (visible, visibility) if m is not None]
        if isinstance(closure, Tensor):
            masks, closure = [closure, *masks], None
        if len(masks) > 1:
            raise ValueError(f"{type(self).__name__}.step: {len(masks)} masks, but one is needed")
        mask = check_visible(type(self).__name__, masks[0], num_points) if masks else None
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        with torch.set_grad_enabled(self.defaults["differentiable"]):
            self._check_mask(mask)
            self._begin_step(loss)
            bad = self._bad_step()
            if bad is not None and bad.device.type == "cpu" and bool(bad):
                return loss
            for group in self.param_groups:
                if self._counts_rows(group, mask):
                    self._step_rows(group, mask, bad)
                else:
                    self._step_group(group, bad)
            self._end_step()
        return loss

    # -- all rows ----------------------------------------------------------------------------

    def _step_group(self, group: dict[str, Any], bad: Tensor | None) -> None:
        params: list[Tensor] = []
        grads: list[Tensor] = []
        moments: tuple[list[Tensor], ...] = ([], [], [], [])
        has_complex = self._init_group(group, params, grads, *moments)
        if not params:
            return
        frozen = self._freeze(params, grads, moments)
        found_inf = self._found_inf(group, bad, frozen)
        fed = self._gradients(group, params, grads)
        self._update(group, params, fed, moments, found_inf, has_complex)
        self._after_group(group, params)
        for rows in frozen:
            rows.restore()

    def _freeze(
        self, params: list[Tensor], grads: list[Tensor], moments: tuple[list[Tensor], ...]
    ) -> list[FrozenRows]:
        if not self.skip_nonfinite:
            return []
        frozen = []
        for i, (param, grad) in enumerate(zip(params, grads, strict=True)):
            kept = [param, *(kind[i] for kind in moments[:3] if kind)]
            rows = FrozenRows.find(grad, kept)
            if rows is not None:
                frozen.append(rows)
                self.skipped_rows = self.skipped_rows + rows.count
        return frozen

    def _found_inf(
        self, group: dict[str, Any], bad: Tensor | None, frozen: list[FrozenRows]
    ) -> Tensor | None:
        """Fused Adam's device-side flag that drops a step, or None where nothing asks for it."""
        flags = [flag for flag in (getattr(self, "found_inf", None),) if flag is not None]
        if group["fused"]:
            if bad is not None:
                flags.append(bad.to(torch.float32))
            flags += [rows.overflow for rows in frozen if rows.overflow is not None]
        return torch.stack([flag.reshape(()) for flag in flags]).amax() if flags else None

    def _update(
        self,
        group: dict[str, Any],
        params: list[Tensor],
        grads: list[Tensor],
        moments: tuple[list[Tensor], ...],
        found_inf: Tensor | None,
        has_complex: bool,
    ) -> None:
        exp_avgs, exp_avg_sqs, max_exp_avg_sqs, steps = moments
        beta1, beta2 = group["betas"]
        options = {}
        if "decoupled_weight_decay" in group:  # torch >= 2.7
            options["decoupled_weight_decay"] = group["decoupled_weight_decay"]
        adam(
            params,
            grads,
            exp_avgs,
            exp_avg_sqs,
            max_exp_avg_sqs,
            steps,
            foreach=group["foreach"],
            capturable=group["capturable"],
            differentiable=group["differentiable"],
            fused=group["fused"],
            grad_scale=getattr(self, "grad_scale", None),
            found_inf=found_inf,
            has_complex=has_complex,
            amsgrad=group["amsgrad"],
            beta1=beta1,
            beta2=beta2,
            lr=self._scaled_lr(group, params[0].device),
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            maximize=group["maximize"],
            **options,
        )

    def _scaled_lr(self, group: dict[str, Any], device: torch.device) -> float | Tensor:
        """lr times the factor, never written into the group: schedulers would compound it."""
        factor = self._factor(group)
        if factor is None:
            return group["lr"]
        if not isinstance(factor, Tensor):
            return group["lr"] * factor
        if factor.device.type == "cpu":
            return group["lr"] * factor.item()
        # Fused Adam reads a float32 learning rate from the device.
        return group["lr"] * factor.to(device=device, dtype=torch.float32, non_blocking=True)


def fused_on_cuda(params: Any, fused: bool | None, foreach: bool | None, capturable: bool) -> Any:
    """`fused`, or True where all parameters are on CUDA and no path was asked for.

    Only the fused path takes a step factor and drops a step on the device, without a
    synchronisation.
    """
    if fused is not None or foreach is not None or capturable:
        return fused
    tensors = [p for item in params for p in _params_of(item)]
    return True if tensors and all(p.is_cuda for p in tensors) else None


def _params_of(item: Any) -> list[Tensor]:
    value = item["params"] if isinstance(item, dict) else item
    if isinstance(value, tuple):  # (name, parameter)
        value = value[1]
    return [value] if isinstance(value, Tensor) else list(value)
