"""What the tests cost: neither a busy machine, nor compiling, nor a slow processor makes a file too costly."""

from __future__ import annotations

import conftest
import pytest
from budgets import BUDGETS, EACH, GROUP, PER_METHOD, TOO_MUCH, Cost, Ledger, budget, probe, share_of

pytestmark = budget("house")


@pytest.mark.parametrize(
    ("cost", "slowness", "excessive"),
    [
        (Cost(1, 9 * EACH, 9 * EACH, 0.0), 1.0, True),
        (Cost(1, 9 * EACH, EACH, 0.0), 1.0, False),  # others had the machine
        (Cost(1, EACH, 2 * EACH, 0.0), 1.0, False),  # two processors at once
        (Cost(1, 9 * EACH, 9 * EACH, 8 * EACH), 1.0, False),  # a fresh clone
        (Cost(1, 3 * EACH, 3 * EACH, 0.0), 1.0, True),
        (Cost(1, 5 * EACH, 5 * EACH, 0.0), 2.0, False),
        (Cost(1, TOO_MUCH * EACH, TOO_MUCH * EACH, 0.0), 1.0, False),
    ],
)
def test_a_file_may_take_its_share_some_times(cost, slowness, excessive):
    ledger = Ledger(probes=[slowness])
    ledger.files["test_new"], ledger.shares["test_new"] = cost, share_of(None)
    assert ledger.excessive() == ([f"test_new.py took {cost.wall:.0f} s of its 5 s; see tests/budgets.py"] * excessive)


def test_a_mark_is_a_share(request):
    assert share_of(request.node.get_closest_marker("budget")) == ("house", EACH)
    assert share_of(budget("methods", 12).mark) == share_of(pytest.mark.budget("methods", seconds=12).mark)
    assert share_of(None) == (GROUP, EACH)
    with pytest.raises(pytest.UsageError, match="'metods'. names no group of tests.budgets.py: kernels, "):
        budget("metods", 12)


def test_a_mark_of_an_unknown_group_ends_the_session(request, monkeypatch):
    """Even one that was made without `budget`."""
    marked = pytest.mark.budget("metods", 3).mark
    monkeypatch.setattr(request.node, "get_closest_marker", {"budget": marked}.get)
    with pytest.raises(pytest.UsageError, match="'metods'. names no group"):
        conftest.pytest_collection_modifyitems([request.node])


def test_the_table_adds_up():
    ledger = Ledger(methods=2)
    ledger.files |= {"test_nerf": Cost(3, 4.0, 2.0, 0.5), "test_contract": Cost(5, 7.0, 7.0, 1.0)}
    ledger.shares |= {"test_nerf": ("methods", 16), "test_contract": ("methods", 2 * PER_METHOD)}
    (line,) = [line.split() for line in ledger.table() if line.startswith("methods")]
    assert line[1:] == ["8", "7.5", f"{BUDGETS['methods'] + 2 * PER_METHOD:.0f}", "11.0", "1.5"]
    assert ledger.table()[-1].split()[1:3] == ["8", "7.5"]


def test_workers_add_up():
    ledger, worker = Ledger(), Ledger(methods=2, probes=[1.5])
    worker.files["test_nerf"], worker.shares["test_nerf"] = Cost(3, 4.0, 2.0, 0.5), ("methods", 16.0)
    for told in (worker.to_plain(), worker.to_plain(), None):
        ledger.add(told)
    assert (ledger.methods, ledger.slowness, ledger.files["test_nerf"]) == (2, 1.5, Cost(6, 8.0, 4.0, 1.0))
    assert ledger.shares == worker.shares


def test_the_probe_is_quick():
    assert 0.001 < probe() < 2
