"""What a checkpoint has beside tensors, and the one check of what is loaded."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from torch import Tensor

from opt3dgs_optim.checks import as_float, check_choice, check_count, check_number
from opt3dgs_optim.clock import Ticket
from opt3dgs_optim.contract import REFUSED
from opt3dgs_optim.mean import BEGAN, MEAN, RESIDUE
from opt3dgs_optim.moments import CODES, MOMENTS
from opt3dgs_optim.stepper import KEPT
from opt3dgs_optim.training import Training

STATE_KEY = "opt3dgs"  # in `param_groups[0]`: what a checkpoint needs beside tensors
FORMAT = 3
NUMBERS = {"format", "iteration", "total_steps", "own_frame", "steps", "moments", "last"}
NUMBERS |= {"notes", "parts"}


def numbers_of(
    training: Training, ticket: Ticket, steps: int, last: Iterable[int], own_frame: Iterable[str]
) -> dict[str, Any]:
    """What a checkpoint of an optimizer has beside tensors: plain numbers and lists.

    Args:
        ticket: the optimizer's.
        steps: that Adam has made, of its parameters the most.
        last: of every parameter, the iteration of its last step.
        own_frame: the sets whose positions' moments are those of the own frame.
    """
    training.read_back()
    training.look_at_numbers()
    notes = {type(p).__name__: dict(training.notes_of(p)) for p in training.parts}
    check_notes("state_dict", notes)
    return {
        "format": FORMAT,
        "iteration": max(ticket.next_iteration, training.iteration),  # it may have been put on
        "total_steps": training.total_steps,
        "own_frame": sorted(own_frame),
        "steps": steps,
        "moments": training.moments,
        "last": list(last),
        "notes": notes,
        "parts": {type(p).__name__: p.state_dict() for p in training.parts if p.learns},
    }


def restore_parts(training: Training, saved: Mapping[str, Any]) -> None:
    """Give parts that learn what they had learnt; they refuse what is damaged."""
    for part in training.parts:
        if part.learns and type(part).__name__ in saved["parts"]:
            part.load_state_dict(saved["parts"][type(part).__name__])


def restore_notes(training: Training, saved: Mapping[str, Any]) -> None:
    """Have the parts know what they had noted."""
    for part in training.parts:
        if type(part).__name__ in saved["notes"]:
            notes = training.notes_of(part)
            notes.clear()
            notes.update(saved["notes"][type(part).__name__])


# -- what is loaded --------------------------------------------------------------------------------


def check_loaded(call: str, state_dict: Any, groups: list[dict[str, Any]]) -> Any:
    """ValueError unless an optimizer with these groups can go on with a state dict.

    Returns:
        What `numbers_of` has put into it; None: it is a stock Adam's.
    """
    check_tensors(call, state_dict, groups)
    saved = next((g[STATE_KEY] for g in state_dict["param_groups"] if STATE_KEY in g), None)
    if saved is not None:
        check_numbers(call, saved)
    return saved


def check_numbers(call: str, saved: Any) -> None:
    """ValueError unless this is what `numbers_of` gives."""
    if not isinstance(saved, Mapping) or set(saved) != NUMBERS or saved["format"] != FORMAT:
        raise ValueError(
            f"{call}: param_groups[0][{STATE_KEY!r}] is not of this version (format {FORMAT}); "
            f"load a checkpoint that it has written, or remove the key to begin with Adam's "
            "moments alone"
        )
    check_count(call, "iteration", saved["iteration"], 0)
    if saved["total_steps"] is not None:
        check_count(call, "total_steps", saved["total_steps"], 1)
    check_count(call, "steps", saved["steps"], 0)
    check_choice(call, "moments", saved["moments"], (32, 16))
    for key, kind in (("last", int), ("own_frame", str)):
        found = saved[key]
        if not isinstance(found, list) or any(type(each) is not kind for each in found):
            raise ValueError(f"{call}: {key}={found!r}, but a list of {kind} is needed")
    for kind in ("notes", "parts"):
        if not isinstance(saved[kind], Mapping) or not all(
            isinstance(each, Mapping) for each in saved[kind].values()
        ):
            raise ValueError(f"{call}: {kind}={saved[kind]!r}, but a dict of dicts is needed")
    check_notes(call, saved["notes"])


def check_notes(call: str, notes: Mapping[str, Mapping[str, Any]]) -> None:
    """ValueError unless what parts have noted is finite numbers, as a checkpoint holds them."""
    for name, found in notes.items():
        if not all(type(v) is bool or math.isfinite(as_float(v)) for v in found.values()):
            raise ValueError(
                f"{call}: notes of {name} are {dict(found)!r}, but finite numbers are needed"
            )


def check_tensors(call: str, state_dict: Any, groups: list[dict[str, Any]]) -> None:
    """ValueError unless a state dict has torch's form, for these groups, and fitting tensors."""
    if not isinstance(state_dict, Mapping) or not {"state", "param_groups"} <= set(state_dict):
        raise ValueError(
            f"{call}: needs a dict with 'state' and 'param_groups', as state_dict() has"
        )
    saved, states = state_dict["param_groups"], state_dict["state"]
    if not isinstance(saved, list) or len(saved) != len(groups):
        raise ValueError(
            f"{call}: {len(saved) if isinstance(saved, list) else repr(saved)} parameter groups "
            f"were saved, but this optimizer has {len(groups)}"
        )
    known: set[int] = set()
    for at, (group, own) in enumerate(zip(saved, groups, strict=True)):
        check_group(f"{call}: group {at}", group, len(own["params"]))
        known.update(group["params"])
    if not isinstance(states, Mapping) or not set(states) <= known:
        raise ValueError(f"{call}: the state is not of the parameters {sorted(known)}")
    for index, state in states.items():
        check_moments(f"{call}: parameter {index}", state)


