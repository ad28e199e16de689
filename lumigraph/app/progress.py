"""Progress of a project as pictures: photographs with their features, cameras and sparse points, training."""

import contextlib
import re
import sqlite3
import time
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..budget import Budget
from ..errors import LumigraphError
from ..files import read_json
from ..files.names import natural
from ..files.ranges import Tally
from ..geometry import evenly
from ..metrics.rows import last_psnr
from ..sfm.reconstruction import SNAPSHOTS
from ..sfm.stages import StageMark
from . import pace
from .job_record import Making
from .jobs import log_lines, run_folder
from .projects import SCENE, Item, changed_at, newest
from .sharing import gaussians_of

STAGES = {
    "features": "Finding details",
    "matching": "Comparing photographs",
    "mapping": "Placing cameras",
    "unfolding": "Looking for folds",
    "completing": "Placing the rest",
    "lenses": "Refining the lens",
}
WEIGHTS = {"features": 0.4, "matching": 0.3, "mapping": 0.15, "unfolding": 0.02, "completing": 0.11, "lenses": 0.02}
MAX_FEATURES, MAX_POINTS, MAX_CAMERAS = 1500, 4000, 1000  # that a page draws
MAX_ROWS, QUERY_STEPS, QUERY_SECONDS = 100_000, 10_000, 2.0  # rows of an answer of COLMAP's database; its longest time
MAX_IMAGES = 2147483647  # of COLMAP: the number of a pair is one image's number times this, and the other's
DATABASE = Path("work", "database.db")  # in the folder of a scene
MAX_ENTRIES = 1000  # of a folder whose age is looked for
CURVE_POINTS = 80
PERCENT = re.compile(r"(\d+) of (\d+)")


@dataclass(frozen=True)
class CaptureRecord:
    """Contents of capture.json, the fields in use; see `Diagnosis`."""

    given: Tally = 0
    used: Tally = 0
    points: Tally = 0
    error: float = 0.0
    angle: float | None = None
    registered: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    blurred: dict[str, str] = field(default_factory=dict)
    duplicates: dict[str, str] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    findings: list[dict[str, Any]] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)


def photographs_state(item: Item) -> dict[str, dict[str, Any]]:
    """State of each photograph by name: features, matching photographs, whether it is registered or why not."""
    found: dict[str, dict[str, Any]] = {}
    for name, features, matched in rows_of(item.path / SCENE / DATABASE):
        found[name] = {"features": features, "matched": matched}
    result = None
    with contextlib.suppress(LumigraphError):  # the page of the item says so
        result = capture_result(item)
    if result is not None:
        for name in result.registered:
            found.setdefault(name, {})["placed"] = True
        for group in ("left_out", "blurred", "duplicates"):
            for name, why in getattr(result, group).items():
                found.setdefault(name, {})[group] = why
    return {name: found[name] for name in sorted(found, key=natural)}


def rows_of(database: Path) -> list[tuple[str, int | None, int]]:
    """Photographs of COLMAP's database: name, number of features, number of matching photographs."""
    images = query(
        database, "SELECT images.image_id, name, keypoints.rows FROM images LEFT JOIN keypoints USING (image_id)"
    )
    pairs = query(database, "SELECT pair_id FROM two_view_geometries WHERE rows >= 15")
    matched = Counter(image for (pair,) in pairs if isinstance(pair, int) for image in divmod(pair, MAX_IMAGES))
    return [
        (name, features if isinstance(features, int) else None, matched[number])
        for number, name, features in images
        if isinstance(name, str)
    ]


def query(database: Path, question: str, *values: Any) -> list[tuple[Any, ...]]:
    """Rows of COLMAP's database while COLMAP writes it. None if missing, locked, foreign, damaged or slow."""
    if not database.is_file():
        return []
    end = time.monotonic() + QUERY_SECONDS
    try:
        with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=0.2)) as connection:
            connection.set_progress_handler(lambda: time.monotonic() > end, QUERY_STEPS)
            return connection.execute(f"{question} LIMIT {MAX_ROWS}", values).fetchall()
    except sqlite3.Error:
        return []


