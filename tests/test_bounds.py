"""Every index of the Numba engines lies in its array: the same comparison, with the engines run as plain Python.

Numba checks no index inside parallel loops, whatever it is told. NumPy checks each of them.
"""

from __future__ import annotations

import pytest
from agreement import OPERATIONS, assert_agrees_in_all_cases, depends, faults, seeded, stand_in
from budgets import budget
from proofs import kept

pytestmark = [
    budget("kernels", 6),
    # what Numba does silently, plain Python does aloud: hashes wrap around, 1 / 0 is infinite
    pytest.mark.filterwarnings("ignore:overflow encountered"),
    pytest.mark.filterwarnings("ignore:divide by zero encountered"),
]


@pytest.mark.parametrize("name", OPERATIONS)
@kept(depends)
def test_no_index_leaves_its_array(name, tmp_path, monkeypatch):
    stand_in(name, "cpu", lambda source: source, tmp_path, monkeypatch)
    assert_agrees_in_all_cases(name, "cpu")


@pytest.mark.parametrize(("name", "what"), [(name, what) for name in OPERATIONS for what in faults(name).ASTRAY])
@kept(depends)
def test_an_index_astray_is_noticed(name, what, tmp_path, monkeypatch):
    engine, *fault = faults(name).ASTRAY[what]
    stand_in(name, engine, lambda source: seeded(source, *fault), tmp_path, monkeypatch)
    with pytest.raises(IndexError):
        assert_agrees_in_all_cases(name, engine)
