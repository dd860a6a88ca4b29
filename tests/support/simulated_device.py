"""GPUs that are not there: tensors that say they are on `cuda:0`, `cuda:1`, ..., and compute here.

    with SimulatedDevice() as gpu:
        means = Parameter(torch.rand(10, 3, device="cuda:0"))
        ...                                     # a training, as on a machine with GPUs
    assert gpu.synchronisations == []           # what made the host wait, and which line did it
    values = on_host(means)                     # is no synchronisation that counts

What such a tensor holds is a tensor of the CPU, so that a training on a simulated GPU computes what
the same training computes on the CPU, and can be compared with it. Beyond that it behaves as a GPU
does, in everything that an optimizer can do wrong there:

- Operators raise RuntimeError where tensors lie on different devices. Only a 0-d tensor of the host
  may be mixed with tensors of a GPU, in element-wise operators, and there not in `lerp`, `addcmul`
  and `addcdiv`, which refuse it up to torch 2.5.
- Whatever makes the host wait is noted with the line that caused it: `item`, `bool`, `float`,
  `tolist`, boolean indexing, `nonzero`, `equal`, copies from one to the other that are not
  `non_blocking`, ...
- A `non_blocking` copy to the host is not finished until the host waits for something else. Reading
  it before raises RuntimeError; a GPU would hand out what the memory held before.
- `numpy()` raises TypeError; a random generator of one device is refused by tensors of another;
  a gradient must lie where its parameter does.
- torch's optimizers take their foreach and fused paths, as for CUDA tensors.

What it does not show: speed, kernels of CUDA C++, streams, memory, the digits of a GPU's own sums,
and the numbers of a GPU's own random generators (these draw the CPU's).
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

HOST = torch.device("cpu")
PACKAGE, SUPPORT = "opt3dgs_optim", Path(__file__).name
# torch.optim hides its module `optimizer`.
OPTIMIZER = importlib.import_module("torch.optim.optimizer")
FOREACH = importlib.import_module("torch.utils._foreach_utils")

# Operators by what they do with tensors of several devices.
COPIES = {"aten::copy_", "aten::_to_copy", "aten::_foreach_copy_"}
INDEXING = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}
# In whose element-wise arithmetic a 0-d tensor of the host is refused up to torch 2.5.
STRICT = ("lerp", "addcmul", "addcdiv")
SCALARS_ALLOWED = {"aten::where", "aten::fill_", "aten::fill", "aten::masked_fill_"}
SCALARS_ALLOWED |= {"aten::masked_fill", "aten::_fused_adam_", "aten::_fused_adamw_"}
VIEWS = {"slice", "select", "view", "detach", "alias", "unsqueeze", "squeeze", "expand"}
WAITING = {"aten::is_nonzero", "aten::equal", "aten::_local_scalar_dense", "aten::nonzero"}
WAITING |= {"aten::masked_select", "aten::bincount", "aten::_unique2", "aten::unique_dim"}


class Synchronisation(NamedTuple):
    """One time that the host had to wait for a GPU."""

    kind: str  # the operator, or the direction of a copy
    line: str  # "file:line" of the innermost line of the package; of anybody's, where none is ours
    ours: bool  # whether a line of the package is on the stack

    def __str__(self) -> str:
        return f"{self.kind} at {self.line}"


class DeviceTensor(Tensor):
    """A tensor that says it is on a GPU; `held` is the CPU's tensor that holds its numbers."""

    held: Tensor
    place: torch.device

    @staticmethod
    def __new__(cls, inner: Tensor, place: torch.device) -> DeviceTensor:
        # To torch's C++ it is a tensor of the CPU: autograd needs CUDA for any other.
        outer = Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            layout=inner.layout,
            device=HOST,
            requires_grad=False,
        )
        outer.held, outer.place = inner, place
        return outer

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.place

    is_cuda = property(lambda self: True)  # pyright: ignore[reportAssignmentType]
    is_cpu = property(lambda self: False)  # pyright: ignore[reportAssignmentType]

    def __repr__(self, *, tensor_contents: Any = None) -> str:
        return f"DeviceTensor({tuple(self.shape)}, {self.dtype}, on {self.place})"

    def __deepcopy__(self, memo: dict[int, Any]) -> DeviceTensor:
        copied: Any = type(self)(self.held.clone(), self.place)
        if isinstance(self, torch.nn.Parameter):
            copied = torch.nn.Parameter(copied, self.requires_grad)
        elif self.requires_grad:
            copied.requires_grad_()
        if self.grad is not None:
            copied.grad = self.grad.__deepcopy__(memo)
        memo[id(self)] = copied
        return copied

    def __reduce_ex__(self, protocol: Any) -> Any:
        is_param = isinstance(self, torch.nn.Parameter)
        return _restored, (self.held, str(self.place), self.requires_grad, is_param)

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _called(func, args, kwargs or {})

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {}, active())


