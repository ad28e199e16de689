"""SIMD vectors for the Numba engines: lanes add, multiply and compare elementwise.

Numba has no vector type. This one lives in registers, so that a block's sums never touch memory. There are sixteen
lanes, or as many as a tuple `like` is long: the compiler knows its length. Without Numba (NUMBA_DISABLE_JIT) the same
code runs on rows of a NumPy array, with bounds checks on loads and stores. Arrays are flat.
"""

import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, overload, register_model

LANES = 16
SIXTEEN = (0,) * LANES
I32 = ir.IntType(32)
ELEMENTS = {"real": ir.FloatType(), "whole": I32, "mask": ir.IntType(1)}  # float32, uint32, bits
SCALARS = {"real": types.Float, "whole": types.Integer, "mask": ()}  # what stands for lanes that are all the same
FLOATS, INTS = (ir.VectorType(kind, LANES) for kind in (ir.FloatType(), I32))
FMA = ("contract", "nsz")  # products and sums may fuse; infinities and NaN keep their meaning
# Operators without flags of their own get those of the function's `fastmath`.


class LanesType(types.Type):
    def __init__(self, kind="real", count=LANES):
        self.kind, self.count = kind, count
        super().__init__(f"lanes({kind}, {count})")

    def can_convert_from(self, typingctx, other):
        return 1 if isinstance(other, SCALARS[self.kind]) else None


@register_model(LanesType)
class LanesModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, ir.VectorType(ELEMENTS[fe_type.kind], fe_type.count))


lanes, mask = LanesType(), LanesType("mask")


@lower_cast(types.Number, LanesType)
def _spread(context, builder, fromty, toty, value):
    x = context.cast(builder, value, fromty, types.float32 if toty.kind == "real" else types.uint32)
    nothing = ir.Constant(ir.VectorType(x.type, toty.count), ir.Undefined)
    first = builder.insert_element(nothing, x, ir.Constant(I32, 0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(I32, toty.count), [0] * toty.count))


def _common(args):
    """Common lane type of operands; None if they have none."""
    among = [x for x in args if isinstance(x, LanesType)]
    fits = among and all(x == among[0] or isinstance(x, SCALARS[among[0].kind]) for x in args)
    return among[0] if fits else None


def _binary(symbol, compares=False, **emit):
    """Overload a Python operator for lanes. emit: LLVM instruction builder of each kind"""

    @infer_global(symbol)
    class Template(AbstractTemplate):
        def generic(self, args, kws):
            operands = _common(args) if len(args) == 2 else None
            if operands and operands.kind in emit:
                return signature(LanesType("mask", operands.count) if compares else operands, operands, operands)

    @lower_builtin(symbol, LanesType, LanesType)
    def lower(context, builder, sig, args):
        return emit[sig.args[0].kind](builder, *args)


_binary(operator.add, real=lambda b, x, y: b.fadd(x, y), whole=lambda b, x, y: b.add(x, y))
_binary(operator.sub, real=lambda b, x, y: b.fsub(x, y))
_binary(operator.mul, real=lambda b, x, y: b.fmul(x, y), whole=lambda b, x, y: b.mul(x, y))
_binary(operator.truediv, real=lambda b, x, y: b.fdiv(x, y, flags=("arcp", *FMA)))
_binary(operator.ge, compares=True, real=lambda b, x, y: b.fcmp_ordered(">=", x, y))
_binary(operator.gt, compares=True, real=lambda b, x, y: b.fcmp_ordered(">", x, y))
_binary(operator.lt, compares=True, real=lambda b, x, y: b.fcmp_ordered("<", x, y))
_binary(operator.ne, compares=True, real=lambda b, x, y: b.fcmp_unordered("!=", x, y))
_binary(operator.and_, mask=lambda b, x, y: b.and_(x, y), whole=lambda b, x, y: b.and_(x, y))
_binary(operator.xor, whole=lambda b, x, y: b.xor(x, y))


# Functions: in Python first, which is what they mean, then for the compiler.


def fetch(array, at):
    """Load array[at : at + 16]."""
    return array[_places(array, at, LANES)].copy()


def fetch_like(array, at, like):
    """Load array[at : at + len(like)]."""
    return array[_places(array, at, len(like))].copy()


