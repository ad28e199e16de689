"""Tables of methods in the documents: made of benchmarks/results, and equal to it."""

from __future__ import annotations

import copy
import json

import pytest
import tables
from budgets import budget

pytestmark = budget("house")

RESULTS = tables.read()
WITH_TABLES = {"README.md", "benchmarks.md", "grids.md", "python.md"}


def test_pages_have_the_figures_of_the_results():
    stale = [
        page.name for page in tables.pages() if tables.filled(text := page.read_text("utf-8"), page, RESULTS) != text
    ]
    assert not stale, f"{stale} differ from {tables.RESULTS.name}; run `python benchmarks/tables.py`"


def test_every_measured_method_has_a_table_on_its_page():
    measured = {f"{row['method'].replace('-', '_')}.md" for row in RESULTS["cells"]}
    written = {page.name for page in tables.pages() if tables.TABLE.search(page.read_text("utf-8"))}
    assert len(measured) > 3 and measured | WITH_TABLES <= written


def test_another_figure_is_another_page():
    other = copy.deepcopy(RESULTS)
    other["cells"][0]["psnr"] += 1
    changed = {page.name for page in tables.pages() if tables.filled(t := page.read_text("utf-8"), page, other) != t}
    assert {"benchmarks.md", f"{other['cells'][0]['method'].replace('-', '_')}.md"} <= changed


def test_a_table_of_something_unknown_is_refused():
    text = "<!-- table: cells mip-nerff -->\n<!-- end of table -->"
    with pytest.raises(SystemExit, match="unknown table or method"):
        tables.filled(text, tables.pages()[0], RESULTS)


def test_commands_measure_the_cells_of_their_table():
    cell = {"method": "nerf", "source": "lego", "budget": {"seconds": 60.0}, "downscale": None, "eval_views": 10}
    rows = [cell, cell | {"method": "dvgo"}, cell | {"source": "fern"}, cell | {"budget": {"seconds": 240.0}}]
    rows += [cell | {"source": "fern", "method": "dvgo"}, cell | {"source": "fox", "downscale": 8, "eval_views": None}]
    assert tables.commands(rows) == [
        "lumigraph bench methods --methods nerf dvgo --scenes lego fern --seconds 60 --eval-views 10 --output OUTPUT",
        "lumigraph bench methods --methods nerf --scenes lego --seconds 240 --eval-views 10 --output OUTPUT",
        "lumigraph bench methods --methods nerf --scenes fox --seconds 60 --downscale 8 --output OUTPUT",
    ]


def test_results_are_of_one_machine_and_commit(tmp_path):
    row = RESULTS["cells"][0]
    settings = {name: row[name] for name in ("downscale", "eval_views")}
    for i, machine in enumerate(("one", "other")):
        row = row | {"trained_on": machine, "command": f"lumigraph train nerf /some/folder/lego --seed {i}"}
        (tmp_path / machine).mkdir()
        (tmp_path / machine / "results.json").write_text(json.dumps({"settings": settings, "cells": [row]}))
    found = tables.collected([tmp_path / "one"], "abc")
    assert found["commit"] == "abc" and found["cells"][0]["command"] == "lumigraph train nerf lego --seed 0"
    for outputs, commit in (([tmp_path / "one", tmp_path / "other"], "abc"), ([tmp_path / "one"], "")):
        with pytest.raises(SystemExit, match="One commit, one machine"):
            tables.collected(outputs, commit)
