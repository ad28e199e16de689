"""Numba: threads share the Gaussians, of which sixteen are projected at once, one in each lane. Backward recomputes
everything, for visible ones alone."""

import numpy as np
from numba import njit, prange

from .._lanes import LANES, SIXTEEN, exp2, fetch, filled, highest, lowest, put, root, turn, where
from .._operation import differentiable, empty
from ..spherical_harmonics.cpu import basis, slope
from . import MIN_ALPHA

FAST = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz", "arcp"}, "error_model": "numpy"}
ZERO, HALF, ONE, TWO, THREE, FOUR, SIX = (np.float32(x) for x in (0, 0.5, 1, 2, 3, 4, 6))
MIN_DETERMINANT_RATIO = np.float32(1e-8)  # of a footprint's determinant to the blurred one's
TINY = np.float32(1e-12)  # least length of a quaternion, and distance of the eye
MAX_EXPONENT = np.float32(20)  # of 2: no opacity is so many times MIN_ALPHA
LOG2_E = np.float32(np.log2(np.e))
PARTS = 64  # of the Gaussians, which threads take one by one
# Rows of lanes: what is read of sixteen Gaussians, of which gradients take the place, and their footprints.
MEAN, QUATERNION, SCALE, OPACITY, TAKEN = 0, 3, 7, 10, 11
PLACE, CONIC, DEPTH, COLOUR, VISIBLE, MADE = 0, 2, 5, 6, 9, 10
MAX_NUMBERS = 48  # of a Gaussian's harmonics: 16 of each colour
# Where a view's numbers begin.
EYE, FOCAL, CENTRE, LENS, LIMITS, WIDTH, HEIGHT, NEAR = 9, 12, 14, 16, 24, 28, 29, 30


@njit(**FAST)
def _radial(s, v):
    """Rational factor q(s) of the lens distortion, with first and second derivatives."""
    k1, k2, k3 = v[LENS], v[LENS + 1], v[LENS + 4]
    k4, k5, k6 = v[LENS + 5], v[LENS + 6], v[LENS + 7]
    below = ONE + s * (k4 + s * (k5 + s * k6))
    q = (ONE + s * (k1 + s * (k2 + s * k3))) / below
    slope_below = k4 + s * (TWO * k5 + s * (THREE * k6))
    q1 = (k1 + s * (TWO * k2 + s * (THREE * k3)) - q * slope_below) / below
    q2 = (TWO * k2 + s * (SIX * k3) - TWO * q1 * slope_below - q * (TWO * k5 + s * (SIX * k6))) / below
    return q, q1, q2


@njit(**FAST)
def _lens(x, y, v):
    """Distorted point, and the Jacobian's entries xx, xy, yy (see `lens.bend`)."""
    p1, p2, s = v[LENS + 2], v[LENS + 3], x * x + y * y
    q, q1, _ = _radial(s, v)
    around = q + TWO * (p1 * y + p2 * x)
    xx = around + TWO * x * x * q1 + FOUR * p2 * x
    xy = TWO * x * y * q1 + TWO * (p1 * x + p2 * y)
    yy = around + TWO * y * y * q1 + FOUR * p1 * y
    return x * around + p2 * s, y * around + p1 * s, xx, xy, yy


@njit(**FAST)
def _curve(x, y, v):
    """Derivatives of the Jacobian: xxx, xxy, xyy, yyy."""
    _, q1, q2 = _radial(x * x + y * y, v)
    p1, p2 = v[LENS + 2], v[LENS + 3]
    xxx = x * (SIX * q1 + FOUR * x * x * q2) + SIX * p2
    xxy = y * (TWO * q1 + FOUR * x * x * q2) + TWO * p1
    xyy = x * (TWO * q1 + FOUR * y * y * q2) + TWO * p2
    yyy = y * (SIX * q1 + FOUR * y * y * q2) + SIX * p1
    return xxx, xxy, xyy, yyy


@njit(**FAST)
def _into_view(d, v):
    """Rotate a vector into camera coordinates."""
    return (
        v[0] * d[0] + v[1] * d[1] + v[2] * d[2],
        v[3] * d[0] + v[4] * d[1] + v[5] * d[2],
        v[6] * d[0] + v[7] * d[1] + v[8] * d[2],
    )


