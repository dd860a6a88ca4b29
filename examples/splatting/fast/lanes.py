"""Eight float32 in one vector register, as a type inside numba kernels.

numba vectorises a loop when it likes to; a row of a tile is eight pixels wide, so the compositing
kernels say it: `Lanes` are eight numbers, `Mask` eight truths. On a machine with narrower
registers LLVM splits them. Scalars are converted to float32 and repeated.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba import types
from numba.extending import intrinsic, models, overload, register_model

WIDTH = 8
_FLOAT = ir.FloatType()
_LANES = ir.VectorType(_FLOAT, WIDTH)
_BITS = ir.VectorType(ir.IntType(32), WIDTH)


class LanesType(types.Type):
    """Eight float32."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


class MaskType(types.Type):
    """Eight truths, each 32 bits of ones or zeros, as a vector register compares."""

    def __init__(self) -> None:
        super().__init__(name="Mask")


lanes_type, mask_type = LanesType(), MaskType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _LANES)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _BITS)


def _splat(builder, scalar, vector):
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(one, one, zeros)


def _as_lanes(context, builder, value, its_type):
    if not isinstance(its_type, types.Number):  # lanes or a mask
        return value
    return _splat(builder, context.cast(builder, value, its_type, types.float32), _LANES)


def _is_lanes(*arguments) -> bool:
    return lanes_type in arguments and all(
        a == lanes_type or isinstance(a, types.Number) for a in arguments
    )


def _intrinsic_of_lanes(arity, emit, result=lanes_type):
    """An intrinsic of `arity` lanes, masks or scalars.

    `emit(builder, *values)` makes its instructions; scalars come to it as lanes.
    """

    def make(*arguments):
        def codegen(context, builder, signature, values):
            pairs = zip(values, signature.args, strict=True)
            return emit(builder, *(_as_lanes(context, builder, v, t) for v, t in pairs))

        return result(*arguments), codegen

    return intrinsic(  # numba counts the arguments
        {
            0: lambda typing_context: make(),
            1: lambda typing_context, a: make(a),
            2: lambda typing_context, a, b: make(a, b),
            3: lambda typing_context, a, b, c: make(a, b, c),
            8: lambda typing_context, a, b, c, d, e, f, g, h: make(a, b, c, d, e, f, g, h),
        }[arity]
    )


def _call(name, arity):
    kind = ir.FunctionType(_LANES, [_LANES] * arity)

    def emit(builder, *values):
        full = f"{name}.v{WIDTH}f32"
        function = builder.module.globals.get(full) or ir.Function(builder.module, kind, full)
        return builder.call(function, values)

    return emit


def _minimum(builder, a, b):
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _compare(sign):
    return lambda builder, a, b: builder.sext(builder.fcmp_ordered(sign, a, b), _BITS)


def _is_true(builder, mask):
    return builder.icmp_signed("<", mask, ir.Constant(_BITS, [0] * WIDTH))


def _raised(builder, lanes, exponents):
    """Add the last bits of `exponents` to those of the exponent."""
    whole = builder.shl(builder.bitcast(exponents, _BITS), ir.Constant(_BITS, [23] * WIDTH))
    return builder.bitcast(builder.add(builder.bitcast(lanes, _BITS), whole), _LANES)


_add = _intrinsic_of_lanes(2, lambda builder, a, b: builder.fadd(a, b))
_sub = _intrinsic_of_lanes(2, lambda builder, a, b: builder.fsub(a, b))
_mul = _intrinsic_of_lanes(2, lambda builder, a, b: builder.fmul(a, b))
_div = _intrinsic_of_lanes(2, lambda builder, a, b: builder.fdiv(a, b))
_less = _intrinsic_of_lanes(2, _compare("<"), mask_type)
_at_most = _intrinsic_of_lanes(2, _compare("<="), mask_type)
_greater = _intrinsic_of_lanes(2, _compare(">"), mask_type)
_at_least = _intrinsic_of_lanes(2, _compare(">="), mask_type)

# a b + c, with one rounding where that is fast
multiply_add = _intrinsic_of_lanes(3, _call("llvm.fmuladd", 3))
minimum = _intrinsic_of_lanes(2, _minimum)
absolute = _intrinsic_of_lanes(1, _call("llvm.fabs", 1))
# Lanes times 2 to the power that the last bits of other lanes hold
raised = _intrinsic_of_lanes(2, _raised)


def _overload_operator(operation, function):
    @overload(operation, inline="never")
    def of_lanes(a, b):
        if _is_lanes(a, b):
            return lambda a, b: function(a, b)  # noqa: PLW0108  numba compiles it
        return None


