"""Charts: what is drawn stands where the numbers say, and a chart in a file of its own needs nothing else."""

from __future__ import annotations

import math
import re
from xml.etree import ElementTree

import pytest
from budgets import budget

from lumigraph.figures.charts import (
    COLOURS,
    DASHES,
    STYLE,
    WIDTH,
    Series,
    bar_chart,
    line_chart,
    log_ticks,
    numbers,
    standalone,
    ticks,
)
from lumigraph.lab.benchmark.table import curves
from lumigraph.methods import COLOURED, available, colour

pytestmark = budget("runs")


def elements(chart: str, kind: str) -> list[dict[str, str]]:
    return [x.attrib for x in ElementTree.fromstring(chart).iter(kind)]


def points(chart: str, kind: str) -> list[tuple[float, float]]:
    """Where a chart's first curve of a kind runs."""
    (first, *_) = (x["d"] for x in elements(chart, "path") if x["class"].startswith(kind))
    return [tuple(map(float, pair.split())) for pair in first[1:].split("L")]


def test_charts_have_round_ticks():
    assert ticks(0, 60) == [0, 20, 40, 60] and ticks(18.2, 24.1) == [20, 22, 24]
    assert log_ticks(-1, 1) == pytest.approx([0.1, 0.2, 0.5, 1, 2, 5, 10])
    assert len(log_ticks(-12, 6)) <= 8 and all(math.log10(x) == round(math.log10(x)) for x in log_ticks(-12, 6))
    assert log_ticks(math.log10(3.1), math.log10(3.9)) == pytest.approx([3.2, 3.4, 3.6, 3.8])


def test_a_curve_is_drawn_twice_or_once():
    falling = Series("a", [1, 2, 3, 4], [1e-1, 1e-3, 1e-2, 0.0])
    chart = line_chart([falling], "step", "loss", log=True)
    assert "nan" not in chart and len(points(chart, "faint")) == len(points(chart, "bold")) == 3
    jagged = Series("a", range(100), [x % 2 for x in range(100)])
    single = line_chart([jagged], "x", "y", smoothed=False)
    assert "faint" not in single and points(single, "bold") == points(line_chart([jagged], "x", "y"), "faint")
    assert line_chart([Series("a", [1], [1])], "x", "y") == ""


def test_equal_ratios_are_equal_steps_on_logarithmic_axes():
    x, y = [0.0, 0.01, 0.1, 1.0, 10.0, 100.0], [5.0, 1.0, 3.0, 9.0, 27.0, math.inf]
    chart = line_chart([Series("a", x, y)], "scale", "y", log=True, log_x=True, smoothed=False)
    drawn = points(chart, "bold")
    assert len(drawn) == 4  # neither nought nor infinity
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in zip(drawn, drawn[1:], strict=False)]
    assert all(step == pytest.approx(steps[0], abs=0.15) for step in steps) and steps[0][0] > 0 > steps[0][1]


def test_each_point_has_its_mark():
    series = [Series("a & b", [1, 2, 3], [3, 4, 4]), Series("c", [2], [5])]
    chart = line_chart(series, "x", "y", marks=True, smoothed=False)
    marks = elements(chart, "circle")
    assert [mark["class"] for mark in marks] == ["dot c0"] * 3 + ["dot c1"]
    assert [(float(m["cx"]), float(m["cy"])) for m in marks[:3]] == points(chart, "bold")
    assert "a &amp; b: 1, 3" in chart


@pytest.mark.parametrize("marks", [True, False])
@pytest.mark.parametrize("smoothed", [True, False])
def test_no_line_joins_two_points(marks, smoothed):
    """Between two measurements a line is a guess; what has more keeps its own."""
    short, long = Series("short", [60, 300], [20, 25]), Series("long", [60, 120, 300], [21, 23, 26])
    alone = line_chart([short], "seconds", "PSNR", log_x=True, marks=marks, smoothed=smoothed)
    assert {x["class"] for x in elements(alone, "path")} == {"grid"} and len(elements(alone, "circle")) == 2
    both = line_chart([short, long], "seconds", "PSNR", log_x=True, marks=marks, smoothed=smoothed)
    lined = {x["class"].split()[1] for x in elements(both, "path") if x["class"] != "grid"}
    assert lined == {"c1"} and sum(x["class"] == "dot c0" for x in elements(both, "circle")) == 2


def test_numbers_at_the_axes_of_a_chart_are_written_alike():
    assert numbers([0, 0.1 + 0.2, 1500, 20_000]) == ["0", "0.3", "1500", "20000"]
    assert numbers([0, 500_000, 1_500_000, -2e6]) == ["0", "5×10⁵", "1.5×10⁶", "-2×10⁶"]
    assert numbers([1e-5, 2e-5, 5e-5, 1, 10]) == ["10⁻⁵", "2×10⁻⁵", "5×10⁻⁵", "10⁰", "10¹"]
    falling = Series("a", [1, 10, 100], [1, 1e-3, 1e-6])
    for log_x in (True, False):
        chart = line_chart([falling], "samples", "error", log=True, log_x=log_x)
        written = [x.text for x in ElementTree.fromstring(chart).iter("text") if "class" not in x.attrib]
        assert len(written) >= 6 and all("10" in x and x[-1] in "⁻⁰¹²³⁴⁵⁶⁷⁸⁹" for x in written if x != "0")


def test_a_method_has_one_colour_in_every_chart():
    """Whatever else is drawn beside it, and in a report as in a benchmark."""
    cells = [
        {"method": name, "train_views": n, "psnr": 20.0 + n, "ssim": None, "lpips": None}
        for name in ("nerf", "mip-nerf", "gaussian-splatting", "instant-ngp")
        for n in (2, 3, 9)
    ]
    for drawn in (cells, cells[:3], cells[3:]):
        series = curves(drawn, "train_views", lambda row: row["train_views"])
        assert {one.name: one.colour for one in series} == {row["method"]: colour(row["method"]) for row in drawn}
        chart = line_chart(series, "x", "y", marks=True, smoothed=False)
        shown = re.findall(r"class='dot (c\d)' [^>]*><title>([^:]*):", chart)
        assert set(shown) == {(f"c{colour(name)}", name) for name in {row["method"] for row in drawn}}
    assert len({colour(name) for name in available()}) == len(available())
    assert all(colour(name) < COLOURS for name in COLOURED)
    assert all(colour("not-installed") > colour(name) for name in available())
    bars = elements(bar_chart(["one", "two"], [20.0, 21.0], "dB", colour("nerf")), "rect")
    assert {bar["class"] for bar in bars} == {f"bar c{colour('nerf')}"}


def test_what_shares_a_colour_is_told_apart_by_dashes():
    series = [Series(f"nerf, {s} s", [2, 3, 9], [s, s + 1, s + 2], 3, dash) for dash, s in enumerate((60, 300))]
    chart = line_chart(series, "x", "y", smoothed=False)
    lines = [x["class"] for x in elements(chart, "path") if x["class"].startswith(("bold", "sample"))]
    assert lines == ["bold c3", "bold c3 dash1", "sample c3 dash1"]
    assert all(f".dash{i} " in STYLE for i in range(1, DASHES))


def test_an_axis_is_marked_where_it_was_measured_as_far_as_there_is_room():
    views = [2, 3, 9, 98, 100]
    chart = line_chart([Series("a", views, views)], "x", "y", log_x=True, marks=True, smoothed=False, x_ticks=views)
    below = [x.text for x in ElementTree.fromstring(chart).iter("text") if x.get("text-anchor") == "middle"]
    assert below == ["2", "3", "9", "98"]
    round_ones = line_chart([Series("a", views, views)], "x", "y", log_x=True, marks=True, smoothed=False)
    assert ">20</text>" in round_ones and ">98</text>" not in round_ones


def test_eight_series_have_eight_colours_and_names_that_fit():
    series = [Series(f"a method called {i}", [1, 2, 3], [i, i + 1, i + 2]) for i in range(8)]
    chart = line_chart(series, "seconds of training", "PSNR of held-out views, dB")
    names = [x for x in elements(chart, "text") if x.get("class", "").startswith("name")]
    assert {name["class"] for name in names} == {f"name c{i}" for i in range(COLOURS)} and COLOURS == 8
    assert all(f"--c{i}:" in STYLE and f".c{i} " in STYLE for i in range(COLOURS))
    left, top, width, height = map(float, re.search("viewBox='([^']*)'", chart)[1].split())
    assert left == 0 and width == WIDTH and top < 0
    assert all(float(x["x"]) > 110 and top < float(x["y"]) < 30 for x in names)
    label = next(x for x in elements(chart, "text") if x.get("class") == "label")
    assert float(label["y"]) < min(float(x["y"]) for x in names)


def test_a_chart_in_a_file_of_its_own_carries_its_style():
    for chart in (
        line_chart([Series("a < b", [1, 2, 3], [3, 4, 4])], "x", "y", note="fern & lego"),
        bar_chart(["one", "two"], [20.0, 21.0], "dB"),
    ):
        root = ElementTree.fromstring(standalone(chart))
        assert root.tag == "{http://www.w3.org/2000/svg}svg" and root[0].text.strip() == STYLE.strip()
        assert root.attrib["viewBox"].split()[2:] == [root.attrib["width"], root.attrib["height"]]
        assert "prefers-color-scheme: dark" in STYLE and "url(" not in STYLE and "@import" not in STYLE
        assert len(root) == len(ElementTree.fromstring(chart)) + 1
