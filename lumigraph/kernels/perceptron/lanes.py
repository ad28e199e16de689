"""Pieces of small matrix products as LLVM wants to hear them, for the Numba engine.

Left to itself Numba's compiler keeps a product's sums in memory. Here they stay in registers: a tile of TILE outputs
for BLOCK samples is 16 vectors, and each weight that is read serves two multiply-adds.
A buffer is rows of BLOCK numbers: feature f of sample s at [f BLOCK + s].
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from .._vectors import FLOATS, INTS, LANES, all_lanes, count, data, load, store, vector_at

BLOCK = 32  # samples
TILE = 8  # outputs
_PARTS = range(0, BLOCK, LANES)
_ZERO = ir.Constant(FLOATS, [0.0] * LANES)


def _vectors(builder, pointer, at):
    """Where the vectors of the BLOCK numbers from `at` on lie."""
    return [vector_at(builder, pointer, builder.add(at, count(part))) for part in _PARTS]


def _row(builder, pointer, first, number):
    """Where the vectors of row `first` + `number` of a buffer lie."""
    return _vectors(builder, pointer, builder.mul(builder.add(first, number), count(BLOCK)))


@intrinsic
def move(typing, source, start, target, to):
    """target[to : to + BLOCK] = source[start : start + BLOCK]."""

    def generate(context, builder, signature, args):
        source_, target_ = data(context, builder, signature, args, 0, 2)
        for a, b in zip(_vectors(builder, source_, args[1]), _vectors(builder, target_, args[3]), strict=True):
            store(builder, load(builder, a), b)
        return context.get_dummy_value()

    return types.void(source, types.int64, target, types.int64), generate


@intrinsic
def transpose(typing, buffer, source, target):
    """Rows target to target + BLOCK become the columns of rows source to source + BLOCK."""

    def generate(context, builder, signature, args):
        (buffer_,) = data(context, builder, signature, args, 0)
        for across in range(len(_PARTS)):
            for down in range(len(_PARTS)):
                places = (_row(builder, buffer_, args[1], count(down * LANES + i))[across] for i in range(LANES))
                lines = _transposed(builder, [load(builder, place) for place in places])
                for i, line in enumerate(lines):
                    store(builder, line, _row(builder, buffer_, args[2], count(across * LANES + i))[down])
        return context.get_dummy_value()

    return types.void(buffer, types.int64, types.int64), generate


def _transposed(builder, lines):
    """A square of vectors: swap its off-diagonal quarters, then those of each quarter, down to single lanes."""
    for size in (8, 4, 2, 1):
        upper = [LANES + lane - size if lane & size else lane for lane in range(LANES)]
        lower = [LANES + lane if lane & size else lane + size for lane in range(LANES)]
        for i in range(LANES):
            if not i & size:
                a, b = lines[i], lines[i + size]
                lines[i] = builder.shuffle_vector(a, b, ir.Constant(INTS, upper))
                lines[i + size] = builder.shuffle_vector(a, b, ir.Constant(INTS, lower))
    return lines


def _tile(finish):
    """The operation y_o = finish(sum_i w_io x_i, gate_o) for as many outputs o as the tuple `lanes` is long.

    x_i is row first_input + i of `inputs`, y_o row first_output + o and gate_o row first_gate + o of `outputs`;
    w_io is number first_weight + down i + across o of `weights`.
    """

    @intrinsic
    def tile(
        typing,
        inputs,
        first_input,
        depth,
        weights,
        first_weight,
        down,
        across,
        outputs,
        first_output,
        first_gate,
        lanes,
    ):
        def generate(context, builder, signature, args):
            inputs_, weights_, outputs_ = data(context, builder, signature, args, 0, 3, 7)
            sums = [[cgutils.alloca_once_value(builder, _ZERO) for _ in _PARTS] for _ in range(lanes.count)]
            with cgutils.for_range(builder, args[2]) as loop:
                values = [load(builder, place) for place in _row(builder, inputs_, args[1], loop.index)]
                first = builder.add(args[4], builder.mul(loop.index, args[5]))
                for o, totals in enumerate(sums):
                    at = builder.add(first, builder.mul(args[6], count(o)))
                    weight = all_lanes(builder, builder.load(builder.gep(weights_, [at])))
                    for total, value in zip(totals, values, strict=True):
                        term = builder.fmul(weight, value, flags=("fast",))
                        builder.store(builder.fadd(builder.load(total), term, flags=("fast",)), total)
            for o, totals in enumerate(sums):
                places = _row(builder, outputs_, args[8], count(o))
                gates = _row(builder, outputs_, args[9], count(o))
                for total, place, gate in zip(totals, places, gates, strict=True):
                    store(builder, finish(builder, builder.load(total), gate), place)
            return context.get_dummy_value()

        whole = types.int64
        before = inputs, whole, whole, weights, whole, whole, whole
        return types.void(*before, outputs, whole, whole, lanes), generate

    return tile


def _positive(builder, value, where):
    return builder.select(builder.fcmp_ordered(">", where, _ZERO), value, _ZERO)


product = _tile(lambda builder, total, gate: total)
rectified = _tile(lambda builder, total, gate: _positive(builder, total, total))
gated = _tile(lambda builder, total, gate: _positive(builder, total, load(builder, gate)))
added = _tile(lambda builder, total, gate: builder.fadd(total, load(builder, gate)))