def _restored(inner: Tensor, place: str, requires_grad: bool, is_param: bool) -> Tensor:
    made = DeviceTensor(inner, torch.device(place))
    return torch.nn.Parameter(made, requires_grad) if is_param else made


class DeviceGenerator(torch.Generator):
    """A random generator of a simulated GPU, or of the CPU: the same numbers either way."""

    place: torch.device

    def __new__(cls, device: Any = "cpu") -> DeviceGenerator:
        place = placed(device)
        made = super().__new__(cls, "cpu" if place.type == "cuda" else place)  # pyright: ignore[reportCallIssue]
        made.place = place
        return made

    def __init__(self, device: Any = "cpu") -> None:
        pass

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.place


class _AnyGenerator(type(torch.Generator)):
    def __instancecheck__(cls, instance: Any) -> bool:
        return isinstance(instance, _Generator)


_Generator = torch.Generator


class _GeneratorInPlace(DeviceGenerator, metaclass=_AnyGenerator):
    """What `torch.Generator` is while GPUs are simulated: torch's own are its instances, too."""


def placed(device: Any) -> torch.device:
    """A device with its index: "cuda" is "cuda:0"."""
    found = torch.device(device) if not isinstance(device, torch.device) else device
    return torch.device("cuda", 0) if found.type == "cuda" and found.index is None else found


def on_host(value: Any) -> Any:
    """Tensors, in any nesting, as copies on the CPU; nothing is counted."""
    with _silence():
        return tree_map(lambda e: _inner(e).clone() if isinstance(e, Tensor) else e, value)


def on_device(value: Any, device: Any = "cuda:0") -> Any:
    """Tensors, in any nesting, as copies on a simulated GPU; parameters stay such; not counted."""
    place = placed(device)

    def moved(each: Any) -> Any:
        if not isinstance(each, Tensor):
            return each
        inner = each.held if isinstance(each, DeviceTensor) else each.detach()
        made = DeviceTensor(inner.clone(), place)
        if isinstance(each, torch.nn.Parameter):
            return torch.nn.Parameter(made, each.requires_grad)
        return made.requires_grad_() if each.requires_grad else made

    with _silence():
        return tree_map(moved, value)


_modes: list[SimulatedDevice] = []


def active() -> SimulatedDevice | None:
    """What simulates GPUs now, or None."""
    return _modes[-1] if _modes else None


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Nothing is counted within."""
    mode = active()
    if mode is None:
        yield
        return
    before, mode.counting = mode.counting, False
    try:
        yield
    finally:
        mode.counting = before


class SimulatedDevice(TorchDispatchMode):
    """Simulates GPUs while the `with` lasts.

    Attributes:
        synchronisations: what made the host wait so far; cleared by `forget`.
        operators: how often each operator has run on a GPU's tensors.
        copied: bytes of the GPU's tensors that `clone` has copied.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counting = True
        self._patches = contextlib.ExitStack()
        self._unfinished: list[tuple[torch.device, Tensor]] = []
        self.forget()

    def forget(self) -> None:
        """Begin to count anew."""
        self.synchronisations: list[Synchronisation] = []
        self.operators: Counter[str] = Counter()
        self.copied = 0

    @property
    def ours(self) -> list[str]:
        """The synchronisations that a line of the package caused, "KIND at FILE:LINE"."""
        return [str(each) for each in self.synchronisations if each.ours]

    def __enter__(self) -> SimulatedDevice:
        patch = self._patches.callback
        for owner, name, value in self._replacements():
            patch(setattr, owner, name, getattr(owner, name))
            setattr(owner, name, value)
        known = OPTIMIZER._foreach_supported_types
        known.append(DeviceTensor)
        patch(known.remove, DeviceTensor)
        _modes.append(self)
        patch(_modes.pop)
        self._patches.enter_context(_Functions())
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        try:
            super().__exit__(*error)
        finally:
            self._patches.close()

    def _replacements(self) -> Iterator[tuple[Any, str, Any]]:
        yield torch.cuda, "_lazy_init", lambda: None
        yield torch.cuda, "synchronize", lambda device=None: self.wait("synchronize", device)
        yield torch, "Generator", _GeneratorInPlace
        for module in (OPTIMIZER, FOREACH):
            yield module, "_group_tensors_by_device_and_dtype", _grouped

    def wait(self, kind: str, device: Any = None) -> None:
        """Note that the host waits for a GPU, which finishes the copies from there."""
        place = placed("cuda" if device is None else device)
        self._unfinished = [each for each in self._unfinished if each[0] != place]
        if self.counting:
            self.synchronisations.append(_noted(kind))

    def note(self, operator: _Operator, args: Any, place: torch.device) -> None:
        """Count an operator on a GPU's tensors, and the wait that it may cost."""
        self.operators[operator.short] += 1
        if operator.short == "clone":
            self.copied += args[0].numel() * args[0].element_size()
        if _waits(operator, args):
            self.wait(operator.short, place)

    def begin_copy(self, place: torch.device, host: Tensor) -> None:
        """Note a copy to the host that nobody has waited for."""
        self._unfinished.append((place, host))

    def check_finished(self, tensors: list[Any], operator: _Operator) -> None:
        """RuntimeError where one of the host's tensors is read that is a copy not yet finished."""
        if not self._unfinished or not self.counting or operator.short in VIEWS:
            return
        pending = {host.untyped_storage().data_ptr() for _, host in self._unfinished}
        for each in tensors:
            if isinstance(each, DeviceTensor) or each.numel() == 0:
                continue
            if each.untyped_storage().data_ptr() in pending:
                raise RuntimeError(
                    "a non_blocking copy to the host is read before the host has waited for it, "
                    f"at {_noted('').line}: on a GPU it holds anything"
                )

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(func, args, kwargs or {}, self)


