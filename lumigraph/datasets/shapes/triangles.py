"""Bounding volume hierarchy of triangles: nearest point and winding number (Numba).

The generalised winding number (Jacobson 2013) is the solid angle of all triangles over 4 pi: 1 inside of a closed
surface and 0 outside, and in between near holes. Far triangles are summed together, by the first term of their
expansion (Barill 2018).
"""

import math

import numpy as np
from numba import njit, prange

LEAF_TRIANGLES = 8  # triangles of a box that is not divided
STACK_DEPTH = 64  # boxes that wait while a tree is walked


class Triangles:
    """Triangles with a hierarchy. corners: (face, corner, 3), in double precision. Face numbers in results are those of
    the input; inside, faces are sorted by boxes."""

    def __init__(self, corners: np.ndarray):
        self.order, self.first, self.count, self.child = divide(np.ascontiguousarray(corners.mean(1), np.float64))
        self.sorted = np.ascontiguousarray(corners[self.order], np.float64).reshape(-1, 9)
        self.box, self.dipole = surround(self.sorted, self.first, self.count)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance of each point (point, 3) to its nearest triangle, and that triangle's number."""
        points = np.ascontiguousarray(points, np.float64)
        distance, place = nearest(self.sorted, self.box, self.first, self.count, self.child, points)
        return distance, self.order[place]

    def winding(self, points: np.ndarray, reach: float = 2.0) -> np.ndarray:
        """Winding number of each point (point, 3).

        reach: distance, in radii of a box, beyond which its triangles are summed together; infinity for the exact sum
        """
        points = np.ascontiguousarray(points, np.float64)
        return winding(self.sorted, self.dipole, self.first, self.count, self.child, points, reach)


