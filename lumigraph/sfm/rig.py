"""Rigs: a folder of synchronised videos of static cameras becomes a scene with times."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import LumigraphError
from ..files import claim_folder, is_file, read_json, replacing_folder, write_json
from ..geometry import evenly
from ..readers import phones
from ..readers.rig import calibration, cameras_of
from .folder import POINTS_FILE
from .options import MotionOptions
from .photos.copies import save
from .photos.film import Tags, is_video, opened, tags_of
from .photos.photo import Track, untracked
from .photos.video import picked
from .reconstruction import MIN_VIEWS, reconstruct

CLOCKS_FILE = "clocks.json"  # seconds after the first camera at which each video begins, by its name
RECORDED_FILM, MAX_RECORDED = "rgb.mp4", 400  # of Stray Scanner; frames taken by default
MAX_MOMENTS = 120  # taken by default
SAME_RATE, SAME_LENGTH = 0.01, 0.05  # relative, and seconds: differences that are not worth a sentence


@dataclass(frozen=True)
class RigVideo:
    """A video of a rig. begin: its start in seconds, on the common clock;  rate: frames per second"""

    path: Path
    begin: float
    seconds: float
    rate: float

    @property
    def end(self) -> float:
        return self.begin + self.seconds

    def numbers(self, moments: Sequence[float]) -> list[int]:
        """Number of the nearest frame at each time."""
        last = max(round(self.seconds * self.rate) - 1, 0)
        return [min(max(round((moment - self.begin) * self.rate), 0), last) for moment in moments]


def is_rig(path: Path) -> bool:
    """True for a folder with several videos."""
    return path.is_dir() and len(list_videos(path)) > 1


def list_videos(folder: Path) -> list[Path]:
    """Videos in a folder, or in its `videos`."""
    found = sorted(path for path in folder.iterdir() if is_video(path))
    return found if found or not (folder / "videos").is_dir() else list_videos(folder / "videos")


def films_of(folder: Path) -> list[RigVideo]:
    """The videos of a folder, with their clocks. Raises LumigraphError for clocks without matching names."""
    clocks: dict[str, float] = {}
    if is_file(folder / CLOCKS_FILE):
        clocks = read_json(folder / CLOCKS_FILE, dict[str, float])
    videos = list_videos(folder)
    if strange := set(clocks) - {path.name for path in videos}:
        raise LumigraphError(f"{folder / CLOCKS_FILE} names {min(strange)}, which is no video there; correct its name")
    found = []
    for path in videos:
        with opened(path) as film:
            found.append(RigVideo(path, clocks.get(path.name, 0.0), film.seconds, film.rate))
    return found


def common_moments(films: Sequence[RigVideo], count: int | None) -> tuple[list[float], list[str]]:
    """Times common to all videos, evenly spaced, and remarks on lengths and rates that differ.

    Raises LumigraphError if there are none.
    """
    begin, end = max(film.begin for film in films), min(film.end for film in films)
    if end <= begin:
        early, late = min(films, key=lambda film: film.end), max(films, key=lambda film: film.begin)
        raise LumigraphError(
            f"{early.path} ends at {early.end:.2f} s and {late.path} begins at {late.begin:.2f} s, so no moment is in "
            f"both; correct {CLOCKS_FILE}, or take the video that does not belong out of the folder"
        )
    rates = [film.rate for film in films]
    step = 1 / min(rates)
    possible = max(int((end - begin) / step + 1e-6), 1)
    moments = np.linspace(begin, begin + (possible - 1) * step, min(count or MAX_MOMENTS, possible)).tolist()
    said = []
    if max(film.end for film in films) - end > SAME_LENGTH or begin - min(film.begin for film in films) > SAME_LENGTH:
        said.append(
            f"the videos are of different lengths or begin at different times; the {end - begin:.2f} s are taken that "
            f"all {len(films)} show"
        )
    if max(rates) > (1 + SAME_RATE) * min(rates):
        off = max(
            abs(n / f.rate + f.begin - t) for f in films for n, t in zip(f.numbers(moments), moments, strict=True)
        )
        said.append(
            f"the videos have {min(rates):g} to {max(rates):g} frames per second; each moment has the nearest frame of "
            f"each, at most {1000 * off:.0f} ms away"
        )
    return moments, said


def capture_rig(
    source: Path, folder: Path, options: MotionOptions, track: Track = untracked
) -> tuple[dict[str, Any], list[str]]:
    """Write a scene of a rig's videos: images/CAMERA/0000.jpg and transforms.json with times. Returns numbers of
    cameras and times, and remarks.

    Poses are those of a transforms.json beside the videos, whose frames name them, or reconstructed at the first time.
    """
    films = films_of(source)
    moments, said = common_moments(films, options.frames)
    claim_folder(folder, "capture")
    folder.mkdir(parents=True, exist_ok=True)
    with replacing_folder(folder / "images", "capture") as partial:
        tags = [tags_of(film.path) for film in films]
        said += [f"{film.path.name}: {own.fault}" for film, own in zip(films, tags, strict=True) if own.fault]
        brightest = max(one.peak for one in tags)  # one tone curve for all cameras
        for film, own in track(list(zip(films, tags, strict=True)), "Taking frames", len(films)):
            take(film, moments, partial / film.path.stem, replace(own, peak=brightest))
    lens: dict[str, Any] = {}
    poses, found = given_poses(source, films), ""
    if poses is None:
        poses, lens = found_poses(films, folder, options, track)
        found = " found"
    frames = []
    for film in films:
        if film.path.stem not in poses:
            said.append(f"{film.path.name} found no place beside the others, and is left out")
            continue
        for i, moment in enumerate(moments):
            name = f"images/{film.path.stem}/{i:04}.jpg"
            frames.append(poses[film.path.stem] | {"file_path": name, "time": moment - moments[0]})
    write_json(folder / "transforms.json", lens | {"frames": frames}, "capture")
    count = len(frames) // len(moments)
    return {"cameras": f"{count} of {len(films)}{found}", "moments": f"{len(moments)}, {step_of(moments)}"}, said


def is_recorded(path: Path) -> bool:
    """True for a recording with poses whose pictures are a film: Stray Scanner's."""
    return phones.is_stray(path) and is_video(path / RECORDED_FILM) and not (path / "rgb").is_dir()