def _noted(kind: str) -> Synchronisation:
    """Where it happens: the innermost line of the package, or of anybody but torch and this."""
    anybody, frame = "", sys._getframe(1)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if PACKAGE in path.parts:
            return Synchronisation(kind, f"{path.name}:{frame.f_lineno}", True)
        if not anybody and path.name != SUPPORT and "torch" not in path.parts:
            anybody = f"{path.name}:{frame.f_lineno}"
        frame = frame.f_back
    return Synchronisation(kind, anybody, False)


# -- operators -------------------------------------------------------------------------------------


class _Operator:
    """What has to be known of an operator, looked up once."""

    def __init__(self, func: Any) -> None:
        schema, tags = func._schema, func.tags
        self.name = schema.name
        self.short = schema.name.removeprefix("aten::")
        self.copies, self.indexes = self.name in COPIES, self.name in INDEXING
        is_list = self.short.startswith("_foreach_")
        plain = self.short.removeprefix("_foreach_")
        elementwise = torch.Tag.pointwise in tags or is_list
        self.takes_scalars = elementwise and not plain.startswith(STRICT)
        self.takes_scalars |= self.indexes or self.name in SCALARS_ALLOWED
        dynamic = torch.Tag.dynamic_output_shape in tags or torch.Tag.data_dependent_output in tags
        self.waits = dynamic or self.name in WAITING
        self.writes = [
            (i, argument.name)
            for i, argument in enumerate(schema.arguments)
            if argument.alias_info is not None and argument.alias_info.is_write
        ]
        self.num_returns = len(schema.returns)


_OPERATORS: dict[Any, _Operator] = {}


def _leaves(values: Any) -> list[Any]:
    """The tensors among an operator's arguments, which are tensors, or lists of them."""
    found: list[Any] = []
    for each in values:
        if isinstance(each, Tensor):
            found.append(each)
        elif isinstance(each, (list, tuple)):
            found += [item for item in each if isinstance(item, Tensor)]
    return found


def _inner(value: Any) -> Any:
    """An argument as the CPU is to see it."""
    if isinstance(value, DeviceTensor):
        return value.held
    if isinstance(value, (list, tuple)):
        return type(value)([_inner(each) for each in value])
    return value


def _wrapped(value: Any, place: torch.device) -> Any:
    """An outcome of the CPU as one of a device."""
    if isinstance(value, Tensor):
        return value if place.type != "cuda" else DeviceTensor(value, place)
    if isinstance(value, (list, tuple)):
        return type(value)([_wrapped(each, place) for each in value])
    return value


