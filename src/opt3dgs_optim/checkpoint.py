"""What a checkpoint has beside tensors, and the one check of what is loaded."""

from __future__ import annotations

import json
import math
from collections.abc import Container, Iterable, Mapping
from typing import Any

from torch import Tensor

from opt3dgs_optim.checks import as_float, check_choice, check_count, check_number
from opt3dgs_optim.contract import REFUSED, Slots
from opt3dgs_optim.mean import (
    BEGAN,
    MEAN,
    RESIDUE,
    REST,
    drop_kept,
    drop_means,
    kept_in,
)
from opt3dgs_optim.moments import CODES, MOMENTS, recode
from opt3dgs_optim.stepper import begin_moments_anew
from opt3dgs_optim.training import Training

# In each group of a checkpoint, as a line of JSON, so that a group may be moved or dropped, and
# that who takes nested states apart (torch.distributed.checkpoint) finds one leaf.
STATE_KEY = "opt3dgs"
FORMAT = 6
COMMON = {
    *("format", "iteration", "total_steps", "fall_step", "steps", "moments", "kept"),
    *("notes", "parts"),
}
OF_GROUP = {"last", "own_frame"}


def numbers_of(training: Training, next_iteration: int, steps: int, kept: int) -> dict[str, Any]:
    """What all groups of a checkpoint have beside tensors: plain numbers and lists.

    A group has besides `last`, of every parameter the iteration of its last step, and `own_frame`,
    whether the moments of its positions are the own frame's.

    Args:
        next_iteration: of the optimizer.
        steps: that Adam has made, of its parameters the most.
        kept: of how many parameters something is kept for rows beside the moments.
    """
    training.read_back()
    training.look_at_numbers()
    notes = {type(p).__name__: dict(training.notes_of(p)) for p in training.parts}
    check_notes("state_dict", notes)
    return {
        "format": FORMAT,
        "iteration": max(next_iteration, training.iteration),  # it may have been put on
        "total_steps": training.end_step,
        "fall_step": training.fall_step,
        "steps": steps,
        "moments": training.moments,
        "kept": kept,
        "notes": notes,
        "parts": {type(p).__name__: p.state_dict() for p in training.parts if p.learns},
    }


def note_in_groups(
    groups: list[dict[str, Any]],
    slots: Slots,
    common: dict[str, Any],
    last: Iterable[int],
    now: int,
    framed: Container[str],
) -> None:
    """Put into each group what it has beside tensors.

    Args:
        common: of all groups, see `numbers_of`.
        last: of every parameter, the iteration of its last step; `now` where it is not known.
        framed: the sets whose positions' moments are the own frame's.
    """
    steps = iter(last)
    for group, (which, name) in zip(groups, slots, strict=True):
        of_group = {
            "last": [next(steps, now) for _ in group["params"]],
            "own_frame": name == "means" and which in framed,
        }
        group[STATE_KEY] = json.dumps({**common, **of_group})


def take_from_groups(groups: list[dict[str, Any]], slots: Slots) -> Any:
    """Read and remove what `note_in_groups` has put there.

    Returns:
        the numbers of the first group that has any, or None; of every parameter, the iteration of
        its last step; the sets whose positions' moments are the own frame's.
    """
    found = [saved_numbers(group.get(STATE_KEY)) for group in groups]
    for group in groups:
        group[STATE_KEY] = ""
    first = next((each for each in found if each is not None), None)
    if first is None:
        return None, (), frozenset()
    now = first["iteration"] - 1
    last: list[int] = []
    framed: set[str] = set()
    for saved, group, (which, _) in zip(found, groups, slots, strict=True):
        last += [now] * len(group["params"]) if saved is None else saved["last"]
        if saved is not None and saved["own_frame"]:
            framed.add(which)
    return first, tuple(last), frozenset(framed)


def complete_groups(
    training: Training, groups: list[dict[str, Any]], own: list[dict[str, Any]]
) -> None:
    """Give loaded groups the options that torch did not always have; tell of other names."""
    for group, was in zip(groups, own, strict=True):
        if group.get("name") != was.get("name"):
            training.messages.say_once(
                f"opt3dgs_optim: the checkpoint's group {group.get('name')!r} is loaded into the "
                f"group {was.get('name')!r}, which has its place; a load hook "
                "(register_load_state_dict_pre_hook) may put groups into another order"
            )
        for key, value in was.items():
            group.setdefault(key, value)


