"""Triton: one lane takes one Gaussian. On the way back everything is worked out again rather than kept.

Backward, from the picture to the world. x' is the loss's derivative in x. L = Q diag(scale), T = N L with N = J R,
C = T T^T + blur I = (a b; b c), K = C^-1 the conic; T_0 and T_1 are a matrix's rows.

    conic    T' = -2 K K' K T, the halves of xy' to either side. K T cancels where a footprint is large; the same is
             K T = (blur T_0 + T_1 x n; blur T_1 + n x T_0) / det,  n = T_0 x T_1,  det = |n|^2 + blur (a + c - blur)
    opacity  o = opacity sqrt(share), share = |n|^2 / det; where that is above 1e-8:
             opacity' = sqrt(share) o'      share' = opacity o' / (2 sqrt(share))
             T_0' += 2 share' blur / det ((a + c - blur) / det T_1 x n - share T_0)      T_1' likewise, with n x T_0
    world    L' = N^T T'      Q' = L' diag(scale)      scale_j' = sum_i Q_ij L_ij'      J' = T' L^T R^T
    J        = S O, S = diag(focal) B(x, y), O = (1 0 -x; 0 1 -y) / z; (x, y) is (X, Y) = p_xy / z held within limits
             S' = J' O^T + u' (X - x, Y - y)      (x, y)' = S' : dS - S^T J_.2' / z      z' = -<J', J> / z
    lens     u = focal bent(x, y) + S (X - x, Y - y) + centre; what u owes to (x, y) through bent and X - x cancels
             (X, Y)' = S^T u' + (x, y)' where nothing was held
    mean     p' = ((X, Y)' / z, z' - (X X' + Y Y') / z)      mean' = R^T p' + (d' - d (d . d')) / |mean - eye|
"""

import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row, store_row
from .._operation import differentiable, empty
from ..spherical_harmonics.gpu import harmonic, harmonic_slope
from . import MIN_ALPHA as _MIN_ALPHA

MIN_ALPHA, MIN_SHARE = tl.constexpr(_MIN_ALPHA), tl.constexpr(1e-8)
# Where the parts of a view begin in View.numbers()
EYE, FOCAL, CENTRE, DISTORTION = tl.constexpr(9), tl.constexpr(12), tl.constexpr(14), tl.constexpr(16)
LIMITS, SIZE, NEAR = tl.constexpr(24), tl.constexpr(28), tl.constexpr(30)
BLOCK = tl.constexpr(128)

# Vectors are tuples of three, matrices tuples of rows.


@triton.jit
def _store(pointer, i, v, seen, here):
    """A row of three, zero where not seen."""
    store_row(pointer, i, (tl.where(seen, v[0], 0.0), tl.where(seen, v[1], 0.0), tl.where(seen, v[2], 0.0)), here)


@triton.jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def _mix(s, a, t, b):
    """s a + t b"""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@triton.jit
def _apply(M, v):
    """M v"""
    return _dot(M[0], v), _dot(M[1], v), _dot(M[2], v)


@triton.jit
def _across(v, M):
    """v^T M"""
    x = v[0] * M[0][0] + v[1] * M[1][0] + v[2] * M[2][0]
    y = v[0] * M[0][1] + v[1] * M[1][1] + v[2] * M[2][1]
    z = v[0] * M[0][2] + v[1] * M[1][2] + v[2] * M[2][2]
    return x, y, z


@triton.jit
def _rotation(view):
    return load_row(view, 0, True), load_row(view, 1, True), load_row(view, 2, True)


