"""Sixteen lanes of the Numba engines: what is compiled does what the Python says, with the error stated."""

import numpy as np
from budgets import budget
from numba import njit

from lumigraph.kernels._lanes import LANES, exp2, fetch, put, put_where

pytestmark = budget("kernels")


@njit
def each_exp2(x, out):
    for i in range(0, len(x), LANES):
        put(out, i, exp2(fetch(x, i)))


@njit
def put_large(x, least, out, at):
    row = fetch(x, 0)
    put_where(row >= fetch(least, 0), out, at, row)


EXPONENTS = np.concatenate([np.linspace(-126, 127, 1 << 16), np.linspace(-1, 1, 1 << 16)])


def test_relative_error_of_exp2_is_as_stated():
    x = EXPONENTS.astype(np.float32)
    out = np.empty_like(x)
    each_exp2(x, out)
    assert np.abs(out / np.exp2(x.astype(np.float64)) - 1).max() < 3e-7


def test_lanes_are_put_where_a_mask_holds_and_nowhere_else():
    x, least = np.arange(16, dtype=np.float32), np.array([0, 99] * 8, np.float32)
    out, plain = (np.full(24, -1, np.float32) for _ in range(2))
    put_large(x, least, out, 5)
    put_where(x >= least, plain, 5, x)
    np.testing.assert_array_equal(out, plain)
    np.testing.assert_array_equal(out[5:21], np.where(x >= least, x, -1))
    assert (out[:5] == -1).all() and (out[21:] == -1).all()