def _computed(func: Any, args: Any, kwargs: Any, mode: SimulatedDevice | None) -> Any:
    """An operator's outcome on the CPU, as a tensor of the device that it belongs to."""
    operator = _OPERATORS.get(func)
    if operator is None:
        operator = _OPERATORS[func] = _Operator(func)
    tensors = _leaves(args)
    if kwargs:
        tensors += _leaves(kwargs.values())
    devices = list(dict.fromkeys(t.place for t in tensors if isinstance(t, DeviceTensor)))
    if mode is not None:
        mode.check_finished(tensors, operator)
    asked = kwargs.get("device")
    asked = None if asked is None else placed(asked)
    if operator.short == "new_empty_strided" and devices:  # autograd's, which sees the CPU's
        asked = devices[0]
    if not devices and (asked is None or asked.type != "cuda"):
        return func(*args, **kwargs)
    if kwargs.get("pin_memory"):
        raise NotImplementedError("pinned memory is not simulated")
    kwargs = {key: _inner(value) for key, value in kwargs.items()}
    if asked is not None:
        kwargs["device"] = HOST
    if operator.copies:
        return _copied(operator, func, args, kwargs, asked)
    _check_devices(operator, args, kwargs, tensors, devices)
    if mode is not None and devices:
        mode.note(operator, args, devices[0])
    shapes = [each.shape for each in tensors] if operator.writes else []
    out = func(*[_inner(each) for each in args], **kwargs)
    if operator.writes:
        if [_inner(each).shape for each in tensors] != shapes:
            raise NotImplementedError(f"{operator.name} changes a shape in place")
        return _written(operator, args, tensors, kwargs, out)
    return _wrapped(out, asked if asked is not None else devices[0])


def _written(operator: _Operator, args: Any, tensors: Any, kwargs: Any, out: Any) -> Any:
    """The argument that an operator in place, or one with `out`, has written and returns."""
    if operator.num_returns == 0:
        return out
    outer = {id(_inner(each)): each for each in tensors}
    written = [args[i] if i < len(args) else kwargs[name] for i, name in operator.writes]
    given = [outer.get(id(each), each) for each in written]
    return given[0] if operator.num_returns == 1 else tuple(given)


def _refuse(name: str, devices: Any) -> None:
    shown = " and ".join(map(str, devices))
    raise RuntimeError(
        f"Expected all tensors to be on the same device, but found {shown} in {name}"
    )


def _check_devices(
    operator: _Operator, args: Any, kwargs: Any, tensors: list[Any], devices: list[torch.device]
) -> None:
    """RuntimeError where a GPU would raise it."""
    if len(devices) > 1:
        _refuse(operator.name, devices)
    if operator.indexes:  # the indices may lie on the host; what is indexed and put may not
        tensors = [each for each in args if isinstance(each, Tensor)]
    hosts = [each for each in tensors if not isinstance(each, DeviceTensor)]
    if not devices or not hosts:
        return
    if not operator.takes_scalars or any(each.dim() > 0 for each in hosts):
        _refuse(operator.name, [HOST, *devices])
    unwrapped = {id(each) for each in hosts}
    for i, name in operator.writes:
        written = args[i] if i < len(args) else kwargs.get(name)
        if any(id(each) in unwrapped for each in _leaves([written])):
            _refuse(operator.name, [HOST, *devices])


def _waits(operator: _Operator, args: Any) -> bool:
    """Whether the host must wait: for what it is to read, for a size, or for a copy."""
    if not operator.indexes:
        return operator.waits
    indices = [each for each in args[1] if each is not None]
    if not all(isinstance(each, DeviceTensor) for each in indices):
        return True
    masked = any(each.dtype in (torch.bool, torch.uint8) for each in indices)
    fills = operator.short != "index" and not isinstance(args[2], DeviceTensor)
    return masked and not (fills and len(indices) == 1)  # torch makes it a masked_fill


# -- copies from device to device ------------------------------------------------------------------


def _place(value: Any) -> torch.device:
    return value.place if isinstance(value, DeviceTensor) else value.device


def _note_copy(source: torch.device, target: torch.device, non_blocking: bool, made: Any) -> None:
    """Have the host wait, as it does unless it said that it would not."""
    mode = active()
    if mode is None or source == target:
        return
    if target.type == "cpu" and non_blocking:
        mode.begin_copy(source, made)
    elif target.type == "cpu":
        mode.wait("copy to the host", source)
    elif source.type == "cpu" and not non_blocking:
        mode.wait("copy to the device", target)


