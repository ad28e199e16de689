"""`lumigraph compress`: a run becomes a smaller one that everything opens, and loses no more than it may."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import tiny
import torch
from budgets import budget
from test_gaussian_splatting import new

from lumigraph import methods
from lumigraph.commands.cli import main
from lumigraph.commands.compress import verdict
from lumigraph.derive.compression import LADDER
from lumigraph.derive.compression.compress import bytes_of, decibels, rendered, squared_error
from lumigraph.derive.compression.model import RUNG_POSITIONS, CompressedModel, rung_at
from lumigraph.derive.options import CompressOptions
from lumigraph.errors import LumigraphError
from lumigraph.evaluation import held_out_poses
from lumigraph.opening import open_scene
from lumigraph.run import Run, build
from lumigraph.run.derived import Compressed
from lumigraph.training import fit

pytestmark = budget("runs", 25)


@pytest.fixture(scope="module", autouse=True)
def _few_steps_for_held_out_poses() -> Iterator[None]:
    """Runs are compared with each other here, by the same steps for each photograph: 5, where commands take 200."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(held_out_poses, "STEPS", 5)
        yield


@pytest.fixture(scope="module")
def cloud_run(tmp_path_factory) -> Run:
    """Gaussians that have learnt the tiny scene for some steps."""
    method, run = new(tmp_path_factory.mktemp("runs") / "cloud")
    fit(method, tiny.scene(), run, steps=30, show=False, rehearsal=False)
    return run


@pytest.fixture(scope="module")
def large(ball_folder, tmp_path_factory) -> Run:
    """Gaussians that have learnt photographs which can be opened again."""
    scene, kind = open_scene(ball_folder), methods.find("gaussian-splatting")
    method = build(kind, scene.frame, kind.smallest(), torch.device("cpu"), 0)
    run = Run.create(tmp_path_factory.mktemp("large") / "run", method, scene)
    fit(method, scene, run, steps=30, show=False, rehearsal=False)
    return run


@pytest.fixture(scope="module")
def small(large, tmp_path_factory) -> Run:
    """The same, compressed on its photographs."""
    folder = tmp_path_factory.mktemp("small") / "run"
    told = ["--output", str(folder), "--steps", "12", "--max-loss", "0.5", "--device", "cpu"]
    assert main(["compress", str(large.folder), *told]) == 0
    return Run(folder)


def test_it_is_smaller_and_looks_the_same(large, small):
    said = Compressed.read(small.folder)
    assert said.bytes_after == small.model_bytes < large.model_bytes / 4 == said.bytes_before / 4
    assert said.compared_with == "photographs" and said.views == 3
    before, after = (decibels(squared_error(run.method(), large.scene(), "test", 3)) for run in (large, small))
    assert said.psnr_before == pytest.approx(before, abs=1e-4) and said.psnr_after == pytest.approx(after, abs=1e-4)
    assert before - after < 1.0
    assert len(small.method().gaussians()) <= len(large.method().gaussians())