def put(array, at, x):
    """array[at : at + len(x)] = x."""
    array[_places(array, at, len(x))] = x


def gather(array, at, stride, like):
    """Strided load: array[at + k stride] for each lane k of `like`."""
    return array[at + stride * np.arange(len(like))]


def scatter(array, at, stride, x):
    """Strided store: array[at + k stride] = x[k] for each lane k."""
    array[at + stride * np.arange(len(x))] = x


def filled(x, like):
    """Broadcast one value to as many lanes as `like` has."""
    return np.full(len(like), x)


def turn(array, at, to, apart):
    """Transpose the 16 x 16 matrix from `at` on into that from `to` on. apart: row stride"""
    square = apart * np.arange(LANES)[:, None] + np.arange(LANES)
    array[to + square] = array[at + square].T


def _places(array, at, count):
    if not 0 <= at <= len(array) - count:
        raise IndexError(f"{count} lanes from {at} of {len(array)}")
    return slice(at, at + count)


def put_where(condition, array, at, x):
    """Masked store: array[at : at + 16] = x where the mask holds."""
    array[_places(array, at, LANES)][condition] = x[condition]


def where(condition, x, y):
    """x where the mask holds, y elsewhere."""
    return np.where(condition, x, y)


def lowest(x, y):
    """Elementwise minimum."""
    return np.minimum(x, y)


def highest(x, y):
    """Elementwise maximum."""
    return np.maximum(x, y)


def whole(x):
    """Truncate numbers from 0 to below 2^31 to integers."""
    return x.astype(np.uint32)


def real(x):
    """Convert integers below 2^31 to floating point."""
    return x.astype(np.float32)


def root(x):
    """Square roots."""
    return np.sqrt(x)


def some(condition):
    """True if the mask holds in any lane."""
    return bool(np.any(condition))


def exp2(x):
    """2^x for x from -126 to 127, undefined for others. Relative error at most 3e-7: a quintic on [-1/2, 1/2]."""
    return np.exp2(x, dtype=np.float32)


def ahead(array, at):
    """Prefetch array[at] into the cache."""
    _places(array, at, 1)


def totals(vectors):
    """Horizontal sums: lane k is the sum of vector k, of at most sixteen vectors; other lanes are undefined."""
    return np.array([x.sum() for x in vectors] + [0] * (LANES - len(vectors)), np.float32)


def bytes_between(x):
    """Bit mask of eight bytes: byte r has the bits from ceil(x[8 + r]) to floor(x[r]) set."""
    last = np.floor(np.minimum(x[:8], 7)).astype(int)
    first = np.ceil(np.maximum(x[8:], 0)).astype(int)
    bits = ((1 << np.maximum(last + 1, 0)) - (1 << np.minimum(first, 8))) * (first <= last)
    return np.uint64(int.from_bytes(bits.astype(np.uint8).tobytes(), "little"))


def first_bit(x):
    """Index of the lowest set bit."""
    return (int(x) & -int(x)).bit_length() - 1


def _vector(context, builder, sig, args, at, of):
    """Pointer to the lanes of type `of` at element args[at] of the array args[at - 1]."""
    kind = ir.VectorType(ELEMENTS[of.kind], of.count)
    return builder.bitcast(builder.gep(_data(context, builder, sig, args, at - 1), [args[at]]), kind.as_pointer())


def _data(context, builder, sig, args, number=0):
    """Pointer to the first element of an argument that is an array."""
    return context.make_array(sig.args[number])(context, builder, args[number]).data


def _apart(context, builder, sig, args, count):
    """Pointers to `count` elements of the array args[0], from args[1] on in strides of args[2]."""
    array = _data(context, builder, sig, args)
    for k in range(count):
        yield builder.gep(array, [builder.add(args[1], builder.mul(args[2], ir.Constant(ir.IntType(64), k)))])


@intrinsic
def _fetch(typing, array, at, like):
    found = LanesType(count=like.count)

    def generate(context, builder, sig, args):
        return builder.load(_vector(context, builder, sig, args, 1, found), align=4)

    return found(array, types.int64, like), generate


@intrinsic
def _put(typing, array, at, x):
    def generate(context, builder, sig, args):
        builder.store(args[2], _vector(context, builder, sig, args, 1, x), align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, x), generate