for _operation, _function in (
    (operator.add, _add),
    (operator.sub, _sub),
    (operator.mul, _mul),
    (operator.truediv, _div),
    (operator.lt, _less),
    (operator.le, _at_most),
    (operator.gt, _greater),
    (operator.ge, _at_least),
):
    _overload_operator(_operation, _function)


def _truths(builder, mask):
    byte = builder.bitcast(_is_true(builder, mask), ir.IntType(WIDTH))
    return builder.zext(byte, ir.IntType(64))


def _shuffle(builder, a, b, order):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), order))


def _total(builder, lanes):
    for half in (4, 2, 1):
        order = [(i + half) % WIDTH for i in range(WIDTH)]
        lanes = builder.fadd(lanes, _shuffle(builder, lanes, lanes, order))
    return builder.extract_element(lanes, ir.IntType(32)(0))


def _add_neighbours(builder, a, b):
    """Sums of neighbouring lanes: of a and b in turns, within each half of the register."""
    even, odd = [0, 2, 8, 10, 4, 6, 12, 14], [1, 3, 9, 11, 5, 7, 13, 15]
    return builder.fadd(_shuffle(builder, a, b, even), _shuffle(builder, a, b, odd))


def _totals(builder, *lanes):
    pairs = [_add_neighbours(builder, *lanes[i : i + 2]) for i in (0, 2, 4, 6)]
    first, second = _add_neighbours(builder, *pairs[:2]), _add_neighbours(builder, *pairs[2:])
    low, high = [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]
    return builder.fadd(
        _shuffle(builder, first, second, low), _shuffle(builder, first, second, high)
    )


# Mask and mask; lanes of a where the mask is true, of b elsewhere
both = _intrinsic_of_lanes(2, lambda builder, a, b: builder.and_(a, b), mask_type)
choose = _intrinsic_of_lanes(
    3, lambda builder, mask, a, b: builder.select(_is_true(builder, mask), a, b)
)
# The mask as the bits of an integer, lane 0 lowest; a scalar in all lanes; 0, 1, ... 7
truths = _intrinsic_of_lanes(1, _truths, types.int64)
repeat = _intrinsic_of_lanes(1, lambda builder, lanes: lanes)
count_up = _intrinsic_of_lanes(0, lambda builder: ir.Constant(_LANES, [*map(float, range(WIDTH))]))
# The sum of the lanes, in pairs; the sums of eight lanes each, as eight lanes
total = _intrinsic_of_lanes(1, _total, types.float32)
totals = _intrinsic_of_lanes(8, _totals)


def _pointer(context, builder, array_type, array, index):
    structure = context.make_array(array_type)(context, builder, array)
    return builder.bitcast(builder.gep(structure.data, [index]), _LANES.as_pointer())


@intrinsic
def load(typing_context, array, index):
    """Eight float32 of a contiguous one-dimensional array, from index on; bounds not checked."""

    def codegen(context, builder, signature, values):
        pointer = _pointer(context, builder, signature.args[0], values[0], values[1])
        return builder.load(pointer, align=4)

    return lanes_type(array, types.intp), codegen


@intrinsic
def store(typing_context, array, index, lanes):
    """Write eight float32, as `load` reads them."""

    def codegen(context, builder, signature, values):
        pointer = _pointer(context, builder, signature.args[0], values[0], values[1])
        builder.store(values[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), codegen


@intrinsic
def from_bits(typing_context, bits):
    """The mask whose lane i is bit i of an integer."""

    def codegen(context, builder, signature, values):
        own = ir.Constant(_BITS, [1 << lane for lane in range(WIDTH)])
        every = _splat(builder, builder.trunc(values[0], ir.IntType(32)), _BITS)
        return builder.sext(builder.icmp_signed("==", builder.and_(every, own), own), _BITS)

    return mask_type(bits), codegen


@intrinsic
def prefetch(typing_context, array, row):
    """Ask for two cache lines of a row of a contiguous two-dimensional array, for later."""

    def codegen(context, builder, signature, values):
        array_type = signature.args[0]
        structure = context.make_array(array_type)(context, builder, values[0])
        strides = builder.extract_value(structure.strides, 0)
        address = builder.add(
            builder.ptrtoint(structure.data, strides.type), builder.mul(strides, values[1])
        )
        byte, whole = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, whole, whole, whole])
        name = "llvm.prefetch.p0"
        function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
        for offset in (0, 64):
            place = builder.add(address, ir.Constant(strides.type, offset))
            arguments = [whole(0), whole(3), whole(1)]  # to read, keep close, data
            builder.call(function, [builder.inttoptr(place, byte), *arguments])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen
