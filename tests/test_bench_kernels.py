"""The kernels' benchmark: what it prints and what it writes."""

from __future__ import annotations

import io
import json

import pytest
from agreement import OPERATIONS, facts
from budgets import budget
from rich.console import Console

from lumigraph.kernels.bench import bench_kernels

pytestmark = budget("kernels")


def test_rates_and_ratios(tmp_path):
    text = io.StringIO()
    console = Console(file=text, width=100)
    result = bench_kernels(device="cpu", size=256, repeats=3, output=tmp_path / "bench.json", console=console)
    assert json.loads((tmp_path / "bench.json").read_text()) == result
    for name in OPERATIONS:
        backward, engines = bool(facts(name).differentiable), result["operations"][name]["engines"]
        assert result["operations"][name]["unit"] == facts(name).unit
        assert name in text.getvalue()
        for direction in ("forward", "backward") if backward else ("forward",):
            rate = engines["cpu"][f"{direction}_per_second"]
            slow = engines["reference"][f"{direction}_per_second"]
            assert engines["cpu"][f"{direction}_ratio"] == pytest.approx(rate / slow)
        assert ("backward_per_second" in engines["cpu"]) == backward
    assert result["operations"]["photometric"]["count"] == 256  # pixels, not rows of them
    assert result["protocol"]["numba_threads"] >= 1
