"""Sixteen lanes of the Numba engines: what is compiled does what the Python says, with the error stated."""

import numpy as np
import pytest
from numba import njit

from lumigraph.kernels import _lanes
from lumigraph.kernels._lanes import LANES, exp2, fetch, inverse, put


@njit
def each_exp2(x, out):
    for i in range(0, len(x), LANES):
        put(out, i, exp2(fetch(x, i)))


@njit
def each_inverse(x, out):
    for i in range(0, len(x), LANES):
        put(out, i, inverse(fetch(x, i)))


EXPONENTS = np.concatenate([np.linspace(-126, 127, 1 << 16), np.linspace(-1, 1, 1 << 16)])
POSITIVE = np.exp2(np.concatenate([np.linspace(-100, 100, 1 << 16), np.linspace(-1, 1, 1 << 16)]))


@pytest.mark.parametrize(
    "compiled, exact, x, error", [(each_exp2, np.exp2, EXPONENTS, 1e-7), (each_inverse, np.reciprocal, POSITIVE, 2e-7)]
)
def test_relative_error_is_as_stated(compiled, exact, x, error):
    x = x.astype(np.float32)
    out = np.empty_like(x)
    compiled(x, out)
    assert np.abs(out / exact(x.astype(np.float64)) - 1).max() < error


def test_far_below_exp2_is_next_to_nothing():
    x = np.array([-126, -127, -1e3, -1e30, -np.inf] + [0] * 11, np.float32)
    out = np.empty_like(x)
    each_exp2(x, out)
    np.testing.assert_array_equal(out, _lanes.exp2(x))
    assert (out[:5] == np.float32(2.0**-126)).all()