def test_every_command_opens_it(small, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(small.folder, folder)
    for words in (
        ["info", str(folder)],
        ["eval", str(folder), "--views", "1"],
        ["render", str(folder), "--frames", "2", "--size", "16", "--output", str(tmp_path / "film.gif")],
        ["export", "splats", str(folder), str(tmp_path / "cloud.ply")],
        ["report", str(folder)],
    ):
        assert main(words) == 0, words
    assert "times smaller" in capsys.readouterr().out


def test_it_neither_resumes_nor_shrinks_again(small, cloud_run, tmp_path, capsys):
    before = sorted(path.read_bytes() for path in small.folder.rglob("*") if path.is_file())
    assert main(["resume", str(small.folder), "--steps", "90"]) == 2
    assert "cannot be resumed" in capsys.readouterr().err
    assert main(["compress", str(small.folder), "--output", str(tmp_path / "new")]) == 2
    assert "is compressed already" in capsys.readouterr().err
    with pytest.raises(LumigraphError, match="keeps nothing to go on learning with"):
        small.restore_training(small.method().optimizers(), torch.Generator())
    assert sorted(path.read_bytes() for path in small.folder.rglob("*") if path.is_file()) == before


REFUSED = {
    "another method": (["RAYS", "--output", "OUT"], "cannot be stored in fewer bytes"),
    "a codebook too large": (["CLOUD", "--output", "OUT", "--codebook", "5000"], "A codebook of 5,000 rows is larger"),
    "no size": (["CLOUD", "--output", "OUT", "--to", "small"], "give it a size such as 5MB"),
    "two aims": (["CLOUD", "--output", "OUT", "--to", "5MB", "--quality", "good"], "give one of them"),
    "two budgets": (["CLOUD", "--output", "OUT", "--steps", "5", "--seconds", "5"], "give one of them"),
    "unreachable": (["CLOUD", "--output", "OUT", "--to", "100B", "--steps", "1"], "the smallest reached is"),
    "its own source": (["CLOUD", "--output", "CLOUD"], "already holds a run"),
    "other photographs": (["CLOUD", "--output", "OUT", "--scene", "/nowhere"], "nowhere"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(case, cloud_run, ball_run, tmp_path, capsys):
    places = {"RAYS": ball_run.folder, "CLOUD": cloud_run.folder, "OUT": tmp_path / "new"}
    words, sentence = REFUSED[case]
    assert main(["compress", *(str(places.get(word, word)) for word in words)]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.splitlines()[-1].startswith("lumigraph: ") and not (tmp_path / "new").exists()


def test_a_size_is_kept_and_without_photographs_it_looks_as_it_did(cloud_run, tmp_path, capsys):
    said = ["--output", str(tmp_path / "new"), "--to", "9kB", "--steps", "6", "--views", "2"]
    assert main(["compress", str(cloud_run.folder), *said]) == 0
    made = Compressed.read(tmp_path / "new")
    assert made.bytes_after <= 9000 and made.compared_with == "renderings of the run" and made.psnr_before is None
    assert made.psnr_after > 20 and "2 held-out renderings of the run, for its photographs" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("after", "psnr", "said"),
    [
        (5_000, 29.9, "2.0 times smaller, with no visible loss"),
        (5_000, 29.5, "2.0 times smaller, with a loss that a comparison side by side shows"),
        (5_000, 28.0, "2.0 times smaller, with a visible loss; for a smaller one give --quality best"),
        (12_000, 29.0, "worse in every row: keep RUN, or give a larger --max-loss, for example 2.0"),
        (12_000, 30.1, "no smaller; give a larger --max-loss than the 0.00 dB that were lost"),
    ],
    ids=["invisible", "small loss", "visible loss", "worse in every row", "no smaller"],
)
def test_the_verdict_in_words(after, psnr, said):
    made = Compressed("RUN", "m", 10_000, after, 20_000, 20_000, psnr, "photographs", 3, 0.1, 16, 0.1, 1, 9, 1.0, 30.0)
    assert verdict(made, Path("RUN")).startswith(said)


def test_interrupted_it_keeps_nothing_and_says_so(cloud_run, tmp_path, monkeypatch, capsys):
    def interrupt(*told, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["lumigraph.derive.compression.compress"], "written", interrupt)
    assert main(["compress", str(cloud_run.folder), "--output", str(tmp_path / "new"), "--steps", "1"]) == 130
    assert f"Stopped; {cloud_run.folder} is as it was and nothing else is kept" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_each_place_on_the_ladder_is_smaller_than_the_one_before(cloud_run):
    sizes = []
    for place in RUNG_POSITIONS[::6]:
        method = cloud_run.method()
        weights = {"cloud.harmonics": torch.rand(len(method.cloud), generator=torch.Generator().manual_seed(0))}
        sizes.append(len(CompressedModel(method, weights, rung_at(place), 30).packed()))
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < sizes[0] / 1.5


def test_importance_is_what_a_picture_gains(cloud_run):
    """Its sum over all Gaussians is the picture's opacity times the first harmonic, and what is hidden has none."""
    method, camera = cloud_run.method(), tiny.scene().cameras[4]
    weights = method.importance(camera)["cloud.harmonics"]
    assert float(weights.sum()) == pytest.approx(0.28209 * float(method.render(camera).opacity.sum()), rel=0.02)
    assert (weights >= 0).all()


def test_tuning_mends_what_storing_broke(cloud_run):
    scene, method = tiny.scene(), cloud_run.method()
    weights = {"cloud.harmonics": torch.ones(len(method.cloud))}
    model = CompressedModel(method, weights, LADDER[-1], 30)
    broken = squared_error(method, scene, "train", 9)
    model.tune(scene, 40, None)
    assert squared_error(method, scene, "train", 9) < 0.95 * broken
    shown = {name: x.clone() for name, x in method.state_dict().items()}
    for name, table in model.tables.items():
        if table.forms:
            assert torch.equal(table.tensor(), shown[name]), name


def test_a_rendering_is_a_photograph_with_straight_alpha(cloud_run):
    method = cloud_run.method()
    scene = rendered(cloud_run, method)
    assert len(scene.splits["train"]) == 9 and len(scene.splits["test"]) == 3
    i = int(scene.splits["test"][1])
    seen = method.render(scene.cameras[i])
    again = scene.photograph(i).before(scene.frame.background)
    assert (again - seen.rgb.clamp(0, 1)).abs().max() < 0.03
    assert bytes_of(seen, None).shape[-1] == 3


@pytest.mark.parametrize(
    ("text", "bytes_"), [("5MB", 5e6), ("800 kb", 8e5), ("2MiB", 2**21), ("0.5g", 5e8), ("17", 17)]
)
def test_sizes_as_people_write_them(text, bytes_):
    assert CompressOptions(to=text).bytes == bytes_


def test_what_compressing_came_to_is_read_by_its_layout(small, tmp_path):
    said = json.loads((small.folder / "compress.json").read_text())
    (tmp_path / "compress.json").write_text(json.dumps(said | {"bytes_after": -1}))
    with pytest.raises(LumigraphError, match="bytes_after is -1"):
        Compressed.read(tmp_path)


def test_a_psnr_at_a_size_lies_between_the_rungs_beside_it():
    from grids import at_size

    lines = [{"bytes": size, "psnr": psnr} for size, psnr in ((4e6, 30.0), (1e6, 28.0), (1e5, 20.0))]
    assert [at_size(lines, size) for size in (1e6, 2e6, 9e6, 1e4)] == ["28.00", "29.00", "(30.00)", "(20.00)"]
