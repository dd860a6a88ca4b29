"""What is known in the middle of a step: the parts that act, and the parameters that move."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from opt3dgs_optim.overrides import TemporaryOverrides, WeightDecay
from opt3dgs_optim.part import Group, Part, overrides
from opt3dgs_optim.state import (
    HeldRows,
    ParameterRecord,
    ParameterState,
    PickedRows,
    broadcast_rows,
)

if TYPE_CHECKING:
    from opt3dgs_optim.course import Course

NamedPart = tuple[str, Part]


@dataclass(slots=True)
class ActingParts:
    """The parts that act on a group in a step, by their hooks, with their names.

    Attributes:
        any: whether there are any.
        shaping: whether Adam may be fed another gradient.
        units: the names of those in whose units Adam's moments are, see `Part.own_units`.
    """

    before: list[NamedPart]
    factor: list[NamedPart]
    displacement: list[NamedPart]
    after: list[NamedPart]
    any: bool = field(init=False)
    shaping: bool = field(init=False)
    units: tuple[str, ...] = field(init=False)
    _asked: list[NamedPart] = field(init=False)  # those that may not be ready
    _narrowed: dict[frozenset[str], ActingParts] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.units = tuple(name for name, part in self.before if part.own_units)
        self.shaping = bool(self.before or self.displacement)
        self.any = bool(self.shaping or self.factor or self.after)
        self._asked = [pair for pair in self._every() if overrides(pair[1], "ready")]

    @classmethod
    def sought(cls, find: Callable[[str], list[NamedPart]]) -> ActingParts:
        """What `find` finds for the name of each hook."""
        return cls(*map(find, STEP_HOOKS))

    def _every(self) -> list[NamedPart]:
        found = {name: part for hook in STEP_HOOKS for name, part in getattr(self, hook)}
        return list(found.items())

    def ready_for(self, group: Group, course: Course) -> ActingParts:
        """Without those that cannot act on the group in this step, or leave it to another."""
        if not (self._asked or self.units):
            return self
        lacking = frozenset(name for name, part in self._asked if not part.ready(group, course))
        if lacking not in self._narrowed:
            left = [(name, part) for name, part in self._every() if name not in lacking]
            if any(part.own_units for _, part in left):
                left = [(name, part) for name, part in left if not part.spares_own_units]
            names = {name for name, _ in left}
            self._narrowed[lacking] = ActingParts.sought(
                lambda hook: [pair for pair in getattr(self, hook) if pair[0] in names]
            )
        return self._narrowed[lacking]

    def check_options(self, call: str, group: Group) -> None:
        """ValueError where Adam's step is to have a graph, while parts have it move a buffer."""
        if group["differentiable"]:
            names = ", ".join(name for name, _ in self.displacement)
            raise ValueError(
                f"{call}.step: differentiable=True with {names} is not possible: the buffer that "
                "Adam moves keeps no graph"
            )

    def feed(
        self, group: Group, param: Tensor, grad: Tensor, state: ParameterState, course: Course
    ) -> Tensor:
        """What Adam is fed in the place of a gradient."""
        for name, part in self.before:
            found = part.before(group, param, grad, state.of(name), course)
            if found is not grad:
                _check_returned(name, "before", found, grad)
                grad = _laid_out_as(grad, found)
        return grad

    def factors(self, group: Group, course: Course) -> list[float | Tensor]:
        """The factors on the group's step that are not None."""
        found = list[Any]()
        for name, part in self.factor:
            factor: Any = part.factor(group, course)
            if factor is None:
                continue
            if not _is_number(factor):
                raise ValueError(f"{name}.factor: {factor!r}, but a finite number is needed")
            found.append(factor)
        return found

    def displace(
        self, group: Group, param: Tensor, step: Tensor, state: ParameterState, course: Course
    ) -> Tensor:
        """What the parameter moves by in the place of Adam's step.

        The last part first: it made of what the others had fed what Adam has seen.
        """
        for name, part in reversed(self.displacement):
            found = part.displacement(group, param, step, state.of(name), course)
            _check_returned(name, "displacement", found, step)
            step = found
        return step


STEP_HOOKS = tuple(each.name for each in fields(ActingParts) if each.init)
NO_PARTS = ActingParts([], [], [], [])


