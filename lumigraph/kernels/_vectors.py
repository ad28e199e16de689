"""Sixteen numbers as one value, for the Numba engines.

Numba has no vector type. What its compiler does not find by itself is said in LLVM's terms, in each room's `lanes`;
here is what these share. Arrays are addressed by numbers counted from their first, wherever their axes end.
"""

from __future__ import annotations

from llvmlite import ir

LANES = 16
F32, I32, I64 = ir.FloatType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS = ir.VectorType(F32, LANES), ir.VectorType(I32, LANES)


def data(context, builder, signature, args, *numbers):
    """Pointers to the first element of those arguments that are arrays."""
    return [context.make_array(signature.args[k])(context, builder, args[k]).data for k in numbers]


def count(x: int):
    return ir.Constant(I64, x)


def all_lanes(builder, x):
    """A vector of one number."""
    kind = ir.VectorType(x.type, LANES)
    nothing = ir.Constant(kind, ir.Undefined)
    vector = builder.insert_element(nothing, x, ir.Constant(I32, 0))
    return builder.shuffle_vector(vector, nothing, ir.Constant(INTS, [0] * LANES))


def vector_at(builder, pointer, at, kind=FLOATS):
    """Where the vector lies that begins with element `at`."""
    return builder.bitcast(builder.gep(pointer, [at]), kind.as_pointer())


def load(builder, place):
    return builder.load(place, align=4)


def store(builder, value, place):
    builder.store(value, place, align=4)
