"""Loading a checkpoint into an optimizer with parts: all of it is taken, or nothing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from torch import Tensor
from torch.optim import Adam

from opt3dgs_optim.checks import check_keys, warn_user
from opt3dgs_optim.lending import use_fused
from opt3dgs_optim.names import SLOT
from opt3dgs_optim.rows import rows_of

STATE_KEY = "opt3dgs"  # in param_groups[0] of a state_dict: the course's state


@contextmanager
def loading(optimizer: Any) -> Iterator[None]:
    """Around torch's `load_state_dict` of a `StepAdam`: what it had comes back after an error."""
    before = optimizer.state, optimizer.param_groups
    names = [group.get(SLOT) for group in optimizer.param_groups]
    yield
    try:
        take_loaded(optimizer)
    except ValueError:
        optimizer.state, optimizer.param_groups = before
        raise
    for group, name in zip(optimizer.param_groups, names, strict=True):
        group[SLOT] = name  # a plain Adam's checkpoint does not say it
    if optimizer.base is Adam and optimizer.defaults["fused"]:
        use_fused(optimizer)
    optimizer.trust_rows()


def take_loaded(optimizer: Any) -> None:
    """Take the course's state out of the groups, where a checkpoint has put it."""
    shared = optimizer.param_groups[0].pop(STATE_KEY, None)
    if shared is not None:
        optimizer.course.load_state_dict(shared)
    else:
        steps = [float(state["step"]) for state in optimizer.state.values() if "step" in state]
        optimizer.course.expect(int(max(steps, default=0)))


def check_rows(call: str, params: list[Tensor], keys: Iterable[str], state: Any) -> None:
    """ValueError unless loaded moments fit the parameters; what parts kept of other rows goes.

    The number of rows may differ: some trainers load the optimizer first, the points afterwards.
    """
    for param in params:
        own = state.get(param)
        if not own and isinstance(own, (Mapping, type(None))):
            continue
        check_keys(call, own, ("step", "exp_avg", "exp_avg_sq"))
        for key in ("exp_avg", "exp_avg_sq"):
            value = own[key]
            if not isinstance(value, Tensor) or value.shape[1:] != param.shape[1:]:
                shape = tuple(value.shape) if isinstance(value, Tensor) else value
                raise ValueError(
                    f"{call}: {key} has shape {shape}, but the parameter has {tuple(param.shape)}"
                )
        for key in keys:
            if key in own and own[key].shape[0] != rows_of(param):
                warn_user(
                    f"{call}: {key} of {own[key].shape[0]} rows for a parameter of "
                    f"{rows_of(param)}: dropped, and collected anew"
                )
                del own[key]