@njit(**FAST)
def _onto_plane(mean, v):
    """Depth, point on the plane z = 1, and that point clamped to the view's limits."""
    x, y, z = _into_view((mean[0] - v[EYE], mean[1] - v[EYE + 1], mean[2] - v[EYE + 2]), v)
    safe = where(z > v[NEAR], z, ONE)
    px, py = x / safe, y / safe
    x = lowest(highest(px, v[LIMITS]), v[LIMITS + 1])
    y = lowest(highest(py, v[LIMITS + 2]), v[LIMITS + 3])
    return z, px, py, x, y


@njit(**FAST)
def _rotation(some):
    """Unit quaternion, its length before normalisation, and its rotation matrix by rows."""
    w, (x, y, z) = fetch(some, LANES * QUATERNION), _three(some, QUATERNION + 1)
    length = highest(root(w * w + x * x + y * y + z * z), TINY)
    w, x, y, z = w / length, x / length, y / length, z / length
    rows = (
        (ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)),
        (TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)),
        (TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)),
    )
    return (w, x, y, z), length, rows


@njit(**FAST)
def _slopes(z, x, y, xx, xy, yy, v):
    """Rows of du/dmean: lens Jacobian times perspective Jacobian times camera rotation."""
    fx, fy = v[FOCAL] / z, v[FOCAL + 1] / z
    j = fx * xx, fx * xy, ZERO - fx * (xx * x + xy * y)
    k = fy * xy, fy * yy, ZERO - fy * (xy * x + yy * y)
    return j, k, _turned(j, v), _turned(k, v)


@njit(**FAST)
def _turned(j, v):
    """A row times the camera's rotation."""
    return (
        j[0] * v[0] + j[1] * v[3] + j[2] * v[6],
        j[0] * v[1] + j[1] * v[4] + j[2] * v[7],
        j[0] * v[2] + j[1] * v[5] + j[2] * v[8],
    )


@njit(**FAST)
def _row(a, Q, sx, sy, sz):
    """A row of du/dmean times Q diag(scale)."""
    return (
        (a[0] * Q[0][0] + a[1] * Q[1][0] + a[2] * Q[2][0]) * sx,
        (a[0] * Q[0][1] + a[1] * Q[1][1] + a[2] * Q[2][1]) * sy,
        (a[0] * Q[0][2] + a[1] * Q[1][2] + a[2] * Q[2][2]) * sz,
    )


@njit(**FAST)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**FAST)
def _footprint(T, U, blur):
    """Entries a, b, c of the blurred covariance, its determinant, and the determinant without blur."""
    x, y, z = T[1] * U[2] - T[2] * U[1], T[2] * U[0] - T[0] * U[2], T[0] * U[1] - T[1] * U[0]
    narrow = x * x + y * y + z * z  # |T x U|^2, which does not cancel
    a, b, c = _dot(T, T) + blur, _dot(T, U), _dot(U, U) + blur
    return a, b, c, narrow + blur * (a + c - blur), narrow


@njit(**FAST)
def _pulled(n, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, grow):
    """Component n of the gradients of T and U: -2 K G W, and the term of the compensation."""
    w0, w1 = (blur * T[n] + Un[n]) / det, (blur * U[n] + nT[n]) / det
    x0, x1 = gxx * w0 + gxy * w1, gxy * w0 + gyy * w1
    to_t = grow * Un[n] - TWO * (kxx * x0 + kxy * x1) - fade * T[n]
    to_u = grow * nT[n] - TWO * (kxy * x0 + kyy * x1) - fade * U[n]
    return to_t, to_u


@njit(**FAST)
def _direction(mean, v):
    """Unit vector from the eye to a Gaussian, and the distance."""
    x, y, z = mean[0] - v[EYE], mean[1] - v[EYE + 1], mean[2] - v[EYE + 2]
    length = highest(root(x * x + y * y + z * z), TINY)
    return x / length, y / length, z / length, length


@njit(**FAST)
def _take(some, lane, i, means, quaternions, scales, opacities):
    """Load Gaussian i's numbers into a lane of `some`."""
    for n in range(3):
        some[LANES * (MEAN + n) + lane] = means[i, n]
        some[LANES * (SCALE + n) + lane] = scales[i, n]
    for n in range(4):
        some[LANES * (QUATERNION + n) + lane] = quaternions[i, n]
    some[LANES * OPACITY + lane] = opacities[i]


