"""What a checkpoint holds besides torch's moments: how it is packed, checked and taken apart.

Inside `param_groups[0]["opt3dgs"]` of an optimizer's `state_dict()`: the course's own state, and
under `"optimizer"` what belongs to this optimizer,

    steps      how many steps Adam's moments have made
    windows    for which iterations each part's state is valid, see `Part.window`
    records    by group and parameter: the iteration of its last step, the numbers kept for it, and
               the parts in whose units Adam's moments are, where there are such
    kept       by parameter: the keys of what parts keep per row, beside the moments, and of the
               numbers that they keep for it; under "training" those of the course

All are plain numbers, strings, lists and dicts, so that `torch.load(weights_only=True)` and torch's
distributed checkpoints take them. Checkpoints of format 2 are still read.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Mapping
from itertools import chain
from numbers import Integral
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim.checks import LOGGER, check_count, check_keys, check_number, warn_user
from opt3dgs_optim.course import NEVER, STATE_KEY, Course, check_format, restored_number
from opt3dgs_optim.names import ADAM_KEYS, SLOT, gaussian_of, group_name
from opt3dgs_optim.part import Group, Kept, Window
from opt3dgs_optim.state import (
    ParameterRecord,
    check_kept,
    check_kept_number,
    check_moments,
    key_of,
    restart_rows,
    rows_of,
)

if TYPE_CHECKING:
    from opt3dgs_optim.stepadam import StepAdam

# Format 2 kept these under names that all parts shared, and numbers in the groups.
ROW_KEYS_OF_FORMAT_2 = {
    "history": "Curvature.history",
    "mean_iterate": "Averaging.mean",
    "num_averaged": "Averaging.count",
}
SHARE_OF_FORMAT_2 = "visible_share"
TRAINING = "training"  # in "kept", in the place of a parameter's number
GROUP_KEYS_OF_FORMAT_2 = (SLOT, "faded", "fresh_since", SHARE_OF_FORMAT_2)


class SavedRecord(NamedTuple):
    """What a checkpoint has for one parameter's record, checked."""

    last_step: int | None
    numbers: dict[str, Any]  # Python's, of the kinds that the parts keep
    units: tuple[str, ...] = ()


class Saved(NamedTuple):
    """What a checkpoint has for one optimizer, checked."""

    course: dict[str, Any] | None  # None: it is no checkpoint of ours
    windows: dict[str, Window | None]
    records: list[list[SavedRecord]]  # by group, by parameter
    rows: list[dict[str, Tensor]]  # by parameter: what parts keep per row
    parts: frozenset[str] = frozenset()  # names of those that have kept something


def take_units(
    group: Group,
    record: ParameterRecord,
    state: dict[str, Any] | None,
    units: tuple[str, ...],
    course: Course,
) -> None:
    """Begin Adam's moments anew, which are in the units of other parts than those that act.

    Args:
        state: Adam's of the parameter; None before its first step.
        units: the names of the parts that act, and have units of their own.
    """
    known, record.units = record.units, units
    if not state:
        return
    if known is None:  # moments that somebody has put there, past our load_state_dict
        course.expect(number_of_steps([state]))
        known = ()
    if known == units:
        return
    for key in [key for key in ADAM_KEYS if key in state]:
        # Not in place: where a load fails later on, all of it is undone.
        value = state[key]
        state[key] = torch.zeros_like(value) if isinstance(value, Tensor) else 0
    name, parts = gaussian_of(group), ", ".join(units or known)
    what = f"Adam's moments of {name} begin anew, since {parts} "
    what += "begins to act" if units else "ceases to act"
    if record.last_moved is None:  # no step by these parts yet: others have made them
        course.warn_once(
            f"units of {name}",
            f"{what}: those that were there count as made in other units, by steps before the "
            "first observe(loss) or in another training; to go on with moments of a checkpoint, "
            "give the parts of its training (a flattened distributed one does not say which)",
        )
    else:
        LOGGER.info("iteration %d: %s", course.current, what)


def number_of_steps(states: Iterable[Mapping[str, Any]]) -> int:
    """How many steps Adam's moments have made, the most of all parameters."""
    return int(max((float(state["step"]) for state in states if "step" in state), default=0))


