"""Methods side by side: cells are runs, what is done is kept, what fails says why."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import statistics
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from budgets import budget
from PIL import Image

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.halves import LEFT_HALVES, RIGHT_HALVES
from lumigraph.lab.benchmark import published as published_table
from lumigraph.lab.benchmark.cell import Cell, CellSettings, ScenePSNR, published
from lumigraph.lab.benchmark.conduct import Patience, conduct, draw_charts, launch, reason
from lumigraph.lab.benchmark.published import RESULTS, first_of
from lumigraph.lab.benchmark.table import few_view_results
from lumigraph.run import Run

pytestmark = budget("runs", 40)

SETTINGS = CellSettings(device="cpu", eval_views=2)


class Here:
    """Launches in this process, where the tests' own method is known, and remembers what it launched."""

    def __init__(self, *more: str, code: int | None = None):
        self.more, self.code, self.seen = list(more), code, []

    def __call__(self, arguments: Sequence[str], log: Path) -> int:
        self.seen.append(arguments[0])
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text("$ lumigraph told\nlumigraph: it did not like the weather\n")
        code = main([*arguments, *self.more])
        return code if self.code is None else self.code


def cell(ball_folder: Path, steps: int = 4, seed: int = 0, views: int | None = None) -> Cell:
    return Cell("voxel-grid", "ball", str(ball_folder), Budget(steps, None), seed, views)


def rows(output: Path) -> list[dict]:
    return json.loads((output / "results.json").read_text())["cells"]


@pytest.fixture(scope="module")
def cells(ball_folder) -> list[Cell]:
    return [cell(ball_folder), cell(ball_folder, seed=1), cell(ball_folder, steps=30)]


@pytest.fixture(scope="module")
def done(cells, tmp_path_factory) -> Path:
    output, here = tmp_path_factory.mktemp("done") / "out", Here()
    assert conduct(cells, SETTINGS, output, launch=here) == 0
    assert here.seen == ["train", "eval"] * 3
    return output


@pytest.fixture
def output(done, tmp_path) -> Path:
    """A copy that a test may spoil."""
    return shutil.copytree(done, tmp_path / "out")


def test_every_cell_is_a_run_and_a_row(cells, done):
    for one, row in zip(cells, rows(done), strict=True):
        run = Run(done / row["run"])
        evaluation = run.evaluation()
        assert (run.method_name, run.settings.seed, run.state.step) == ("voxel-grid", one.seed, one.budget.steps)
        assert all(row[name] == evaluation[name] for name in ("psnr", "ssim", "seconds_per_view", "protocol"))
        assert (row["protocol"]["views"], row["protocol"]["of"], row["train_views"]) == (2, 3, 9)
        assert row["peak_memory"] == run.state.peak_memory > 0
        assert row["model_bytes"] == sum(file.stat().st_size for file in run.folder.rglob("weights.safetensors"))


def test_the_page_has_means_and_every_cell(done):
    page, scores = (done / "results.md").read_text(), [row["psnr"] for row in rows(done)]
    assert f"{statistics.mean(scores[:2]):.2f} ± {abs(scores[0] - scores[1]) / 2**0.5:.2f}" in page
    assert all(f"| {score:.2f} |" in page for score in scores)
    assert "24x24, 2 of 3 of test, evenly spread, white background" in page and "LPIPS |" not in page
    assert (done / "ball-psnr-over-time.svg").read_text().count("<circle") == 2
    assert "(ball-psnr-over-time.svg)" in page and "(views.png)" in page


def test_the_sheet_shows_photograph_and_rendering(ball_folder, done):
    row = rows(done)[2]  # the longest training
    name = Path(row["shown"]["name"]).stem
    sheet = np.array(Image.open(done / "views.png"))
    photograph = np.array(Image.open(ball_folder / f"{name}.png")).astype(float)
    photograph = photograph[..., :3] * photograph[..., 3:] / 255 + (255 - photograph[..., 3:])
    rendering = np.array(Image.open(done / row["run"] / "eval" / f"{name}.png").convert("RGB"))
    top = next(y for y in range(len(sheet)) if (sheet[y : y + 24, 158:182] == rendering).all())
    assert np.abs(sheet[top : top + 24, 28:52] - photograph).max() <= 1


def test_what_is_done_is_kept(cells, output):
    again = Here()
    assert conduct(cells[:1], SETTINGS, output, launch=again) == 0
    assert again.seen == [] and len(rows(output)) == 3
    assert conduct(cells[:1], CellSettings(device="cpu", eval_views=3), output, launch=again) == 0
    assert again.seen == ["eval"] and len(rows(output)) == 3
    assert rows(output)[0]["protocol"]["views"] == 3


def test_a_stopped_benchmark_goes_on(ball_folder, tmp_path):
    one, again = cell(ball_folder), Here()
    assert conduct([one], SETTINGS, tmp_path, launch=Here("--pause-at", "2", code=130)) == 130
    assert Run(tmp_path / "runs" / one.name).state.step == 2 and not (tmp_path / "results.json").exists()
    assert conduct([one], SETTINGS, tmp_path, launch=again) == 0
    assert again.seen == ["resume", "eval"] and rows(tmp_path)[0]["steps"] == 4


def test_a_cell_that_fails_is_a_row_that_says_why(cells, output, tmp_path):
    lost = Cell("voxel-grid", "lost", str(tmp_path / "lost"), Budget(4, None))
    for _ in range(2):  # it is tried again
        here = Here()
        assert conduct([lost, *cells], SETTINGS, output, launch=here) == 0
        assert here.seen == ["train"]
        assert [row["failed"] for row in rows(output)] == [None, None, None, "it did not like the weather"]
    page = (output / "results.md").read_text()
    assert "| failed: it did not like the weather |" in page and f"| {rows(output)[0]['psnr']:.2f} |" in page


class Lit(Here):
    """The same, where the methods of some seeds find a code of each photograph on its left half."""

    def __init__(self, *seeds: int):
        super().__init__()
        self.lit, self.evaluations = seeds, []

    def __call__(self, arguments: Sequence[str], log: Path) -> int:
        code = super().__call__(arguments, log)
        if arguments[0] == "eval":
            self.evaluations.append((log.stem, "--right-halves" in arguments))
            path = Path(arguments[1]) / "eval.json"
            if any(log.stem.endswith(f"seed{seed}") for seed in self.lit):
                found = json.loads(path.read_text())
                found["protocol"]["halves"] = LEFT_HALVES
                path.write_text(json.dumps(found))
        return code


def test_all_methods_of_a_scene_are_compared_on_the_same_pixels(ball_folder, tmp_path):
    """One that is judged by halves makes all of its scene be, also those of earlier commands; other scenes stay."""
    early, plain, lit, late = (cell(ball_folder, seed=seed) for seed in range(4))
    other = replace(early, scene="other", source=str(shutil.copytree(ball_folder, tmp_path / "other")))
    output, here = tmp_path / "out", Lit(2)
    assert conduct([other, early], SETTINGS, output, launch=here) == 0
    assert conduct([plain, lit, late], SETTINGS, output, launch=here) == 0
    expected = [
        (other, False),
        (early, False),
        (plain, False),
        (lit, False),
        (late, True),
        (early, True),
        (plain, True),
    ]
    assert here.evaluations == [(one.name, halves) for one, halves in expected]
    said = {row["run"]: row["protocol"]["halves"] for row in rows(output)}
    assert said == {
        f"runs/{one.name}": how
        for one, how in (
            (other, None),
            (early, RIGHT_HALVES),
            (plain, RIGHT_HALVES),
            (lit, LEFT_HALVES),
            (late, RIGHT_HALVES),
        )
    }
    whole, halves = (row["psnr"] for row in rows(output)[:2])  # the same run, on other pixels
    assert whole != halves
    page = (output / "results.md").read_text()
    assert "| halves | poses |" in page and "| right, codes from left | as captured |" in page
    assert page.count("| whole | as captured |") == 2 and page.count("| right | as captured |") == 3
    again = Lit(2)
    assert conduct([other, early, plain, lit, late], SETTINGS, output, launch=again) == 0 and again.seen == []


