"""LQNAdam: a per-point L-BFGS direction as the gradient that Adam is fed (eq. 17)."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim import curvature
from opt3dgs_optim._adam import HookedAdam
from opt3dgs_optim._checkpoint import drop_foreign_rows
from opt3dgs_optim._repr import block, curvature_line, group_lines, skipped_lines
from opt3dgs_optim.backend import Backend, uses_kernel
from opt3dgs_optim.curvature_options import CurvatureOptions
from opt3dgs_optim.ops import lqn_direction

__all__ = ["EPOCH", "HISTORY", "CurvatureOptions", "LQNAdam"]

HISTORY = "history"  # state keys: float tensors, points first, an all-zero row means "nothing"
EPOCH = "epoch"


class LQNAdam(HookedAdam):
    """Adam fed with the local quasi-Newton direction of every point (eq. 17).

    Dimension 0 of a parameter is points; the rest of it (3 coordinates, for Gaussians) is one
    small optimization problem per point. Each keeps the last `history_size` curvature pairs, and
    the L-BFGS two-loop recursion turns its gradient into a pseudo-gradient. There is no line
    search: Adam takes the step. A point without a usable pair is stepped by plain Adam, bit for
    bit.

    Args:
        params, lr, betas, eps, weight_decay, amsgrad: as in `torch.optim.Adam`.
        foreach, maximize, capturable, differentiable, fused: as in `torch.optim.Adam`.
        history_size: K, number of pairs, 1 to 16 (the paper: 5).
        pairs: `"consecutive"` takes a pair between two consecutive visible steps of a point
            (paper). `"epoch"` takes it between the means over two whole epochs of views, so that
            y is not mostly the difference between two views.
        epoch_steps: steps per epoch (the number of training views) for `pairs="epoch"`.
        min_cosine: a pair is accepted if s.y > min_cosine |s| |y|.
        powell: damp pairs of too little curvature instead of rejecting them.
        graft: give the pseudo-gradient of each point the length of its gradient.
        gamma_clamp: (low, high) bounds of gamma = s.y / y.y, parameter units per gradient unit.
        backend: `"auto"` runs consecutive pairs of points in three dimensions as a CUDA kernel
            where it can, and all else as pure torch; `"cuda"` and `"torch"` insist. See
            `backend_info`.
        pair_dtype: `"bfloat16"` stores the pairs rounded to 2^-8, in 96 bytes per point instead
            of 160 (K = 5, D = 3), for parameters of float32 or less; the arithmetic stays float32.
        skip_nonfinite: rows with a non-finite gradient keep parameters, moments and pairs for a
            step (those rows of `.grad` are set to zero).

    A point whose gradient is exactly zero is taken as not visible: no pair is stored for it. The
    history is dropped where the parameter object, or its number of rows, is not the one of the
    last step: a trainer's density control has moved the rows. A row that it sets to zero starts
    anew.

    Memory: 32 K bytes per point beyond Adam's (K > 3, D = 3, float32; with bfloat16
    pairs 12 K + 32 and up to 12 more for alignment), 32 more with epoch pairs.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import LQNAdam
        >>> points = torch.nn.Parameter(torch.ones(4, 3))
        >>> optimizer = LQNAdam([points], lr=0.05)
        >>> for _ in range(100):
        ...     optimizer.zero_grad()
        ...     (points**2 * torch.tensor([1.0, 10.0, 100.0])).sum().backward()
        ...     optimizer.step()
        >>> bool(points.abs().max() < 0.2)
        True

    Raises:
        ValueError: an option is outside what is allowed, or a parameter is complex, or float64
            with bfloat16 pairs (raised by `step`).
        RuntimeError: `backend="cuda"`, and the kernel cannot run (raised by `step`).
    """

    _own = (*HookedAdam._own, "curvature_options")

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._init_curvature(self.curvature_options)
        self._trust_present()  # the copied parameters are other objects, the rows the same

    def __init__(
        self,
        params: Any,
        lr: float | Tensor = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        amsgrad: bool = False,
        *,
        history_size: int = 5,
        pairs: Literal["consecutive", "epoch"] = "consecutive",
        epoch_steps: int | None = None,
        min_cosine: float = 1e-6,
        powell: bool = False,
        graft: bool = True,
        gamma_clamp: tuple[float, float] | None = None,
        backend: Backend = "auto",
        pair_dtype: curvature.PairDtype = "float32",
        skip_nonfinite: bool = True,
        foreach: bool | None = None,
        maximize: bool = False,
        capturable: bool = False,
        differentiable: bool = False,
        fused: bool | None = None,
    ) -> None:
        options = CurvatureOptions(
            history_size,
            pairs,
            epoch_steps,
            min_cosine,
            powell,
            graft,
            gamma_clamp,
            backend,
            pair_dtype,
        )
        super().__init__(
            params,
            lr,
            betas,
            eps,
            weight_decay,
            amsgrad,
            skip_nonfinite=skip_nonfinite,
            foreach=foreach,
            maximize=maximize,
            capturable=capturable,
            differentiable=differentiable,
            fused=fused,
        )
        self._init_curvature(options)

    def _init_curvature(self, options: CurvatureOptions) -> None:
        self.curvature_options = options
        self._held: list[tuple[weakref.ref[Tensor], weakref.ref[Tensor]]] = []
        self._seen: dict[int, tuple[weakref.ref[Tensor], int]] = {}
        self._tally: list[Tensor] = []  # [accepted, candidates] per parameter of the last step

    @property
    def accepted_share(self) -> Tensor | None:
        """Share of the last step's candidate pairs that were accepted, 0-d; None before any."""
        if not self._tally:
            return None
        accepted, candidates = torch.stack(self._tally).sum(0).unbind()
        return accepted / candidates.clamp(min=1)

    def __repr__(self) -> str:
        lines = [curvature_line(self.curvature_options, self.accepted_share)]
        lines += skipped_lines(self.skipped_rows) + group_lines(self.param_groups)
        return block(type(self).__name__, lines)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As torch's; a loaded history is used if its shape fits the parameters.

        Raises:
            ValueError: the state does not fit; then nothing has been loaded.
        """
        super().load_state_dict(state_dict)
        drop_foreign_rows(f"{type(self).__name__}.load_state_dict", self)
        self._trust_present()

    def state_dict(self) -> dict[str, Any]:
        """As torch's, without a history that density control has edited since the last step."""
        for param, state in self.state.items():
            if HISTORY in state and not self._is_known(param):
                del state[HISTORY]
                state.pop(EPOCH, None)
        return super().state_dict()

    def reset_points(self, rows: Tensor, *, moments: bool = False) -> None:
        """Say which points have moved by other means than `step()`: their pairs are dropped.

        For a trainer that knows what its density control did. Call it after each edit of the
        parameters: the pairs of all other points stay in use, where they would otherwise be
        dropped with the exchanged Parameter object. The state's rows must have been edited along
        (gsplat does; INRIA's edits leave the pairs behind, and they are dropped if their number
        does not fit).

        Args:
            rows: [N] bool mask or a vector of indices, of the points as they are now.
            moments: whether to start their Adam moments anew too.

        Raises:
            ValueError: a mask fits no parameter.
        """
        self._reset_rows(rows, moments)

    def drop_pairs(self) -> None:
        """Free all curvature pairs; they are collected anew where they are used."""
        for state in self.state.values():
            state.pop(HISTORY, None)
            state.pop(EPOCH, None)
        self._seen.clear()
        self._held, self._tally = [], []

    def _trust_present(self) -> None:
        """Take the histories in the state as those of the parameters' present rows."""
        self._seen.clear()
        for group in self.param_groups:
            for param in group["params"]:
                if HISTORY in self.state.get(param, {}):
                    self._remember(param)

    def _reset_rows(self, rows: Tensor, moments: bool) -> None:
        mask = rows.dtype == torch.bool
        every = [p for g in self.param_groups if self._is_points(g) for p in g["params"]]
        fitting = [p for p in every if p.dim() > 0 and (not mask or rows.shape == p.shape[:1])]
        if not fitting:
            raise ValueError(
                f"{type(self).__name__}.reset_points: rows has shape {tuple(rows.shape)}, but a "
                f"mask of the first dimension of {[tuple(p.shape) for p in every]} is needed"
            )
        for param in fitting:
            state = self.state.get(param, {})
            if not self._pairs_follow(param, state):
                state.pop(HISTORY, None)
                state.pop(EPOCH, None)
            kept = moments and {key for key in state if key != "step"}
            for key in kept or {HISTORY, EPOCH} & set(state):
                if state[key].shape[:1] == param.shape[:1]:
                    state[key][rows.to(param.device)] = 0
            if HISTORY in state:
                self._remember(param)

    def _pairs_follow(self, param: Tensor, state: Mapping[str, Any]) -> bool:
        """Whether the history was edited with the rows: not where the moments alone were."""
        history, moment = state.get(HISTORY), state.get("exp_avg")
        if history is None or history.shape[0] != param.shape[0]:
            return False
        return not any(h() is history and m() is not moment for h, m in self._held)

    def _is_points(self, group: Mapping[str, Any]) -> bool:
        return True

    def _remember(self, param: Tensor) -> None:
        rows = param.shape[0] if param.dim() else 1
        self._seen[id(param)] = (weakref.ref(param), rows)
        # The history and the moment that belong together: an edit of one alone shows.
        state = self.state[param]
        held = [(h, m) for h, m in self._held if h() is not None and h() is not state[HISTORY]]
        self._held = [*held, (weakref.ref(state[HISTORY]), weakref.ref(state["exp_avg"]))]

    def _is_known(self, param: Tensor) -> bool:
        seen = self._seen.get(id(param))
        rows = param.shape[0] if param.dim() else 1
        return seen is not None and seen[0]() is param and seen[1] == rows

    # -- the step ----------------------------------------------------------------------------

    def _begin_step(self, loss: Any) -> None:
        super()._begin_step(loss)
        self._tally = []

    def _uses_curvature(self, group: Mapping[str, Any]) -> bool:
        return True

    def _gradients(
        self, group: dict[str, Any], params: list[Tensor], grads: list[Tensor]
    ) -> list[Tensor]:
        if not self._uses_curvature(group):
            return grads
        epoch_ends = self._advance_epoch(group)
        # Curvature is that of the function being minimised, in unscaled units.
        unit = -1.0 if group["maximize"] else 1.0
        grad_scale = getattr(self, "grad_scale", None)
        if grad_scale is not None:
            unit = unit * grad_scale
        plain = isinstance(unit, float) and unit == 1.0
        fed = []
        for param, grad in zip(params, grads, strict=True):
            used = grad if plain else grad / unit
            used = self._pseudo_gradient(param, used, epoch_ends)
            fed.append(used if plain else used * unit)
        return fed

    def _advance_epoch(self, group: dict[str, Any]) -> bool:
        """Count the steps of the epoch (in the group: a plain int that checkpoints keep)."""
        steps = self.curvature_options.epoch_steps
        if steps is None:
            return False
        group["epoch_step"] = group.get("epoch_step", 0) % steps + 1
        return group["epoch_step"] == steps

    def _pseudo_gradient(self, param: Tensor, grad: Tensor, epoch_ends: bool) -> Tensor:
        if param.is_complex():
            raise ValueError("LQNAdam: complex parameters have no real curvature pairs")
        if param.numel() == 0:
            return grad
        options = self.curvature_options
        rows = param.shape[0] if param.dim() else 1
        position, gradient = param.detach().reshape(rows, -1), grad.reshape(rows, -1)
        history = self._history(param, position)
        if self._has_operator(position):
            self._foresee(history, position, gradient)
            fed, accepted, candidates = lqn_direction(
                position,
                gradient,
                history,
                options.history_size,
                min_cosine=options.min_cosine,
                powell=options.powell,
                graft=options.graft,
                gamma_clamp=options.gamma_clamp,
                backend=options.backend,
            )
            self._count(accepted, candidates)
            return fed.reshape(grad.shape)
        if options.backend == "cuda":
            raise RuntimeError(
                f"LQNAdam: backend='cuda' with pairs={options.pairs!r} and points of shape "
                f"{tuple(position.shape)}, but the kernel is for consecutive pairs and [N, 3]"
            )
        self._take_pairs(param, history, position, gradient, epoch_ends)
        return curvature.direction(
            gradient,
            history,
            options.history_size,
            graft=options.graft,
            gamma_clamp=options.gamma_clamp,
        ).reshape(grad.shape)

    def _take_pairs(
        self, param: Tensor, history: Tensor, position: Tensor, gradient: Tensor, epoch_ends: bool
    ) -> None:
        """Store the pairs that this step completes; position and gradient are [N, D]."""
        options = self.curvature_options
        visible = (gradient != 0).any(dim=1) & torch.isfinite(gradient).all(dim=1)
        recorded = (position, gradient, visible)
        if options.pairs == "epoch":
            recorded = self._average_epoch(param, *recorded, epoch_ends)
        if recorded is None:
            return
        self._foresee(history, *recorded)
        taken = curvature.record(
            history,
            options.history_size,
            *recorded,
            min_cosine=options.min_cosine,
            powell=options.powell,
        )
        self._count(*taken)

    def _count(self, accepted: Tensor, candidates: Tensor) -> None:
        """Remember a step's pairs for `accepted_share`; [N] bool each."""
        self._tally.append(torch.stack([accepted.sum(), candidates.sum()]))

    def _foresee(
        self, history: Tensor, position: Tensor, gradient: Tensor, visible: Tensor | None = None
    ) -> None:
        """Called before a step's pairs are stored; [N, D] and [N]."""

    def _has_operator(self, position: Tensor) -> bool:
        return self.curvature_options.pairs == "consecutive" and position.shape[1] == 3

    def _average_epoch(
        self,
        param: Tensor,
        position: Tensor,
        gradient: Tensor,
        visible: Tensor,
        epoch_ends: bool,
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        state, steps = self.state[param], self.curvature_options.epoch_steps or 0
        if EPOCH not in state:
            state[EPOCH] = curvature.new_history(position, 1)[:, 0].clone()
        curvature.accumulate(state[EPOCH], position, gradient, visible)
        if not epoch_ends:
            return None
        mean = curvature.epoch_mean(state[EPOCH], steps)
        state[EPOCH].zero_()
        return mean

    def _history(self, param: Tensor, position: Tensor) -> Tensor:
        """This parameter's history; a new one if somebody has exchanged or resized its rows."""
        state = self.state[param]
        size, packing = self.curvature_options.history_size, self.curvature_options.pair_dtype
        shape = curvature.history_shape(position, size, packing)
        fits = HISTORY in state and tuple(state[HISTORY].shape) == shape
        if packing == "bfloat16" and fits:  # a cast to another dtype has destroyed the bits
            fits = state[HISTORY].dtype == torch.float32
        kernel = self._has_operator(position) and uses_kernel(
            self.curvature_options.backend, position.device, position.dtype
        )
        if not fits or not self._is_known(param):
            state[HISTORY] = curvature.new_history(
                position, size, contiguous=kernel, pair_dtype=packing
            )
            state.pop(EPOCH, None)
        state[HISTORY] = curvature.laid_out(state[HISTORY], contiguous=kernel)
        self._seen = {key: entry for key, entry in self._seen.items() if entry[0]() is not None}
        self._remember(param)
        return state[HISTORY]
