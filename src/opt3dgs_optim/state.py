"""The state of a parameter: Adam's moments, what parts keep, and to whose rows it belongs."""

from __future__ import annotations

import cmath
import math
import weakref
from collections.abc import Iterable, Iterator, Mapping, MutableMapping, Sequence
from numbers import Complex, Integral, Real
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from opt3dgs_optim.checks import as_float, check_keys
from opt3dgs_optim.names import ADAM_KEYS, MOMENTS
from opt3dgs_optim.part import Kept

Rows = Tensor | np.ndarray | Sequence[int] | Sequence[bool]  # indices, or a mask
Declared = Mapping[str, Mapping[str, Kept]]  # a part's name -> a name -> what it keeps under it


def key_of(part: str, kept: Kept) -> str:
    """Where a part keeps something: in `optimizer.state[param]`, if it is kept per row."""
    return f"{part}.{kept.name}"


def rows_of(param: Tensor) -> int:
    """The number of points of a parameter; a number alone is one."""
    return param.shape[0] if param.dim() else 1


def broadcast_rows(rows: Tensor, like: Tensor) -> Tensor:
    """[N] as [N, 1, ..] for broadcasting over `like` [N, ..]; 0-d as it is."""
    return rows.reshape(-1, *[1] * (like.dim() - 1)) if rows.dim() else rows


def is_finite_sum(tensor: Tensor) -> bool:
    """Whether a tensor's sum is finite, and so all of it: one pass, no copy. Waits for a device.

    False where a summand is not finite, or where the sum of finite ones overflows.
    """
    return cmath.isfinite(tensor.sum().item())


class RowOwnership:
    """Remembers to which rows of which parameter the tensors that parts keep belong.

    Some trainers edit every tensor of the state by rows, others (INRIA, 3dgs-mcmc) the two moments
    only. The rule that is safe with all of them: what was not seen with this parameter object, at
    this number of rows, is dropped. The number of rows alone is not enough, because pruning and
    splitting between two steps can bring it back to what it was.
    """

    def __init__(self) -> None:
        self._owners: Any = WeakIdKeyDictionary()  # kept tensor -> (weak parameter, rows)

    def drop_foreign(self, param: Tensor, state: dict[str, Any], keys: Iterable[str]) -> None:
        """Remove the tensors under `keys` that are of other rows than the parameter's present."""
        # What a stock optimizer has loaded may be anything, and is checked after the upgrade.
        for key in [key for key in keys if isinstance(state.get(key), Tensor)]:
            owner, rows = self._owners.get(state[key], (None, 0))
            if owner is None or owner() is not param or rows != rows_of(param):
                del state[key]

    def claim(self, param: Tensor, state: dict[str, Any], keys: Iterable[str]) -> None:
        """Take the tensors under `keys` as those of the parameter's present rows."""
        for key in keys:
            if isinstance(state.get(key), Tensor):
                self._owners[state[key]] = weakref.ref(param), rows_of(param)


class HeldRows:
    """Rows of a parameter [N, ..] that a mask holds still in Adam's step: put back after it.

    `moving` [N] bool are the others. Adam's step count is the whole parameter's and goes on. It
    takes a copy of the parameter and of its moments, see `PickedRows`.
    """

    def __init__(self, moving: Tensor, param: Tensor, state: Mapping[str, Any]) -> None:
        # .data: putting back is no write that a part should notice by the version counter.
        tensors = [param.data, *(state[key] for key in MOMENTS if key in state)]
        self._saved = [(each, each.clone(), broadcast_rows(moving, each)) for each in tensors]

    @torch.no_grad()
    def put_back(self) -> None:
        """Give the rows that were not to move what they had."""
        for tensor, saved, moving in self._saved:
            torch.where(moving, tensor, saved, out=tensor)


class PickedRows:
    """Rows of a parameter [N, ..] that a mask lets move, in a tensor of their own for Adam's step.

    The time of it is that of these rows. It is for a CPU: a GPU would have to be waited for to know
    how many they are. torch's fused step rounds the last few numbers of a tensor otherwise than the
    rest, so that the same rows in another tensor would not get the same bits.

    Args:
        moving: [N] bool, which rows.
        grad: what Adam is fed with, of the parameter's shape.

    Attributes:
        tensor: the rows, with their gradient.
        state: Adam's of these rows; the step count is the whole parameter's.
    """

    def __init__(
        self, moving: Tensor, param: Tensor, grad: Tensor, state: Mapping[str, Any]
    ) -> None:
        self._index = moving.nonzero().squeeze(1)
        # .data: putting back is no write that a part should notice by the version counter.
        self._rows = param.data
        self._moments = {key: state[key] for key in MOMENTS if key in state}
        self.tensor = self._rows.index_select(0, self._index)
        self.tensor.grad = grad.index_select(0, self._index)
        picked = {key: each.index_select(0, self._index) for key, each in self._moments.items()}
        self.state = {"step": state["step"], **picked}

    @torch.no_grad()
    def put_back(self) -> None:
        """Put the rows and their moments, as Adam has left them, where they are from."""
        self._rows.index_copy_(0, self._index, self.tensor)
        for key, moment in self._moments.items():
            moment.index_copy_(0, self._index, self.state[key])