def forget_own_frames(
    groups: list[dict[str, Any]], slots: Slots, framed: Container[str], states: Mapping[Any, Any]
) -> None:
    """Have moments of positions in the own frame's units begin anew, for a stock step."""
    for group, (which, name) in zip(groups, slots, strict=True):
        if name == "means" and which in framed:
            state = states.get(group["params"][0], {})
            if "exp_avg" in state:
                begin_moments_anew(state)


def saved_numbers(line: Any) -> dict[str, Any] | None:
    """What a group of a checkpoint has; None: it is a stock Adam's."""
    try:
        return json.loads(line) if line else None
    except (TypeError, ValueError):
        return {}  # of no version


def restore_parts(training: Training, saved: Iterable[Mapping[str, Any]]) -> None:
    """Give parts that learn what they had learnt; where one refuses it none is changed."""
    learn = {type(part).__name__: part for part in training.parts if part.learns}
    before = {name: part.state_dict() for name, part in learn.items()}
    try:
        for each in saved:
            for name in set(learn) & set(each["parts"]):
                learn[name].load_state_dict(each["parts"][name])
    except ValueError:
        for name, part in learn.items():
            part.load_state_dict(before[name])
        raise


def restore_training(training: Training, saved: Mapping[str, Any]) -> None:
    """Have the parts know what they had noted, and a training of no planned end of its fall."""
    if training.open_end:
        start = saved["fall_step"]
        training.plan_fall(start, None if start is None else saved["total_steps"])
    for part in training.parts:
        if type(part).__name__ in saved["notes"]:
            notes = training.notes_of(part)
            notes.clear()
            notes.update(saved["notes"][type(part).__name__])


def drop_other_means(
    states: Iterable[dict[str, Any]], saved: Mapping[str, Any] | None, training: Training
) -> None:
    """Drop means, and what else is kept for rows, of another end of training, or in another form.

    Args:
        states: of the optimizer's parameters.
        saved: what the checkpoint says; None: nothing that holds.
    """
    states = list(states)
    if saved is not None and saved["kept"] > sum(bool(kept_in(state)) for state in states):
        training.messages.say_once(
            "opt3dgs_optim: the checkpoint was loaded without the mean of the last iterates, or "
            "curvature pairs, that it has (torch.distributed.checkpoint loads only what the new "
            "optimizer has); they begin anew"
        )
    ends = None if saved is None else (saved["total_steps"], saved["fall_step"])
    if ends != (training.end_step, training.fall_step):
        for state in states:
            drop_kept(state)
    if saved is not None and saved["moments"] != training.moments:
        if any(BEGAN in state for state in states):
            training.messages.say_once(
                "opt3dgs_optim: the mean of the last iterates begins anew, at "
                f"{training.moments} bits"
            )
        drop_means(states)


def recode_all(
    states: Mapping[Tensor, dict[str, Any]],
    coded: bool,
    saved: Mapping[str, Any] | None,
    training: Training,
) -> None:
    """Have moments, which are codes or not, at as many bits as the training has; tell of a change.

    Args:
        states: of the optimizer, by parameter.
        saved: what the checkpoint says, or None.
    """
    bits = training.moments
    found = [recode(state, coded, bits, param.dtype) for param, state in states.items()]
    if any(found) and coded != (bits == 16) and (saved is None or saved["moments"] != bits):
        training.messages.say_once(
            f"opt3dgs_optim: the moments that were there are now at {bits} bits"
        )


def steps_of_a_stock_adam(
    counts: list[int], saved: Mapping[str, Any] | None, training: Training
) -> int:
    """How many steps a stock Adam has made with a checkpoint of ours; tell of them."""
    made, missed = max(counts, default=0), 0
    if saved is not None and counts:  # it counts from 0 where the state was dropped before
        missed = made if made < saved["steps"] else made - saved["steps"]
    if missed:
        training.messages.say_once(
            f"opt3dgs_optim: a stock Adam has gone on for {missed} steps with this checkpoint; "
            "what was kept beside its moments begins anew"
        )
    return missed


def iteration_by_counts(call: str, counts: list[int], training: Training) -> int:
    """The iteration that comes next, by Adam's own counts of steps, of a stock checkpoint."""
    if not counts:
        return training.iteration + 1
    if not any(counts):
        training.messages.warn_once(
            "uncounted",
            f"{call}: it has moments, but does not count its steps, so that the clock begins at 0; "
            "call phases.observe(iteration=...) where the training goes on",
        )
    return max(counts)


# -- what is loaded --------------------------------------------------------------------------------


def check_loaded(call: str, state_dict: Any, groups: list[dict[str, Any]]) -> Any:
    """ValueError unless an optimizer with these groups can go on with a state dict.

    Returns:
        What `numbers_of` has put into it; None: it is a stock Adam's.
    """
    check_tensors(call, state_dict, groups)
    return check_groups(call, state_dict["param_groups"])


