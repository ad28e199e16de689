"""Sixteen numbers as one value, for the Numba engines: `Lanes` add, multiply and compare as a number does.

Numba has no vector type; this one lives in a register, so that a pixel block's sums never touch memory. Without Numba
(NUMBA_DISABLE_JIT) the same code runs on rows of a NumPy array, which check what is loaded and stored.
"""

from __future__ import annotations

import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, overload, register_model

from ._vectors import FLOATS, I32, INTS, LANES, all_lanes, data, load, store, vector_at

BOOLS = ir.VectorType(ir.IntType(1), LANES)
FMA = ("contract", "nsz")  # products and sums may fuse; infinities and NaN keep their meaning


class LanesType(types.Type):
    def __init__(self):
        super().__init__("lanes")

    def can_convert_from(self, typingctx, other):
        return 1 if isinstance(other, types.Float) else None


class MaskType(types.Type):
    def __init__(self):
        super().__init__("mask")


lanes, mask = LanesType(), MaskType()


@register_model(LanesType)
class LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, FLOATS)


@register_model(MaskType)
class MaskModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, BOOLS)


@lower_cast(types.Float, LanesType)
def _spread(context, builder, fromty, toty, value):
    return all_lanes(builder, context.cast(builder, value, fromty, types.float32))


def _binary(symbol, result, operands, emit):
    """Make an operator of Python's act on lanes."""

    @infer_global(symbol)
    class Template(AbstractTemplate):
        def generic(self, args, kws):
            fits = len(args) == 2 and any(isinstance(x, type(operands)) for x in args)
            if fits and all(isinstance(x, type(operands) | types.Float) for x in args):
                return signature(result, operands, operands)

    @lower_builtin(symbol, type(operands), type(operands))
    def lower(context, builder, sig, args):
        return emit(builder, *args)


_binary(operator.add, lanes, lanes, lambda b, x, y: b.fadd(x, y, flags=FMA))
_binary(operator.sub, lanes, lanes, lambda b, x, y: b.fsub(x, y, flags=FMA))
_binary(operator.mul, lanes, lanes, lambda b, x, y: b.fmul(x, y, flags=FMA))
_binary(operator.truediv, lanes, lanes, lambda b, x, y: b.fdiv(x, y, flags=("arcp", *FMA)))
_binary(operator.ge, mask, lanes, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_binary(operator.lt, mask, lanes, lambda b, x, y: b.fcmp_ordered("<", x, y))
_binary(operator.and_, mask, mask, lambda b, x, y: b.and_(x, y))


# Functions: in Python first, which is what they mean, then for the compiler.


def fetch(array, at):
    """The sixteen numbers of a flat array from `at` on."""
    if not 0 <= at <= len(array) - LANES:
        raise IndexError(f"lanes from {at} of {len(array)}")
    return array[at : at + LANES].copy()


def put(array, at, x):
    """array[at : at + 16] = x."""
    if not 0 <= at <= len(array) - LANES:
        raise IndexError(f"lanes from {at} of {len(array)}")
    array[at : at + LANES] = x


def put_where(condition, array, at, x):
    """array[at : at + 16] = x where the mask holds; the other numbers are not touched."""
    if not 0 <= at <= len(array) - LANES:
        raise IndexError(f"lanes from {at} of {len(array)}")
    array[at : at + LANES][condition] = x[condition]


def where(condition, x, y):
    """x where the mask holds, y elsewhere."""
    return np.where(condition, x, y)


def lowest(x, y):
    """The smaller of each pair."""
    return np.minimum(x, y)


def highest(x, y):
    """The larger of each pair."""
    return np.maximum(x, y)


def root(x):
    """Square roots."""
    return np.sqrt(x)


def some(condition):
    """Whether the mask holds anywhere."""
    return bool(np.any(condition))


def exp2(x):
    """2^x for x up to 127, 2^-126 below -126. Relative error at most 1e-7: a polynomial of degree 6 on [-1/2, 1/2]."""
    return np.exp2(np.maximum(x, -126), dtype=np.float32)


def inverse(x):
    """1 / x for positive x that are no subnormals. Relative error at most 2e-7; a division takes longer."""
    return np.float32(1) / x


def totals(vectors):
    """Lane k is the sum of all lanes of the k-th of up to sixteen vectors; lanes beyond mean nothing."""
    return np.array([x.sum() for x in vectors] + [0] * (LANES - len(vectors)), np.float32)


def bytes_between(x):
    """Eight bytes as one number: in byte r the bits from x[8 + r], rounded up, to x[r], rounded down, are set."""
    last = np.floor(np.minimum(x[:8], 7)).astype(int)
    first = np.ceil(np.maximum(x[8:], 0)).astype(int)
    bits = ((1 << np.maximum(last + 1, 0)) - (1 << np.minimum(first, 8))) * (first <= last)
    return np.uint64(int.from_bytes(bits.astype(np.uint8).tobytes(), "little"))


def first_bit(x):
    """Number of the lowest bit that is set."""
    return (int(x) & -int(x)).bit_length() - 1


@intrinsic
def _fetch(typing, array, at):
    def generate(context, builder, sig, args):
        (array_,) = data(context, builder, sig, args, 0)
        return load(builder, vector_at(builder, array_, args[1]))

    return lanes(array, types.int64), generate


@intrinsic
def _put(typing, array, at, x):
    def generate(context, builder, sig, args):
        (array_,) = data(context, builder, sig, args, 0)
        store(builder, args[2], vector_at(builder, array_, args[1]))
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), generate


