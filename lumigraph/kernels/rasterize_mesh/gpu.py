"""Triton: a lane draws a triangle, some pixels of its box at a time, into a buffer of 1 / z and number, by an atomic
maximum of both as one integer. Then a lane takes a pixel. Gradients meet in atomic adds.

Coverage is computed in double precision, as on the CPU: neighbours must leave no gap.
"""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch, load_row
from .._operation import differentiable, empty

TRIANGLES, STRIDE = tl.constexpr(32), tl.constexpr(16)  # triangles of a program, pixels of each that are drawn together
PIXELS = tl.constexpr(64)  # pixels of a program
SLACK = tl.constexpr(1e-9)  # by which u may be below 0, as a share of 1 / z


@triton.jit
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def _corners(corners, faces, f, here):
    """Vertex numbers and positions of a triangle's corners."""
    i, j, k = load_row(faces, f, here)
    x, y, z = load_row(corners, i, here)
    a = x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)
    x, y, z = load_row(corners, j, here)
    b = x.to(tl.float64), y.to(tl.float64), z.to(tl.float64)
    x, y, z = load_row(corners, k, here)
    return (i, j, k), a, b, (x.to(tl.float64), y.to(tl.float64), z.to(tl.float64))


@triton.jit
def _planes(a, b, c):
    """Rows of M^-1, and det M."""
    first, second, third = _cross(b, c), _cross(c, a), _cross(a, b)
    volume = first[0] * a[0] + first[1] * a[1] + first[2] * a[2]
    scale = 1 / tl.where(volume == 0, 1.0, volume)
    first = first[0] * scale, first[1] * scale, first[2] * scale
    second = second[0] * scale, second[1] * scale, second[2] * scale
    return first, second, (third[0] * scale, third[1] * scale, third[2] * scale), volume


@triton.jit
def _at(plane, x, y):
    return plane[0] * x + plane[1] * y + plane[2]


@triton.jit
def _range(a, b, c, axis: tl.constexpr, whole, pixels):
    """First pixel along an axis whose centre a triangle may cover, and their number; all of them where `whole`."""
    u, v = a[axis] / tl.where(whole, 1.0, a[2]), b[axis] / tl.where(whole, 1.0, b[2])
    w = c[axis] / tl.where(whole, 1.0, c[2])
    low, high = tl.minimum(tl.minimum(u, v), w), tl.maximum(tl.maximum(u, v), w)
    low = tl.where(whole, 0.0, tl.minimum(tl.maximum(low, 0.0), pixels))
    high = tl.where(whole, pixels, tl.minimum(tl.maximum(high, 0.0), pixels))
    first = tl.floor(low)
    return first.to(tl.int32), tl.maximum(tl.minimum(tl.floor(high), pixels - 1.0) - first + 1, 0.0).to(tl.int32)


@triton.jit(do_not_specialize=["F", "width", "height"])
def _draw(corners, faces, buffer, F, width, height, near):
    f, here = indices(F, TRIANGLES)
    _, a, b, c = _corners(corners, faces, f, here)
    first, second, third, volume = _planes(a, b, c)
    least = tl.minimum(tl.minimum(a[2], b[2]), c[2])
    seen = here & (volume != 0) & (tl.abs(volume) < float("inf"))  # not where a corner is no number
    left, columns = _range(a, b, c, 0, least <= near, width.to(tl.float64))
    top, rows = _range(a, b, c, 1, least <= near, height.to(tl.float64))
    count = tl.where(seen, columns * rows, 0)
    columns, most = tl.maximum(columns, 1), tl.max(count, 0)
    begin = 0
    while begin < most:
        place = begin + tl.arange(0, STRIDE)[None, :]
        x, y = left[:, None] + place % columns[:, None], top[:, None] + place // columns[:, None]
        px, py = x.to(tl.float64) + 0.5, y.to(tl.float64) + 0.5
        u = first[0][:, None] * px + first[1][:, None] * py + first[2][:, None]
        v = second[0][:, None] * px + second[1][:, None] * py + second[2][:, None]
        w = third[0][:, None] * px + third[1][:, None] * py + third[2][:, None]
        total = u + v + w
        inside = (tl.minimum(tl.minimum(u, v), w) >= -SLACK * total) & (total > 0) & (total * near < 1)
        nearness = total.to(tl.float32).to(tl.int32, bitcast=True).to(tl.int64)  # bits of floats > 0 sort as they do
        key = nearness * 4294967296 + (2147483647 - f[:, None])
        tl.atomic_max(buffer + y.to(tl.int64) * width + x, key, mask=inside & (place < count[:, None]), sem="relaxed")
        begin += STRIDE


