"""The plugin of examples/plugin, installed into an environment of its own, and used from the command line."""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny
from budgets import budget
from PIL import Image

from lumigraph.components.clouds.cloud_method import addition_of
from lumigraph.errors import LumigraphError
from lumigraph.system.plugins import taken

pytestmark = budget("runs", 12)
ROOT = Path(__file__).parent.parent
PROGRAM = """
import json, sys
import lumigraph
from lumigraph.commands.cli import main

capture, out = sys.argv[1:]
cloud = ["--additions", "small-splats", "--initial-gaussians", "50", "--sh-degree", "0"]
always = ["--steps", "10", "--device", "cpu", "--downscale", "1", "--reader", "poses-csv"]
assert main(["methods"]) == 0
assert main(["train", "mean-colour", capture, *always, "--log", "csv", "--output", f"{out}/a"]) == 0
assert main(["train", "gaussian-splatting", capture, *always, *cloud, "--output", f"{out}/b"]) == 0
assert main(["export", "centres", f"{out}/b", f"{out}/centres.csv"]) == 0
print("SEEN", json.dumps(list(lumigraph.open(f"{out}/b").metrics())))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """A folder that packages are installed into."""
    project = tmp_path_factory.mktemp("project") / "plugin"
    shutil.copytree(ROOT / "examples" / "plugin", project, ignore=shutil.ignore_patterns("__pycache__"))
    found = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--target", found, project], check=True, capture_output=True)
    return found


@pytest.fixture
def capture(tmp_path) -> Path:
    """Photographs of noise around the origin, with the table of poses that the plugin reads."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    random, rows = np.random.default_rng(0), []
    for i in range(8):
        Image.fromarray(random.integers(0, 255, (48, 48, 3), dtype=np.uint8)).save(folder / f"{i}.png")
        turn = 2 * np.pi * i / 8
        z, x = np.array([-np.cos(turn), -np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
        pose = np.stack([x, np.cross(z, x), z, -3 * z], 1)
        rows.append([f"{i}.png", 50.0, *pose.flatten().tolist()])
    with open(folder / "poses.csv", "w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


def test_the_template_installs_and_each_of_its_parts_runs(site, capture, tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(site)])}
    words = [sys.executable, "-c", PROGRAM, str(capture), str(tmp_path)]
    told = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr[-3000:]
    assert "mean-colour" in told.stdout
    table = list(csv.reader((tmp_path / "a" / "metrics.csv").read_text().splitlines()))
    assert {name for _, name, _ in table} >= {"loss", "loss/colour"} and {step for step, _, _ in table} == {"10"}
    assert len((tmp_path / "centres.csv").read_text().splitlines()) >= 50
    names = json.loads(told.stdout.rpartition("SEEN ")[2])
    assert "loss/small" in names and "loss/ssim" in names
    assert json.loads((tmp_path / "b" / "config.json").read_text())["config"]["cloud"]["additions"] == ["small-splats"]


def test_without_the_package_its_names_are_refused_in_a_sentence():
    with pytest.raises(LumigraphError, match="No package offers 'small-splats' of lumigraph.additions"):
        addition_of("small-splats", tiny.scene().frame)
    with pytest.raises(LumigraphError, match="No package offers 'csv' of lumigraph.loggers"):
        taken("loggers", "csv")
