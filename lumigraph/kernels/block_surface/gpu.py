"""Triton: a program takes one block, a lane some of its voxels. The first pass counts, the second writes."""

import torch
import triton
import triton.language as tl

from .._gpu import launch
from .._operation import empty
from ..block_hash import SIDE, VOXELS
from ..block_hash.gpu import find
from . import case_table

N, S = tl.constexpr(VOXELS), tl.constexpr(SIDE)


@triton.jit
def _at(i, j, k, bx, by, bz, blocks, table, mask):
    """Block number and row of voxels (i, j, k) of a block or of its neighbours."""
    number = find(bx + (i >> 3), by + (j >> 3), bz + (k >> 3), blocks, table, mask, i >= 0)
    return number.to(tl.int64), ((i & 7) * S + (j & 7)) * S + (k & 7)


@triton.jit
def _distance(number, row, voxels, channels, min_weight):
    """Distances of voxels, and a mask of known ones."""
    there = number >= 0
    place = voxels + (number * N + row) * channels
    known = there & (tl.load(place + 1, mask=there, other=-1.0) > min_weight)
    return tl.load(place, mask=known, other=0.0), known


@triton.jit
def _case(i, j, k, bx, by, bz, voxels, blocks, table, mask, channels, min_weight):
    """Cases of cubes, 0 where one of the corners is unknown."""
    case = tl.zeros([N], tl.int32)
    whole = i >= 0
    for c in tl.static_range(8):
        number, row = _at(i + c // 4, j + c // 2 % 2, k + c % 2, bx, by, bz, blocks, table, mask)
        d, known = _distance(number, row, voxels, channels, min_weight)
        whole = whole & known
        case += (d < 0).to(tl.int32) << c
    return tl.where(whole, case, 0)


@triton.jit
def _crosses(i, j, k, axis: tl.constexpr, bx, by, bz, voxels, blocks, table, mask, channels, min_weight):
    """Mask of voxels whose edge along an axis has a vertex; the far ends' distance, block and row."""
    number, row = _at(i, j, k, bx, by, bz, blocks, table, mask)
    d, known = _distance(number, row, voxels, channels, min_weight)
    x, y, z = i + (1 if axis == 0 else 0), j + (1 if axis == 1 else 0), k + (1 if axis == 2 else 0)
    held, other = _at(x, y, z, bx, by, bz, blocks, table, mask)
    e, there = _distance(held, other, voxels, channels, min_weight)
    return known & there & ((d < 0) != (e < 0)), d, e, held, other


@triton.jit(do_not_specialize=["mask"])
def _count(voxels, blocks, table, counts, packed, vertices, faces, mask, channels: tl.constexpr, min_weight):
    block, row = tl.program_id(0).to(tl.int64), tl.arange(0, N)
    i, j, k = row // (S * S), row // S % S, row % S
    bx, by, bz = tl.load(blocks + 3 * block), tl.load(blocks + 3 * block + 1), tl.load(blocks + 3 * block + 2)
    edges = tl.zeros([N], tl.int32)
    total = tl.zeros([N], tl.int32)
    for axis in tl.static_range(3):
        crossed, _, _, _, _ = _crosses(
            i, j, k, axis, bx, by, bz, voxels, blocks, table, mask, channels, min_weight
        )  # fmt: skip
        edges += crossed.to(tl.int32) << axis
        total += crossed.to(tl.int32)
    before = tl.cumsum(total, 0) - total
    tl.store(packed + block * N + row, before * 8 + edges)
    case = _case(i, j, k, bx, by, bz, voxels, blocks, table, mask, channels, min_weight)
    tl.store(vertices + block, tl.sum(total, 0))
    tl.store(faces + block, tl.sum(tl.load(counts + case), 0))


@triton.jit(do_not_specialize=["mask"])
def _write(
    voxels, blocks, table, fans, counts, packed, starts, face_starts, out, values, faces, mask, channels: tl.constexpr,
    min_weight, MOST: tl.constexpr,
):  # fmt: skip
    block, row = tl.program_id(0).to(tl.int64), tl.arange(0, N)
    i, j, k = row // (S * S), row // S % S, row % S
    bx, by, bz = tl.load(blocks + 3 * block), tl.load(blocks + 3 * block + 1), tl.load(blocks + 3 * block + 2)
    vertex = tl.load(starts + block) + (tl.load(packed + block * N + row) >> 3)
    for axis in tl.static_range(3):
        crossed, d, e, held, other = _crosses(
            i, j, k, axis, bx, by, bz, voxels, blocks, table, mask, channels, min_weight
        )  # fmt: skip
        share = d / tl.where(crossed, d - e, 1.0)
        tl.store(out + 3 * vertex, (bx * S + i).to(tl.float32) + (share if axis == 0 else 0.0), mask=crossed)
        tl.store(out + 3 * vertex + 1, (by * S + j).to(tl.float32) + (share if axis == 1 else 0.0), mask=crossed)
        tl.store(out + 3 * vertex + 2, (bz * S + k).to(tl.float32) + (share if axis == 2 else 0.0), mask=crossed)
        one, two = voxels + (block * N + row) * channels, voxels + (held * N + other) * channels
        if channels > 2:
            share = tl.where(tl.load(two + 2, mask=crossed, other=0.0) < 0, 0.0, share)
            share = tl.where(tl.load(one + 2, mask=crossed, other=0.0) < 0, 1.0, share)
        for channel in tl.static_range(2, channels):
            a, b = tl.load(one + channel, mask=crossed, other=0.0), tl.load(two + channel, mask=crossed, other=0.0)
            tl.store(values + vertex * (channels - 2) + channel - 2, a + share * (b - a), mask=crossed)
        vertex += crossed.to(tl.int64)
    case = _case(i, j, k, bx, by, bz, voxels, blocks, table, mask, channels, min_weight)
    count = tl.load(counts + case)
    face = tl.load(face_starts + block) + tl.cumsum(count, 0) - count
    for nth in range(MOST):
        here = nth < count
        for corner in tl.static_range(3):
            edge = tl.load(fans + (case * MOST + nth) * 3 + corner, mask=here, other=0)
            c, along = edge // 3, edge % 3
            x, y, z = i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)
            held, other = _at(x, y, z, bx, by, bz, blocks, table, mask)
            there = here & (held >= 0)
            code = tl.load(packed + held * N + other, mask=there, other=0)
            rank = code & ((1 << along) - 1)
            index = tl.load(starts + held, mask=there, other=0) + (code >> 3) + (rank & 1) + (rank >> 1)
            tl.store(faces + (face + nth) * 3 + corner, index, mask=here)


def run(voxels, blocks, table, min_weight):
    count, channels, device = len(blocks), voxels.shape[2], voxels.device
    voxels, blocks, table = (x.contiguous() for x in (voxels, blocks, table))
    fans, counts = case_table(str(device))
    packed = torch.empty(count, VOXELS, dtype=torch.int32, device=device)
    starts, face_starts = (torch.zeros(count + 1, dtype=torch.int64, device=device) for _ in range(2))
    rest = len(table) - 1, channels, float(min_weight)
    launch(_count, (count,), voxels, blocks, table, counts, packed, starts[1:], face_starts[1:], *rest)
    torch.cumsum(starts, 0, out=starts)
    torch.cumsum(face_starts, 0, out=face_starts)
    vertices, values = (empty(int(starts[-1]), width, device=device) for width in (3, channels - 2))
    faces = torch.empty(int(face_starts[-1]), 3, dtype=torch.int64, device=device)
    given = voxels, blocks, table, fans, counts, packed, starts, face_starts, vertices, values, faces
    launch(_write, (count,), *given, *rest, MOST=fans.shape[1])
    return vertices, values, faces
