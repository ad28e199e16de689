"""Renderings of a run beside the photographs of the same views, which `lumigraph eval` makes."""

from functools import lru_cache
from pathlib import Path
from typing import Any

from .pictures import version_of
from .projects import newest

COMPARE = "compare"  # kind of the job
VIEWS = 12  # at most
SPLITS = "test", "train"  # held-out photographs first


def eval_options(run: Path) -> dict[str, Any]:
    """Options of `lumigraph eval`: held-out photographs, or training photographs of a run without any."""
    from ..run import Run

    split = next((name for name in SPLITS if Run(run).settings.splits.get(name)), "train")
    return {"split": split, "views": VIEWS, "save_images": True, "overwrite": True}


def comparison(run: Path) -> dict[str, Any] | None:
    """Views with a rendering: name, PSNR, whether held out. stale: whether the run has been trained further since"""
    return _comparison(run, newest(run)) if run.is_dir() else None


@lru_cache(512)
def _comparison(folder: Path, version: tuple[int, ...]) -> dict[str, Any] | None:
    from ..evaluation.run import stem
    from ..run import Run
    from ..run.records import read_evaluation

    for split in SPLITS:
        place = folder / f"{stem(split)}.json"
        if not place.is_file():
            continue
        result = read_evaluation(place)
        views = [
            {"name": one["name"], "psnr": one["psnr"], "held_out": split == "test", "version": version_of(picture)}
            for one in result.get("views", [])
            if (picture := place_of(folder, one["name"])).is_file()
        ]
        if views:
            return {"views": views, "stale": result["steps"] != Run(folder).state.step}
    return None


def place_of(folder: Path, name: str) -> Path:
    """Path of the rendering of a view."""
    from ..evaluation.views import file_name

    return folder / "eval" / f"{file_name(name)}.png"


def rendering(folder: Path, name: str) -> Path | None:
    """Rendering of a view by its name; None for any other name."""
    views = (comparison(folder) or {"views": []})["views"]
    return next((place_of(folder, name) for one in views if one["name"] == name), None)