@triton.jit
def _pixel(buffer, P, width):
    """Indices of the program's pixels, a mask of covered ones, their triangles, and their centres."""
    p, here = indices(P, PIXELS)
    f = tl.load(buffer + p, mask=here, other=-1).to(tl.int64)
    return p, here, here & (f >= 0), f, (p % width).to(tl.float64) + 0.5, (p // width).to(tl.float64) + 0.5


@triton.jit(do_not_specialize=["P", "width"])
def _fill(corners, attributes, faces, buffer, values, depth, found, P, width, C: tl.constexpr, CHANNELS: tl.constexpr):
    p, here = indices(P, PIXELS)
    key = tl.load(buffer + p, mask=here, other=0)
    seen = here & (key > 0)
    f = tl.where(seen, 2147483647 - key % 4294967296, -1)
    tl.store(found + p, f.to(tl.int32), mask=here)
    n, a, b, c = _corners(corners, faces, f, seen)
    first, second, third, _ = _planes(a, b, c)
    x, y = (p % width).to(tl.float64) + 0.5, (p // width).to(tl.float64) + 0.5
    u, v, w = _at(first, x, y), _at(second, x, y), _at(third, x, y)
    z = 1 / tl.where(seen, u + v + w, 1.0)
    tl.store(depth + p, tl.where(seen, z, 0.0).to(tl.float32), mask=here)
    k = tl.arange(0, CHANNELS)[None, :]
    there = seen[:, None] & (k < C)
    value = (u * z)[:, None] * tl.load(attributes + n[0].to(tl.int64)[:, None] * C + k, mask=there, other=0.0)
    value += (v * z)[:, None] * tl.load(attributes + n[1].to(tl.int64)[:, None] * C + k, mask=there, other=0.0)
    value += (w * z)[:, None] * tl.load(attributes + n[2].to(tl.int64)[:, None] * C + k, mask=there, other=0.0)
    tl.store(values + p[:, None] * C + k, value.to(tl.float32), mask=here[:, None] & (k < C))


@triton.jit
def _add(pointer, value, here):
    tl.atomic_add(pointer, value.to(tl.float32), mask=here, sem="relaxed")


@triton.jit
def _pull(d_corners, n, share, pull, far, seen):
    """Add the gradient of a corner h: -b M^-T dL / du, and that of its depth."""
    _add(d_corners + 3 * n, -share * pull[0], seen)
    _add(d_corners + 3 * n + 1, -share * pull[1], seen)
    _add(d_corners + 3 * n + 2, far * share - share * pull[2], seen)


@triton.jit(do_not_specialize=["P", "width"])
def _backward(
    to_values, to_depth, corners, attributes, faces, found, d_corners, d_attributes, P, width,
    C: tl.constexpr, CHANNELS: tl.constexpr,
):  # fmt: skip
    p, _, seen, f, x, y = _pixel(found, P, width)
    n, a, b, c = _corners(corners, faces, f, seen)
    first, second, third, _ = _planes(a, b, c)
    u, v, w = _at(first, x, y), _at(second, x, y), _at(third, x, y)
    z = 1 / tl.where(seen, u + v + w, 1.0)
    u, v, w = u * z, v * z, w * z
    i, j, m = n[0].to(tl.int64), n[1].to(tl.int64), n[2].to(tl.int64)
    k = tl.arange(0, CHANNELS)[None, :]
    there = seen[:, None] & (k < C)
    grad = tl.load(to_values + p[:, None] * C + k, mask=there, other=0.0).to(tl.float64)
    far = tl.load(to_depth + p, mask=seen, other=0.0).to(tl.float64)
    g = far * a[2] + tl.sum(grad * tl.load(attributes + i[:, None] * C + k, mask=there, other=0.0), 1)
    h = far * b[2] + tl.sum(grad * tl.load(attributes + j[:, None] * C + k, mask=there, other=0.0), 1)
    q = far * c[2] + tl.sum(grad * tl.load(attributes + m[:, None] * C + k, mask=there, other=0.0), 1)
    mean = g * u + h * v + q * w
    g, h, q = g - mean, h - mean, q - mean
    pull = (
        first[0] * g + second[0] * h + third[0] * q,
        first[1] * g + second[1] * h + third[1] * q,
        first[2] * g + second[2] * h + third[2] * q,
    )
    _pull(d_corners, i, u, pull, far, seen)
    _pull(d_corners, j, v, pull, far, seen)
    _pull(d_corners, m, w, pull, far, seen)
    _add(d_attributes + i[:, None] * C + k, u[:, None] * grad, there)
    _add(d_attributes + j[:, None] * C + k, v[:, None] * grad, there)
    _add(d_attributes + m[:, None] * C + k, w[:, None] * grad, there)


def forward(ctx, corners, attributes, faces, size, near):
    (width, height), channels, device = size, attributes.shape[1], corners.device
    buffer = torch.zeros(height, width, dtype=torch.int64, device=device)
    launch(_draw, (blocks(len(faces), TRIANGLES),), corners, faces, buffer, len(faces), width, height, near)
    values, depth = empty(height, width, channels, device=device), empty(height, width, device=device)
    found = torch.empty(height, width, dtype=torch.int32, device=device)
    ctx.sizes = {"P": width * height, "width": width, "C": channels, "CHANNELS": triton.next_power_of_2(channels)}
    outputs = values, depth, found
    launch(_fill, (blocks(width * height, PIXELS),), corners, attributes, faces, buffer, *outputs, **ctx.sizes)
    ctx.save_for_backward(corners, attributes, faces, found)
    ctx.mark_non_differentiable(found)
    return outputs


def backward(ctx, to_values, to_depth, _):
    corners, attributes, faces, found = ctx.saved_tensors
    results = torch.zeros_like(corners), torch.zeros_like(attributes)
    grid = (blocks(found.numel(), PIXELS),)
    launch(_backward, grid, to_values, to_depth, corners, attributes, faces, found, *results, **ctx.sizes)
    return *results, None, None, None


run = differentiable(forward, backward)