class ParameterRecord:
    """What is known of the parameter at one place of an optimizer's groups.

    Density control puts other parameter objects there; what a part keeps *per parameter*, and the
    clock of the last step, belong to the place.

    Attributes:
        last_step: the iteration of the parameter's last step, whether that counted or not; None
            before the first.
        last_moved: that of its last step with a learning rate above 0 and a gradient required.
        units: the parts in whose units Adam's moments are; None where there are no moments yet.
        param: the parameter that was there last, weakly; None before any.
        numbers: what parts keep per parameter, key -> 0-d tensor.
    """

    def __init__(self) -> None:
        self.last_step: int | None = None
        self.last_moved: int | None = None
        self.units: tuple[str, ...] | None = None
        self.param: weakref.ref[Tensor] | None = None
        self.numbers: dict[str, Tensor] = {}
        self._view: ParameterState | None = None

    def view(
        self, param: Tensor, adam: dict[str, Any], declared: Declared, training: dict[str, Tensor]
    ) -> ParameterState:
        """The state that hooks see, until `let_go`.

        Args:
            adam: `optimizer.state[param]`.
            declared: what the parts keep.
            training: what parts keep per training, shared by all optimizers.
        """
        view = self._view
        if view is None:
            view = self._view = ParameterState(param, adam, self, declared, training)
        view.param, view.adam = param, adam
        if self.param is None or self.param() is not param:
            self.param = weakref.ref(param)
        view.release()
        return view

    def forget_after(self, iteration: int) -> None:
        """Know of no step after an iteration: the clock was set back, and they are to come."""
        if self.last_step is not None and self.last_step > iteration:
            self.last_step = None

    def is_of(self, param: Tensor) -> bool:
        """Whether that parameter was there last."""
        return self.param is not None and self.param() is param

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_view": None, "param": None}


def records_of(
    params: list[Tensor],
    records: list[ParameterRecord],
    elsewhere: Iterable[ParameterRecord] = (),
) -> list[ParameterRecord]:
    """One record for each of a group's parameters, of the records that it has had.

    A parameter that was there keeps its own, wherever it stands now. Another one has the record of
    its place, where density control has put it, if nobody else has that. Where places have gone,
    nobody knows which, and it begins anew. `elsewhere` are the records of other groups, where a
    parameter may have stood.
    """
    before = [None if record.param is None else record.param() for record in records]
    known = {id(param): i for i, param in enumerate(before) if param is not None}
    kept = {known[id(param)] for param in params if id(param) in known}
    moved = {id(r.param()): r for r in elsewhere if r.param is not None and r.param() is not None}
    free = range(len(records)) if len(records) <= len(params) else ()
    found = list[ParameterRecord]()
    for place, param in enumerate(params):
        i = known.get(id(param), place if place in free and place not in kept else None)
        if id(param) not in known and id(param) in moved:
            found.append(moved[id(param)])
        else:
            found.append(ParameterRecord() if i is None else records[i])
        found[-1].param = weakref.ref(param)
    return found


def are_of(records: list[ParameterRecord], params: list[Tensor]) -> bool:
    """Whether each record is that of the parameter at its place."""
    return len(records) == len(params) and all(map(ParameterRecord.is_of, records, params))


