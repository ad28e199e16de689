"""Durations of captures and trainings: estimates for the page, corrected by what earlier ones took on this machine."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..budget import BY_PHOTOGRAPH, BY_RAY, QUALITIES, Efforts
from ..errors import LumigraphError
from ..files import read_json, write_json
from ..system.cache import cache_folder
from .pictures import is_film, photographs_of
from .projects import SCENE, Item

FILE = "pace.json"  # in the user's cache folder
KEPT = 0.5  # share of the former mean in a new one
FILM_FRAMES = 60  # that a capture takes of a film, about
PER_PHOTOGRAPH = 2.0  # seconds of a capture; 0.7 to 4.7 on two cores, by the details that are found
RAYS_PER_STEP = 4096
PIXELS = 500_000  # of a photograph that a training reads
# Efforts, and seconds of a step on two cores, of the methods that the page offers.
STEPS: dict[str, tuple[Efforts, float]] = {
    "gaussian-splatting": (BY_PHOTOGRAPH, 0.12),
    "planar-splatting": (BY_PHOTOGRAPH, 0.2),
    "instant-ngp": (BY_RAY, 0.05),
    "nerf-w": (BY_RAY, 0.4),
}


@dataclass(frozen=True)
class Pace:
    """Contents of pace.json: seconds of a photograph in captures, and of a step by method."""

    photograph: float = PER_PHOTOGRAPH
    step: dict[str, float] = field(default_factory=dict)


def known() -> Pace:
    try:
        return read_json(cache_folder() / FILE, Pace)
    except LumigraphError:  # there is none yet, or it was damaged
        return Pace()


def note_capture(item: Item, seconds: float) -> None:
    """Keep the pace of a capture that ran from its beginning."""
    before = known()
    keep(Pace(mixed(before.photograph, seconds / max(1, given(item))), before.step))


def note_training(run: Path) -> None:
    """Keep the pace of a training."""
    from ..run.records import read_rows

    rows = read_rows(run / "metrics.jsonl")
    if rows and rows[-1]["step"] > 0:
        from ..run import Run

        name, before, last = Run(run).method_name, known(), rows[-1]
        mean = mixed(before.step.get(name, last["seconds"] / last["step"]), last["seconds"] / last["step"])
        keep(Pace(before.photograph, before.step | {name: mean}))


def mixed(before: float, now: float) -> float:
    return KEPT * before + (1 - KEPT) * now


def keep(pace: Pace) -> None:
    try:
        write_json(cache_folder() / FILE, {"photograph": pace.photograph, "step": pace.step}, ours=True)
    except (OSError, LumigraphError):  # a home that cannot be written to
        pass


def given(item: Item) -> int:
    """Number of photographs of a capture; of a film, about."""
    return sum(FILM_FRAMES if is_film(path) else 1 for path in photographs_of(item).values())


def estimates(item: Item) -> dict[str, Any]:
    """Seconds by method and quality, of the cameras and of the training together."""
    from ..sfm.photos import is_bare

    count, now, found = given(item), known(), {}
    placed = (item.path / SCENE / "transforms.json").is_file() or not is_bare(item.photographs)
    for name, (efforts, seconds) in STEPS.items():
        passes = count if efforts is BY_PHOTOGRAPH else count * PIXELS / RAYS_PER_STEP
        each, cameras = now.step.get(name, seconds), 0.0 if placed else now.photograph * count
        found[name] = {quality: round(cameras + each * efforts[quality].steps(passes)) for quality in QUALITIES}
    return found