def test_a_damaged_run_stops_nothing(cells, output):
    next((output / "runs" / cells[0].name).rglob("state.json")).write_text("{}")
    assert conduct(cells, SETTINGS, output, launch=Here()) == 0
    faults = [row["failed"] for row in rows(output)]
    assert "is not a checkpoint" in faults[0] and faults[1:] == [None, None]


def test_fewer_views_make_a_chart(ball_folder, tmp_path):
    output = tmp_path / "out"
    conduct([cell(ball_folder, views=views) for views in (2, None)], SETTINGS, output, launch=Here())
    assert [row["train_views"] for row in rows(output)] == [2, 9]
    assert (output / "ball-psnr-over-views.svg").read_text().count("<circle") == 2
    assert not (output / "ball-psnr-over-time.svg").exists()


def test_a_chart_is_marked_at_its_own_budgets(done, tmp_path):
    """Not at those of cells that learnt from fewer photographs, which are another chart's."""
    row = rows(done)[0]
    drawn = [(60, None), (300, None), (20, 2), (20, 3)]
    draw_charts(
        [
            row | {"budget": {"seconds": s}, "training_seconds": s + 0.1, "views": n, "train_views": n or 9}
            for s, n in drawn
        ],
        tmp_path,
    )
    over_time = (tmp_path / "ball-psnr-over-time.svg").read_text()
    assert ">60</text>" in over_time and ">300</text>" in over_time and ">20</text>" not in over_time
    over_views = (tmp_path / "ball-psnr-over-views.svg").read_text()
    assert all(f">{n}</text>" in over_views for n in (2, 3, 9))


def test_photographs_at_several_scales_count_once(ball_folder, tmp_path):
    output = tmp_path / "out"
    conduct([cell(ball_folder)], CellSettings(device="cpu", scales=2), output, launch=Here())
    (row,) = rows(output)
    assert row["train_views"] == 9 and row["protocol"]["views"] == 6
    assert set(row["by_resolution"]) == {"24x24", "12x12"} and row["shown"]["resolution"] == "24x24"
    assert (
        row["command"].endswith("--scales 2 --device cpu")
        and "| 2 sizes, 6 of test" in (output / "results.md").read_text()
    )


def test_cells_that_share_nothing_are_kept_apart(ball_folder, done, tmp_path):
    with pytest.raises(LumigraphError, match="begun with --preset auto, which is now paper"):
        conduct([cell(ball_folder)], CellSettings(device="cpu", preset="paper"), done, launch=Here())
    with pytest.raises(LumigraphError, match="Two scenes are called ball"):
        conduct([cell(tmp_path)], SETTINGS, done, launch=Here())


def test_time_left_counts_what_is_not_training():
    cells = [Cell("nerf", "lego", "lego", Budget(None, 60.0), seed) for seed in range(3)]
    patience = Patience()
    assert patience.left(cells) == "at least 3:00 left"
    patience.note(cells[0], 75.0)
    patience.note(cells[1], 65.0)
    assert patience.left(cells[2:]) == "about 1:10 left"


def test_published_figures_are_of_methods_and_scenes():
    assert published("nerf", "Lego") == ScenePSNR(32.54, "800x800", "Mildenhall et al. 2020, white background")
    assert published("nerf", "fern") == ScenePSNR(25.17, "1008x756", "Mildenhall et al. 2020")
    assert published("nerf", "my-garden") is None