@njit(cache=True)
def divide(centres):
    """Binary tree over points, halved along the longest side of their box. Children follow their parents.

    Returns the order of the points, and for each node its first index in it, its count, and its left child (the right
    one is next to it; -1 for a leaf).
    """
    most = max(1, 4 * len(centres) // LEAF_TRIANGLES + 4)
    order = np.arange(len(centres))
    first, count, child = np.zeros(most, np.int64), np.zeros(most, np.int64), np.full(most, -1, np.int64)
    count[0], made, node = len(centres), 1, 0
    while node < made:
        if count[node] > LEAF_TRIANGLES:
            begin, end = first[node], first[node] + count[node]
            inside = centres[order[begin:end]]
            axis, longest = 0, -1.0
            for k in range(3):
                side = inside[:, k].max() - inside[:, k].min()
                if side > longest:
                    axis, longest = k, side
            order[begin:end] = order[begin:end][np.argsort(inside[:, axis])]
            half = count[node] // 2
            child[node] = made
            first[made], count[made] = begin, half
            first[made + 1], count[made + 1] = begin + half, count[node] - half
            made += 2
        node += 1
    return order, first[:made].copy(), count[:made].copy(), child[:made].copy()


@njit(cache=True)
def surround(triangles, first, count):
    """Two tables of the nodes: the bounding box of each one's triangles (low, high); and their centroid, the sum of
    their area vectors, and the distance of the farthest corner from the centroid."""
    nodes = len(first)
    box, dipole = np.empty((nodes, 6)), np.zeros((nodes, 7))
    for node in range(nodes):
        box[node, :3], box[node, 3:] = np.inf, -np.inf
        total, end = 0.0, first[node] + count[node]
        for i in range(first[node], end):
            t = triangles[i]
            ux, uy, uz, vx, vy, vz = t[3] - t[0], t[4] - t[1], t[5] - t[2], t[6] - t[0], t[7] - t[1], t[8] - t[2]
            x, y, z = (uy * vz - uz * vy) / 2, (uz * vx - ux * vz) / 2, (ux * vy - uy * vx) / 2
            size = math.sqrt(x * x + y * y + z * z) + 1e-30
            total += size
            dipole[node, 3] += x
            dipole[node, 4] += y
            dipole[node, 5] += z
            for k in range(3):
                dipole[node, k] += size * (t[k] + t[3 + k] + t[6 + k]) / 3
                for c in range(k, 9, 3):
                    box[node, k] = min(box[node, k], t[c])
                    box[node, 3 + k] = max(box[node, 3 + k], t[c])
        for k in range(3):
            dipole[node, k] /= total
        for i in range(first[node], end):
            for c in range(0, 9, 3):
                x = triangles[i, c] - dipole[node, 0]
                y = triangles[i, c + 1] - dipole[node, 1]
                z = triangles[i, c + 2] - dipole[node, 2]
                dipole[node, 6] = max(dipole[node, 6], math.sqrt(x * x + y * y + z * z))
    return box, dipole


@njit(cache=True)
def dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@njit(cache=True, error_model="numpy")
def square_distance(px, py, pz, t, i):
    """Squared distance from a point to triangle i (Ericson 2005, section 5.1.5)."""
    abx, aby, abz = t[i, 3] - t[i, 0], t[i, 4] - t[i, 1], t[i, 5] - t[i, 2]
    acx, acy, acz = t[i, 6] - t[i, 0], t[i, 7] - t[i, 1], t[i, 8] - t[i, 2]
    apx, apy, apz = px - t[i, 0], py - t[i, 1], pz - t[i, 2]
    d1, d2 = dot(abx, aby, abz, apx, apy, apz), dot(acx, acy, acz, apx, apy, apz)
    bpx, bpy, bpz = px - t[i, 3], py - t[i, 4], pz - t[i, 5]
    d3, d4 = dot(abx, aby, abz, bpx, bpy, bpz), dot(acx, acy, acz, bpx, bpy, bpz)
    cpx, cpy, cpz = px - t[i, 6], py - t[i, 7], pz - t[i, 8]
    d5, d6 = dot(abx, aby, abz, cpx, cpy, cpz), dot(acx, acy, acz, cpx, cpy, cpz)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0 and d2 <= 0:
        u, v = 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        u, v = 1.0, 0.0
    elif d6 >= 0 and d5 <= d6:
        u, v = 0.0, 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        u, v = d1 / (d1 - d3), 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        u, v = 0.0, d2 / (d2 - d6)
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        v = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        u = 1 - v
    else:
        u, v = vb / (va + vb + vc), vc / (va + vb + vc)
    x, y, z = apx - u * abx - v * acx, apy - u * aby - v * acy, apz - u * abz - v * acz
    return x * x + y * y + z * z


@njit(cache=True)
def square_distance_to_box(px, py, pz, box, i):
    x = max(box[i, 0] - px, 0.0, px - box[i, 3])
    y = max(box[i, 1] - py, 0.0, py - box[i, 4])
    z = max(box[i, 2] - pz, 0.0, pz - box[i, 5])
    return x * x + y * y + z * z


@njit(parallel=True, cache=True, error_model="numpy")
def nearest(triangles, box, first, count, child, points):
    distance, place = np.empty(len(points)), np.empty(len(points), np.int64)
    for p in prange(len(points)):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        waiting = np.empty(STACK_DEPTH, np.int64)
        best, found, held = np.inf, 0, 1
        waiting[0] = 0
        while held:
            held -= 1
            node = waiting[held]
            if square_distance_to_box(px, py, pz, box, node) >= best:
                continue
            left = child[node]
            if left < 0:
                for i in range(first[node], first[node] + count[node]):
                    square = square_distance(px, py, pz, triangles, i)
                    if square < best:
                        best, found = square, i
                continue
            a = square_distance_to_box(px, py, pz, box, left)
            b = square_distance_to_box(px, py, pz, box, left + 1)
            waiting[held] = left + 1 if a <= b else left
            waiting[held + 1] = left if a <= b else left + 1  # the nearer one is looked at first
            held += 2
        distance[p], place[p] = math.sqrt(best), found
    return distance, place


@njit(cache=True, error_model="numpy")
def solid_angle(px, py, pz, t, i):
    """Solid angle of triangle i, seen from a point: positive from behind (van Oosterom and Strackee 1983, eq. 8)."""
    ax, ay, az = t[i, 0] - px, t[i, 1] - py, t[i, 2] - pz
    bx, by, bz = t[i, 3] - px, t[i, 4] - py, t[i, 5] - pz
    cx, cy, cz = t[i, 6] - px, t[i, 7] - py, t[i, 8] - pz
    a, b = math.sqrt(dot(ax, ay, az, ax, ay, az)), math.sqrt(dot(bx, by, bz, bx, by, bz))
    c = math.sqrt(dot(cx, cy, cz, cx, cy, cz))
    volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    below = a * b * c + dot(ax, ay, az, bx, by, bz) * c
    below += dot(bx, by, bz, cx, cy, cz) * a + dot(cx, cy, cz, ax, ay, az) * b
    return 2 * math.atan2(volume, below)


@njit(parallel=True, cache=True, error_model="numpy")
def winding(triangles, dipole, first, count, child, points, reach):
    found = np.empty(len(points))
    for p in prange(len(points)):
        px, py, pz = points[p, 0], points[p, 1], points[p, 2]
        waiting = np.empty(STACK_DEPTH, np.int64)
        total, held = 0.0, 1
        waiting[0] = 0
        while held:
            held -= 1
            node = waiting[held]
            x, y, z = dipole[node, 0] - px, dipole[node, 1] - py, dipole[node, 2] - pz
            away = math.sqrt(x * x + y * y + z * z)
            if away > reach * dipole[node, 6]:
                total += dot(x, y, z, dipole[node, 3], dipole[node, 4], dipole[node, 5]) / (away * away * away)
            elif child[node] < 0:
                for i in range(first[node], first[node] + count[node]):
                    total += solid_angle(px, py, pz, triangles, i)
            else:
                waiting[held], waiting[held + 1] = child[node], child[node] + 1
                held += 2
        found[p] = total / (4 * math.pi)
    return found
