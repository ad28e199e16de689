"""Tracks of captures of any reader: tracks.json has boxes of moving rigid objects.

It is in the frame and unit of the photographs' poses, with times in the unit of their times.

    {
      "format": "lumigraph tracks 1",
      "tracks": [
        {"name": "car 1", "category": "car", "size": [4.2, 1.8, 1.5],
         "times": [0.0, 0.1], "positions": [[3, 1, 0.75], [3.6, 1, 0.75]], "rotations": [[1, 0, 0, 0], [1, 0, 0, 0]]}
      ]
    }

size: of the box along its own axes, x forward, y to the left, z up. positions: of its centre. rotations: from the box's
axes to the frame's, quaternions (w, x, y, z). Between two times a pose is interpolated; before the first and after
the last the object is absent. A single time is constant.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from .. import files
from ..camera import Camera
from ..datasets.tracks import BoxTrack, check_names
from ..errors import LumigraphError
from ..files.ranges import typed
from ..files.reading import reads
from ..geometry import Similarity
from .capture import Capture

TRACKS_FILE = "tracks.json"
FORMAT = "lumigraph tracks 1"


@dataclass(frozen=True)
class TracksRecord:
    """Contents of tracks.json."""

    tracks: tuple[BoxTrack, ...]
    format: str = FORMAT


@reads()
def read_tracks(path: Path) -> tuple[BoxTrack, ...]:
    """Read the tracks in a file. Raises LumigraphError for an invalid file or track."""
    said = files.read_json(path)
    if not isinstance(said, dict) or said.get("format") != FORMAT:
        raise LumigraphError(f"{path} does not say {FORMAT!r}, as files of tracks do; add that, or rename the file")
    tracks = typed(TracksRecord, said, path, closed=True).tracks
    for number, track in enumerate(tracks):
        try:
            track.check()
        except LumigraphError as fault:
            raise LumigraphError(f"{path}: tracks[{number}]: {fault}") from fault
    check_names(tracks, path)
    return tracks


def write_tracks(path: Path, tracks: tuple[BoxTrack, ...]) -> None:
    """Write a file of tracks."""
    files.write_json(path, {"format": FORMAT, "tracks": [asdict(track) for track in tracks]})


def with_tracks(capture: Capture, folder: Path) -> Capture:
    """The capture with the tracks of its folder's tracks.json. Raises LumigraphError for an invalid file."""
    path = folder / TRACKS_FILE
    return replace(capture, tracks=read_tracks(path)) if path.is_file() else capture


def seen_tracks(capture: Capture, to_scene: Similarity, cameras: Camera) -> tuple[tuple[BoxTrack, ...], list[str]]:
    """Tracks in the scene's frame that are visible in some training photograph, and a sentence about the others.

    cameras: of the training photographs. Raises LumigraphError for tracks with times and photographs without
    """
    tracks = tuple(track.transformed(to_scene) for track in capture.tracks)
    moving = next((track.name for track in tracks if len(track.times) > 1), None)
    if moving is not None and cameras.time is None:
        raise LumigraphError(
            f"{capture.source}: track {moving} has moments, and the photographs have none; give each its time"
        )
    kept = tuple(track for track in tracks if any(shows(cameras[i], track) for i in range(len(cameras))))
    lost = [track.name for track in tracks if track not in kept]
    if not lost:
        return kept, []
    names = ", ".join(lost[:8]) + (f" and {len(lost) - 8} more" if len(lost) > 8 else "")
    verb = "is" if len(lost) == 1 else "are"
    return kept, [
        f"{capture.source}: the box of {names} {verb} outside all photographs to learn from, so it is left out; "
        "correct its poses and times"
    ]


def shows(camera: Camera, track: BoxTrack) -> bool:
    """True if a point of a track's box projects into a camera's picture at its time: corners, centres."""
    pose = track.pose(None if camera.time is None else float(camera.time[0]))
    if pose is None:
        return False
    grid = torch.cartesian_prod(*(torch.tensor([-0.5, 0.0, 0.5], dtype=torch.float64) * side for side in track.size))
    points = grid @ pose[:, :3].T + pose[:, 3]
    pixels, visible = camera.project(points.float())
    inside = visible & (pixels >= 0).all(-1) & (pixels <= camera.size[0]).all(-1)
    return bool(inside.any())