def features(item: Item, name: str) -> list[list[float]]:
    """Some features of a photograph, x and y as shares of its width and height; none of a damaged table."""
    rows = query(
        item.path / SCENE / DATABASE,
        "SELECT cols, data, width, height FROM images JOIN keypoints USING (image_id) "
        "JOIN cameras USING (camera_id) WHERE name = ?",
        name,
    )
    for columns, data, width, height in rows[:1]:
        if not all(isinstance(number, int) and number > 0 for number in (columns, width, height)) or columns < 2:
            return []
        if not isinstance(data, bytes) or len(data) % (4 * columns):
            return []
        table = np.frombuffer(data, np.float32).reshape(-1, columns)[:, :2] / (width, height)
        table = table[np.isfinite(table).all(1)]
        return np.round(table[:: max(1, len(table) // MAX_FEATURES)], 4).tolist()
    return []


def capture_result(item: Item) -> CaptureRecord | None:
    """Contents of capture.json; None before the capture is done. Raises LumigraphError for a damaged file."""
    path = item.path / SCENE / "capture.json"
    return read_json(path, CaptureRecord) if path.is_file() else None


def progress_of(item: Item, job: Making) -> dict[str, Any]:
    """Stage of a job, its progress as a share, and the figures of its kind."""
    return capture_progress(item) if job.stage == "capture" else training_progress(item, job)


def capture_progress(item: Item) -> dict[str, Any]:
    """Stage of a running capture: its name, overall progress as a share, remaining seconds if known."""
    marks = item.path / SCENE / "work" / "stages.json"
    try:
        done = read_json(marks, dict[str, StageMark]) if marks.is_file() else {}
    except LumigraphError as fault:
        return {"stage": str(fault), "share": 0.0, "said": ""}
    said = next((line for line in reversed(log_lines(item)) if ": " in line and PERCENT.search(line)), "")
    share, stage = 0.03, "Looking at photographs"
    for name, title in STAGES.items():
        if name not in done:
            break
        if done[name].done:
            share += 0.95 * WEIGHTS[name]
        else:
            stage, (count, total) = title, within_stage(item, name, said)
            share += 0.95 * WEIGHTS[name] * min(1.0, count / max(total, 1))
            said = f": {count} of {total}" if name == "features" and total else said
    else:
        stage = "Writing the scene"
    made = sum(WEIGHTS[name] for name in STAGES if name in done and done[name].done)
    spent = sum(done[name].seconds or 0.0 for name in STAGES if name in done and done[name].done)
    left = (spent / made if made else pace.known().photograph * pace.given(item)) * (1 - min(share, 1.0))
    return {"stage": stage, "share": min(share, 1.0), "said": said.partition(": ")[2], "left": left}


def within_stage(item: Item, stage: str, said: str) -> tuple[int, int]:
    """Count and total of a stage: of photographs with features, else from the last line of the log."""
    if stage == "features":  # those of an earlier start count too, unlike in the log
        rows = rows_of(item.path / SCENE / DATABASE)
        return sum(features is not None for _, features, _ in rows), len(rows)
    found = PERCENT.search(said)
    return (int(found[1]), int(found[2])) if found else (0, 0)


def model_folder(item: Item) -> Path | None:
    """The latest model: that of the scene, or a snapshot during mapping."""
    scene = item.path / SCENE
    if (scene / "capture.json").is_file() and (scene / "sparse" / "0" / "images.bin").is_file():
        return scene / "sparse" / "0"
    folder = scene / "work" / SNAPSHOTS
    found = sorted(folder.iterdir(), reverse=True) if folder.is_dir() else []
    return next((path for path in found if (path / "points3D.bin").is_file()), None)


def model(item: Item) -> dict[str, Any]:
    """Cameras and sparse points for the page: up is +z, about the middle of the points and one unit wide."""
    with contextlib.suppress(Exception):  # a snapshot that is being written, or deleted, or a damaged one
        if (place := model_folder(item)) is not None:
            return {"version": place.name, **_model(place, (place / "points3D.bin").stat().st_mtime_ns)}
    return {"version": "", "cameras": [], "points": []}


@lru_cache(4)
def _model(place: Path, modified: int) -> dict[str, Any]:
    from ..readers.colmap import poses_of, read_model

    found = read_model(place)
    poses = poses_of(found)
    names = evenly(sorted(poses, key=natural), MAX_CAMERAS)
    stacked = np.stack([poses[name] for name in names])
    points = evenly([p for p in found.points3D.values() if p.track.length() > 2], MAX_POINTS)
    places = np.array([p.xyz for p in points]).reshape(-1, 3)
    colours = np.array([p.color for p in points], int).reshape(-1, 3)
    turn, middle, scale = framed(stacked, places)
    centres = (stacked[:, :, 3] - middle) @ turn.T / scale
    axes = np.einsum("ij,njk->nik", turn, stacked[:, :, :3])
    cameras = np.concatenate([centres, axes.transpose(0, 2, 1).reshape(-1, 9)], 1)
    places = (places - middle) @ turn.T / scale
    return {
        "names": names,
        "cameras": np.round(cameras, 4).tolist(),
        "points": np.concatenate([np.round(places, 4), colours], 1).tolist(),
    }


def framed(
    poses: Float[np.ndarray, "camera 3 4"], points: Float[np.ndarray, "point 3"]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"], float]:
    """Rotation of the pictures' mean up to +z; centre and half-size of the cameras and most points."""
    up = -poses[:, :, 1].mean(0)
    up /= np.linalg.norm(up) + 1e-9
    across = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    across /= np.linalg.norm(across)
    turn = np.stack([across, np.cross(up, across), up])
    most = np.quantile(points, [0.05, 0.95], axis=0) if len(points) else np.zeros((0, 3))
    corners = np.concatenate([poses[:, :, 3], most])
    middle = (corners.min(0) + corners.max(0)) / 2
    return turn, middle, float(np.linalg.norm(corners - middle, axis=1).max()) or 1.0


# Training


def training_progress(item: Item, job: Making) -> dict[str, Any]:
    """Step, share, PSNR, its curve and seconds left of a run."""
    from ..run import Run

    folder = run_folder(item, job.run)
    if not job.run or not (folder / "config.json").is_file():
        return {"stage": "Beginning", "share": 0.0}
    try:
        run = Run(folder)
        rows, budget = run.metrics(), Budget.from_json(run.settings.budget)
    except Exception as fault:  # a received run may hold anything
        return {"stage": sentence_of(folder, fault), "share": 0.0}
    if not rows:
        return {"stage": "Compiling kernels", "share": 0.0, "method": run.method_name}
    last = rows[-1]
    share = budget.progress(last["step"], last["seconds"])
    points = [(row["seconds"], row["psnr"]) for row in rows if "psnr" in row]
    means = [np.mean(part, axis=0) for part in np.array_split(points, min(len(points), CURVE_POINTS))] if points else []
    return {
        "stage": "Training",
        "share": share,
        "step": last["step"],
        "seconds": last["seconds"],
        "left": seconds_left(budget, last["step"], last["seconds"]),
        "psnr": last_psnr(rows),
        "gaussians": last["statistics"].get("gaussians"),
        "method": run.method_name,
        "curve": [[round(float(x), 3) for x in one] for one in means],
        "quality": budget.quality,
        "budget": str(budget),
    }


def seconds_left(budget: Budget, step: int, seconds: float) -> float | None:
    """Remaining seconds of training, by the mean time of a step so far."""
    if budget.steps is None:
        return max(budget.total - seconds, 0.0)
    return max(budget.total - step, 0) * seconds / step if step else None


def sentence_of(path: Path, fault: Exception) -> str:
    """A sentence for a fault in the files of an item or run."""
    if isinstance(fault, LumigraphError):
        return str(fault)
    return f"{path} has files that cannot be understood ({type(fault).__name__}); restore them from a copy"


def card_of_run(folder: Path) -> dict[str, Any]:
    """Method, PSNR, and previews of a run, for its card; empty for what cannot be read."""
    with contextlib.suppress(Exception):  # a received run may hold anything
        return _card(folder, newest(folder))
    return {"method": "", "psnr": None}


@lru_cache(512)
def _card(folder: Path, version: tuple[int, ...]) -> dict[str, Any]:
    from ..run import Run, is_block_run

    if is_block_run(folder):
        return {"method": "block-nerf", "psnr": None, "trained": True, "splats": False}
    run = Run(folder)
    held_out = (run.evaluation() or {}).get("psnr")
    return {
        "method": run.method_name,
        "psnr": held_out if held_out is not None else last_psnr(run.metrics()),
        "held_out": held_out is not None,
        "trained": run.has_state,
        "splats": run.has_state and gaussians_of(folder) is not None,
        "photographs": run.frame.image_count,
    }


def picture_of_run(folder: Path) -> Path | None:
    """The latest preview of a run."""
    found = sorted((folder / "previews").glob("*.png")) if (folder / "previews").is_dir() else []
    return found[-1] if found else None


def age(path: Path) -> float:
    """Seconds since a folder, or something just inside it, changed."""
    inner: list[Path] = []
    with contextlib.suppress(OSError):  # it is a file, or has gone
        inner = list(islice(path.iterdir(), MAX_ENTRIES))
    return max(0.0, time.time() - max(map(changed_at, [path, *inner])))