def pack_optimizer(
    optimizer: StepAdam,
    records: list[list[ParameterRecord]],
    windows: Mapping[str, Window | None],
) -> dict[str, Any]:
    """What belongs to one optimizer. Synchronises with the device."""
    keys = optimizer.course.row_keys
    kept = {TRAINING: sorted(optimizer.course.kept_numbers)}
    every = zip(_parameters(optimizer), chain.from_iterable(records), strict=True)
    for i, (param, record) in enumerate(every):
        present = [key for key in keys if key in optimizer.state.get(param, {})]
        if present or record.numbers:
            kept[str(i)] = [*present, *record.numbers]
    return {
        "steps": number_of_steps(optimizer.state.values()),
        "windows": {name: list(window) for name, window in windows.items() if window is not None},
        "records": [
            [
                {
                    "last_step": _last_step(optimizer, record),
                    "numbers": {key: value.item() for key, value in record.numbers.items()},
                    **({"units": list(record.units)} if record.units else {}),
                }
                for record in group
            ]
            for group in records
        ],
        "kept": kept,
    }


def _last_step(optimizer: StepAdam, record: ParameterRecord) -> int | None:
    """The iteration of a parameter's last step, which an optimizer without parts does not note."""
    param = None if record.param is None else record.param()
    if optimizer.course.parts or optimizer.stepped_at < 0 or param is None:
        return record.last_step
    return optimizer.stepped_at if optimizer.state.get(param) else None


def inspect_checkpoint(optimizer: StepAdam, loaded: dict[str, Any]) -> tuple[Saved, dict[str, Any]]:
    """Check a `state_dict()`; return what parts have in it, and the rest, for torch to load.

    The course has its own state then, which the caller undoes if the load fails.

    Raises:
        ValueError: it is damaged.
    """
    call = f"{optimizer.call_name}.load_state_dict"
    params = _parameters(optimizer)
    groups = [dict(group) for group in loaded["param_groups"]]
    for i, group in enumerate(groups):
        _check_options(call, f"param_groups[{i}]", group)
    shared = groups[0].pop(STATE_KEY, None) if groups else None
    share = [group.get(SHARE_OF_FORMAT_2) for group in groups]
    is_format_2 = _is_format_2(shared)
    if is_format_2:  # such keys of others are the trainer's own
        groups = [
            {key: value for key, value in group.items() if key not in GROUP_KEYS_OF_FORMAT_2}
            for group in groups
        ]
    numbers = list(chain.from_iterable(group["params"] for group in groups))
    nothing = Saved(None, {}, [], [{} for _ in params])
    if len(numbers) != len(params):  # torch says so
        return nothing, {**loaded, "param_groups": groups}
    state, cast = dict(loaded["state"]), bool(loaded.get("cast"))
    by_name = any(isinstance(number, str) for number in state)  # torch's distributed checkpoints
    own, clock = _unpack(call, shared, optimizer, share, by_name=by_name)
    steps = number_of_steps(_checked_states(call, groups, params, state))
    stale = own is not None and own["steps"] not in (None, steps)
    if own is not None and clock is not None:
        clock = _moved_on(call, own, clock, steps) if stale else clock
        # Here, because a window may follow the clock, or what a part has learnt.
        optimizer.course.load_state_dict(clock)
    rows, orphaned, rounded = [], False, set[torch.dtype]()
    known = frozenset(optimizer.course.named()) | _names_of_parts(own)
    for i, (number, param) in enumerate(zip(numbers, params, strict=True)):
        saved = state.get(number)
        if not saved:
            state.pop(number, None)  # torch takes no None
            rows.append({})
            continue
        kept, rest = _split(saved, known, ROW_KEYS_OF_FORMAT_2 if is_format_2 else {})
        state[number] = rest
        if own is None or stale:
            orphaned |= bool(kept) and own is None
            rows.append({})
            continue
        # Distributed files leave out what a fresh optimizer has not; that is said below.
        needed = () if by_name else own["kept"].get(str(i), ())
        kept = _cast_back(call, optimizer.course, kept, param, rest["exp_avg"], rounded, cast=cast)
        rows.append(_rows(call, optimizer.course, own, param, rest, kept, needed))
    if rounded:
        warn_user(
            f"{call}: what the parts keep was rounded to {', '.join(map(str, rounded))} by an "
            "optimizer without them, which had loaded it; one that is upgraded before it loads "
            "keeps all digits"
        )
    if own is None and by_name and steps and optimizer.course.keeps_state:
        warn_user(
            f"{call}: a distributed checkpoint of {steps} steps without our state, as flattened "
            "ones and those of a plain Adam are: what the parts keep begins anew, and the clock "
            "needs observe(loss, iteration=...)"
        )
    elif orphaned:
        warn_user(
            f"{call}: this checkpoint has what parts keep per point, but not for which iterations: "
            "it begins anew (a consolidated or flattened checkpoint leaves that out)"
        )
    if by_name and own is not None and clock is not None:
        _warn_of_rows_left_out(call, optimizer.course, clock["iteration"] - 1, rows)
    windows = {} if own is None or stale else own["windows"]
    # Another optimizer's gradients were in the parameters' own units.
    records = [] if own is None else own["records"]
    if stale and clock is not None:
        records = _gone_on(records, clock["iteration"] - 1)
    rest = {**loaded, "state": state, "param_groups": groups}
    return Saved(clock, windows, records, rows, known), rest


