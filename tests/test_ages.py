"""`benchmarks/tables.py --check`: ages of results, fields that they lack, share of figures in generated tables."""

from __future__ import annotations

import subprocess

import ages
from budgets import budget

pytestmark = budget("house", 3)

PAGE = """# 7 wonders

Training takes 12 s and 3.5 GB after 300 000 steps ([4](a5.md), `--steps 6`, section 8.1, Kerbl 2023, eq. 9).

| method | dB | s |
|---|---|---|
| one | 31.2 | 4 |

<!-- table: methods -->
| method | dB |
|---|---|
| one | 30.5 |
| two | 29.5 |

<!-- end of table -->
<!-- options -->
| `--depth` | 8 | 4 |
<!-- end of options -->
"""


def test_figures_are_counted_without_code_years_and_places():
    found = ages.count({"page.md": PAGE, "other.md": "Ten pages.\n"})
    # by hand: 7, 12, 3.5, 300 000, [4], 31.2 and 4; generated: 30.5 and 29.5
    assert (found.figures, found.made, found.share) == (9, 2, 2 / 9)
    assert found.by_hand == {}, "two figures are no table of figures"
    assert ages.count(
        {"page.md": PAGE.replace("| one | 31.2 | 4 |", "| one | 31.2 | 4 |\n| two | 5.1 | 6 |")}
    ).by_hand == {"page.md": 1}


def test_only_changes_of_code_make_results_stale(tmp_path):
    def commit(text: str) -> None:
        (tmp_path / "lens.py").write_text(text)
        for words in (["add", "."], ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "step"]):
            subprocess.run(["git", *words], cwd=tmp_path, check=True)

    subprocess.run(["git", "init", "-q", "."], cwd=tmp_path, check=True)
    commit("def half(x):\n    return x / 2\n")
    measured = ages.git("rev-parse", "HEAD", root=tmp_path).strip()
    commit('SOURCES = {"a": "b"}\n\n\ndef half(x):\n    """Half of x."""\n\n    return (x / 2)  # exact\n')
    assert ages.changed_since(measured, ["lens.py"], tmp_path) == []
    commit("def half(x):\n    return x / 3\n")
    assert ages.changed_since(measured, ["lens.py"], tmp_path) == ["lens.py"]
    assert ages.changed_since(measured, ["other"], tmp_path) == []


def test_a_result_without_its_circumstances_is_listed():
    whole = {name: "" for name in ages.FIELDS if name not in ("steps", "load")}
    rows = [{"steps": 10, "load": 0.1}, {"steps": 20, "load": 0.2}]
    assert ages.lacking(whole | {"cells": rows}) == []
    assert ages.lacking(whole | {"cells": [rows[0], {"steps": 20}]}) == ["load"]
    assert ages.lacking({"commands": [], "cells": []}) == [
        "commit",
        "date",
        "machine",
        "threads",
        "load",
        "versions",
        "steps",
    ]


def test_each_file_of_results_says_what_it_measures():
    assert {path.name for path in ages.RESULTS.glob("*.json")} == {*ages.MEASURED}
    assert [x for paths in ages.MEASURED.values() for x in paths if not (ages.ROOT / x).exists()] == []