@dataclass(slots=True)
class MovingParameter:
    """A parameter in the middle of a step.

    Attributes:
        state: what the hooks see of its state.
        rows: [N] bool, those that a mask lets move; None: all.
        counts: whether the step counts, 0-d where only the device knows.
        guarded: whether something of what the hooks do is to be undone.
        masked: what has torch's own step move the rows of a mask alone; None without a mask.
        buffer: where Adam writes its step, if a part says what becomes of it; else None.
    """

    group: Group
    param: Tensor
    state: ParameterState
    parts: ActingParts
    rows: Tensor | None
    counts: Tensor | bool
    guarded: bool
    masked: HeldRows | PickedRows | None = None
    buffer: Tensor | None = None

    def where_it_moves(self, new: Tensor, old: Tensor | float) -> Tensor:
        """`new` in the rows that move, if the step counts, else `old`."""
        keep: Any = self.counts
        if self.rows is not None:
            keep = broadcast_rows(self.rows, new) & keep
        return torch.where(torch.as_tensor(keep, device=new.device), new, old)


@dataclass(slots=True)
class StepInProgress:
    """What a step has to finish, or to undo, once Adam has moved the parameters.

    Attributes:
        fed: parameters, and what Adam is fed in the place of their gradients.
        moved: groups, and what Adam moves in the place of their parameters.
    """

    mask: Tensor | None
    acting: bool
    counts: Tensor | bool
    overrides: TemporaryOverrides
    moving: list[MovingParameter] = field(default_factory=list)
    decays: list[WeightDecay] = field(default_factory=list)
    fed: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    moved: list[tuple[Group, list[Tensor]]] = field(default_factory=list)
    _renewed: list[tuple[ParameterRecord, Any, dict[str, Any], dict[str, Any]]] = field(
        default_factory=list
    )

    def put_in_place(self) -> None:
        """Have Adam read what the hooks have said, now that none looks at the Gaussians any more.

        Before that a hook of a later group would find Adam's buffers in the place of the trainer's
        tensors.
        """
        for param, fed in self.fed:
            self.overrides.attribute(param, "grad", fed)
        for group, params in self.moved:
            self.overrides.item(group, "params", params)

    def remember(self, record: ParameterRecord, state: dict[str, Any] | None) -> None:
        """Of a parameter whose moments may begin anew: their units, and what its state holds."""
        known = {} if state is None else state
        self._renewed.append((record, record.units, known, dict(known)))

    def take_back(self) -> None:
        """Undo what no override undoes: a hook has raised, and there will be no step."""
        for record, units, state, moments in self._renewed:
            record.units = units
            state.update(moments)


def _is_number(factor: Any) -> bool:
    """Whether it is a finite real number, or a tensor of one; a device's is not read."""
    if isinstance(factor, Tensor):
        one = factor.numel() == 1 and not factor.is_complex()
        return one and (not factor.is_cpu or math.isfinite(factor.item()))
    return isinstance(factor, Real) and math.isfinite(factor)


def _laid_out_as(like: Tensor, found: Tensor) -> Tensor:
    """The same numbers in the memory layout and dtype of a gradient.

    torch's fused step reads a gradient as if it lay in memory as the parameter does.
    """
    if found.dtype == like.dtype and found.stride() == like.stride():
        return found
    return torch.empty_like(like).copy_(found.detach())


def _check_returned(name: str, hook: str, found: Any, like: Tensor) -> None:
    """ValueError unless what a part's hook has returned is a tensor of the shape of `like`."""
    if not isinstance(found, Tensor):
        got = repr(found)
    elif found.shape != like.shape:
        got = f"a tensor of shape {tuple(found.shape)}"
    elif found.layout is not like.layout or (found.is_complex() and not like.is_complex()):
        got = f"a tensor of {found.dtype} and {found.layout}"
    else:
        return
    raise ValueError(
        f"{name}.{hook}: returned {got}, but a tensor of shape {tuple(like.shape)}, {like.dtype} "
        f"and {like.layout} is needed"
    )


def check_mask_fits(
    call: str, groups: Iterable[Group], mask: Tensor, is_about: Callable[[Group, int], bool]
) -> None:
    """ValueError unless a mask [N] fits the parameters that it is about, and there are any.

    Only those with a gradient: the others are not stepped, and it may be older than they are.

    Args:
        call: whose step it is.
        is_about: whether a mask of so many rows is about a group.
    """
    rows, present = mask.numel(), list[tuple[Group, Tensor]]()
    for group in groups:
        if group["differentiable"]:
            raise ValueError(f"{call}.step: a mask with differentiable=True is not possible")
        present += [(group, param) for param in group["params"] if param.grad is not None]
    shapes = [tuple(param.shape) for group, param in present if is_about(group, rows)]
    if present and (not shapes or any(shape[:1] != (rows,) for shape in shapes)):
        shapes = shapes or [tuple(param.shape) for _, param in present]
        raise ValueError(
            f"{call}.step: the mask has {rows} rows, but the parameters have shapes {shapes}; a "
            "mask of their first dimension is needed"
        )