class ParameterState(MutableMapping[str, Any]):
    """The `state` of the hooks: Adam's moments, and what the part that is asked keeps.

    While it is `guarded`, each tensor that a hook reads is saved before, so that what the hook
    writes can be undone: where a mask holds rows still, or where the step does not count.
    """

    def __init__(
        self,
        param: Tensor,
        adam: dict[str, Any],
        record: ParameterRecord,
        declared: Declared,
        training: dict[str, Tensor],
    ) -> None:
        self.param: Tensor = param
        self.adam: dict[str, Any] = adam
        self._record, self._declared, self._training = record, declared, training
        self._part, self._kept = "", dict[str, Kept]()
        self._guarded = self._moments_guarded = False
        self._saved: list[tuple[dict[str, Any], str, Tensor]] = []

    @property
    def last_step(self) -> int | None:
        """The iteration of the parameter's last step, see `ParameterRecord`."""
        return self._record.last_step

    def of(self, part: str) -> ParameterState:
        """This state as the part of that name sees it."""
        self._part, self._kept = part, self._declared[part]
        return self

    def let_go(self) -> None:
        """Hold no parameter and no moments after a step: density control may replace them."""
        nothing: Any = None
        self.param = self.adam = nothing

    def release(self) -> None:
        """Forget what a step has saved that an exception has ended."""
        if self._guarded:
            self._saved, self._guarded, self._moments_guarded = [], False, False

    def guard(self, moments: bool) -> None:
        """Save what hooks read from now on, until `settle`; Adam's moments too if `moments`."""
        self._guarded, self._moments_guarded = True, moments

    @torch.no_grad()
    def settle(self, rows: Tensor | None, counts: Tensor | bool) -> None:
        """Undo what hooks have written to rows that are held still, or in a step that is dropped.

        An edit of Adam's moments holds in a dropped step, too, as it does without a mask.

        Args:
            rows: [N] bool, those that move; None: all.
            counts: whether the step counts, 0-d on the parameter's device where it is a tensor.
        """
        saved, self._saved = self._saved, []
        self._guarded = self._moments_guarded = False
        for store, key, old in saved:
            new = store.setdefault(key, old)
            keep = True if store is self.adam and key in ADAM_KEYS else counts
            if rows is not None and old.dim():
                keep = broadcast_rows(rows, old) & keep
            if keep is not True:
                new.copy_(torch.where(torch.as_tensor(keep, device=new.device), new, old))

    def _place(self, kept: Kept) -> dict[str, Any]:
        if kept.per == "row":
            return self.adam
        return self._record.numbers if kept.per == "parameter" else self._training

    def _find(self, kept: Kept) -> Tensor:
        store, key = self._place(kept), f"{self._part}.{kept.name}"
        tensor = store.get(key)
        if tensor is None:
            tensor = store[key] = kept.make(self.param)
        elif tensor.device != self.param.device:  # numbers of a checkpoint, offloaded parameters
            tensor = store[key] = tensor.to(self.param.device)
        if kept.per != "row" and tensor.dtype != kept.dtype_for(self.param):
            tensor = store[key] = tensor.to(kept.dtype_for(self.param))  # read of a checkpoint
        if self._guarded:
            self._save(store, key, tensor)
        return tensor

    def _save(self, store: dict[str, Any], key: str, tensor: Tensor) -> None:
        if not any(key == known and store is place for place, known, _ in self._saved):
            self._saved.append((store, key, tensor.clone()))

    def __getitem__(self, name: str) -> Any:
        kept = self._kept.get(name)
        if kept is not None:
            return self._find(kept)
        if name not in self.adam:
            part, allowed = self._part, ", ".join(self)
            raise KeyError(f"{part} does not declare {name!r} in keeps; there are {allowed}")
        value = self.adam[name]
        if self._moments_guarded and name in ADAM_KEYS:
            self._save(self.adam, name, value)
        return value

    def peek(self, name: str) -> Tensor:
        """One of Adam's moments, to be read, or edited by what is zero where the gradient is.

        A row that is held still, and a step that does not count, have a gradient of zero, so that
        such an edit needs no copy to be undone with.
        """
        return self.adam[name]

    @torch.no_grad()
    def __setitem__(self, name: str, value: Any) -> None:
        tensor = self[name]
        if value is not tensor:
            tensor.copy_(value) if isinstance(value, Tensor) else tensor.fill_(value)

    def exchange(self, name: str, tensor: Tensor) -> None:
        """Keep these rows in the place of those under `name`: the same numbers, laid out anew."""
        kept = self._kept[name]
        self._place(kept)[key_of(self._part, kept)] = tensor

    def __delitem__(self, name: str) -> None:
        kept = self._kept[name]
        self._place(kept).pop(key_of(self._part, kept), None)

    def __contains__(self, name: object) -> bool:
        return name in self._kept or (name in ADAM_KEYS and name in self.adam)

    def __iter__(self) -> Iterator[str]:
        return iter([*(key for key in ADAM_KEYS if key in self.adam), *self._kept])

    def __len__(self) -> int:
        return len(list(iter(self)))


