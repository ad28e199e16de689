"""Triton: one program takes a block of points through all components. Gradients meet in atomic adds."""

import torch
import triton
import triton.language as tl

from .._gpu import blocks, indices, launch
from .._operation import differentiable, empty

BLOCK = tl.constexpr(64)  # samples
MAX_COMPONENTS = 32  # components taken together


@triton.jit
def _place(points, i, axis: tl.constexpr, here, n):
    """Node below each point along an axis, and the fraction towards the next one."""
    s = tl.load(points + 3 * i + axis, mask=here, other=0.0)
    s = tl.minimum(tl.maximum(s, 0.0), 1.0) * (n - 1)
    node = tl.minimum(s.to(tl.int32), n - 2)
    return node.to(tl.int64), s - node.to(tl.float32)


@triton.jit
def _line(table, row, f, c, there, R: tl.constexpr):
    at = table + row[:, None] * R + c[None, :]
    low, high = tl.load(at, mask=there, other=0.0), tl.load(at + R, mask=there, other=0.0)
    return low * (1 - f)[:, None] + high * f[:, None]


@triton.jit
def _plane(table, row, across, f, g, c, there, R: tl.constexpr):
    """Bilinear interpolation in a plane. across: stride of its rows; f, g: fractions across rows and along them"""
    low, high = _line(table, row, g, c, there, R), _line(table, row + across, g, c, there, R)
    return low * (1 - f)[:, None] + high * f[:, None]


@triton.jit
def _add_line(table, row, f, c, there, x, R: tl.constexpr):
    at = table + row[:, None] * R + c[None, :]
    tl.atomic_add(at, x * (1 - f)[:, None], mask=there, sem="relaxed")
    tl.atomic_add(at + R, x * f[:, None], mask=there, sem="relaxed")


@triton.jit
def _add_plane(table, row, across, f, g, c, there, x, R: tl.constexpr):
    _add_line(table, row, g, c, there, x * (1 - f)[:, None], R)
    _add_line(table, row + across, g, c, there, x * f[:, None], R)


@triton.jit(do_not_specialize=["S"])
def _forward(
    points, table, out, S, nx, ny, nz, VM: tl.constexpr, SUMMED: tl.constexpr, R: tl.constexpr, C: tl.constexpr
):
    i, here = indices(S, BLOCK)
    x, fx = _place(points, i, 0, here, nx)
    y, fy = _place(points, i, 1, here, ny)
    z, fz = _place(points, i, 2, here, nz)
    lines = ny * nz + nx * nz + nx * ny if VM else 0
    total = tl.zeros([BLOCK], tl.float32)
    for first in tl.static_range(0, R, C):
        c = first + tl.arange(0, C)
        there = here[:, None] & (c < R)[None, :]
        a = _line(table, lines + x, fx, c, there, R)
        b = _line(table, lines + nx + y, fy, c, there, R)
        d = _line(table, lines + nx + ny + z, fz, c, there, R)
        if VM:
            a *= _plane(table, y * nz + z, nz, fy, fz, c, there, R)
            b *= _plane(table, ny * nz + x * nz + z, nz, fx, fz, c, there, R)
            d *= _plane(table, ny * nz + nx * nz + x * ny + y, ny, fx, fy, c, there, R)
            if SUMMED:
                total += tl.sum(a + b + d, 1)
            else:
                at = out + i[:, None] * (3 * R) + c[None, :]
                tl.store(at, a, mask=there)
                tl.store(at + R, b, mask=there)
                tl.store(at + 2 * R, d, mask=there)
        elif SUMMED:
            total += tl.sum(a * b * d, 1)
        else:
            tl.store(out + i[:, None] * R + c[None, :], a * b * d, mask=there)
    if SUMMED:
        tl.store(out + i, total, mask=here)


@triton.jit(do_not_specialize=["S"])
def _backward(
    grad, points, table, d_table, S, nx, ny, nz,
    VM: tl.constexpr, SUMMED: tl.constexpr, R: tl.constexpr, C: tl.constexpr,
):  # fmt: skip
    i, here = indices(S, BLOCK)
    x, fx = _place(points, i, 0, here, nx)
    y, fy = _place(points, i, 1, here, ny)
    z, fz = _place(points, i, 2, here, nz)
    lines = ny * nz + nx * nz + nx * ny if VM else 0
    on_x, on_y, on_z = lines + x, lines + nx + y, lines + nx + ny + z
    for first in tl.static_range(0, R, C):
        c = first + tl.arange(0, C)
        there = here[:, None] & (c < R)[None, :]
        a = _line(table, on_x, fx, c, there, R)
        b = _line(table, on_y, fy, c, there, R)
        d = _line(table, on_z, fz, c, there, R)
        if SUMMED:
            slope = tl.load(grad + i, mask=here, other=0.0)[:, None] + tl.zeros([BLOCK, C], tl.float32)
        elif not VM:
            slope = tl.load(grad + i[:, None] * R + c[None, :], mask=there, other=0.0)
        if VM:
            on_yz, on_xz = y * nz + z, ny * nz + x * nz + z
            on_xy = ny * nz + nx * nz + x * ny + y
            if SUMMED:
                to_a, to_b, to_d = slope, slope, slope
            else:
                at = grad + i[:, None] * (3 * R) + c[None, :]
                to_a = tl.load(at, mask=there, other=0.0)
                to_b = tl.load(at + R, mask=there, other=0.0)
                to_d = tl.load(at + 2 * R, mask=there, other=0.0)
            p = _plane(table, on_yz, nz, fy, fz, c, there, R)
            _add_line(d_table, on_x, fx, c, there, to_a * p, R)
            _add_plane(d_table, on_yz, nz, fy, fz, c, there, to_a * a, R)
            p = _plane(table, on_xz, nz, fx, fz, c, there, R)
            _add_line(d_table, on_y, fy, c, there, to_b * p, R)
            _add_plane(d_table, on_xz, nz, fx, fz, c, there, to_b * b, R)
            p = _plane(table, on_xy, ny, fx, fy, c, there, R)
            _add_line(d_table, on_z, fz, c, there, to_d * p, R)
            _add_plane(d_table, on_xy, ny, fx, fy, c, there, to_d * d, R)
        else:
            _add_line(d_table, on_x, fx, c, there, slope * b * d, R)
            _add_line(d_table, on_y, fy, c, there, slope * a * d, R)
            _add_line(d_table, on_z, fz, c, there, slope * a * b, R)


def forward(ctx, points, table, factors, summed):
    width = table.shape[1]
    out = empty(len(points), 1 if summed else factors.products * width, device=points.device)
    ctx.numbers = len(points), *factors.nodes
    ctx.shape = {"VM": factors.kind == "vm", "SUMMED": summed, "R": width}
    ctx.shape["C"] = min(MAX_COMPONENTS, triton.next_power_of_2(width))
    launch(_forward, (blocks(len(points), BLOCK),), points, table, out, *ctx.numbers, **ctx.shape)
    ctx.save_for_backward(points, table)
    return out


def backward(ctx, grad):
    points, table = ctx.saved_tensors
    d_table = torch.zeros_like(table)
    launch(_backward, (blocks(len(points), BLOCK),), grad, points, table, d_table, *ctx.numbers, **ctx.shape)
    return None, d_table, None, None


run = differentiable(forward, backward)