@intrinsic
def _put_where(typing, condition, array, at, x):
    def generate(context, builder, sig, args):
        place = _vector(context, builder, sig, args, 2, lanes)
        kind = ir.FunctionType(ir.VoidType(), [FLOATS, FLOATS.as_pointer(), I32, args[0].type])
        name = f"llvm.masked.store.v{LANES}f32.p0"
        masked = cgutils.get_or_insert_function(builder.module, kind, name)
        builder.call(masked, [args[3], place, ir.Constant(I32, 4), args[0]])
        return context.get_dummy_value()

    return types.void(mask, array, types.int64, lanes), generate


@intrinsic
def _gather(typing, array, at, stride, like):
    found = LanesType(count=like.count)

    def generate(context, builder, sig, args):
        x = ir.Constant(ir.VectorType(ir.FloatType(), like.count), ir.Undefined)
        for k, place in enumerate(_apart(context, builder, sig, args, like.count)):
            x = builder.insert_element(x, builder.load(place), ir.Constant(I32, k))
        return x

    return found(array, types.int64, types.int64, like), generate


@intrinsic
def _scatter(typing, array, at, stride, x):
    def generate(context, builder, sig, args):
        for k, place in enumerate(_apart(context, builder, sig, args, x.count)):
            builder.store(builder.extract_element(args[3], ir.Constant(I32, k)), place)
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, x), generate


@intrinsic
def _filled(typing, x, like):
    found = LanesType(count=like.count)
    return found(found, like), lambda context, builder, sig, args: args[0]


@intrinsic
def _turn(typing, array, at, to, apart):
    """Transpose recursively: swap the off-diagonal quarters, then those of each quarter, down to single lanes."""

    def generate(context, builder, sig, args):
        def rows(first):
            array_ = _data(context, builder, sig, args)
            for i in range(LANES):
                begin = builder.add(first, builder.mul(args[3], ir.Constant(ir.IntType(64), i)))
                yield builder.bitcast(builder.gep(array_, [begin]), FLOATS.as_pointer())

        lines = [builder.load(place, align=4) for place in rows(args[1])]
        for size in (8, 4, 2, 1):
            upper, lower = _swapped(size)
            for i in range(LANES):
                if not i & size:
                    a, b = lines[i], lines[i + size]
                    lines[i], lines[i + size] = (builder.shuffle_vector(a, b, pattern) for pattern in (upper, lower))
        for line, place in zip(lines, rows(args[2]), strict=True):
            builder.store(line, place, align=4)
        return context.get_dummy_value()

    return types.void(array, types.int64, types.int64, types.int64), generate


def _swapped(size):
    """Shuffle masks for rows a and b of a square's halves: lanes of (a, b) for the new a, and for the new b."""
    upper = [LANES + lane - size if lane & size else lane for lane in range(LANES)]
    lower = [LANES + lane if lane & size else lane + size for lane in range(LANES)]
    return ir.Constant(INTS, upper), ir.Constant(INTS, lower)


@intrinsic
def _where(typing, condition, x, y):
    found = LanesType(count=condition.count)
    return found(condition, found, found), lambda context, builder, sig, args: builder.select(*args)


def _chosen(real, whole):
    """Elementwise selection by an LLVM comparison: the operand for which it holds."""

    @intrinsic
    def choose(typing, x, y):
        kind = _common((x, y))

        def generate(context, builder, sig, args):
            first = builder.fcmp_ordered(real, *args) if kind.kind == "real" else builder.icmp_signed(whole, *args)
            return builder.select(first, *args)

        return kind(kind, kind), generate

    return choose


_lowest, _highest = _chosen("<", "<"), _chosen(">", ">")


@intrinsic
def _whole(typing, x):
    def generate(context, builder, sig, args):
        return builder.fptosi(args[0], ir.VectorType(I32, x.count))

    return LanesType("whole", x.count)(x), generate


@intrinsic
def _real(typing, x):
    def generate(context, builder, sig, args):
        return builder.sitofp(args[0], ir.VectorType(ir.FloatType(), x.count))

    return LanesType(count=x.count)(x), generate


