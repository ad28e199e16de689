"""Transmittance along rays through a grid (Numba). `SurfaceGrid.marched` does the same with tensors, for GPUs, and as
the definition that tests compare with."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange


@njit(parallel=True, fastmath=True, cache=True)
def transmittance(thickness, clear, low, cell, step, stop, points, normals, directions, out):
    """Transmittance from each point in directions above its surface.

    thickness: optical, of a step in each cell; clear: number of empty steps from each cell; low: corner of the grid;
    step: in cells; stop: optical thickness at which rays terminate
    """
    nx, ny, nz = thickness.shape
    half = np.float32(0.5) * step
    for i in prange(len(points)):
        for j in range(len(directions)):
            dx, dy, dz = directions[j, 0], directions[j, 1], directions[j, 2]
            if normals[i, 0] * dx + normals[i, 1] * dy + normals[i, 2] * dz <= np.float32(0):
                out[i, j] = np.float32(0)
                continue
            x = (points[i, 0] - low[0]) / cell + half * dx
            y = (points[i, 1] - low[1]) / cell + half * dy
            z = (points[i, 2] - low[2]) / cell + half * dz
            dx, dy, dz = step * dx, step * dy, step * dz
            tau = np.float32(0)
            while x >= 0 and y >= 0 and z >= 0 and x < nx and y < ny and z < nz:
                a, b, c = int(x), int(y), int(z)
                jump = np.float32(clear[a, b, c])
                if jump > 0:  # whole steps, so that samples lie where they would without jumps
                    x, y, z = x + jump * dx, y + jump * dy, z + jump * dz
                    continue
                tau += thickness[a, b, c]
                if tau > stop:
                    break
                x, y, z = x + dx, y + dy, z + dz
            out[i, j] = math.exp(-tau)