def _is_format_2(shared: Any) -> bool:
    """Whether it is the course's part of a checkpoint of format 2."""
    number = shared.get("format") if isinstance(shared, Mapping) else None
    return isinstance(number, Integral) and number == 2


def _moved_on(
    call: str, own: Mapping[str, Any], clock: dict[str, Any], steps: int
) -> dict[str, Any]:
    """The course's state, moved on by the steps that another optimizer has made since."""
    # Torch's distributed checkpoints make a step of a fresh optimizer: of no iteration of ours.
    counted = int(own["steps"] or 0) if clock["iteration"] else 0
    clock = {**clock, "iteration": clock["iteration"] + max(steps - counted, 0)}
    warn_user(
        f"{call}: Adam's moments have made {steps} steps, but {own['steps']} when our state was "
        "saved: another optimizer has gone on with them. The clock is moved on to iteration "
        f"{clock['iteration']}, and what the parts had kept per point begins anew"
    )
    return clock


def as_loaded(optimizer: StepAdam) -> dict[str, Any]:
    """The state of an optimizer as a checkpoint has it, without a copy."""
    params = _parameters(optimizer)
    numbers = iter(range(len(params)))
    groups = [
        {**group, "params": [next(numbers) for _ in group["params"]]}
        for group in optimizer.param_groups
    ]
    state = {i: optimizer.state[p] for i, p in enumerate(params) if p in optimizer.state}
    return {"state": state, "param_groups": groups, "cast": True}


def _checked_states(
    call: str, groups: list[dict[str, Any]], params: list[Tensor], state: Mapping[Any, Any]
) -> list[Mapping[str, Any]]:
    """The states of the parameters that have been stepped, checked; groups are the checkpoint's."""
    found = []
    numbers = [(number, group) for group in groups for number in group["params"]]
    for (number, group), param in zip(numbers, params, strict=True):
        saved = state.get(number)
        if saved is None or (isinstance(saved, Mapping) and not saved):
            continue
        check_moments(call, param, saved, amsgrad=group.get("amsgrad") is True)
        found.append(saved)
    return found


def restore_records(
    optimizer: StepAdam, records: list[list[ParameterRecord]], saved: Saved
) -> None:
    """Give each parameter's record what a checkpoint has for it."""
    entries = optimizer.course.number_entries("parameter")
    for group, own in zip(optimizer.param_groups, records, strict=True):
        for param, record in zip(group["params"], own, strict=True):
            record.units = () if optimizer.state.get(param) else None
    for group, own, theirs in zip(optimizer.param_groups, records, saved.records, strict=False):
        for param, record, found in zip(group["params"], own, theirs, strict=False):
            record.last_step = found.last_step
            if record.units is not None:
                record.units = found.units
            record.numbers = {
                key: restored_number(value, entries[key]).to(
                    param.device, entries[key].dtype_for(param)
                )
                for key, value in found.numbers.items()
            }


def _parameters(optimizer: StepAdam) -> list[Tensor]:
    return list(chain.from_iterable(group["params"] for group in optimizer.param_groups))