def test_each_published_result_has_an_owner_a_protocol_and_a_source():
    for result in RESULTS:
        assert result.method in methods.available() and result.data and result.protocol, result
        assert re.fullmatch(r"[^\W\d].+ (19|20)\d\d", result.measured_by), result
        assert re.fullmatch(r"arXiv \d{4}\.\d{4,5}", result.source), result
        assert re.search(r"\d", result.value) and float(re.findall(r"[\d.]+", result.value)[0]) > 0, result
    places = [(x.method, x.metric, x.data, x.protocol) for x in RESULTS]
    assert len({*places}) == len(places), "one result stands twice"


def test_published_results_of_others_name_them():
    """Park 2021 and Li 2021 did not measure these captures, nor did Weng 2022 these of people."""
    owners = {name: first_of(name).measured_by for name in ("nerfies", "nsff", "humannerf", "mip-nerf", "nerf")}
    assert owners == {
        "nerfies": "Gao et al. 2022",
        "nsff": "Gao et al. 2022",
        "humannerf": "Hu et al. 2024",
        "mip-nerf": "Barron et al. 2021",
        "nerf": "Mildenhall et al. 2020",
    }
    assert first_of("regnerf").sentence == (
        "18.89 dB: DTU, 15 scenes, 3 photographs, background masked out (measured by Niemeyer et al. 2022)"
    )
    assert first_of("eg3d").sentence.startswith("FID 4.70: FFHQ") and first_of("srn") is None


def test_documents_have_the_table_of_published_results():
    assert few_view_results() in (Path(__file__).parent.parent / "docs" / "few-views.md").read_text("utf-8")
    own = re.compile(r"class Published|PSNR, dB\"|arXiv \d{4}\.\d{5}")
    folder = Path(published_table.__file__).parent
    assert [x.name for x in folder.glob("*.py") if own.search(x.read_text("utf-8"))] == ["published.py"]


def test_a_process_says_why_it_failed(tmp_path):
    log = tmp_path / "a.log"
    assert launch(["eval", str(tmp_path / "nowhere")], log) == 2
    assert reason(log, 2).startswith(str(tmp_path / "nowhere")) and "does not exist" in reason(log, 2)
    assert "memory" in reason(log, 137)


def test_ctrl_c_is_passed_on(ball_folder, tmp_path):
    press = threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGINT))
    press.start()
    arguments = ["train", "fourier-features", str(ball_folder), "--seconds", "300", "--output", str(tmp_path / "run")]
    assert launch(arguments, tmp_path / "run.log") == 130
    press.join()


def test_the_command(ball_folder, tmp_path, capsys):
    output = tmp_path / "out"
    arguments = [
        "bench",
        "views",
        "--methods",
        "fourier-features",
        "--scenes",
        str(ball_folder),
        "--views",
        "3",
        "40",
        "--steps",
        "2",
    ]
    assert main([*arguments, "--eval-views", "1", "--output", str(output)]) == 0
    told = capsys.readouterr()
    assert "leaving out 40" in told.err and "1 of 1: fourier-features on ball from 3 views, 2 steps, seed 0" in told.err
    (row,) = rows(output)
    assert row["train_views"] == 3 and row["steps"] == 2 and row["peak_memory"] > 50e6
    assert row["command"] == "lumigraph train fourier-features ball --steps 2 --seed 0 --views 3"
    assert str(tmp_path) not in (output / "results.json").read_text() + (output / "results.md").read_text()


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (["--steps", "3", "--seconds", "3"], "give one of them"),
        (["--steps", "0"], "from 1 to"),
        (["--eval-views", "0"], "--eval-views"),
        (["--lpips", "nowhere.pth"], "nowhere.pth"),
        (["--device", "abacus"], "abacus"),
    ],
)
def test_numbers_are_checked_before_anything_is_trained(ball_folder, tmp_path, capsys, more, why):
    output = tmp_path / "out"
    arguments = ["bench", "methods", "--methods", "voxel-grid", "--scenes", str(ball_folder), "--output", str(output)]
    assert main([*arguments, *more]) == 2
    told = capsys.readouterr().err
    assert why in told and len(told.splitlines()) == 1 and not output.exists()