@intrinsic
def _put_where(typing, condition, array, at, x):
    def generate(context, builder, sig, args):
        (array_,) = data(context, builder, sig, args, 1)
        place = vector_at(builder, array_, args[2])
        kind = ir.FunctionType(ir.VoidType(), [FLOATS, FLOATS.as_pointer(), I32, BOOLS])
        name = f"llvm.masked.store.v{LANES}f32.p0"
        masked = cgutils.get_or_insert_function(builder.module, kind, name)
        builder.call(masked, [args[3], place, ir.Constant(I32, 4), args[0]])
        return context.get_dummy_value()

    return types.void(mask, array, types.int64, lanes), generate


@intrinsic
def _where(typing, condition, x, y):
    return lanes(mask, lanes, lanes), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def _lowest(typing, x, y):
    def generate(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return lanes(lanes, lanes), generate


@intrinsic
def _highest(typing, x, y):
    def generate(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return lanes(lanes, lanes), generate


def _each(builder, name, x):
    """An operation of LLVM's on every lane."""
    kind = ir.FunctionType(FLOATS, [FLOATS])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32"), [x])


@intrinsic
def _root(typing, x):
    def generate(context, builder, sig, args):
        return _each(builder, "sqrt", args[0])

    return lanes(lanes), generate


@intrinsic
def _bytes_between(typing, x):
    def generate(context, builder, sig, args):
        def constant(value, kind=INTS):
            return ir.Constant(kind, [value] * LANES)

        def pick(order, a, sign):
            return builder.select(builder.fcmp_ordered(order, a, constant(sign, FLOATS)), a, constant(sign, FLOATS))

        down = builder.fptosi(_each(builder, "floor", pick(">", pick("<", args[0], 7.0), -1.0)), INTS)
        up = builder.fptosi(_each(builder, "ceil", pick("<", pick(">", args[0], 0.0), 8.0)), INTS)
        up = builder.shuffle_vector(up, up, ir.Constant(INTS, [(lane + 8) % LANES for lane in range(LANES)]))
        one = constant(1)
        bits = builder.sub(builder.shl(one, builder.add(down, one)), builder.shl(one, up))
        bits = builder.select(builder.icmp_signed("<=", up, down), bits, constant(0))
        packed = builder.bitcast(
            builder.trunc(bits, ir.VectorType(ir.IntType(8), LANES)), ir.VectorType(ir.IntType(64), 2)
        )
        return builder.extract_element(packed, ir.Constant(I32, 0))

    return types.uint64(lanes), generate


@intrinsic
def _some(typing, condition):
    def generate(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask), generate


# 2^f = sum_i c_i f^i on [-1/2, 1/2]: Chebyshev's nodes, found once in double precision.
_NODES = 0.5 * np.cos((np.arange(7) + 0.5) * np.pi / 7)
_COEFFICIENTS = np.linalg.solve(np.vander(_NODES, increasing=True), np.exp2(_NODES))
_ROUNDER = 1.5 * 2.0**23  # adding it leaves the nearest whole number in the lowest bits


@intrinsic
def _exp2(typing, x):
    def generate(context, builder, sig, args):
        def constant(value):
            return ir.Constant(FLOATS, [float(np.float32(value))] * LANES)

        high = builder.fcmp_ordered(">=", args[0], constant(-126))
        x = builder.select(high, args[0], constant(-126))
        rounded = builder.fadd(x, constant(_ROUNDER))
        f = builder.fsub(x, builder.fsub(rounded, constant(_ROUNDER)))
        total = constant(_COEFFICIENTS[-1])
        for c in _COEFFICIENTS[-2::-1]:
            total = builder.fadd(builder.fmul(total, f, flags=FMA), constant(c), flags=FMA)
        exponent = builder.shl(builder.bitcast(rounded, INTS), ir.Constant(INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(total, INTS), exponent), FLOATS)

    return lanes(lanes), generate


@intrinsic
def _inverse(typing, x):
    """Bits of a float are its logarithm, nearly: taken from a constant they give 1 / x to within an eighth. Three steps
    of Newton's y += y (1 - x y) square that three times."""

    def generate(context, builder, sig, args):
        (x,) = args
        one = ir.Constant(FLOATS, [1.0] * LANES)
        bits = builder.sub(ir.Constant(INTS, [0x7EF311C7] * LANES), builder.bitcast(x, INTS))
        y = builder.bitcast(bits, FLOATS)
        for _ in range(3):
            left = builder.fsub(one, builder.fmul(x, y, flags=FMA), flags=FMA)
            y = builder.fadd(y, builder.fmul(y, left, flags=FMA), flags=FMA)
        return y

    return lanes(lanes), generate


@intrinsic
def _totals(typing, vectors):
    """Fold halves: after each fold lanes of different vectors share a register, so that few shuffles do for all."""

    def generate(context, builder, sig, args):
        lines = list(cgutils.unpack_tuple(builder, args[0]))
        lines += [None] * (LANES - len(lines))
        for size in (8, 4, 2, 1):
            stay = ir.Constant(INTS, [LANES + lane if lane & size else lane for lane in range(LANES)])
            move = ir.Constant(INTS, [LANES + lane - size if lane & size else lane + size for lane in range(LANES)])
            for i in range(size):
                a, b = lines[i], lines[i + size]
                if a is not None:
                    b = a if b is None else b
                    kept, moved = (builder.shuffle_vector(a, b, pattern) for pattern in (stay, move))
                    lines[i] = builder.fadd(kept, moved, flags=FMA)
        return lines[0]

    return lanes(vectors), generate


@intrinsic
def _first_bit(typing, x):
    def generate(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uint64), generate


overload(fetch)(lambda array, at: lambda array, at: _fetch(array, at))
overload(put)(lambda array, at, x: lambda array, at, x: _put(array, at, x))
overload(put_where)(lambda condition, array, at, x: lambda condition, array, at, x: _put_where(condition, array, at, x))
overload(where)(lambda condition, x, y: lambda condition, x, y: _where(condition, x, y))
overload(lowest)(lambda x, y: lambda x, y: _lowest(x, y))
overload(highest)(lambda x, y: lambda x, y: _highest(x, y))
overload(root)(lambda x: lambda x: _root(x))
overload(bytes_between)(lambda x: lambda x: _bytes_between(x))
overload(some)(lambda condition: lambda condition: _some(condition))
overload(exp2)(lambda x: lambda x: _exp2(x))
overload(inverse)(lambda x: lambda x: _inverse(x))
overload(totals)(lambda vectors: lambda vectors: _totals(vectors))
overload(first_bit)(lambda x: lambda x: _first_bit(x))
