"""Pieces of small matrix products as LLVM wants to hear them, for the Numba engine.

Numba has no vector type. Left to itself its compiler keeps a product's sums in memory; here they stay in registers: a
tile of 8 outputs for BLOCK samples is 16 registers of 16 numbers, two multiply-adds for each weight that is read.
A buffer is rows of BLOCK numbers: feature f of sample s at [f BLOCK + s].
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

BLOCK = 32  # samples
TILE = 8  # outputs
LANES = 16
_F32, _I32, _I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_F32, LANES)
_ZERO = ir.Constant(_VECTOR, [0.0] * LANES)
_NOTHING = ir.Constant(_VECTOR, ir.Undefined)
_HALVES = range(0, BLOCK, LANES)


def _data(context, builder, kind, value):
    return context.make_array(kind)(context, builder, value).data


def _int(x):
    return ir.Constant(_I64, x)


def _vectors(builder, data, at):
    """Where the vectors of the BLOCK numbers from `at` on lie."""
    places = (builder.gep(data, [builder.add(at, _int(half))]) for half in _HALVES)
    return [builder.bitcast(place, _VECTOR.as_pointer()) for place in places]


def _row(builder, data, *numbers):
    """Where the vectors of a buffer's row lie, whose number is a sum."""
    total = numbers[0]
    for number in numbers[1:]:
        total = builder.add(total, number)
    return _vectors(builder, data, builder.mul(total, _int(BLOCK)))


def _shuffle(builder, a, b, lanes):
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_I32, LANES), lanes))


def _broadcast(builder, x):
    return _shuffle(builder, builder.insert_element(_NOTHING, x, ir.Constant(_I32, 0)), _NOTHING, [0] * LANES)


@intrinsic
def move(typing, source, start, target, to):
    """target[to : to + BLOCK] = source[start : start + BLOCK], both counted from the array's first number."""

    def generate(context, builder, signature, args):
        source_, target_ = (_data(context, builder, signature.args[k], args[k]) for k in (0, 2))
        for a, b in zip(_vectors(builder, source_, args[1]), _vectors(builder, target_, args[3]), strict=True):
            builder.store(builder.load(a, align=4), b, align=4)
        return context.get_dummy_value()

    return types.void(source, start, target, to), generate


@intrinsic
def transpose(typing, buffer, source, target):
    """Rows target to target + BLOCK become the columns of rows source to source + BLOCK."""

    def generate(context, builder, signature, args):
        data = _data(context, builder, signature.args[0], args[0])
        for across in range(len(_HALVES)):
            for down in range(len(_HALVES)):
                lines = [_row(builder, data, args[1], _int(down * LANES + i))[across] for i in range(LANES)]
                lines = _transposed(builder, [builder.load(place, align=4) for place in lines])
                for i, line in enumerate(lines):
                    place = _row(builder, data, args[2], _int(across * LANES + i))[down]
                    builder.store(line, place, align=4)
        return context.get_dummy_value()

    return types.void(buffer, source, target), generate


def _transposed(builder, lines):
    """16 vectors as a square matrix: swap the off-diagonal quarters, then those of each quarter, down to single lanes."""
    for size in (8, 4, 2, 1):
        upper = [LANES + lane - size if lane & size else lane for lane in range(LANES)]
        lower = [LANES + lane if lane & size else lane + size for lane in range(LANES)]
        for i in range(LANES):
            if not i & size:
                a, b = lines[i], lines[i + size]
                lines[i], lines[i + size] = _shuffle(builder, a, b, upper), _shuffle(builder, a, b, lower)
    return lines


def _tile(finish):
    """The operation y_o = finish(sum_i w_io x_i, gate_o) for as many outputs o as the tuple `lanes` is long.

    x_i is row first_input + i of `inputs`, y_o row first_output + o and gate_o row first_gate + o of `outputs`;
    w_io is number first_weight + down i + across o of `weights`.
    """

    @intrinsic
    def tile(
        typing, inputs, first_input, depth, weights, first_weight, down, across, outputs, first_output, first_gate, lanes
    ):
        def generate(context, builder, signature, args):
            inputs_, weights_, outputs_ = (_data(context, builder, signature.args[k], args[k]) for k in (0, 3, 7))
            sums = [[cgutils.alloca_once_value(builder, _ZERO) for _ in _HALVES] for _ in range(lanes.count)]
            with cgutils.for_range(builder, args[2]) as loop:
                values = [builder.load(p, align=4) for p in _row(builder, inputs_, args[1], loop.index)]
                first = builder.add(args[4], builder.mul(loop.index, args[5]))
                for o, totals in enumerate(sums):
                    at = builder.add(first, builder.mul(args[6], _int(o)))
                    weight = _broadcast(builder, builder.load(builder.gep(weights_, [at])))
                    for total, value in zip(totals, values, strict=True):
                        term = builder.fmul(weight, value, flags=("fast",))
                        builder.store(builder.fadd(builder.load(total), term, flags=("fast",)), total)
            for o, totals in enumerate(sums):
                places = _row(builder, outputs_, args[8], _int(o))
                gates = _row(builder, outputs_, args[9], _int(o))
                for total, place, gate in zip(totals, places, gates, strict=True):
                    builder.store(finish(builder, builder.load(total), gate), place, align=4)
            return context.get_dummy_value()

        names = (
            inputs, first_input, depth, weights, first_weight, down, across, outputs, first_output, first_gate, lanes
        )  # fmt: skip
        return types.void(*names), generate

    return tile


def _positive(builder, value, where):
    return builder.select(builder.fcmp_ordered(">", where, _ZERO), value, _ZERO)


product = _tile(lambda builder, total, gate: total)
rectified = _tile(lambda builder, total, gate: _positive(builder, total, total))
gated = _tile(lambda builder, total, gate: _positive(builder, total, builder.load(gate, align=4)))
added = _tile(lambda builder, total, gate: builder.fadd(total, builder.load(gate, align=4)))