def check_groups(call: str, groups: list[dict[str, Any]]) -> Any:
    """`check_loaded` of what is ours in the groups."""
    first = None
    for group in groups:
        if line := group.get(STATE_KEY):
            saved = saved_numbers(line)
            check_numbers(call, saved, len(group["params"]))
            first = saved if first is None else first
    return first


def check_numbers(call: str, saved: Any, count: int) -> None:
    """ValueError unless this is what a group of so many parameters has."""
    known = isinstance(saved, dict) and set(saved) == COMMON | OF_GROUP
    if not known or saved["format"] != FORMAT:
        raise ValueError(
            f"{call}: {STATE_KEY!r} in a group is not of this version (format {FORMAT}); load a "
            "checkpoint that it has written, or remove the key from all groups to begin with "
            "Adam's moments alone"
        )
    check_count(call, "iteration", saved["iteration"], 0)
    if saved["total_steps"] is not None:
        check_count(call, "total_steps", saved["total_steps"], 1)
    if saved["fall_step"] is not None:
        check_count(call, "fall_step", saved["fall_step"], 0, (saved["total_steps"] or 0) - 1)
    check_count(call, "steps", saved["steps"], 0)
    check_count(call, "kept", saved["kept"], 0)
    check_choice(call, "moments", saved["moments"], (32, 16))
    last = saved["last"]
    if not isinstance(last, list) or [type(each) for each in last] != [int] * count:
        raise ValueError(f"{call}: last={last!r}, but a list of {count} integers is needed")
    check_choice(call, "own_frame", saved["own_frame"])
    for kind in ("notes", "parts"):
        if not isinstance(saved[kind], Mapping) or not all(
            isinstance(each, Mapping) for each in saved[kind].values()
        ):
            raise ValueError(f"{call}: {kind}={saved[kind]!r}, but a dict of dicts is needed")
    check_notes(call, saved["notes"])


def check_notes(call: str, notes: Mapping[str, Mapping[str, Any]]) -> None:
    """ValueError unless what parts have noted is finite numbers, as a checkpoint holds them."""
    for name, found in notes.items():
        others = [v for v in found.values() if type(v) is not bool]
        if not all(type(v) in (int, float) and math.isfinite(as_float(v)) for v in others):
            raise ValueError(
                f"{call}: notes of {name} are {dict(found)!r}, but finite numbers of Python "
                "are needed"
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
    if not all(isinstance(each, (int, str)) for each in params):
        raise ValueError(f"{call} has params={params!r}, but indices or names are needed")
    for option in REFUSED:
        if group.get(option):
            raise ValueError(f"{call} has {option}={group[option]!r}, which is not taken")
    betas = group.get("betas")
    if not isinstance(betas, (tuple, list)) or len(betas) != 2:
        raise ValueError(f"{call} has betas={betas!r}, but two numbers are needed")
    numbers = {name: group.get(name) for name in ("lr", "eps", "weight_decay")}
    for name, value in {**numbers, "betas[0]": betas[0], "betas[1]": betas[1]}.items():
        is_beta = "betas" in name
        check_number(call, name, value, 0.0, 1.0 if is_beta else math.inf, open_high=is_beta)


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
    for key in (*MOMENTS, *kept_in(state)):
        value: Any = state[key]
        if not isinstance(value, Tensor) or not (
            value.is_floating_point() or (key in (*MOMENTS, RESIDUE) and value.dtype == CODES)
        ):
            raise ValueError(f"{call} has {key}={value!r}, but a tensor of real numbers is needed")
        shapes[key] = tuple(value.shape)
    one = shapes["exp_avg"]
    rows = one[:1], one[:1] or (1,)  # a scalar is one row
    like = ("exp_avg_sq", MEAN, RESIDUE, REST)
    if any(shape != one if key in like else shape[:1] not in rows for key, shape in shapes.items()):
        raise ValueError(f"{call} has shapes {shapes}, but the same rows are needed in all")
    means = (MEAN in shapes) + (RESIDUE in shapes)
    if means != (BEGAN in shapes) or shapes.get(BEGAN, rows[0]) not in rows:
        raise ValueError(f"{call} has shapes {shapes}, but {BEGAN} needs a number for each row")


def whole(step: Any) -> Any:
    """Adam's count of steps, a tensor or a number, as an int; anything else as it is."""
    value = step.item() if isinstance(step, Tensor) and step.numel() == 1 else step
    return int(value) if isinstance(value, float) and value.is_integer() else value
