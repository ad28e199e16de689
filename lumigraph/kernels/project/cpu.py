"""Numba: threads share the Gaussians. On the way back everything is worked out again rather than kept."""

import math

import numpy as np
from numba import njit, prange

from .._operation import differentiable, empty
from ..spherical_harmonics.cpu import basis, slope
from . import MIN_ALPHA

FAST = {"cache": True, "fastmath": {"contract", "nsz", "arcp", "reassoc"}, "error_model": "numpy"}
HALF, ONE, TWO = np.float32(0.5), np.float32(1), np.float32(2)
MIN_DETERMINANT_RATIO = np.float32(1e-8)  # of a footprint's determinant to the blurred one's
# Where a view's numbers begin.
EYE, FOCAL, CENTRE, LENS, LIMITS, WIDTH, HEIGHT, NEAR = 9, 12, 14, 16, 24, 28, 29, 30


@njit(**FAST)
def _radial(s, v):
    """q(s), the rational factor of the lens's distortion, and its first and second derivatives."""
    k1, k2, k3 = v[LENS], v[LENS + 1], v[LENS + 4]
    k4, k5, k6 = v[LENS + 5], v[LENS + 6], v[LENS + 7]
    below = ONE + s * (k4 + s * (k5 + s * k6))
    q = (ONE + s * (k1 + s * (k2 + s * k3))) / below
    slope_below = k4 + s * (2 * k5 + s * (3 * k6))
    q1 = (k1 + s * (2 * k2 + s * (3 * k3)) - q * slope_below) / below
    q2 = (2 * k2 + s * (6 * k3) - 2 * q1 * slope_below - q * (2 * k5 + s * (6 * k6))) / below
    return q, q1, q2


@njit(**FAST)
def _lens(x, y, v):
    """The bent point, and the Jacobian's entries xx, xy, yy (see `lens.bend`)."""
    p1, p2, s = v[LENS + 2], v[LENS + 3], x * x + y * y
    q, q1, _ = _radial(s, v)
    around = q + 2 * (p1 * y + p2 * x)
    xx = around + 2 * x * x * q1 + 4 * p2 * x
    xy = 2 * x * y * q1 + 2 * (p1 * x + p2 * y)
    yy = around + 2 * y * y * q1 + 4 * p1 * y
    return x * around + p2 * s, y * around + p1 * s, xx, xy, yy


@njit(**FAST)
def _curve(x, y, v):
    """Derivatives of the Jacobian: xxx, xxy, xyy, yyy."""
    _, q1, q2 = _radial(x * x + y * y, v)
    p1, p2 = v[LENS + 2], v[LENS + 3]
    xxx = x * (6 * q1 + 4 * x * x * q2) + 6 * p2
    xxy = y * (2 * q1 + 4 * x * x * q2) + 2 * p1
    xyy = x * (2 * q1 + 4 * y * y * q2) + 2 * p2
    yyy = y * (6 * q1 + 4 * y * y * q2) + 6 * p1
    return xxx, xxy, xyy, yyy


@njit(**FAST)
def _onto_plane(means, i, v):
    """Depth, point on the plane z = 1, and the same within the view's limits."""
    dx, dy, dz = means[i, 0] - v[EYE], means[i, 1] - v[EYE + 1], means[i, 2] - v[EYE + 2]
    z = v[6] * dx + v[7] * dy + v[8] * dz
    safe = z if z > v[NEAR] else ONE
    px = (v[0] * dx + v[1] * dy + v[2] * dz) / safe
    py = (v[3] * dx + v[4] * dy + v[5] * dz) / safe
    x = min(max(px, v[LIMITS]), v[LIMITS + 1])
    y = min(max(py, v[LIMITS + 2]), v[LIMITS + 3])
    return z, px, py, x, y


@njit(**FAST)
def _rotation(quaternions, i):
    """The unit quaternion, the length it had, and its matrix row by row."""
    w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
    length = max(math.sqrt(w * w + x * x + y * y + z * z), np.float32(1e-12))
    w, x, y, z = w / length, x / length, y / length, z / length
    rows = (
        (ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y)),
        (TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x)),
        (TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y)),
    )
    return (w, x, y, z), length, rows


