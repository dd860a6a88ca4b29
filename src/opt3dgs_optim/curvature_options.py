"""The options of the per-point L-BFGS, checked when they are made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from opt3dgs_optim import curvature
from opt3dgs_optim._checks import (
    check_choice,
    check_count,
    check_flag,
    check_interval,
    check_number,
)
from opt3dgs_optim.backend import BACKENDS, Backend


@dataclass(frozen=True)
class CurvatureOptions:
    """Options of the per-point L-BFGS; see `LQNAdam` for their meaning."""

    history_size: int = 5
    pairs: Literal["consecutive", "epoch"] = "consecutive"
    epoch_steps: int | None = None
    min_cosine: float = 1e-6
    powell: bool = False
    graft: bool = True
    gamma_clamp: tuple[float, float] | None = None
    backend: Backend = "auto"
    pair_dtype: curvature.PairDtype = "float32"

    def __post_init__(self) -> None:
        call = "LQNAdam"
        check_choice(call, "backend", self.backend, BACKENDS)
        check_choice(call, "pair_dtype", self.pair_dtype, curvature.PAIR_DTYPES)
        check_count(call, "history_size", self.history_size, 1, curvature.MAX_HISTORY)
        check_choice(call, "pairs", self.pairs, ("consecutive", "epoch"))
        if self.pairs == "epoch":
            check_count(call, "epoch_steps (needed for pairs='epoch')", self.epoch_steps, 1)
        elif self.epoch_steps is not None:
            raise ValueError(
                f"{call}: epoch_steps={self.epoch_steps!r}, but it is used with pairs='epoch' only"
            )
        check_number(call, "min_cosine", self.min_cosine, 0.0, 1.0, open_high=True)
        check_flag(call, "powell", self.powell)
        check_flag(call, "graft", self.graft)
        if self.gamma_clamp is not None:
            low, _ = check_interval(call, "gamma_clamp", self.gamma_clamp)
            check_number(call, "gamma_clamp[0]", low, 0.0)