def check_mask(call: str, masks: list[Any], num_points: int | None) -> Tensor:
    """The only mask as a flat bool tensor [N]; ValueError where there is another number of them."""
    if len(masks) != 1:
        raise ValueError(f"{call}.step: {len(masks)} masks, but one is needed")
    mask = masks[0]
    if not isinstance(mask, Tensor) or mask.dim() == 0 or mask.is_complex():
        raise ValueError(f"{call}.step: visible={mask!r}, but a mask of shape [N] is needed")
    mask = mask.detach().reshape(-1)
    if num_points is not None and num_points != mask.numel():
        raise ValueError(
            f"{call}.step: num_points={num_points}, but the mask has {mask.numel()} rows"
        )
    return mask if mask.dtype == torch.bool else mask != 0


def check_rows(call: str, rows: Rows, param: Tensor) -> Tensor:
    """Which rows of a parameter [N, ..] are meant: [K] int64 indices, or an [N] bool mask.

    Raises:
        ValueError: they are none, or there are no such rows.
    """
    needed = f"indices of, or a bool mask over, {rows_of(param)} rows are needed"
    if not isinstance(rows, (Tensor, np.ndarray, list, tuple, range)):
        raise ValueError(f"{call}: rows={rows!r}, but {needed}")
    try:
        # A copy: torch takes no array of numpy with negative strides, and warns of read-only ones.
        given = np.array(rows) if isinstance(rows, np.ndarray) else rows
        index = torch.as_tensor(given, device=param.device)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ValueError(f"{call}: rows={rows!r}, but {needed}") from error
    if not index.numel() and not isinstance(rows, Tensor):
        index = index.to(torch.bool if index.dtype == torch.bool else torch.int64)  # [] is of float
    if index.dtype == torch.uint8:
        raise ValueError(
            f"{call}: rows={rows!r} may be indices or, as torch takes uint8, a mask; int64 or bool "
            "is needed"
        )
    if index.dtype == torch.bool:
        if index.shape == param.shape[:1]:
            return index
    elif not index.is_floating_point() and not index.is_complex() and param.dim():
        index, count = index.to(torch.int64), rows_of(param)
        if not index.numel() or (-count <= int(index.min()) and int(index.max()) < count):
            return index
    raise ValueError(f"{call}: rows={rows!r}, but {needed}")


def check_moments(call: str, param: Tensor, saved: Any, *, amsgrad: bool = False) -> None:
    """ValueError unless these are the step count and Adam's moments of a parameter like `param`.

    The number of rows may differ from the parameter's, but is one: some trainers load the optimizer
    first, the points afterwards. One pass over each moment, and a wait for its device.

    Args:
        call: what messages name.
        param: the parameter.
        saved: what a checkpoint has for it.
        amsgrad: whether the largest second moment must be there.
    """
    check_keys(call, saved, ADAM_KEYS if amsgrad else ADAM_KEYS[:-1])
    step = saved["step"]
    if isinstance(step, Tensor):
        real = step.numel() == 1 and step.dtype != torch.bool and not step.is_complex()
        step = step.item() if real else None
    if not 0 <= as_float(step) < math.inf:
        raise ValueError(f"{call}: step={saved['step']!r}, but a number of steps is needed")
    for key in [key for key in MOMENTS if key in saved]:
        value = saved[key]
        fits = isinstance(value, Tensor) and value.dim() == param.dim()
        if not fits or value.shape[1:] != param.shape[1:]:
            shape = tuple(value.shape) if isinstance(value, Tensor) else value
            raise ValueError(
                f"{call}: {key} has shape {shape}, but the parameter has {tuple(param.shape)}"
            )
        if value.shape != saved["exp_avg"].shape:
            raise ValueError(
                f"{call}: {key} has {rows_of(value)} rows, but exp_avg has "
                f"{rows_of(saved['exp_avg'])}, and one number of rows is needed"
            )
        fits = value.is_complex() if param.is_complex() else value.is_floating_point()
        if not fits or value.layout is not torch.strided:
            raise ValueError(
                f"{call}: {key} is of {value.dtype}, {value.layout}, but a dense moment of a "
                f"parameter of {param.dtype} is needed"
            )
        _check_finite(call, key, value.detach(), param.detach())