def check_group(call: str, group: Any, count: int) -> None:
    """ValueError unless a saved group has so many parameters, and options that Adam here takes."""
    params = group.get("params") if isinstance(group, Mapping) else None
    if not isinstance(params, list) or len(params) != count:
        raise ValueError(f"{call} has params={params!r}, but a list of {count} is needed")
    if not all(type(each) is int for each in params):
        raise ValueError(f"{call} has params={params!r}, but integers are needed")
    for option in REFUSED:
        if group.get(option):
            raise ValueError(f"{call} has {option}={group[option]!r}, which is not taken")
    betas = group.get("betas")
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise ValueError(f"{call} has betas={betas!r}, but two numbers are needed")
    numbers = {name: group.get(name) for name in ("lr", "eps", "weight_decay")}
    for name, value in {**numbers, "betas[0]": betas[0], "betas[1]": betas[1]}.items():
        check_number(call, name, value, 0.0, 1.0 if "betas" in name else math.inf)


def check_moments(call: str, state: Any) -> None:
    """ValueError unless the state of a parameter is empty, or Adam's with what is kept for rows."""
    if not isinstance(state, Mapping):
        raise ValueError(f"{call} has the state {state!r}, but a dict is needed")
    if not state:
        return
    missing = [key for key in ("step", *MOMENTS) if key not in state]
    if missing:
        raise ValueError(f"{call} has no {missing[0]}, but {sorted(map(str, state))}")
    check_count(call, "step", whole(state["step"]), 0)
    shapes: dict[str, tuple[int, ...]] = {}
    for key in (*MOMENTS, *KEPT):
        value: Any = state.get(key)
        if value is None and key in KEPT:
            continue
        if not isinstance(value, Tensor) or not (
            value.is_floating_point() or (key in (*MOMENTS, RESIDUE) and value.dtype == CODES)
        ):
            raise ValueError(f"{call} has {key}={value!r}, but a tensor of real numbers is needed")
        shapes[key] = tuple(value.shape)
    one = shapes["exp_avg"]
    if any(shapes.get(key, one) != one for key in ("exp_avg_sq", MEAN, RESIDUE)) or any(
        shapes.get(key, one)[:1] != one[:1] for key in KEPT
    ):
        raise ValueError(f"{call} has shapes {shapes}, but the same rows are needed in all")
    means = (MEAN in shapes) + (RESIDUE in shapes)
    if means != (BEGAN in shapes) or shapes.get(BEGAN, one[:1]) != one[:1]:
        raise ValueError(f"{call} has shapes {shapes}, but {BEGAN} needs a number for each row")


def whole(step: Any) -> Any:
    """Adam's count of steps, a tensor or a number, as an int; anything else as it is."""
    value = step.item() if isinstance(step, Tensor) and step.numel() == 1 else step
    return int(value) if isinstance(value, float) and value.is_integer() else value
