"""The Numba engines in debug mode: the same comparison, with every index checked.

Numba checks no index inside parallel loops, and its cache does not know a checked function from an unchecked one, so
that setting NUMBA_BOUNDSCHECK alone checks nothing. Here copies of the engines are compiled serially, uncached.
"""

from __future__ import annotations

import importlib

import numba
import pytest
from agreement import OPERATIONS, assert_agrees, cases, edit_engine, module, plain_lanes


@pytest.fixture(autouse=True)
def checked(monkeypatch):
    for name in OPERATIONS:  # what is imported from here on is serial for good
        importlib.import_module(f"{module(name).__name__}.cpu")
    njit = numba.njit

    def checked_njit(*function, **options):
        return njit(*function, **options | {"boundscheck": True, "parallel": False, "cache": False})

    monkeypatch.setattr(numba, "njit", checked_njit)


@pytest.mark.parametrize("name", OPERATIONS)
def test_no_index_leaves_its_array(name, tmp_path, monkeypatch):
    if name == "rasterize":  # its lanes check themselves where they are rows of NumPy
        monkeypatch.setattr(numba.config, "DISABLE_JIT", True)
    edit_engine(name, "cpu", plain_lanes, tmp_path, monkeypatch)
    for inputs in cases(name):
        assert_agrees(name, "cpu", inputs)


@pytest.mark.parametrize(
    ("name", "sound", "astray"),
    [
        ("composite", "weights[i] = w", "weights[i + 1] = w"),
        ("hash_encode", "np.int32(resolution - 1))\n", "np.int32(resolution))\n"),  # the point 1.0, a cell too far
        ("perceptron", "whole = across - across % TILE\n", "whole = across\n"),
        ("ssim", "x[at + 10 * step]", "x[at + 11 * step]"),
    ],
    ids=["composite", "hash_encode", "perceptron", "ssim"],
)
def test_an_index_astray_is_noticed(name, sound, astray, tmp_path, monkeypatch):
    def edit(source: str) -> str:
        assert sound in source
        return plain_lanes(source).replace(sound, astray, 1)

    edit_engine(name, "cpu", edit, tmp_path, monkeypatch)
    with pytest.raises(IndexError):
        for inputs in cases(name):
            assert_agrees(name, "cpu", inputs)