def _copied(
    operator: _Operator, func: Any, args: Any, kwargs: Any, asked: torch.device | None
) -> Any:
    """`copy_(to, from)` and `_to_copy(from, device=...)`: between any two devices."""
    mode = active()
    if mode is not None:
        mode.operators[operator.short] += 1
    out = func(*[_inner(each) for each in args], **kwargs)
    if operator.short == "_to_copy":
        source = _place(args[0])
        target = source if asked is None else asked
        _note_copy(source, target, kwargs.get("non_blocking", False), out)
        return _wrapped(out, target)
    pairs = zip(args[0], args[1], strict=True) if isinstance(args[0], list) else [args[:2]]
    for target, source in pairs:
        non_blocking = kwargs.get("non_blocking", len(args) > 2 and args[2])
        _note_copy(_place(source), _place(target), non_blocking, target)
    return args[0]


class _Move(torch.autograd.Function):
    """A copy on another device; the gradient comes back to where the tensor lies."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, place: torch.device, non_blocking: bool) -> Tensor:
        ctx.source = _place(value)
        made = _inner(value).clone()
        _note_copy(ctx.source, place, non_blocking, made)
        return _wrapped(made, place)

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        with torch.no_grad():
            return _Move.apply(grads[0], ctx.source, False), None, None


# -- functions that torch's C++ would answer for the CPU -------------------------------------------


class _Functions(TorchFunctionMode):
    """Has the functions below called for tensors of the host, too."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _called(func, args, kwargs or {})


def _called(func: Any, args: Any, kwargs: Any) -> Any:
    special = _SPECIAL.get(func)
    if special is not None:
        return special(func, *args, **kwargs)
    if kwargs.get("generator") is not None:
        _check_generator(kwargs["generator"], args, kwargs.get("device"))
    with torch._C.DisableTorchFunctionSubclass():
        return func(*args, **kwargs)


def _check_generator(generator: Any, args: Any, asked: Any) -> None:
    """RuntimeError where a random generator is of another kind of device than the numbers."""
    drawn_like = next((each for each in args if isinstance(each, Tensor)), None)
    place = (
        placed(asked) if asked is not None else HOST if drawn_like is None else drawn_like.device
    )
    if generator.device.type != place.type:
        raise RuntimeError(
            f"Expected a '{place.type}' device type for generator but found "
            f"'{generator.device.type}'"
        )


def _as_usual(func: Any, *args: Any, **kwargs: Any) -> Any:
    with torch._C.DisableTorchFunctionSubclass():
        return func(*args, **kwargs)


def _to(func: Any, tensor: Any, *args: Any, **kwargs: Any) -> Any:
    """`Tensor.to`: first to the other device, then to the other dtype."""
    place = _place(tensor)
    given = list(args)
    non_blocking = bool(kwargs.get("non_blocking", False))
    if given and isinstance(given[0], Tensor):
        other = given.pop(0)
        place, kwargs = _place(other), {**kwargs, "dtype": other.dtype}
    elif given and isinstance(given[0], (str, int, torch.device)):
        place = placed(given.pop(0))
        if given and isinstance(given[0], torch.dtype):
            kwargs = {**kwargs, "dtype": given.pop(0)}
    elif given and given[0] is None:
        given.pop(0)
    if given and isinstance(given[0], torch.dtype):
        kwargs = {**kwargs, "dtype": given.pop(0)}
    if given:
        non_blocking = bool(given[0])
    asked = kwargs.pop("device", None)
    place = place if asked is None else placed(asked)
    if place != _place(tensor):
        tensor = _Move.apply(tensor, place, non_blocking)
    elif kwargs.get("copy"):
        tensor = tensor.clone()
    dtype = kwargs.get("dtype")
    return tensor if dtype is None else _as_usual(func, tensor, dtype)


def _cpu(func: Any, tensor: Any, **kwargs: Any) -> Any:
    return _to(Tensor.to, tensor, HOST)


def _cuda(func: Any, tensor: Any, device: Any = None, non_blocking: bool = False) -> Any:
    place = placed("cuda" if device is None else device)
    return _to(Tensor.to, tensor, place, non_blocking=non_blocking)


def _made(func: Any, data: Any, *args: Any, device: Any = None, **kwargs: Any) -> Any:
    """`torch.tensor`, `torch.as_tensor`: made on the host, then copied."""
    if isinstance(data, DeviceTensor):
        device = data.place if device is None else placed(device)
        dtype = {"dtype": kwargs["dtype"]} if kwargs.get("dtype") is not None else {}
        made = data if func is torch.as_tensor else data.detach().clone()
        return _to(Tensor.to, made, device, **dtype)
    flat = tree_flatten(data)[0] if isinstance(data, (list, tuple)) else []
    if any(isinstance(each, DeviceTensor) for each in flat):
        data = tree_map(lambda each: each.item() if isinstance(each, Tensor) else each, data)
    made = _as_usual(func, data, *args, **kwargs)
    return made if device is None else _to(Tensor.to, made, device)


