"""Does the kernels' test notice? Faults are written into a copy of an engine, and the same comparison must turn red."""

from __future__ import annotations

import pytest
from agreement import OPERATIONS, assert_agrees_in_all_cases, depends, faults, seeded, stand_in
from budgets import budget
from proofs import kept

pytestmark = [
    budget("kernels", 30),
    # what Numba does silently, plain Python does aloud: hashes wrap around, 1 / 0 is infinite
    pytest.mark.filterwarnings("ignore:overflow encountered"),
    pytest.mark.filterwarnings("ignore:divide by zero encountered"),
]


@pytest.mark.parametrize(("name", "what"), [(name, what) for name in OPERATIONS for what in faults(name).FAULTS])
@kept(depends)
def test_a_fault_turns_the_test_red(name, what, tmp_path, monkeypatch):
    engine, *fault = faults(name).FAULTS[what]
    stand_in(name, engine, lambda source: seeded(source, *fault), tmp_path, monkeypatch)
    with pytest.raises(AssertionError, match="result"):
        assert_agrees_in_all_cases(name, engine, small_first=True)


@kept(lambda: depends("spherical_harmonics"))
def test_a_copy_without_a_fault_stays_green(tmp_path, monkeypatch):
    """On the GPU's engine; `test_bounds.py` asks the same of all Numba engines."""
    stand_in("spherical_harmonics", "gpu", lambda source: source, tmp_path, monkeypatch)
    assert_agrees_in_all_cases("spherical_harmonics", "gpu")