def _unpack(
    call: str, shared: Any, optimizer: StepAdam, share: list[Any], *, by_name: bool
) -> tuple[dict[str, Any] | None, dict[str, Any] | None]:
    """The optimizer's own part of a checkpoint, checked, and the course's."""
    if shared is None:
        return None, None
    check_keys(call, shared, ("format", "iteration"))
    clock = {key: value for key, value in shared.items() if key != "optimizer"}
    check_count(call, "iteration", clock["iteration"], 0, NEVER)
    check_format(call, clock["format"])
    if clock["format"] == 2:
        own = _from_format_2(call, clock, optimizer, share)
    else:
        own = shared.get("optimizer")
        check_keys(f"{call}: optimizer", own, ("steps", "windows", "records", "kept"))
    windows = {}
    check_keys(f"{call}: windows", own["windows"], ())
    for name, window in own["windows"].items():
        pair = isinstance(window, (list, tuple)) and len(window) == 2
        if not pair or not all(isinstance(each, int) for each in window):
            raise ValueError(f"{call}: windows[{name!r}]={window!r}, but two iterations are needed")
        windows[name] = tuple(window)
    if own["steps"] is not None:
        check_count(call, "steps", own["steps"], 0)
    check_keys(f"{call}: kept", own["kept"], ())
    for number, names in own["kept"].items():
        if not isinstance(names, (list, tuple)) or not all(isinstance(n, str) for n in names):
            raise ValueError(f"{call}: kept[{number!r}]={names!r}, but a list of keys is needed")
    if TRAINING in own["kept"]:  # earlier versions did not say
        check_keys(call, clock, ("kept", "windows"))
        numbers = own["kept"][TRAINING]
        if by_name and not set(numbers) <= set(clock["kept"]):
            warn_user(
                f"{call}: {', '.join(numbers)} begin anew: torch's distributed files leave out "
                "what an optimizer that has made no step does not keep yet"
            )
        check_keys(f"{call}: kept", clock["kept"], () if by_name else numbers)
    records = _records(call, own["records"], own["kept"], optimizer)
    return {**own, "windows": windows, "records": records}, clock


def _records(
    call: str, saved: Any, kept: Mapping[str, Any], optimizer: StepAdam
) -> list[list[SavedRecord]]:
    """The records of all parameters, by group, checked; there may be more of them.

    `kept` are, by parameter, the keys of what must be there.
    """
    if not isinstance(saved, list):
        raise ValueError(f"{call}: records={saved!r}, but a list is needed")
    entries, records = optimizer.course.number_entries("parameter"), list[list[SavedRecord]]()
    needed = ([key for key in kept.get(str(i), ()) if key in entries] for i in itertools.count())
    for group in saved:
        if not isinstance(group, list):
            raise ValueError(f"{call}: records has {group!r}, but a list is needed")
        records.append([_record(call, entry, entries, next(needed)) for entry in group])
    for i, group in enumerate(optimizer.param_groups):
        found, needed = len(records[i]) if i < len(records) else 0, len(group["params"])
        if found < needed:
            raise ValueError(
                f"{call}: records has {found} for {group_name(i, group)}, but {needed} are needed"
            )
    return records


def _record(
    call: str, entry: Any, entries: Mapping[str, Kept], needed: Collection[str]
) -> SavedRecord:
    """One parameter's record, checked; of the numbers those that are among the `entries`."""
    check_keys(f"{call}: records", entry, ("last_step", "numbers"))
    check_keys(f"{call}: records: numbers", entry["numbers"], needed)
    last_step, units = entry["last_step"], entry.get("units", [])
    if last_step is not None:
        check_count(call, "last_step", last_step, -1, NEVER)
    if not isinstance(units, (list, tuple)) or not all(isinstance(name, str) for name in units):
        raise ValueError(f"{call}: units={units!r}, but names of parts are needed")
    numbers = {
        key: check_kept_number(call, key, entries[key], value)
        for key, value in entry["numbers"].items()
        if key in entries
    }
    return SavedRecord(last_step, numbers, tuple(units))


def _gone_on(records: list[list[SavedRecord]], last_step: int) -> list[list[SavedRecord]]:
    """The same, where another optimizer has made the steps since, the last in that iteration.

    Its gradients were in the parameters' own units.
    """
    return [
        [SavedRecord(None if each.last_step is None else last_step, each.numbers) for each in group]
        for group in records
    ]


def _names_of_parts(own: Mapping[str, Any] | None) -> frozenset[str]:
    """The names of the parts of which an optimizer's own part of a checkpoint has something."""
    if own is None:
        return frozenset()
    keys = chain.from_iterable(own["kept"].values())
    return frozenset(own["windows"]) | {key.rpartition(".")[0] for key in keys}