def _check_finite(call: str, key: str, moment: Tensor, param: Tensor) -> None:
    """ValueError where a moment would make a number of the parameter one that is not finite.

    Two things are let through, since they are no damage. In float16 the square of a gradient above
    256 is infinite, and Adam's step is then zero, in the stock trainer, too: a healthy run has
    such second moments, and could not be resumed otherwise. And where the parameter itself is not
    finite, as a point that a trainer has lost and not removed yet, there is nothing left to break.
    """
    if moment.numel() == 0:
        return
    second = key != "exp_avg"  # a mean of squares
    may_overflow = second and moment.dtype == torch.float16
    numbers = torch.view_as_real(moment.resolve_conj()) if moment.is_complex() else moment
    lowest = 0.0 if second else -torch.finfo(numbers.dtype).max
    low, high = (each.item() for each in torch.aminmax(numbers))  # NaN where there is one
    if low >= lowest and (high < math.inf or may_overflow):
        return
    sound = numbers >= lowest
    if not may_overflow:
        sound &= numbers < math.inf
    if moment.is_complex():
        sound = sound.all(-1)
    if moment.shape == param.shape:
        sound |= ~param.isfinite().to(sound.device)
    wrong = int((~sound).reshape(rows_of(moment), -1).any(1).sum())
    if wrong:
        raise ValueError(
            f"{call}: {key} is not finite{', or below 0,' if second else ''} in {wrong} of "
            f"{rows_of(moment)} rows; zeros for all moments of a row let it begin anew"
        )


def check_kept_number(call: str, key: str, kept: Kept, value: Any) -> Any:
    """What a part keeps as a number, as Python's; ValueError where it cannot be that.

    The smallest of what has not begun yet is infinite. Other numbers are finite.
    """
    kind: Any = int
    numbers: type = Integral
    if kept.dtype == torch.bool:
        kind = numbers = bool
    elif kept.dtype.is_complex:
        kind, numbers = complex, Complex
    elif kept.dtype.is_floating_point:
        kind, numbers = float, Real
    try:
        if isinstance(value, numbers) and isinstance(value, bool) == (kind is bool):
            number = kind(value)
            torch.tensor(number, dtype=kept.dtype, device="cpu")  # raises where it does not fit
            finite = cmath.isfinite(number) or not cmath.isfinite(kept.initial)
            if finite and (kept.allowed is None or kept.allowed[0] <= number <= kept.allowed[1]):
                return number
    except (OverflowError, RuntimeError, ValueError):
        pass
    within = "" if kept.allowed is None else " in [{:g}, {:g}]".format(*kept.allowed)
    raise ValueError(f"{call}: {key}={value!r}, but a number of {kept.dtype}{within} is needed")


def check_kept(call: str, key: str, kept: Kept, value: Any, param: Tensor) -> None:
    """ValueError unless `value` is what a part keeps per row of a parameter, of however many rows.

    Which of its rows are finite is looked at by `restart_rows`.
    """
    if not isinstance(value, Tensor):
        raise ValueError(f"{call}: {key}={value!r}, but a tensor is needed")
    needed = kept.shape_for(param)
    if param.dim() and value.dim():
        needed = (len(value), *needed[1:])
    dense = "" if value.layout is torch.strided else "dense "
    if tuple(value.shape) != needed or dense:
        raise ValueError(
            f"{call}: {key} has shape {tuple(value.shape)}, but {dense}{needed} is needed beside a "
            f"parameter of shape {tuple(param.shape)}"
        )
    if value.dtype != kept.dtype_for(param):
        raise ValueError(
            f"{call}: {key} is of {value.dtype}, but {kept.dtype_for(param)} is needed"
        )


def restart_rows(kept: dict[str, Tensor], entries: Mapping[str, Kept], param: Tensor) -> int:
    """Zero the rows of what a part keeps that are not finite, or not allowed; return how many.

    A row of zeros means "nothing yet". Rows whose parameter is not finite either stay as they are:
    those of a point that a healthy run has lost, which goes on bit for bit.

    Args:
        kept: [N, ..] each, of one part. What has rows to be zeroed is replaced, not written to.
        entries: how they are declared.
        param: the parameter, [N, ..].
    """
    wrong = torch.zeros(param.shape[:1], dtype=torch.bool, device=param.device)
    for key, value in kept.items():
        if (value.is_floating_point() or value.is_complex()) and not is_finite_sum(value):
            wrong |= ~_finite_rows(value, wrong.shape).to(wrong.device)
        allowed = entries[key].allowed
        if allowed is not None and not value.is_complex():
            beyond = (value < allowed[0]) | (value > allowed[1])
            while beyond.dim() > wrong.dim():
                beyond = beyond.any(-1)
            wrong |= beyond.to(wrong.device)
    if not bool(wrong.any()):
        return 0
    wrong &= _finite_rows(param.detach(), wrong.shape)
    for key, value in kept.items():
        rows = broadcast_rows(wrong.to(value.device), value)
        kept[key] = value.masked_fill(rows, 0)
    return int(wrong.sum())


def _finite_rows(tensor: Tensor, shape: torch.Size) -> Tensor:
    """Which rows of a tensor [N, ..] are finite, bool, of the shape [N]; 0-d of a number alone."""
    return tensor.isfinite().reshape(*shape, -1).all(-1)
