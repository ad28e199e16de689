"""Tracks: boxes of moving rigid objects, with their poses over time; edits of them, and the nodes of a scene graph.

A box has axes of its own, x forward, y to the left and z up, and its origin in its centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from ..errors import LumigraphError
from ..files.ranges import Coordinate, Name, Point, Row, between
from ..geometry import Similarity, to_matrix, to_quaternion

Side = Annotated[float, between(1e-9, 1e9)]  # of a box, units of the frame
MAX_TIME_ERROR = 1e-5  # of a moment, relative to its size: single precision


@dataclass(frozen=True)
class BoxTrack:
    """One object and its box over time.

    name, category: of the object
    size:           of its box along x, y and z
    times:          of its poses, in order, with interpolation between them; the object is absent before the first and
                    after the last. A single pose is constant
    positions:      of the box's centre
    rotations:      from the box's axes to those of the frame, quaternions (w, x, y, z)
    """

    name: Name
    category: Name
    size: tuple[Side, Side, Side]
    times: tuple[Coordinate, ...]
    positions: tuple[Point, ...]
    rotations: tuple[Row, ...]

    def check(self) -> None:
        """Raise LumigraphError for lists of different length, times out of order, and zero quaternions."""
        counts = len(self.times), len(self.positions), len(self.rotations)
        if not counts[0] or len(set(counts)) > 1:
            raise LumigraphError(
                f"Track {self.name} has {counts[0]} times, {counts[1]} positions and {counts[2]} rotations; give as "
                "many of each, and one at least"
            )
        if ":" in self.name:
            raise LumigraphError(f"Track {self.name} has a colon in its name, which is between two names; rename it")
        for a, b in zip(self.times, self.times[1:], strict=False):
            if a >= b:
                raise LumigraphError(
                    f"Track {self.name} ends before it begins: its times go from {a:g} to {b:g}; sort them"
                )
        if not all(any(rotation) for rotation in self.rotations):
            raise LumigraphError(f"Track {self.name} has a rotation of four zeros; give a quaternion (w, x, y, z)")

    def transformed(self, frame: Similarity) -> BoxTrack:
        """The same track in another frame."""
        length, width, height = (frame.scale * side for side in self.size)
        positions = frame.points(torch.tensor(self.positions, dtype=torch.float64))
        turned = frame.rotation @ to_matrix(torch.tensor(self.rotations, dtype=torch.float64))
        return replace(
            self,
            size=(length, width, height),
            positions=tuple(map(tuple, positions.tolist())),
            rotations=tuple(map(tuple, to_quaternion(turned).tolist())),
        )

    def pose(self, time: float | None) -> Float[Tensor, "3 4"] | None:
        """Rotation and position at a time, in double precision; None where the object is absent."""
        times = torch.tensor(self.times, dtype=torch.float64)
        if len(times) == 1 or time is None:
            lower = upper = 0
            share = 0.0
        else:
            slack = MAX_TIME_ERROR * max(1.0, abs(time))
            if not self.times[0] - slack <= time <= self.times[-1] + slack:
                return None
            upper = min(max(int(torch.searchsorted(times, time, right=True)), 1), len(times) - 1)
            lower = upper - 1
            share = min(max((time - self.times[lower]) / (self.times[upper] - self.times[lower]), 0.0), 1.0)
        first, last = (torch.tensor(self.positions[i], dtype=torch.float64) for i in (lower, upper))
        position = torch.lerp(first, last, share)
        a, b = (torch.nn.functional.normalize(torch.tensor(self.rotations[i]).double(), dim=0) for i in (lower, upper))
        return torch.cat([to_matrix(torch.lerp(a, b if a @ b >= 0 else -b, share)[None])[0], position[:, None]], 1)


@dataclass(frozen=True)
class TrackEdit:
    """A change of one object of a scene graph.

    node:   name of the object, or a new one to add an object
    like:   the object whose appearance and size it takes; None for its own. Its lower side stays
    remove: whether to hide it
    shift:  added to its positions, in units and axes of the frame
    turn:   degrees about its box's upright axis, counterclockwise from above
    track:  its new poses; None for its own, and for a new object those of `like`
    """

    node: Name
    like: Name | None = None
    remove: bool = False
    shift: Point = (0.0, 0.0, 0.0)
    turn: Annotated[float, between(-1e6, 1e6)] = 0.0
    track: BoxTrack | None = None

    def transformed(self, frame: Similarity) -> TrackEdit:
        """The same edit in another frame."""
        shift = frame.matrix[:3, :3] @ torch.tensor(self.shift, dtype=torch.float64)
        track = None if self.track is None else self.track.transformed(frame)
        return replace(self, shift=tuple(shift.tolist()), track=track)


@dataclass(frozen=True)
class TrackEdits:
    """Edits of a scene graph, evidence for its method. They apply to the trained scene, in order."""

    edits: tuple[TrackEdit, ...]

    def transformed(self, frame: Similarity) -> TrackEdits:
        """The same edits in another frame."""
        return TrackEdits(tuple(edit.transformed(frame) for edit in self.edits))


@dataclass(frozen=True)
class GraphNode:
    """An object of an edited scene graph.

    like:  name of the track whose appearance it has
    track: its box over time
    own:   name of the track whose learnt corrections apply to it; "" for none
    """

    name: str
    like: str
    track: BoxTrack
    own: str


def nodes_of(tracks: Sequence[BoxTrack], edits: TrackEdits = TrackEdits(())) -> tuple[GraphNode, ...]:
    """Objects of a scene graph after edits. Raises LumigraphError for an edit of a missing object."""
    known = {track.name: track for track in tracks}
    nodes = {name: GraphNode(name, name, track, name) for name, track in known.items()}
    for edit in edits.edits:
        if edit.remove:
            if nodes.pop(edit.node, None) is None:
                raise LumigraphError(unknown(edit.node, known))
            continue
        like = edit.like or edit.node
        if edit.node not in nodes and like not in known:
            raise LumigraphError(unknown(like, known))
        if edit.like is not None and edit.like not in known:
            raise LumigraphError(unknown(edit.like, known))
        base = nodes.get(edit.node) or nodes.get(like) or GraphNode(like, like, known[like], like)
        looks = edit.like or base.like
        if known[looks].category != known[base.like].category:
            raise LumigraphError(
                f"{edit.node} is a {known[base.like].category} and {looks} a {known[looks].category}; "
                "swap things of one category"
            )
        track = base.track if edit.track is None else edit.track
        moved = resized(turned(track, edit.turn, edit.shift), known[looks].size)
        nodes[edit.node] = GraphNode(edit.node, looks, moved, base.own if edit.track is None else "")
    return tuple(nodes.values())


def unknown(name: str, known: dict[str, BoxTrack]) -> str:
    """Sentence about an unknown track name."""
    return f"the scene graph has no {name!r}; there are {', '.join(known) or 'none'}"


def turned(track: BoxTrack, degrees: float, shift: Point = (0.0, 0.0, 0.0)) -> BoxTrack:
    """The track with its box rotated about its upright axis and then shifted, at every time."""
    half = 0.5 * math.radians(degrees)
    turn = to_matrix(torch.tensor([[math.cos(half), 0.0, 0.0, math.sin(half)]], dtype=torch.float64))
    rotations = to_matrix(torch.tensor(track.rotations, dtype=torch.float64)) @ turn
    positions = torch.tensor(track.positions, dtype=torch.float64) + torch.tensor(shift, dtype=torch.float64)
    return replace(
        track,
        positions=tuple(map(tuple, positions.tolist())),
        rotations=tuple(map(tuple, to_quaternion(rotations).tolist())) if degrees else track.rotations,
    )


def resized(track: BoxTrack, size: tuple[float, float, float]) -> BoxTrack:
    """The track with a box of another size, whose lower side stays where it was."""
    if size == track.size:
        return track
    up = to_matrix(torch.tensor(track.rotations, dtype=torch.float64))[:, :, 2]
    positions = torch.tensor(track.positions, dtype=torch.float64) + 0.5 * (size[2] - track.size[2]) * up
    return replace(track, size=size, positions=tuple(map(tuple, positions.tolist())))


def check_names(tracks: Sequence[BoxTrack], where: Path | str) -> None:
    """Raise LumigraphError where two tracks have one name."""
    names = [track.name for track in tracks]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise LumigraphError(f"{where} has two tracks that are called {twice}; rename one")
