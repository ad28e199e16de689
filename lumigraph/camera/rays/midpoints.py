"""The midpoints of samples on the CPU, without gradients (Numba)."""

from numba import njit, prange


@njit(parallel=True, cache=True, error_model="numpy")
def fill_midpoints(origins, directions, t_start, t_end, ray_starts, positions, sample_directions):
    """Fill in the position of each sample's middle and the direction of its ray, as `Samples.along` returns them."""
    half = origins.dtype.type(0.5)
    for ray in prange(len(origins)):
        for i in range(ray_starts[ray], ray_starts[ray + 1]):
            t = half * (t_start[i] + t_end[i])
            for axis in range(3):
                positions[i, axis] = origins[ray, axis] + t * directions[ray, axis]
                sample_directions[i, axis] = directions[ray, axis]