def _each(builder, name, x):
    """Apply an LLVM intrinsic to every lane."""
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
        bits = builder.sext(args[0], INTS)
        name = f"llvm.vector.reduce.or.v{LANES}i32"
        any_ = cgutils.get_or_insert_function(builder.module, ir.FunctionType(I32, [INTS]), name)
        return builder.icmp_signed("<", builder.call(any_, [bits]), ir.Constant(I32, 0))

    return types.boolean(mask), generate


# 2^f = sum_i c_i f^i on [-1/2, 1/2]: Chebyshev's nodes, found once in double precision.
_NODES = 0.5 * np.cos((np.arange(6) + 0.5) * np.pi / 6)
_COEFFICIENTS = np.linalg.solve(np.vander(_NODES, increasing=True), np.exp2(_NODES))
_ROUNDER = 1.5 * 2.0**23  # adding it leaves the nearest whole number in the lowest bits


@intrinsic
def _exp2(typing, x):
    """Evaluate the polynomial by Estrin's scheme, whose terms are independent: faster than Horner's chain."""

    def generate(context, builder, sig, args):
        def constant(value, kind=ir.FloatType()):
            return ir.Constant(ir.VectorType(kind, x.count), [value] * x.count)

        def plus(a, b, c):
            return builder.fadd(builder.fmul(a, b, flags=FMA), c, flags=FMA)

        whole = builder.fadd(args[0], constant(_ROUNDER))
        f = builder.fsub(args[0], builder.fsub(whole, constant(_ROUNDER)))
        c0, c1, c2, c3, c4, c5 = (constant(float(np.float32(c))) for c in _COEFFICIENTS)
        square = builder.fmul(f, f)
        total = plus(square, plus(square, plus(c5, f, c4), plus(c3, f, c2)), plus(c1, f, c0))
        whole, total = (builder.bitcast(v, ir.VectorType(I32, x.count)) for v in (whole, total))
        exponent = builder.shl(whole, constant(23, I32))
        return builder.bitcast(builder.add(total, exponent), args[0].type)

    return x(x), generate


@intrinsic
def _ahead(typing, array, at):
    def generate(context, builder, sig, args):
        place = builder.gep(_data(context, builder, sig, args), [args[1]])
        place = builder.bitcast(place, ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [place.type, I32, I32, I32])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(prefetch, [place, *(ir.Constant(I32, x) for x in (0, 3, 1))])  # to be read, kept near, data
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@intrinsic
def _totals(typing, vectors):
    """Sum by folding halves: after each fold lanes of different vectors share a register, which needs few shuffles."""

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


overload(fetch)(lambda array, at: lambda array, at: _fetch(array, at, SIXTEEN))
overload(fetch_like)(lambda array, at, like: lambda array, at, like: _fetch(array, at, like))
overload(gather)(lambda array, at, stride, like: lambda array, at, stride, like: _gather(array, at, stride, like))
overload(scatter)(lambda array, at, stride, x: lambda array, at, stride, x: _scatter(array, at, stride, x))
overload(filled)(lambda x, like: lambda x, like: _filled(x, like))
overload(turn)(lambda array, at, to, apart: lambda array, at, to, apart: _turn(array, at, to, apart))
overload(whole)(lambda x: lambda x: _whole(x))
overload(real)(lambda x: lambda x: _real(x))
overload(put)(lambda array, at, x: lambda array, at, x: _put(array, at, x))
overload(put_where)(lambda condition, array, at, x: lambda condition, array, at, x: _put_where(condition, array, at, x))
overload(where)(lambda condition, x, y: lambda condition, x, y: _where(condition, x, y))
overload(lowest)(lambda x, y: lambda x, y: _lowest(x, y))
overload(highest)(lambda x, y: lambda x, y: _highest(x, y))
overload(root)(lambda x: lambda x: _root(x))
overload(bytes_between)(lambda x: lambda x: _bytes_between(x))
overload(some)(lambda condition: lambda condition: _some(condition))
overload(exp2)(lambda x: lambda x: _exp2(x))
overload(ahead)(lambda array, at: lambda array, at: _ahead(array, at))
overload(totals)(lambda vectors: lambda vectors: _totals(vectors))
overload(first_bit)(lambda x: lambda x: _first_bit(x))