@njit(**FAST)
def _slopes(z, x, y, xx, xy, yy, v):
    """The two rows of du/dmean: the lens's slope, the perspective's, and the camera's rotation."""
    fx, fy = v[FOCAL] / z, v[FOCAL + 1] / z
    j = fx * xx, fx * xy, -fx * (xx * x + xy * y)
    k = fy * xy, fy * yy, -fy * (xy * x + yy * y)
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
def _pulled(n, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, turn):
    """Component n of the gradients of T and U: -2 K G W, and what the compensation adds."""
    w0, w1 = (blur * T[n] + Un[n]) / det, (blur * U[n] + nT[n]) / det
    x0, x1 = gxx * w0 + gxy * w1, gxy * w0 + gyy * w1
    to_t = -TWO * (kxx * x0 + kxy * x1) + turn * Un[n] - fade * T[n]
    to_u = -TWO * (kxy * x0 + kyy * x1) + turn * nT[n] - fade * U[n]
    return to_t, to_u


@njit(**FAST)
def _direction(means, i, v):
    """From the eye to a Gaussian, unit length, and the distance."""
    x, y, z = means[i, 0] - v[EYE], means[i, 1] - v[EYE + 1], means[i, 2] - v[EYE + 2]
    length = max(math.sqrt(x * x + y * y + z * z), np.float32(1e-12))
    return x / length, y / length, z / length, length