def _from_format_2(
    call: str, clock: dict[str, Any], optimizer: StepAdam, share: list[Any]
) -> dict[str, Any]:
    """What format 2 did not say: the present windows hold where its iteration lies in them."""
    course, last_step = optimizer.course, clock["iteration"] - 1
    windows = {}
    for name, part in course.named().items():
        window = course.window_of_part(part)
        if window is not None and window[0] <= last_step < window[1]:
            windows[name] = list(window)
    records = []
    for group, seen in zip(optimizer.param_groups, share, strict=True):
        numbers = {}
        if seen is not None:
            number = seen.item() if isinstance(seen, Tensor) and seen.numel() == 1 else seen
            numbers["OutOfView.seen_share"] = check_number(call, SHARE_OF_FORMAT_2, number)
        if "FreshMoments" in windows:  # those moments were zeroed already
            numbers["FreshMoments.fresh"] = 1.0
        records.append(
            [{"last_step": last_step, "numbers": dict(numbers)} for _ in group["params"]]
        )
    return {"steps": None, "windows": windows, "records": records, "kept": {}}


def is_kept_by_part(key: Any, known: Collection[str]) -> bool:
    """Whether a key of a parameter's state is that of a part, and not torch's or the trainer's.

    Those of parts begin with the name of a class. `known` are the names of parts that there are;
    of others it is taken for one if it begins with a capital letter.
    """
    part = str(key).rpartition(".")[0]
    return part in known or part[:1].isupper()


