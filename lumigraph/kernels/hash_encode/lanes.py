"""Two small machine operations for the Numba engine: all features of an entry as one vector register.

Numba has no vector type, and its loops touch the features of an entry one by one; written in LLVM's terms, the eight
corners cost eight loads and eight multiply-adds however many features there are (measured with two features:
2.0 times the backward pass, 1.4 times the forward).
A tuple argument `lanes` carries the number of features in its type.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

BLOCK = 256  # points whose corners are worked out together; entries and weights are laid out corner by corner
_I64, _I32, _F32 = ir.IntType(64), ir.IntType(32), ir.FloatType()


def _data(context, builder, kind, value):
    return context.make_array(kind)(context, builder, value).data


def _splat(builder, x, n):
    vector = builder.insert_element(ir.Constant(ir.VectorType(_F32, n), ir.Undefined), x, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, n), [0] * n)
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), zeros)


def _corners(builder, table, base, entries, weights, i, n):
    """For each of point i's corners: where its entry lies, and its weight in every lane."""
    for corner in range(8):
        at = builder.add(i, ir.Constant(_I64, corner * BLOCK))
        entry = builder.add(base, builder.zext(builder.load(builder.gep(entries, [at])), _I64))
        place = builder.gep(table, [builder.mul(entry, ir.Constant(_I64, n))])
        vector = builder.bitcast(place, ir.VectorType(_F32, n).as_pointer())
        yield vector, _splat(builder, builder.load(builder.gep(weights, [at])), n)


def _planes(builder, array, first, stride, n):
    for f in range(n):
        yield builder.gep(array, [builder.add(first, builder.mul(stride, ir.Constant(_I64, f)))])


@intrinsic
def blend(typing, table, base, entries, weights, i, lanes, out, first, stride):
    """out[first + f stride] = sum over corners c of weights[c, i] table[base + entries[c, i], f], for each lane f."""

    def generate(context, builder, signature, args):
        arrays = {k: _data(context, builder, signature.args[k], args[k]) for k in (0, 2, 3, 6)}
        total = None
        for place, weight in _corners(builder, arrays[0], args[1], arrays[2], arrays[3], args[4], lanes.count):
            term = builder.fmul(weight, builder.load(place, align=4), flags=("fast",))
            total = term if total is None else builder.fadd(total, term, flags=("fast",))
        for f, plane in enumerate(_planes(builder, arrays[6], args[7], args[8], lanes.count)):
            builder.store(builder.extract_element(total, ir.Constant(_I32, f)), plane)
        return context.get_dummy_value()

    return types.void(table, base, entries, weights, i, lanes, out, first, stride), generate


@intrinsic
def spread(typing, grad, first, stride, base, entries, weights, i, lanes, table):
    """table[base + entries[c, i], f] += weights[c, i] grad[first + f stride], for each corner c and lane f."""

    def generate(context, builder, signature, args):
        arrays = {k: _data(context, builder, signature.args[k], args[k]) for k in (0, 4, 5, 8)}
        g = ir.Constant(ir.VectorType(_F32, lanes.count), ir.Undefined)
        for f, plane in enumerate(_planes(builder, arrays[0], args[1], args[2], lanes.count)):
            g = builder.insert_element(g, builder.load(plane), ir.Constant(_I32, f))
        for place, weight in _corners(builder, arrays[8], args[3], arrays[4], arrays[5], args[6], lanes.count):
            term = builder.fmul(weight, g, flags=("fast",))
            builder.store(builder.fadd(builder.load(place, align=4), term, flags=("fast",)), place, align=4)
        return context.get_dummy_value()

    return types.void(grad, first, stride, base, entries, weights, i, lanes, table), generate