@triton.jit
def _unit(quaternions, i, here):
    """A unit quaternion (w, x, y, z), and 1 over the length that it had."""
    w = tl.load(quaternions + 4 * i, mask=here, other=1.0)
    x, y, z = load_row(quaternions + i + 1, i, here)
    inverse = 1 / tl.maximum(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse


@triton.jit
def _matrix(q):
    w, x, y, z = q
    row0 = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    row1 = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    row2 = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return row0, row1, row2


@triton.jit
def _matrix_backward(q, inverse, D):
    """Gradient of the quaternion before normalisation, from that of the rotation matrix."""
    w, x, y, z = q
    dw = 2 * (x * (D[2][1] - D[1][2]) + y * (D[0][2] - D[2][0]) + z * (D[1][0] - D[0][1]))
    dx = 2 * (y * (D[0][1] + D[1][0]) + z * (D[0][2] + D[2][0]) + w * (D[2][1] - D[1][2])) - 4 * x * (D[1][1] + D[2][2])
    dy = 2 * (x * (D[0][1] + D[1][0]) + z * (D[1][2] + D[2][1]) + w * (D[0][2] - D[2][0])) - 4 * y * (D[0][0] + D[2][2])
    dz = 2 * (x * (D[0][2] + D[2][0]) + y * (D[1][2] + D[2][1]) + w * (D[1][0] - D[0][1])) - 4 * z * (D[0][0] + D[1][1])
    along = w * dw + x * dx + y * dy + z * dz
    dw, dx, dy, dz = dw - along * w, dx - along * x, dy - along * y, dz - along * z
    return dw * inverse, dx * inverse, dy * inverse, dz * inverse


@triton.jit
def _stretched(Q, s):
    """Q diag(s)"""
    row0 = Q[0][0] * s[0], Q[0][1] * s[1], Q[0][2] * s[2]
    row1 = Q[1][0] * s[0], Q[1][1] * s[1], Q[1][2] * s[2]
    row2 = Q[2][0] * s[0], Q[2][1] * s[1], Q[2][2] * s[2]
    return row0, row1, row2


@triton.jit
def _radial(s, view):
    """The lens's q(s), 2 q'(s) and 4 q''(s), of P / B:  B q = P,  B q' = P' - q B',  B q'' = P'' - 2 q' B' - q B''."""
    k1, k2 = tl.load(view + DISTORTION), tl.load(view + DISTORTION + 1)
    k3, k4 = tl.load(view + DISTORTION + 4), tl.load(view + DISTORTION + 5)
    k5, k6 = tl.load(view + DISTORTION + 6), tl.load(view + DISTORTION + 7)
    inverse = 1 / (1 + s * (k4 + s * (k5 + s * k6)))
    below = k4 + s * (2 * k5 + s * (3 * k6))
    q = (1 + s * (k1 + s * (k2 + s * k3))) * inverse
    slope = 2 * (k1 + s * (2 * k2 + s * (3 * k3)) - q * below) * inverse
    curve = 4 * (2 * k2 + 6 * k3 * s - slope * below - q * (2 * k5 + 6 * k6 * s)) * inverse
    return q, slope, curve


@triton.jit
def _bend(x, y, view):
    """Distorted (x, y, 1), and the distortion's Jacobian (xx, xy, yy), as `lens.bend`."""
    p1, p2 = tl.load(view + DISTORTION + 2), tl.load(view + DISTORTION + 3)
    s = x * x + y * y
    q, slope, _ = _radial(s, view)
    across, down = p1 * y + p2 * x, p1 * x + p2 * y
    bent_x, bent_y = x * (q + 2 * across) + p2 * s, y * (q + 2 * across) + p1 * s
    xx = q + x * x * slope + 2 * across + 4 * p2 * x
    yy = q + y * y * slope + 2 * across + 4 * p1 * y
    return bent_x, bent_y, xx, x * y * slope + 2 * down, yy


@triton.jit
def _bend_backward(x, y, d_xx, d_xy, d_yy, view):
    """Gradient of (x, y) through the distortion's symmetric Jacobian: xx_y = xy_x, yy_x = xy_y."""
    p1, p2 = tl.load(view + DISTORTION + 2), tl.load(view + DISTORTION + 3)
    _, slope, curve = _radial(x * x + y * y, view)
    xxx, yyy = x * (3 * slope + x * x * curve) + 6 * p2, y * (3 * slope + y * y * curve) + 6 * p1
    xxy, xyy = y * (slope + x * x * curve) + 2 * p1, x * (slope + y * y * curve) + 2 * p2
    return xxx * d_xx + xxy * d_xy + xyy * d_yy, xxy * d_xx + xyy * d_xy + yyy * d_yy


@triton.jit
def _clamp_coordinate(X, low):
    """Clamp a coordinate of the plane z = 1 to the view's limits."""
    return tl.minimum(tl.maximum(X, tl.load(low)), tl.load(low + 1))


@triton.jit
def _lens(X, Y, z, view):
    """u, the lens Jacobian S in pixels by rows, and J = S O."""
    fx, fy = tl.load(view + FOCAL), tl.load(view + FOCAL + 1)
    x, y = _clamp_coordinate(X, view + LIMITS), _clamp_coordinate(Y, view + LIMITS + 2)
    bent_x, bent_y, xx, xy, yy = _bend(x, y, view)
    ux = fx * (bent_x + xx * (X - x) + xy * (Y - y)) + tl.load(view + CENTRE)
    uy = fy * (bent_y + xy * (X - x) + yy * (Y - y)) + tl.load(view + CENTRE + 1)
    S = (fx * xx, fx * xy), (fy * xy, fy * yy)
    J0 = S[0][0] / z, S[0][1] / z, -(S[0][0] * x + S[0][1] * y) / z
    J1 = S[1][0] / z, S[1][1] / z, -(S[1][0] * x + S[1][1] * y) / z
    return (ux, uy), S, (J0, J1)


@triton.jit
def _lens_backward(X, Y, z, S, J, d_u, d_J, view):
    """Gradient of p = z (X, Y, 1)."""
    fx, fy = tl.load(view + FOCAL), tl.load(view + FOCAL + 1)
    x, y = _clamp_coordinate(X, view + LIMITS), _clamp_coordinate(Y, view + LIMITS + 2)
    d_xx = fx * ((d_J[0][0] - x * d_J[0][2]) / z + d_u[0] * (X - x))
    d_xy = fx * ((d_J[0][1] - y * d_J[0][2]) / z + d_u[0] * (Y - y))
    d_xy += fy * ((d_J[1][0] - x * d_J[1][2]) / z + d_u[1] * (X - x))
    d_yy = fy * ((d_J[1][1] - y * d_J[1][2]) / z + d_u[1] * (Y - y))
    d_x, d_y = _bend_backward(x, y, d_xx, d_xy, d_yy, view)
    d_x -= (S[0][0] * d_J[0][2] + S[1][0] * d_J[1][2]) / z
    d_y -= (S[0][1] * d_J[0][2] + S[1][1] * d_J[1][2]) / z
    d_X = S[0][0] * d_u[0] + S[1][0] * d_u[1] + tl.where(x == X, d_x, 0.0)
    d_Y = S[0][1] * d_u[0] + S[1][1] * d_u[1] + tl.where(y == Y, d_y, 0.0)
    return d_X / z, d_Y / z, -(_dot(d_J[0], J[0]) + _dot(d_J[1], J[1]) + X * d_X + Y * d_Y) / z


@triton.jit
def _covariance(T, blur):
    """a, b, c and det of T T^T + blur I, and n = T_0 x T_1, whose square is det T T^T without cancellation."""
    n = _cross(T[0], T[1])
    a, b, c = _dot(T[0], T[0]) + blur, _dot(T[0], T[1]), _dot(T[1], T[1]) + blur
    return a, b, c, _dot(n, n) + blur * (a + c - blur), n


@triton.jit
def _covariance_backward(T, d_conic, d_share, blur):
    """Gradient of T, from those of the conic K = C^-1 and of the compensation share |n|^2 / det."""
    a, b, c, det, n = _covariance(T, blur)
    xx, xy, yy = c / det, -b / det, a / det
    up, down = _cross(T[1], n), _cross(n, T[0])  # half the slope of |n|^2 in T_0, in T_1
    KT0, KT1 = _mix(blur / det, T[0], 1 / det, up), _mix(blur / det, T[1], 1 / det, down)
    GKT0 = _mix(d_conic[0], KT0, 0.5 * d_conic[1], KT1)
    GKT1 = _mix(0.5 * d_conic[1], KT0, d_conic[2], KT1)
    d_T0, d_T1 = _mix(-2 * xx, GKT0, -2 * xy, GKT1), _mix(-2 * xy, GKT0, -2 * yy, GKT1)
    steep = 2 * d_share * blur / det
    narrow, wide = steep * (a + c - blur) / det, -steep * _dot(n, n) / det
    d_T0 = _mix(1.0, d_T0, 1.0, _mix(narrow, up, wide, T[0]))
    d_T1 = _mix(1.0, d_T1, 1.0, _mix(narrow, down, wide, T[1]))
    return d_T0, d_T1


@triton.jit
def _colour(harmonics, i, d, seen, K: tl.constexpr, BANDS: tl.constexpr):
    """1/2 + sum_k Y_k(d) h_k, before clamping at zero."""
    half = 0.5 + 0 * d[0]
    colour = half, half, half
    for k in tl.static_range(BANDS * BANDS):
        colour = _mix(1.0, colour, harmonic(k, d[0], d[1], d[2]), load_row(harmonics, K * i + k, seen))
    return colour


@triton.jit
def _direction(v):
    inverse = 1 / tl.maximum(tl.sqrt(_dot(v, v)), 1e-12)
    return (v[0] * inverse, v[1] * inverse, v[2] * inverse), inverse


@triton.jit
def _reaches(u, extent, size):
    """True if a footprint reaches the picture along one axis."""
    return (u + extent >= 0.5) & (u - extent <= size - 0.5)


@triton.jit(do_not_specialize=["N"])
def _forward(inputs, view, outputs, N, blur, K: tl.constexpr, BANDS: tl.constexpr, COMPENSATE: tl.constexpr):
    means, quaternions, scales, opacities, harmonics = inputs
    centres, conics, depths, colours, shown = outputs
    i, here = indices(N, BLOCK)
    R = _rotation(view)
    v = _mix(1.0, load_row(means, i, here), -1.0, load_row(view + EYE, 0, True))
    p = _apply(R, v)
    seen = here & (p[2] > tl.load(view + NEAR))
    z = tl.where(seen, p[2], 1.0)
    u, _, J = _lens(p[0] / z, p[1] / z, z, view)
    q, _ = _unit(quaternions, i, here)
    L = _stretched(_matrix(q), load_row(scales, i, here))
    T = _across(_across(J[0], R), L), _across(_across(J[1], R), L)
    a, b, c, det, n = _covariance(T, blur)
    opacity = tl.load(opacities + i, mask=here, other=0.0)
    if COMPENSATE:
        opacity *= tl.sqrt(tl.maximum(_dot(n, n) / det, MIN_SHARE))
    reach = 2 * tl.log(tl.maximum(opacity / MIN_ALPHA, 1.0))
    wide, high = tl.sqrt(tl.maximum(reach * a, 1e-12)), tl.sqrt(tl.maximum(reach * c, 1e-12))
    seen &= _reaches(u[0], wide, tl.load(view + SIZE)) & _reaches(u[1], high, tl.load(view + SIZE + 1))
    seen &= opacity > MIN_ALPHA
    d, _ = _direction(v)
    colour = _colour(harmonics, i, d, seen, K, BANDS)
    colour = tl.maximum(colour[0], 0.0), tl.maximum(colour[1], 0.0), tl.maximum(colour[2], 0.0)
    tl.store(centres + 2 * i, tl.where(seen, u[0], 0.0), mask=here)
    tl.store(centres + 2 * i + 1, tl.where(seen, u[1], 0.0), mask=here)
    _store(conics, i, (c / det, -b / det, a / det), seen, here)
    tl.store(depths + i, tl.where(seen, z, 0.0), mask=here)
    _store(colours, i, colour, seen, here)
    tl.store(shown + i, tl.where(seen, opacity, 0.0), mask=here)


@triton.jit(do_not_specialize=["N"])
def _backward(
    grads, inputs, view, depths, colours, found, N, blur, K: tl.constexpr, BANDS: tl.constexpr, COMPENSATE: tl.constexpr
):
    d_centres, d_conics, d_depths, d_colours, d_shown = grads
    means, quaternions, scales, opacities, harmonics = inputs
    d_means, d_quaternions, d_scales, d_opacities, d_harmonics = found
    i, here = indices(N, BLOCK)
    seen = tl.load(depths + i, mask=here, other=0.0) > 0  # what is not seen has depth zero, and all gradients zero
    R = _rotation(view)
    v = _mix(1.0, load_row(means, i, seen), -1.0, load_row(view + EYE, 0, True))
    p = _apply(R, v)
    z = tl.where(seen, p[2], 1.0)
    X, Y = p[0] / z, p[1] / z
    _, S, J = _lens(X, Y, z, view)
    q, inverse = _unit(quaternions, i, seen)
    Q, s = _matrix(q), load_row(scales, i, seen)
    L = _stretched(Q, s)
    N0, N1 = _across(J[0], R), _across(J[1], R)
    T = _across(N0, L), _across(N1, L)

    d_opacity = tl.load(d_shown + i, mask=seen, other=0.0)
    d_share = 0 * z
    if COMPENSATE:
        _, _, _, det, n = _covariance(T, blur)
        share = _dot(n, n) / det
        root = tl.sqrt(tl.maximum(share, MIN_SHARE))
        opacity = tl.load(opacities + i, mask=seen, other=0.0)
        d_share = tl.where(share > MIN_SHARE, 0.5 * d_opacity * opacity / root, 0.0)
        d_opacity *= root
    d_T = _covariance_backward(T, load_row(d_conics, i, seen), d_share, blur)
    d_L0 = _mix(N0[0], d_T[0], N1[0], d_T[1])
    d_L1 = _mix(N0[1], d_T[0], N1[1], d_T[1])
    d_L2 = _mix(N0[2], d_T[0], N1[2], d_T[1])
    d_L = d_L0, d_L1, d_L2
    d_J = _apply(R, _apply(L, d_T[0])), _apply(R, _apply(L, d_T[1]))
    d_u = tl.load(d_centres + 2 * i, mask=seen, other=0.0), tl.load(d_centres + 2 * i + 1, mask=seen, other=0.0)
    d_p = _lens_backward(X, Y, z, S, J, d_u, d_J, view)
    d_v = _across((d_p[0], d_p[1], d_p[2] + tl.load(d_depths + i, mask=seen, other=0.0)), R)

    d, shrink = _direction(v)
    colour, g = load_row(colours, i, seen), load_row(d_colours, i, seen)
    g = tl.where(colour[0] > 0, g[0], 0.0), tl.where(colour[1] > 0, g[1], 0.0), tl.where(colour[2] > 0, g[2], 0.0)
    d_d = 0 * z, 0 * z, 0 * z
    for k in tl.static_range(K):
        if k < BANDS * BANDS:
            worth = _dot(g, load_row(harmonics, K * i + k, seen))
            d_d = _mix(1.0, d_d, worth, harmonic_slope(k, d[0], d[1], d[2]))
            Y_k = harmonic(k, d[0], d[1], d[2])
            _store(d_harmonics, K * i + k, (Y_k * g[0], Y_k * g[1], Y_k * g[2]), seen, here)
        else:
            _store(d_harmonics, K * i + k, g, False, here)
    d_v = _mix(1.0, d_v, shrink, _mix(1.0, d_d, -_dot(d, d_d), d))

    d_q = _matrix_backward(q, inverse, _stretched(d_L, s))
    d_s0 = Q[0][0] * d_L0[0] + Q[1][0] * d_L1[0] + Q[2][0] * d_L2[0]
    d_s1 = Q[0][1] * d_L0[1] + Q[1][1] * d_L1[1] + Q[2][1] * d_L2[1]
    d_s2 = Q[0][2] * d_L0[2] + Q[1][2] * d_L1[2] + Q[2][2] * d_L2[2]
    _store(d_means, i, d_v, seen, here)
    tl.store(d_quaternions + 4 * i, tl.where(seen, d_q[0], 0.0), mask=here)
    _store(d_quaternions + i + 1, i, (d_q[1], d_q[2], d_q[3]), seen, here)
    _store(d_scales, i, (d_s0, d_s1, d_s2), seen, here)
    tl.store(d_opacities + i, tl.where(seen, d_opacity, 0.0), mask=here)


def forward(ctx, means, quaternions, scales, opacities, harmonics, view, bands, blur, compensate):
    inputs, numbers = (means, quaternions, scales, opacities, harmonics), view.numbers().to(means)
    count, device = len(means), means.device
    outputs = tuple(empty(*shape, device=device) for shape in ((count, 2), (count, 3), (count,), (count, 3), (count,)))
    ctx.options = {"K": harmonics.shape[1], "BANDS": bands, "COMPENSATE": compensate}
    ctx.grid, ctx.rest = (blocks(count, BLOCK),), (count, float(blur))
    launch(_forward, ctx.grid, inputs, numbers, outputs, *ctx.rest, **ctx.options)
    ctx.save_for_backward(*inputs, numbers, outputs[2], outputs[3])
    return outputs


def backward(ctx, *grads):
    *inputs, view, depths, colours = ctx.saved_tensors
    found = tuple(empty(*x.shape, device=x.device) for x in inputs)
    launch(_backward, ctx.grid, grads, tuple(inputs), view, depths, colours, found, *ctx.rest, **ctx.options)
    return *found, None, None, None, None


run = differentiable(forward, backward)