def _split(
    saved: Mapping[str, Any], known: Collection[str], renamed: Mapping[str, str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What parts keep, under today's keys, and what is torch's, the base class's or the trainer's.

    `known` are names of parts, `renamed` today's keys for those of another format.
    """
    kept, rest = {}, {}
    for key, value in saved.items():
        new = renamed.get(key, key)
        (kept if is_kept_by_part(new, known) else rest)[new] = value
    return kept, rest


def _check_options(call: str, name: str, group: Any) -> None:
    """ValueError unless a group of a checkpoint has Adam's options, each one that Adam takes."""
    check_keys(f"{call}: {name}", group, ("params", "lr", "betas", "eps", "weight_decay"))
    if not isinstance(group["params"], (list, tuple)):
        raise ValueError(f"{call}: {name}: params={group['params']!r}, but a list is needed")
    betas = group["betas"]
    if not isinstance(betas, (list, tuple)) or len(betas) != 2:
        raise ValueError(f"{call}: {name}: betas={betas!r}, but two numbers are needed")
    numbers = [(option, group[option], math.inf) for option in ("lr", "eps", "weight_decay")]
    for option, value, most in [*numbers, *(("betas", beta, 1.0) for beta in betas)]:
        if not isinstance(value, Tensor):
            check_number(call, f"{name}: {option}", value, 0.0, most)
        elif value.numel() == 1 and value.is_cpu:  # of others torch says so, or a GPU must wait
            check_number(call, f"{name}: {option}", value.item(), 0.0, most)
    for option in ("amsgrad", "maximize", "capturable", "differentiable", "foreach", "fused"):
        value = group.get(option)
        whether = isinstance(value, (bool, np.bool_)) or (
            isinstance(value, int) and value in (0, 1)
        )
        if value is not None and not whether:
            raise ValueError(f"{call}: {name}: {option}={value!r}, but True or False is needed")


def _cast_back(
    call: str,
    course: Course,
    kept: Mapping[str, Any],
    param: Tensor,
    moment: Tensor,
    rounded: set[torch.dtype],
    *,
    cast: bool,
) -> dict[str, Any]:
    """What parts keep per row in the dtypes that they declare.

    torch's own load casts all that an optimizer without parts has beside a parameter to the
    parameter's dtype, and a checkpoint that such an optimizer saves has it so. One of a model of
    another dtype has what that declares.

    Args:
        call: what messages name.
        course: whose parts they are.
        kept: what the checkpoint has, under today's keys.
        param: the parameter.
        moment: Adam's first one in the checkpoint, of the dtype of the parameter that was saved.
        rounded: gets the dtypes that have lost digits.
        cast: whether a stock optimizer has loaded it here, of whatever dtype the parameter is now.

    Raises:
        ValueError: it has numbers that the declared dtype cannot hold.
    """
    found = dict(kept)
    for name, entries in course.declared.items():
        for entry in entries.values():
            key, dtype = key_of(name, entry), entry.dtype_for(param)
            value = found.get(key)
            if not isinstance(value, Tensor) or value.dtype == dtype:
                continue
            of_another_model = value.dtype in (moment.dtype, entry.dtype_for(moment))
            if value.is_floating_point() and (cast or of_another_model):
                if not _can_be(value, dtype):
                    raise ValueError(f"{call}: {key} has numbers that {dtype} cannot hold")
                found[key] = value.to(dtype)
                if _has_lost_digits(value, dtype):
                    rounded.add(value.dtype)
    return found


def _can_be(value: Tensor, declared: torch.dtype) -> bool:
    """Whether numbers of a floating dtype are numbers of another one, rounded at most."""
    if declared.is_floating_point or declared.is_complex:
        return True
    low, high = (0, 1)
    if declared is not torch.bool:
        low, high = torch.iinfo(declared).min, torch.iinfo(declared).max
    return bool(((value == value.trunc()) & (value >= low) & (value < high + 1)).all())


def _has_lost_digits(value: Tensor, declared: torch.dtype) -> bool:
    """Whether a tensor may have been rounded when it was cast to the dtype that it has."""
    if declared.is_floating_point or declared.is_complex:
        return value.dtype.itemsize < declared.itemsize
    # Integers are exact up to 2 / eps.
    return bool((value.abs() >= 2 / torch.finfo(value.dtype).eps).any())


def _rows(
    call: str,
    course: Course,
    own: Mapping[str, Any],
    param: Tensor,
    moments: Mapping[str, Any],
    kept: Mapping[str, Any],
    needed: Iterable[str],
) -> dict[str, Tensor]:
    """What parts keep per row of a parameter, checked; without what is not valid any more.

    Args:
        call: what messages name.
        course: whose parts they are.
        own: the optimizer's own part of the checkpoint.
        param: the parameter.
        moments: Adam's, which say how many rows there were.
        kept: what the checkpoint has, under today's keys.
        needed: keys that it must have.
    """
    found, rows = dict[str, Tensor](), rows_of(moments["exp_avg"])
    for name, part in course.named().items():
        window = course.window_of_part(part)
        entries = {key_of(name, e): e for e in course.declared[name].values() if e.per == "row"}
        absent = [key for key in entries if not _is_there(kept.get(key))]
        missing = [key for key in absent if key in needed]
        if not needed and len(absent) < len(entries):
            missing = absent  # nobody has said which there were, and they are of use together
        if missing:
            raise ValueError(f"{call}: {missing} are missing, which the checkpoint says are there")
        there = {key: kept[key] for key in entries if key not in absent}
        for key, value in there.items():
            check_kept(call, key, entries[key], value, param)
        valid = own["windows"].get(name) == window
        mine = {k: v for k, v in there.items() if valid and not _too_many(k, v, own, window)}
        for key in there.keys() - mine.keys():
            LOGGER.info("%s: %s is of other iterations: it begins anew", call, key)
        edited = [key for key, value in mine.items() if rows_of(value) != rows]
        if edited:
            # INRIA's edits of rows are of the moments alone, and a stock trainer has no ledger.
            warn_user(
                f"{call}: {edited[0]} of {rows_of(mine[edited[0]])} rows beside moments of {rows}, "
                "since a trainer without parts has edited the points: what "
                f"{name} keeps is dropped, and collected anew"
            )
        elif mine and rows != rows_of(param):
            for key in mine:
                warn_user(
                    f"{call}: {key} of {rows} rows for a parameter of {rows_of(param)}: dropped, "
                    "and collected anew"
                )
        else:
            restarted = restart_rows(mine, entries, param)
            if restarted:
                warn_user(
                    f"{call}: what {name} keeps of {restarted} of {rows} rows is not finite, or "
                    "cannot be: they begin anew"
                )
            found |= mine
    return found


def _warn_of_rows_left_out(
    call: str, course: Course, last_step: int, rows: list[dict[str, Tensor]]
) -> None:
    """Torch's distributed files give only what a fresh optimizer had, too: no rows of parts."""
    found = set().union(*rows) if rows else set()
    for name, part in course.named().items():
        window = course.window_of_part(part)
        keys = [key_of(name, entry) for entry in course.declared[name].values()]
        begun = window is None or window[0] <= last_step < window[1]
        if any(key in course.row_keys for key in keys) and begun and not found & set(keys):
            warn_user(f"{call}: {name} has kept nothing in this checkpoint, and begins anew")


def _is_there(value: Any) -> bool:
    """Torch's flat checkpoints have an empty dict in the place of what they do not hold."""
    return value is not None and not (isinstance(value, dict) and not value)


def _too_many(key: str, value: Any, own: Mapping[str, Any], window: Window | None) -> bool:
    """Whether a mean of format 2 holds iterates of a shorter run: more than this window has had."""
    if own["steps"] is not None or key != "Averaging.count" or window is None or not value.numel():
        return False
    last_step = own["records"][0][0][0] if own["records"] and own["records"][0] else None
    return last_step is not None and float(value.max()) > last_step - window[0] + 1
