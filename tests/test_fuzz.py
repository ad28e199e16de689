"""Files made wrong, a fixed few of each class: whatever is opened opens, or says in one sentence why it does not.

`benchmarks/fuzz.py` tries thousands, each in a process of its own, with limits of time and memory.
"""

from __future__ import annotations

import json
import random
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path

import captures
import pytest
import tiny
import torch
from budgets import budget
from fuzzing import flags, templates
from fuzzing.bend import bend

from lumigraph.commands.cli import main
from lumigraph.commands.info_tree import run_tree
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.report import write_report
from lumigraph.exchange import SUFFIXES, packing, write_gaussians
from lumigraph.gaussians import Gaussians
from lumigraph.geometry import Similarity
from lumigraph.large import open_any
from lumigraph.opening import open_dataset
from lumigraph.paths.keyframes import CameraPath
from lumigraph.run import Run
from lumigraph.run.composition import CompositionPart, write_composition

pytestmark = budget("capture", 20)

SEED = 18
Open = Callable[[Path], object]


def opened_or_told(kind: str, folder: Path, patterns: tuple[str, ...], count: int, open_it: Open) -> None:
    """Bend one file after the other, open what it belongs to, and put it right again."""
    chance = random.Random(f"{SEED} {kind}")
    for number in range(count):
        file = chance.choice([path for path in sorted(folder.glob(chance.choice(patterns))) if path.is_file()])
        before = file.read_bytes()
        done = bend(file, chance)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                open_it(folder)
        except LumigraphError as error:
            assert "\n\n" not in str(error) and 10 < len(str(error)) < 2000, f"{kind} {number}, {done}: no sentence"
        except Exception as fault:
            raise AssertionError(f"{kind} {number}, {done} of {file.name}: {type(fault).__name__}: {fault}") from fault
        finally:
            file.write_bytes(before)


SCENES: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "blender": (lambda folder: captures.write_blender(folder, captures.Tiny(4)), ("*.json",)),
    "instant-ngp": (lambda folder: captures.write_ngp(folder, captures.Tiny(4)), ("*.json",)),
    "layers": (lambda folder: templates.with_layers(folder, captures.Tiny(4)), ("*.json", "sparse.ply", "*/*.png")),
    "tum": (lambda folder: templates.write_tum(folder, captures.Tiny(4)), ("*.txt", "depth/*")),
    "seven-scenes": (lambda folder: templates.write_seven_scenes(folder, captures.Tiny(4)), ("*.txt", "*.depth.png")),
    "colmap binary": (lambda folder: captures.write_colmap(folder, captures.Tiny(4)), ("sparse/0/*",)),
    "colmap text": (lambda folder: captures.write_colmap(folder, captures.Tiny(4), text=True), ("sparse/0/*",)),
    "llff": (lambda folder: captures.write_llff(folder, captures.Tiny(4)), ("*.npy",)),
    "nerfies": (lambda folder: captures.write_nerfies(folder, captures.Tiny(4)), ("*.json", "camera/*", "*.npy")),
    "nr-nerf": (lambda folder: captures.write_nr_nerf(folder, captures.Tiny(4)), ("*.json",)),
    "nsvf": (lambda folder: captures.write_nsvf(folder, captures.Tiny(4)), ("*.txt", "pose/*")),
    "shapes": (templates.write_shapes, ("*",)),
}


@pytest.mark.parametrize("kind", SCENES)
def test_scenes(kind, tmp_path):
    write, files = SCENES[kind]
    folder = tmp_path / "scene"
    folder.mkdir()
    write(folder)
    open_dataset(folder)
    opened_or_told(kind, folder, files, 25, open_dataset)


def test_pictures(tmp_path):
    templates.write_pictures(tmp_path)
    for path in sorted(tmp_path.iterdir()):
        opened_or_told(path.name, tmp_path, (path.name,), 8, lambda _, path=path: open_dataset(path))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_clouds(suffix, tmp_path):
    chance = torch.Generator().manual_seed(SEED)
    write_gaussians(tmp_path / f"cloud{suffix}", cloud(chance))
    opened_or_told(suffix, tmp_path, ("cloud*",), 40, lambda folder: open_any(folder / f"cloud{suffix}"))