@njit(**FAST)
def _three(some, row):
    """Three rows of lanes."""
    return fetch(some, LANES * row), fetch(some, LANES * (row + 1)), fetch(some, LANES * (row + 2))


@njit(**FAST)
def _row_of(number):
    """Index of the lanes of one harmonics number, after rows of MAX_NUMBERS were transposed."""
    return MAX_NUMBERS * (number % LANES) + LANES * (number // LANES)


@njit(**FAST)
def _turn_all(rows, numbers):
    """Transpose rows of harmonics to lanes, or back, in place."""
    for first in range(0, numbers, LANES):
        turn(rows, first, first, MAX_NUMBERS)


@njit(**FAST)
def _outside(place, size):
    """Distance of a coordinate from the nearest pixel centre, in pixels; zero within the picture."""
    return highest(highest(HALF - place, place - (size - HALF)), ZERO)


@njit(**FAST)
def _reaches(opacity, away, variance):
    """Mask of Gaussians that add at least MIN_ALPHA at this distance from their centre."""
    exponent = lowest((HALF * LOG2_E) * away * away / variance, MAX_EXPONENT)
    return opacity > np.float32(MIN_ALPHA) * exp2(exponent)


@njit(parallel=True, **FAST)
def _forward(
    means, quaternions, scales, opacities, harmonics, v, bands, blur, compensate, centres, conics, depths, colours, seen
):
    numbers = 3 * bands * bands
    for part in prange(PARTS):
        some, made = np.zeros(TAKEN * LANES, np.float32), np.empty(MADE * LANES, np.float32)
        Y, rows = np.empty(16 * LANES, np.float32), np.zeros(MAX_NUMBERS * LANES, np.float32)
        end = len(means) * (part + 1) // PARTS
        for first in range(len(means) * part // PARTS, end, LANES):
            count = min(LANES, end - first)
            for lane in range(count):
                _take(some, lane, first + lane, means, quaternions, scales, opacities)
            mean, (sx, sy, sz), opacity = _three(some, MEAN), _three(some, SCALE), fetch(some, LANES * OPACITY)
            z, px, py, x, y = _onto_plane(mean, v)
            bent_x, bent_y, xx, xy, yy = _lens(x, y, v)
            over, under = px - x, py - y
            u = v[FOCAL] * (bent_x + xx * over + xy * under) + v[CENTRE]
            w = v[FOCAL + 1] * (bent_y + xy * over + yy * under) + v[CENTRE + 1]
            _, _, A, B = _slopes(where(z > v[NEAR], z, ONE), x, y, xx, xy, yy, v)
            _, _, Q = _rotation(some)
            a, b, c, det, narrow = _footprint(_row(A, Q, sx, sy, sz), _row(B, Q, sx, sy, sz), blur)
            if compensate:
                opacity = opacity * root(highest(narrow / det, MIN_DETERMINANT_RATIO))
            visible = (z > v[NEAR]) & _reaches(opacity, _outside(u, v[WIDTH]), a)
            visible = visible & _reaches(opacity, _outside(w, v[HEIGHT]), c)
            put(made, LANES * VISIBLE, where(visible, opacity, ZERO))
            for lane in range(count):
                if made[LANES * VISIBLE + lane] > 0:
                    for n in range(numbers):
                        rows[MAX_NUMBERS * lane + n] = harmonics[first + lane, n]
            _turn_all(rows, numbers)
            dx, dy, dz, _ = _direction(mean, v)
            basis(dx, dy, dz, bands, Y)
            red = green = blue = filled(HALF, SIXTEEN)
            for k in range(bands * bands):
                value = fetch(Y, LANES * k)
                red = red + value * fetch(rows, _row_of(3 * k))
                green = green + value * fetch(rows, _row_of(3 * k + 1))
                blue = blue + value * fetch(rows, _row_of(3 * k + 2))
            put(made, LANES * PLACE, u)
            put(made, LANES * (PLACE + 1), w)
            put(made, LANES * CONIC, c / det)
            put(made, LANES * (CONIC + 1), ZERO - b / det)
            put(made, LANES * (CONIC + 2), a / det)
            put(made, LANES * DEPTH, z)
            put(made, LANES * COLOUR, highest(red, ZERO))
            put(made, LANES * (COLOUR + 1), highest(green, ZERO))
            put(made, LANES * (COLOUR + 2), highest(blue, ZERO))
            for lane in range(count):
                i, kept = first + lane, made[LANES * VISIBLE + lane] > 0
                centres[i, 0] = made[LANES * PLACE + lane] if kept else ZERO
                centres[i, 1] = made[LANES * (PLACE + 1) + lane] if kept else ZERO
                for n in range(3):
                    conics[i, n] = made[LANES * (CONIC + n) + lane] if kept else ZERO
                    colours[i, n] = made[LANES * (COLOUR + n) + lane] if kept else ZERO
                depths[i] = made[LANES * DEPTH + lane] if kept else ZERO
                seen[i] = made[LANES * VISIBLE + lane] if kept else ZERO


@njit(parallel=True, **FAST)
def _backward(
    g_centres, g_conics, g_depths, g_colours, g_seen,
    means, quaternions, scales, opacities, harmonics, v, bands, blur, compensate, colours, seen,
    to_means, to_quaternions, to_scales, to_opacities, to_harmonics,
):  # fmt: skip
    inputs = means, quaternions, scales, opacities, harmonics
    grads, results = (
        (g_centres, g_conics, g_depths, g_colours, g_seen),
        (to_means, to_quaternions, to_scales, to_opacities, to_harmonics),
    )
    for part in prange(PARTS):
        some, given = np.zeros(TAKEN * LANES, np.float32), np.zeros(MADE * LANES, np.float32)
        Y, g_Y = np.empty(16 * LANES, np.float32), np.empty(16 * LANES, np.float32)
        rows, which, count = np.zeros(MAX_NUMBERS * LANES, np.float32), np.empty(LANES, np.int64), 0
        scratch = some, given, Y, g_Y, rows
        end = len(means) * (part + 1) // PARTS
        for i in range(len(means) * part // PARTS, end):
            if seen[i] > 0:
                which[count] = i
                count += 1
            else:
                to_means[i], to_quaternions[i], to_scales[i], to_opacities[i], to_harmonics[i] = 0, 0, 0, 0, 0
            if count == LANES or (i == end - 1 and count):
                _pull(which, count, grads, inputs, v, bands, blur, compensate, colours, results, scratch)
                count = 0


@njit(**FAST)
def _pull(which, count, grads, inputs, v, bands, blur, compensate, colours, results, scratch):
    """Gradients of up to sixteen visible Gaussians."""
    g_centres, g_conics, g_depths, g_colours, g_seen = grads
    means, quaternions, scales, opacities, harmonics = inputs
    to_means, to_quaternions, to_scales, to_opacities, to_harmonics = results
    some, given, Y, g_Y, rows = scratch
    numbers = 3 * bands * bands
    for lane in range(count):
        i = which[lane]
        _take(some, lane, i, means, quaternions, scales, opacities)
        given[LANES * PLACE + lane], given[LANES * (PLACE + 1) + lane] = g_centres[i, 0], g_centres[i, 1]
        for n in range(3):
            given[LANES * (CONIC + n) + lane] = g_conics[i, n]
            given[LANES * (COLOUR + n) + lane] = g_colours[i, n] if colours[i, n] > 0 else ZERO
        given[LANES * DEPTH + lane], given[LANES * VISIBLE + lane] = g_depths[i], g_seen[i]
        for n in range(numbers):
            rows[MAX_NUMBERS * lane + n] = harmonics[i, n]
    mean, (sx, sy, sz), opacity = _three(some, MEAN), _three(some, SCALE), fetch(some, LANES * OPACITY)
    g_u, g_w = fetch(given, LANES * PLACE), fetch(given, LANES * (PLACE + 1))
    (gxx, gxy, gyy), g_depth, g_opacity = (
        _three(given, CONIC),
        fetch(given, LANES * DEPTH),
        fetch(given, LANES * VISIBLE),
    )
    gxy = HALF * gxy
    z, px, py, x, y = _onto_plane(mean, v)
    _, _, xx, xy, yy = _lens(x, y, v)
    j, k, A, B = _slopes(z, x, y, xx, xy, yy, v)
    (qw, qx, qy, qz), length, Q = _rotation(some)
    T, U = _row(A, Q, sx, sy, sz), _row(B, Q, sx, sy, sz)
    a, b, c, det, narrow = _footprint(T, U, blur)

    # Rows T and U of the footprint's root. For K = C^-1 and W = K (T, U), dL/d(T, U) = -2 K G W. With n = T x U,
    # W = (blur T + U x n, blur U + n x T) / det, in which nothing cancels, however long it is.
    nx, ny, nz = T[1] * U[2] - T[2] * U[1], T[2] * U[0] - T[0] * U[2], T[0] * U[1] - T[1] * U[0]
    Un = (U[1] * nz - U[2] * ny, U[2] * nx - U[0] * nz, U[0] * ny - U[1] * nx)
    nT = (ny * T[2] - nz * T[1], nz * T[0] - nx * T[2], nx * T[1] - ny * T[0])
    kxx, kxy, kyy = c / det, ZERO - b / det, a / det
    to_opacity, fade, grow = g_opacity, filled(ZERO, SIXTEEN), filled(ZERO, SIXTEEN)
    if compensate:
        share = highest(narrow / det, MIN_DETERMINANT_RATIO)
        fade = where(share > MIN_DETERMINANT_RATIO, g_opacity * opacity / root(share) * blur / det, ZERO)
        grow = fade * (a + c - blur) / det
        fade = fade * share
        to_opacity = to_opacity * root(share)
    t0, u0 = _pulled(0, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, grow)
    t1, u1 = _pulled(1, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, grow)
    t2, u2 = _pulled(2, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, grow)

    # What made them: the slopes A and B, the rotation Q, the scales.
    gTs, gUs = (t0 * sx, t1 * sy, t2 * sz), (u0 * sx, u1 * sy, u2 * sz)
    gA = (_dot(Q[0], gTs), _dot(Q[1], gTs), _dot(Q[2], gTs))
    gB = (_dot(Q[0], gUs), _dot(Q[1], gUs), _dot(Q[2], gUs))
    to_sx = _along(A, Q, 0) * t0 + _along(B, Q, 0) * u0
    to_sy = _along(A, Q, 1) * t1 + _along(B, Q, 1) * u1
    to_sz = _along(A, Q, 2) * t2 + _along(B, Q, 2) * u2
    G00, G01, G02 = A[0] * gTs[0] + B[0] * gUs[0], A[0] * gTs[1] + B[0] * gUs[1], A[0] * gTs[2] + B[0] * gUs[2]
    G10, G11, G12 = A[1] * gTs[0] + B[1] * gUs[0], A[1] * gTs[1] + B[1] * gUs[1], A[1] * gTs[2] + B[1] * gUs[2]
    G20, G21, G22 = A[2] * gTs[0] + B[2] * gUs[0], A[2] * gTs[1] + B[2] * gUs[1], A[2] * gTs[2] + B[2] * gUs[2]
    hw = TWO * (qx * (G21 - G12) + qy * (G02 - G20) + qz * (G10 - G01))
    hx = TWO * (qy * (G01 + G10) + qz * (G02 + G20) + qw * (G21 - G12) - TWO * qx * (G11 + G22))
    hy = TWO * (qx * (G01 + G10) + qz * (G12 + G21) + qw * (G02 - G20) - TWO * qy * (G00 + G22))
    hz = TWO * (qx * (G02 + G20) + qy * (G12 + G21) + qw * (G10 - G01) - TWO * qz * (G00 + G11))
    along = qw * hw + qx * hx + qy * hy + qz * hz  # a quaternion's length does not matter

    # The slopes: their rotation, then the perspective, then the lens.
    g0, g1, g2 = _into_view(gA, v)
    h0, h1, h2 = _into_view(gB, v)
    fx, fy = v[FOCAL] / z, v[FOCAL + 1] / z
    gu, gv = v[FOCAL] * g_u, v[FOCAL + 1] * g_w
    over, under = px - x, py - y
    g_xx = fx * (g0 - x * g2) + gu * over
    g_xy = fx * (g1 - y * g2) + fy * (h0 - x * h2) + gu * under + gv * over
    g_yy = fy * (h1 - y * h2) + gv * under
    xxx, xxy, xyy, yyy = _curve(x, y, v)
    g_x = g_xx * xxx + g_xy * xxy + g_yy * xyy - fx * xx * g2 - fy * xy * h2
    g_y = g_xx * xxy + g_xy * xyy + g_yy * yyy - fx * xy * g2 - fy * yy * h2
    g_px = gu * xx + gv * xy + where(over != ZERO, ZERO, g_x)
    g_py = gu * xy + gv * yy + where(under != ZERO, ZERO, g_y)
    g_z = g_depth - (_dot(j, (g0, g1, g2)) + _dot(k, (h0, h1, h2)) + px * g_px + py * g_py) / z
    to_mean = _turned((g_px / z, g_py / z, g_z), v)

    # The colour, and the direction it is seen along.
    dx, dy, dz, distance = _direction(mean, v)
    red, green, blue = _three(given, COLOUR)
    basis(dx, dy, dz, bands, Y)
    _turn_all(rows, numbers)
    for n in range(bands * bands):
        h = fetch(rows, _row_of(3 * n)), fetch(rows, _row_of(3 * n + 1)), fetch(rows, _row_of(3 * n + 2))
        put(g_Y, LANES * n, red * h[0] + green * h[1] + blue * h[2])
        value = fetch(Y, LANES * n)
        put(rows, _row_of(3 * n), value * red)
        put(rows, _row_of(3 * n + 1), value * green)
        put(rows, _row_of(3 * n + 2), value * blue)
    _turn_all(rows, numbers)
    tx, ty, tz = slope(dx, dy, dz, bands, g_Y)
    inward = tx * dx + ty * dy + tz * dz
    put(some, LANES * MEAN, to_mean[0] + (tx - dx * inward) / distance)
    put(some, LANES * (MEAN + 1), to_mean[1] + (ty - dy * inward) / distance)
    put(some, LANES * (MEAN + 2), to_mean[2] + (tz - dz * inward) / distance)
    put(some, LANES * QUATERNION, (hw - qw * along) / length)
    put(some, LANES * (QUATERNION + 1), (hx - qx * along) / length)
    put(some, LANES * (QUATERNION + 2), (hy - qy * along) / length)
    put(some, LANES * (QUATERNION + 3), (hz - qz * along) / length)
    put(some, LANES * SCALE, to_sx)
    put(some, LANES * (SCALE + 1), to_sy)
    put(some, LANES * (SCALE + 2), to_sz)
    put(some, LANES * OPACITY, to_opacity)
    for lane in range(count):
        i = which[lane]
        for n in range(3):
            to_means[i, n], to_scales[i, n] = some[LANES * (MEAN + n) + lane], some[LANES * (SCALE + n) + lane]
        for n in range(4):
            to_quaternions[i, n] = some[LANES * (QUATERNION + n) + lane]
        to_opacities[i] = some[LANES * OPACITY + lane]
        for n in range(numbers):
            to_harmonics[i, n] = rows[MAX_NUMBERS * lane + n]
        for n in range(numbers, to_harmonics.shape[1]):
            to_harmonics[i, n] = ZERO


@njit(**FAST)
def _along(row, Q, n):
    """Product of a row with column n of the rotation."""
    return row[0] * Q[0][n] + row[1] * Q[1][n] + row[2] * Q[2][n]


def forward(ctx, means, quaternions, scales, opacities, harmonics, view, bands, blur, compensate):
    n, inputs = len(means), (means, quaternions, scales, opacities, harmonics)
    ctx.numbers = view.numbers().float().numpy(), bands, np.float32(blur), compensate
    results = empty(n, 2), empty(n, 3), empty(n), empty(n, 3), empty(n)
    _forward(*_flat(inputs), *ctx.numbers, *(x.numpy() for x in results))
    ctx.save_for_backward(*inputs, results[3], results[4])
    return results


def backward(ctx, *grads):
    *inputs, colours, seen = ctx.saved_tensors
    results = [empty(*x.shape) for x in inputs]
    seen = colours.numpy(), seen.numpy()
    _backward(*(x.numpy() for x in grads), *_flat(inputs), *ctx.numbers, *seen, *_flat(results))
    return *results, None, None, None, None


def _flat(tensors):
    """NumPy arrays of means, quaternions, scales, opacities and harmonics, the last flattened to a row per Gaussian."""
    *others, harmonics = (x.detach().numpy() for x in tensors)
    return *others, harmonics.reshape(len(harmonics), 3 * harmonics.shape[1])


run = differentiable(forward, backward)
