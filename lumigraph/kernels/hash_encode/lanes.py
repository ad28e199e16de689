"""The innermost operations of the Numba engine, sixteen points or all features of an entry at a time.

`place` finds the eight corners around sixteen points; `blend` and `spread` take one point, whose corners' entries are
each one register of features: eight loads and eight multiply-adds however many features there are. Left to itself the
compiler would gather numbers one by one (measured on dense levels: 2.4 times slower).
A tuple argument `lanes` carries the number of features in its type.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from .._vectors import F32, FLOATS, I32, I64, INTS, LANES, all_lanes, count, data, load, store, vector_at

BLOCK = 64  # points whose corners are worked out together; entries and weights are laid out corner by corner


def _place(hashed):
    """Number of the first feature, and trilinear weight, of the corners around sixteen points, from point `at` on.

    axes:   how far apart the coordinates of a point lie in `points`
    strides: what a step along y and z adds to an entry's number (multiplies, where hashed)
    Written to [corner BLOCK + i] and on. Lanes beyond the last point get what happens to lie there.
    """

    @intrinsic
    def place(typing, points, at, axes, resolution, stride_y, stride_z, mask, base, lanes, entries, weights, i):
        def generate(context, builder, signature, args):
            points_, entries_, weights_ = data(context, builder, signature, args, 0, 9, 10)
            one = ir.Constant(FLOATS, [1.0] * LANES)
            size = all_lanes(builder, builder.trunc(args[3], I32))
            cells, shares = [], []
            for axis in range(3):
                first = builder.add(args[1], builder.mul(args[2], count(axis)))
                x = _clamped(builder, load(builder, vector_at(builder, points_, first)))
                scaled = builder.fmul(x, builder.uitofp(size, FLOATS))
                cell, last = builder.fptosi(scaled, INTS), builder.sub(size, ir.Constant(INTS, [1] * LANES))
                cell = builder.select(builder.icmp_signed("<", cell, last), cell, last)
                share = builder.fsub(scaled, builder.sitofp(cell, FLOATS))
                cells.append(cell)
                shares.append((builder.fsub(one, share), share))
            steps = [all_lanes(builder, step) for step in (ir.Constant(I32, 1), args[4], args[5])]
            lower = [builder.mul(cell, step) for cell, step in zip(cells, steps, strict=True)]
            sides = [(a, builder.add(a, step)) for a, step in zip(lower, steps, strict=True)]
            join = builder.xor if hashed else builder.add
            for corner in range(8):
                x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
                entry = join(join(sides[0][x], sides[1][y]), sides[2][z])
                if hashed:
                    entry = builder.and_(entry, all_lanes(builder, args[6]))
                entry = builder.add(entry, all_lanes(builder, builder.trunc(args[7], I32)))
                entry = builder.mul(entry, ir.Constant(INTS, [lanes.count] * LANES))
                weight = builder.fmul(shares[0][x], builder.fmul(shares[1][y], shares[2][z]))
                to = builder.add(args[11], count(corner * BLOCK))
                store(builder, entry, vector_at(builder, entries_, to, INTS))
                store(builder, weight, vector_at(builder, weights_, to))
            return context.get_dummy_value()

        whole, bits = types.int64, types.uint32
        numbers = whole, whole, whole, bits, bits, bits, whole
        return types.void(points, *numbers, lanes, entries, weights, whole), generate

    return place


def _clamped(builder, x):
    zero, one = (ir.Constant(FLOATS, [value] * LANES) for value in (0.0, 1.0))
    x = builder.select(builder.fcmp_ordered(">", x, zero), x, zero)
    return builder.select(builder.fcmp_ordered("<", x, one), x, one)


place_dense, place_hashed = _place(hashed=False), _place(hashed=True)


def _corners(builder, table, entries, weights, i, n):
    """For each of point i's corners: where its entry lies, and its weight in every lane."""
    for corner in range(8):
        at = builder.add(i, count(corner * BLOCK))
        entry = builder.zext(builder.load(builder.gep(entries, [at])), I64)
        vector = builder.bitcast(builder.gep(table, [entry]), ir.VectorType(F32, n).as_pointer())
        weight = builder.load(builder.gep(weights, [at]))
        all_features = ir.Constant(ir.VectorType(I32, n), [0] * n)
        nothing = ir.Constant(ir.VectorType(F32, n), ir.Undefined)
        weight = builder.shuffle_vector(
            builder.insert_element(nothing, weight, ir.Constant(I32, 0)), nothing, all_features
        )
        yield vector, weight


def _planes(builder, array, first, stride, n):
    for f in range(n):
        yield builder.gep(array, [builder.add(first, builder.mul(stride, count(f)))])


@intrinsic
def blend(typing, table, entries, weights, i, lanes, out, first, stride):
    """out[first + f stride] = sum over corners c of weights[c, i] table[entries[c, i] + f], for each lane f."""

    def generate(context, builder, signature, args):
        table_, entries_, weights_, out_ = data(context, builder, signature, args, 0, 1, 2, 5)
        total = None
        for place, weight in _corners(builder, table_, entries_, weights_, args[3], lanes.count):
            term = builder.fmul(weight, load(builder, place), flags=("fast",))
            total = term if total is None else builder.fadd(total, term, flags=("fast",))
        for f, plane in enumerate(_planes(builder, out_, args[6], args[7], lanes.count)):
            builder.store(builder.extract_element(total, ir.Constant(I32, f)), plane)
        return context.get_dummy_value()

    return types.void(table, entries, weights, i, lanes, out, first, stride), generate


@intrinsic
def spread(typing, grad, first, stride, entries, weights, i, lanes, table):
    """table[entries[c, i] + f] += weights[c, i] grad[first + f stride], for each corner c and lane f."""

    def generate(context, builder, signature, args):
        grad_, entries_, weights_, table_ = data(context, builder, signature, args, 0, 3, 4, 7)
        g = ir.Constant(ir.VectorType(F32, lanes.count), ir.Undefined)
        for f, plane in enumerate(_planes(builder, grad_, args[1], args[2], lanes.count)):
            g = builder.insert_element(g, builder.load(plane), ir.Constant(I32, f))
        for place, weight in _corners(builder, table_, entries_, weights_, args[5], lanes.count):
            term = builder.fmul(weight, g, flags=("fast",))
            store(builder, builder.fadd(load(builder, place), term, flags=("fast",)), place)
        return context.get_dummy_value()

    return types.void(grad, first, stride, entries, weights, i, lanes, table), generate