def cloud(chance: torch.Generator) -> Gaussians:
    def draw(*size: int) -> torch.Tensor:
        return 0.5 * torch.randn(*size, generator=chance)

    return Gaussians(draw(60, 3), draw(60, 4), draw(60, 3) - 4, draw(60), draw(60, 4, 3))


FILES_OF_RUN = {
    "config.json": 50,
    "cameras.json": 30,
    "metrics.jsonl": 25,
    "eval.json": 25,
    "checkpoints/*/state.json": 20,
    "checkpoints/*/*.safetensors": 20,
}


@pytest.mark.parametrize("file", FILES_OF_RUN)
def test_runs(file, ball_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(ball_run.folder, folder)
    score = {"name": "psnr", "value": 20.0, "unit": "dB"}
    about = {"split": "test", "views": 3, "of": 3, "resolution": "24x24"}
    (folder / "eval.json").write_text(
        json.dumps({"psnr": 20.0, "ssim": 0.9, "protocol": about, "views": [], "scores": [score]})
    )
    opened_or_told(file, folder, (file,), FILES_OF_RUN[file], everything)


def everything(folder: Path) -> None:
    """All that commands ask of a run."""
    run = Run(folder)
    run_tree(run)
    write_report(run)
    method = run.method()
    run.restore_training(method.optimizers(), torch.Generator())
    views = run.cameras()["train"]
    method.render(views[0].resized(0.3))
    run.view_names()


def test_packed_tensors(tmp_path):
    chance = torch.Generator().manual_seed(SEED)
    recipe = packing.Recipe(codebook=8, apart=0.3)
    tables = {
        how: packing.packed(torch.randn(90, 6, generator=chance), packing.Stored(how), recipe, None, chance)
        for how in ("scaled", "coded", "half", "nothing")
    }
    path = tmp_path / "weights.packed"
    path.write_bytes(packing.write({**tables, "marks": torch.rand(4, 50, generator=chance) < 0.5}))
    opened_or_told("packed", tmp_path, ("*.packed",), 150, lambda _: packing.read(path.read_bytes(), path))


def test_camera_paths(tmp_path):
    templates.write_path(tmp_path / "path.json")
    frame = tiny.scene().frame
    opened_or_told(
        "camera path",
        tmp_path,
        ("path.json",),
        60,
        lambda folder: CameraPath.load(folder / "path.json").cameras(frame, (16, 16), frames=3),
    )


def test_compositions(tmp_path):
    for name in ("a.splat", "b.splat"):
        write_gaussians(tmp_path / name, cloud(torch.Generator().manual_seed(SEED)))
    parts = [CompositionPart("a.splat", Similarity.make(1.0)), CompositionPart("b.splat", Similarity.make(2.0))]
    write_composition(tmp_path / "both.json", parts)
    opened_or_told("composition", tmp_path, ("both.json",), 50, lambda folder: open_any(folder / "both.json").cameras())


def test_options(tmp_path, monkeypatch, capsys):
    """Each is refused, or fails later for there is no such scene: never otherwise than by a sentence or a list."""
    monkeypatch.chdir(tmp_path)
    chance = random.Random(SEED)
    for number in range(30):
        words, _ = (flags.command, flags.method_command)[number % 2](chance)
        words = [word.encode(errors="replace").decode() for word in words]  # terminals show any byte, this one UTF-8
        if words[0] in ("bench", "demo", "view"):  # what they are asked for takes long if it can be done
            continue
        try:
            code = main(words)
        except SystemExit as leave:
            code = leave.code
        said = capsys.readouterr().err
        if code:
            assert code == 2, f"{number}, {words}: {code}"
            assert said.count("lumigraph:") == 1 or "For full helptext" in said, f"{number}, {words}: {said}"
    assert not list(tmp_path.rglob("*.partial*"))