def _new(func: Any, tensor: Any, *args: Any, **kwargs: Any) -> Any:
    if isinstance(tensor, DeviceTensor) and kwargs.get("device") is None:
        kwargs = {**kwargs, "device": tensor.place}
    return _as_usual(func, tensor, *args, **kwargs)


def _where(func: Any, condition: Any, *args: Any, **kwargs: Any) -> Any:
    """A number becomes a tensor on the device; a 0-d tensor of the host is copied there."""
    chosen = [each for each in (condition, *args, *kwargs.values()) if isinstance(each, Tensor)]
    places = {_place(each) for each in chosen}
    mode = active()
    if mode is not None and len(places) > 1 and HOST in places:
        mode.wait("copy to the device", max(places, key=str))
    return _as_usual(func, condition, *args, **kwargs)


def _tolist(func: Any, tensor: Any) -> Any:
    return _as_usual(func, _to(Tensor.to, tensor.detach(), HOST))


def _format(func: Any, tensor: Any, spec: str) -> str:
    if isinstance(tensor, DeviceTensor) and tensor.dim() == 0:
        return format(tensor.item(), spec)
    return _as_usual(func, tensor, spec)


def _numpy(func: Any, tensor: Any, *args: Any, **kwargs: Any) -> Any:
    if isinstance(tensor, DeviceTensor):
        raise TypeError(
            f"can't convert {tensor.place} device type tensor to numpy. Use Tensor.cpu() to copy "
            "the tensor to host memory first."
        )
    return _as_usual(func, tensor, *args, **kwargs)


def _data_ptr(func: Any, tensor: Any) -> int:
    return _as_usual(func, _inner(tensor))


def _get_device(func: Any, tensor: Any) -> int:
    return tensor.place.index if isinstance(tensor, DeviceTensor) else -1


def _set_grad(func: Any, tensor: Any, grad: Any) -> None:
    if isinstance(grad, Tensor) and _place(grad) != _place(tensor):
        raise RuntimeError("attempting to assign a gradient with a different device")
    _as_usual(func, tensor, grad)


def _set_data(func: Any, tensor: Any, value: Any) -> None:
    if isinstance(tensor, DeviceTensor) != isinstance(value, DeviceTensor):
        raise NotImplementedError("data of another device")
    _as_usual(func, tensor, value)
    if isinstance(tensor, DeviceTensor):
        tensor.held, tensor.place = value.held, value.place


_SPECIAL: dict[Any, Any] = {
    Tensor.to: _to,
    Tensor.cpu: _cpu,
    Tensor.cuda: _cuda,
    Tensor.tolist: _tolist,
    Tensor.numpy: _numpy,
    Tensor.__array__: _numpy,
    Tensor.__format__: _format,
    Tensor.data_ptr: _data_ptr,
    Tensor.get_device: _get_device,
    Tensor.grad.__set__: _set_grad,  # pyright: ignore[reportOptionalMemberAccess, reportAttributeAccessIssue]
    Tensor.data.__set__: _set_data,  # pyright: ignore[reportAttributeAccessIssue]
    torch.where: _where,
    Tensor.where: lambda func, chosen, *args: _where(torch.where, args[0], chosen, *args[1:]),
    torch.tensor: _made,
    torch.as_tensor: _made,
}
_SPECIAL |= {
    getattr(Tensor, name): _new
    for name in ("new_zeros", "new_ones", "new_full", "new_empty", "new_tensor")
}


def _grouped(tensorlistlist: Any, with_indices: bool = False) -> Any:
    """torch's grouping of an optimizer's lists by the first's devices and dtypes."""
    found: dict[Any, Any] = {}
    for i, first in enumerate(tensorlistlist[0]):
        device = _place(first)
        lists, indices = found.setdefault((device, first.dtype), ([[] for _ in tensorlistlist], []))
        for made, given in zip(lists, tensorlistlist, strict=True):
            if not given:
                continue
            each = given[i]
            if each is not None and _place(each) not in (device, HOST):
                _refuse("_group_tensors_by_device_and_dtype", [device, _place(each)])
            made.append(each)
        if with_indices:
            indices.append(i)
    return found