@njit(parallel=True, **FAST)
def _forward(
    means, quaternions, scales, opacities, harmonics, v, bands, blur, compensate, centres, conics, depths, colours, seen
):
    parts = 64
    for part in prange(parts):
        Y = np.empty(16, np.float32)
        for i in range(len(means) * part // parts, len(means) * (part + 1) // parts):
            centres[i], conics[i], colours[i], depths[i], seen[i] = 0, 0, 0, 0, 0
            z, px, py, x, y = _onto_plane(means, i, v)
            if not (z > v[NEAR] and opacities[i] > MIN_ALPHA):
                continue
            bent_x, bent_y, xx, xy, yy = _lens(x, y, v)
            over, under = px - x, py - y
            u = v[FOCAL] * (bent_x + xx * over + xy * under) + v[CENTRE]
            w = v[FOCAL + 1] * (bent_y + xy * over + yy * under) + v[CENTRE + 1]
            _, _, A, B = _slopes(z, x, y, xx, xy, yy, v)
            _, _, Q = _rotation(quaternions, i)
            sx, sy, sz = scales[i, 0], scales[i, 1], scales[i, 2]
            a, b, c, det, narrow = _footprint(_row(A, Q, sx, sy, sz), _row(B, Q, sx, sy, sz), blur)
            opacity = opacities[i]
            if compensate:
                opacity *= math.sqrt(max(narrow / det, MIN_DETERMINANT_RATIO))
            if not opacity > MIN_ALPHA:
                continue
            reach = TWO * math.log(opacity / np.float32(MIN_ALPHA))
            wide, high = math.sqrt(reach * a), math.sqrt(reach * c)
            if u + wide < HALF or u - wide > v[WIDTH] - HALF or w + high < HALF or w - high > v[HEIGHT] - HALF:
                continue
            dx, dy, dz, _ = _direction(means, i, v)
            basis(dx, dy, dz, bands, Y)
            red = green = blue = HALF
            for k in range(bands * bands):
                red += Y[k] * harmonics[i, k, 0]
                green += Y[k] * harmonics[i, k, 1]
                blue += Y[k] * harmonics[i, k, 2]
            centres[i, 0], centres[i, 1] = u, w
            conics[i, 0], conics[i, 1], conics[i, 2] = c / det, -b / det, a / det
            depths[i], seen[i] = z, opacity
            colours[i, 0], colours[i, 1], colours[i, 2] = max(red, 0), max(green, 0), max(blue, 0)


@njit(parallel=True, **FAST)
def _backward(
    g_centres, g_conics, g_depths, g_colours, g_seen,
    means, quaternions, scales, opacities, harmonics, v, bands, blur, compensate, colours, seen,
    to_means, to_quaternions, to_scales, to_opacities, to_harmonics,
):  # fmt: skip
    parts = 64
    for part in prange(parts):
        Y, worth = np.empty(16, np.float32), np.empty(16, np.float32)
        for i in range(len(means) * part // parts, len(means) * (part + 1) // parts):
            to_means[i], to_quaternions[i], to_scales[i], to_opacities[i], to_harmonics[i] = 0, 0, 0, 0, 0
            if not seen[i] > 0:
                continue
            z, px, py, x, y = _onto_plane(means, i, v)
            _, _, xx, xy, yy = _lens(x, y, v)
            j, k, A, B = _slopes(z, x, y, xx, xy, yy, v)
            (qw, qx, qy, qz), length, Q = _rotation(quaternions, i)
            sx, sy, sz = scales[i, 0], scales[i, 1], scales[i, 2]
            T, U = _row(A, Q, sx, sy, sz), _row(B, Q, sx, sy, sz)
            a, b, c, det, narrow = _footprint(T, U, blur)

            # Rows T and U of the footprint's root. For K = C^-1 and W = K (T, U), dL/d(T, U) = -2 K G W. With
            # n = T x U, W = (blur T + U x n, blur U + n x T) / det, in which nothing cancels, however long it is.
            nx, ny, nz = T[1] * U[2] - T[2] * U[1], T[2] * U[0] - T[0] * U[2], T[0] * U[1] - T[1] * U[0]
            Un = (U[1] * nz - U[2] * ny, U[2] * nx - U[0] * nz, U[0] * ny - U[1] * nx)
            nT = (ny * T[2] - nz * T[1], nz * T[0] - nx * T[2], nx * T[1] - ny * T[0])
            kxx, kxy, kyy = c / det, -b / det, a / det
            gxx, gxy, gyy = g_conics[i, 0], HALF * g_conics[i, 1], g_conics[i, 2]
            to_opacity, fade, turn = g_seen[i], np.float32(0), np.float32(0)
            if compensate:
                share = max(narrow / det, MIN_DETERMINANT_RATIO)
                if share > MIN_DETERMINANT_RATIO:
                    fade = g_seen[i] * opacities[i] / math.sqrt(share) * blur / det
                    turn = fade * (a + c - blur) / det
                    fade *= share
                to_opacity *= math.sqrt(share)
            to_opacities[i] = to_opacity
            t0, u0 = _pulled(0, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, turn)
            t1, u1 = _pulled(1, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, turn)
            t2, u2 = _pulled(2, T, U, Un, nT, blur, det, gxx, gxy, gyy, kxx, kxy, kyy, fade, turn)
            gT, gU = (t0, t1, t2), (u0, u1, u2)

            # What made them: the slopes A and B, the rotation Q, the scales.
            gTs = (gT[0] * sx, gT[1] * sy, gT[2] * sz)
            gUs = (gU[0] * sx, gU[1] * sy, gU[2] * sz)
            gA = (_dot(Q[0], gTs), _dot(Q[1], gTs), _dot(Q[2], gTs))
            gB = (_dot(Q[0], gUs), _dot(Q[1], gUs), _dot(Q[2], gUs))
            for n in range(3):
                q0, q1, q2 = Q[0][n], Q[1][n], Q[2][n]
                to_scales[i, n] = (A[0] * q0 + A[1] * q1 + A[2] * q2) * gT[n] + (
                    B[0] * q0 + B[1] * q1 + B[2] * q2
                ) * gU[n]
            G00, G01, G02 = A[0] * gTs[0] + B[0] * gUs[0], A[0] * gTs[1] + B[0] * gUs[1], A[0] * gTs[2] + B[0] * gUs[2]
            G10, G11, G12 = A[1] * gTs[0] + B[1] * gUs[0], A[1] * gTs[1] + B[1] * gUs[1], A[1] * gTs[2] + B[1] * gUs[2]
            G20, G21, G22 = A[2] * gTs[0] + B[2] * gUs[0], A[2] * gTs[1] + B[2] * gUs[1], A[2] * gTs[2] + B[2] * gUs[2]
            hw = TWO * (qx * (G21 - G12) + qy * (G02 - G20) + qz * (G10 - G01))
            hx = TWO * (qy * (G01 + G10) + qz * (G02 + G20) + qw * (G21 - G12) - TWO * qx * (G11 + G22))
            hy = TWO * (qx * (G01 + G10) + qz * (G12 + G21) + qw * (G02 - G20) - TWO * qy * (G00 + G22))
            hz = TWO * (qx * (G02 + G20) + qy * (G12 + G21) + qw * (G10 - G01) - TWO * qz * (G00 + G11))
            along = qw * hw + qx * hx + qy * hy + qz * hz  # a quaternion's length does not matter
            to_quaternions[i, 0], to_quaternions[i, 1] = (hw - qw * along) / length, (hx - qx * along) / length
            to_quaternions[i, 2], to_quaternions[i, 3] = (hy - qy * along) / length, (hz - qz * along) / length

            # The slopes: their rotation, then the perspective, then the lens.
            g0, g1, g2 = _dot((v[0], v[1], v[2]), gA), _dot((v[3], v[4], v[5]), gA), _dot((v[6], v[7], v[8]), gA)
            h0, h1, h2 = _dot((v[0], v[1], v[2]), gB), _dot((v[3], v[4], v[5]), gB), _dot((v[6], v[7], v[8]), gB)
            fx, fy = v[FOCAL] / z, v[FOCAL + 1] / z
            gu, gv = v[FOCAL] * g_centres[i, 0], v[FOCAL + 1] * g_centres[i, 1]
            over, under = px - x, py - y
            g_xx = fx * (g0 - x * g2) + gu * over
            g_xy = fx * (g1 - y * g2) + fy * (h0 - x * h2) + gu * under + gv * over
            g_yy = fy * (h1 - y * h2) + gv * under
            xxx, xxy, xyy, yyy = _curve(x, y, v)
            g_x = g_xx * xxx + g_xy * xxy + g_yy * xyy - fx * xx * g2 - fy * xy * h2
            g_y = g_xx * xxy + g_xy * xyy + g_yy * yyy - fx * xy * g2 - fy * yy * h2
            g_px, g_py = gu * xx + gv * xy, gu * xy + gv * yy
            g_px += g_x if over == 0 else 0
            g_py += g_y if under == 0 else 0
            g_z = g_depths[i] - (_dot(j, (g0, g1, g2)) + _dot(k, (h0, h1, h2)) + px * g_px + py * g_py) / z
            to_mean = _turned((g_px / z, g_py / z, g_z), v)

            # The colour, and the direction it is seen along.
            dx, dy, dz, distance = _direction(means, i, v)
            basis(dx, dy, dz, bands, Y)
            red = g_colours[i, 0] if colours[i, 0] > 0 else np.float32(0)
            green = g_colours[i, 1] if colours[i, 1] > 0 else np.float32(0)
            blue = g_colours[i, 2] if colours[i, 2] > 0 else np.float32(0)
            for n in range(bands * bands):
                to_harmonics[i, n, 0], to_harmonics[i, n, 1], to_harmonics[i, n, 2] = (
                    Y[n] * red,
                    Y[n] * green,
                    Y[n] * blue,
                )
                worth[n] = red * harmonics[i, n, 0] + green * harmonics[i, n, 1] + blue * harmonics[i, n, 2]
            tx, ty, tz = slope(dx, dy, dz, bands, worth)
            inward = tx * dx + ty * dy + tz * dz
            to_means[i, 0] = to_mean[0] + (tx - dx * inward) / distance
            to_means[i, 1] = to_mean[1] + (ty - dy * inward) / distance
            to_means[i, 2] = to_mean[2] + (tz - dz * inward) / distance


def forward(ctx, means, quaternions, scales, opacities, harmonics, view, bands, blur, compensate):
    n, inputs = len(means), (means, quaternions, scales, opacities, harmonics)
    ctx.numbers = view.numbers().float().numpy(), bands, np.float32(blur), compensate
    results = empty(n, 2), empty(n, 3), empty(n), empty(n, 3), empty(n)
    _forward(*(x.detach().numpy() for x in inputs), *ctx.numbers, *(x.numpy() for x in results))
    ctx.save_for_backward(*inputs, results[3], results[4])
    return results


def backward(ctx, *grads):
    *inputs, colours, seen = (x.detach().numpy() for x in ctx.saved_tensors)
    results = [empty(*x.shape) for x in inputs]
    _backward(*(x.numpy() for x in grads), *inputs, *ctx.numbers, colours, seen, *(x.numpy() for x in results))
    return *results, None, None, None, None


run = differentiable(forward, backward)
