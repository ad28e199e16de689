"""Loop over points and lamps with occlusion by a mesh (Numba)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract", "reassoc"})
def unshadowed(points, normals, coefficients, basis, toward, poses, depth, scale, bias, found):
    """Loop of ShadowMaps.shares: the unshadowed share of each point's irradiance, by channel.

    points:       in units of the mesh's radius, from its centre
    coefficients: L_lm at each point;  basis: Y_lm of each lamp's direction
    depth:        of the mesh from each lamp;  scale: pixels of a map for a slope of 1 in its camera
    bias:         shadow bias, towards the lamp
    """
    side = depth.shape[1]
    for i in prange(len(points)):
        total, left = np.zeros(3), np.zeros(3)
        for lamp in range(len(toward)):
            facing = 0.0
            for k in range(3):
                facing += normals[i, k] * toward[lamp, k]
            if facing <= 0.0:
                continue
            x = y = z = 0.0
            for k in range(3):
                away = points[i, k] - poses[lamp, k, 3]
                x += away * poses[lamp, k, 0]
                y += away * poses[lamp, k, 1]
                z += away * poses[lamp, k, 2]
            u, v = x / z * scale + side / 2 - 0.5, y / z * scale + side / 2 - 0.5
            hidden = 0.0
            if 0 <= u < side - 1 and 0 <= v < side - 1:
                column, row = int(u), int(v)
                fx, fy, near = u - column, v - row, z - bias
                hidden += (1 - fy) * (1 - fx) * (depth[lamp, row, column] < near)
                hidden += (1 - fy) * fx * (depth[lamp, row, column + 1] < near)
                hidden += fy * (1 - fx) * (depth[lamp, row + 1, column] < near)
                hidden += fy * fx * (depth[lamp, row + 1, column + 1] < near)
            for c in range(3):
                light = 0.0
                for k in range(basis.shape[1]):
                    light += basis[lamp, k] * coefficients[i, k, c]
                arriving = max(light, 0.0) * facing
                total[c] += arriving
                left[c] += arriving * (1 - hidden)
        for c in range(3):
            found[i, c] = left[c] / total[c] if total[c] > 0 else 1.0