def capture_recorded(
    source: Path, folder: Path, count: int | None = None, track: Track = untracked
) -> tuple[dict[str, Any], list[str]]:
    """Write frames of a recording's film beside its poses and depth, as pictures of the same layout. count: of frames,
    MAX_RECORDED at most by default. Returns rows to print, and remarks."""
    claim_folder(folder, "capture")
    numbers, tags = sorted(phones.stray_path(source)), tags_of(source / RECORDED_FILM)
    chosen = evenly(numbers, count or MAX_RECORDED)
    with replacing_folder(folder, "capture") as partial:
        (partial / "rgb").mkdir(parents=True)
        written = []
        for number, picture, _ in track(picked(source / RECORDED_FILM, chosen, tags), "Taking frames", len(chosen)):
            save(picture, partial / "rgb" / f"{number:06}.jpg", ".jpg")
            written.append(number)
        for kind in ("depth", "confidence"):
            for file in (found for number in written if (found := phones.find_measured(source / kind, number))):
                (partial / kind).mkdir(exist_ok=True)
                shutil.copyfile(file, partial / kind / file.name)
        for name in phones.STRAY_FILES:
            shutil.copyfile(source / name, partial / name)
    rows = {"photographs": f"{len(written)} of {len(numbers)} frames, with the recorded poses"}
    return rows, [f"{source / RECORDED_FILM}: {tags.fault}"] if tags.fault else []


def step_of(moments: Sequence[float]) -> str:
    return f"{1000 * (moments[1] - moments[0]):.0f} ms apart" if len(moments) > 1 else "of one frame"


def take(film: RigVideo, moments: Sequence[float], folder: Path, tags: Tags) -> None:
    """Write the frame of each moment. tags: as in `opened`. Raises LumigraphError where the video ends before its last
    one."""
    folder.mkdir(parents=True)
    numbers = film.numbers(moments)
    pictures = {number: picture for number, picture, _ in picked(film.path, sorted(set(numbers)), tags)}
    if missing := [number for number in numbers if number not in pictures]:
        raise LumigraphError(f"{film.path} has no frame {missing[0]}, which its length promises; record it again")
    for i, number in enumerate(numbers):
        save(pictures[number], folder / f"{i:04}.jpg", ".jpg")


def given_poses(source: Path, films: Sequence[RigVideo]) -> dict[str, dict[str, Any]] | None:
    """Frames of the transforms.json beside videos, by the videos' names without suffixes, each with the file's common
    lens, or those of a published rig; None without either. Raises LumigraphError for a video without a pose."""
    path = source / "transforms.json"
    if not is_file(path):
        if (name := calibration(source)) is None:
            return None
        path, frames = source / name, cameras_of(source, [film.path.stem for film in films])
    else:
        made = read_json(path)
        common = {name: value for name, value in made.items() if name != "frames"}
        said = [frame for frame in made.get("frames", []) if "file_path" in frame]
        frames = {Path(frame["file_path"]).stem: common | frame for frame in said}
    if missing := [film.path.name for film in films if film.path.stem not in frames]:
        raise LumigraphError(f"{path} has no pose of {missing[0]}; add a frame with that file_path")
    return frames


def found_poses(
    films: Sequence[RigVideo], folder: Path, options: MotionOptions, track: Track
) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Poses reconstructed from the pictures at the first time, and the common lens."""
    if len(films) < MIN_VIEWS:
        raise LumigraphError(
            f"{films[0].path.parent} has {len(films)} videos, and poses of fewer than {MIN_VIEWS} cameras cannot be "
            "found; add a transforms.json with their poses"
        )
    first = folder / "work" / "first"
    first.mkdir(parents=True)
    for film in films:
        shutil.copyfile(folder / "images" / film.path.stem / "0000.jpg", first / f"{film.path.stem}.jpg")
    reconstruct([first], folder / "work" / "rig", replace(options, moving=False, frames=None), track)
    made = read_json(folder / "work" / "rig" / "transforms.json")
    shutil.copyfile(folder / "work" / "rig" / POINTS_FILE, folder / POINTS_FILE)
    common = {name: value for name, value in made.items() if name != "frames"}
    return {Path(frame["file_path"]).stem: frame for frame in made["frames"]}, common
