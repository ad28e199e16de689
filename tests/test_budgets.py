"""What the tests cost: neither a busy machine, nor compiling, nor a slow processor makes a file too costly."""

from __future__ import annotations

from pathlib import Path

import pytest
from budgets import A_METHOD, BUDGETS, EACH, GROUPS, MUCH, SHARES, TOO_MUCH, Cost, Ledger, probe, share_of

HERE = Path(__file__).parent


@pytest.mark.parametrize(
    ("cost", "slowness", "excessive"),
    [
        (Cost(1, 9 * EACH, 9 * EACH, 0.0), 1.0, True),
        (Cost(1, 9 * EACH, EACH, 0.0), 1.0, False),  # others had the machine
        (Cost(1, EACH, 2 * EACH, 0.0), 1.0, False),  # two processors at once
        (Cost(1, 9 * EACH, 9 * EACH, 8 * EACH), 1.0, False),  # a fresh clone
        (Cost(1, 5 * EACH, 5 * EACH, 0.0), 1.0, True),
        (Cost(1, 5 * EACH, 5 * EACH, 0.0), 2.0, False),
        (Cost(1, TOO_MUCH * EACH, TOO_MUCH * EACH, 0.0), 1.0, False),
    ],
)
def test_a_file_may_take_its_share_four_times(cost, slowness, excessive):
    ledger = Ledger(probes=[slowness])
    ledger.files["test_new"] = cost
    assert ledger.excessive() == ([f"test_new.py took {cost.wall:.0f} s of its 5 s; see tests/budgets.py"] * excessive)


def test_a_method_more_is_a_share_more():
    assert share_of("test_contract", 40) == ("methods", 40 * A_METHOD)
    assert share_of("test_nobody_thought_of", 40) == ("nouns, capture", EACH)


def test_the_table_adds_up():
    ledger = Ledger(methods=2)
    ledger.files |= {"test_nerf": Cost(3, 4.0, 2.0, 0.5), "test_contract": Cost(5, 7.0, 7.0, 1.0)}
    (line,) = [line.split() for line in ledger.table() if line.startswith("methods")]
    assert line[1:] == ["8", "7.5", f"{BUDGETS['methods'] + 2 * A_METHOD:.0f}", "11.0", "1.5"]
    assert ledger.table()[-1].split()[1:3] == ["8", "7.5"]


def test_shares_are_of_files_that_are_there_and_fit_their_groups():
    shares = {group: 0.0 for group in BUDGETS}
    for group, share in SHARES.values():
        shares[group] += share
    assert all(shares[group] <= MUCH * budget for group, budget in BUDGETS.items())
    assert not set(SHARES) & set(GROUPS)
    there = {path.stem for path in HERE.glob("test_*.py")}
    assert {*SHARES, *GROUPS} <= there


def test_workers_add_up():
    ledger, worker = Ledger(), Ledger(methods=2, probes=[1.5])
    worker.files["test_nerf"] = Cost(3, 4.0, 2.0, 0.5)
    for told in (worker.to_plain(), worker.to_plain(), None):
        ledger.add(told)
    assert (ledger.methods, ledger.slowness, ledger.files["test_nerf"]) == (2, 1.5, Cost(6, 8.0, 4.0, 1.0))


def test_the_probe_is_quick():
    assert 0.001 < probe() < 2
