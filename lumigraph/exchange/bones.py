"""Skeletons as files: bones.json, lists of joint angles, and glTF animations.

    {
      "format": "lumigraph bones 1",
      "names": ["hips", "spine"], "parents": [-1, 0],
      "rest": {"positions": [[0, 0, 1], [0, 0, 1.2]], "rotations": [[1, 0, 0, 0], [1, 0, 0, 0]]},
      "times": [0.0],
      "poses": [{"positions": [[0, 0, 1], [0, 0, 1.2]], "rotations": [[1, 0, 0, 0], [1, 0, 0, 0]]}]
    }

It is in the frame and unit of the photographs' poses. positions: of the joints. rotations: from the axes of a joint to
the frame's, quaternions (w, x, y, z). A file of angles, {"format": ..., "angles": {"left elbow": [0, 45, 0]}}, turns
joints from the pose at rest, in degrees about their own x, then y, then z axis.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from .. import files
from ..datasets.skeleton import Skeleton, retargeted, turned_joints
from ..errors import LumigraphError
from ..files.ranges import Name, Point, typed
from ..files.reading import reads
from ..geometry import Similarity
from . import skinned_gltf

FORMAT = "lumigraph bones 1"
SUFFIXES = (".json", ".glb")  # of files with a pose, or poses over time


@dataclass(frozen=True)
class BonesRecord(Skeleton):
    """Contents of bones.json."""

    format: str = FORMAT


@dataclass(frozen=True)
class AnglesRecord:
    """A file of joint angles, degrees."""

    angles: dict[Name, Point]
    format: str = FORMAT


@reads()
def read_bones(path: Path) -> Skeleton:
    """Read the skeleton in a bones.json. Raises LumigraphError for an invalid file."""
    said = _said(path)
    if "rest" not in said:
        raise LumigraphError(f"{path} has a skeleton without its bind pose; add the pose of the body at rest as `rest`")
    found = typed(BonesRecord, said, path, closed=True)
    return Skeleton(found.names, found.parents, found.rest, found.times, found.poses)


def write_bones(path: Path, skeleton: Skeleton) -> None:
    """Write a bones.json."""
    files.write_json(path, {"format": FORMAT} | asdict(skeleton))


@reads()
def read_motion(path: Path, onto: Skeleton, to_scene: Similarity) -> Skeleton:
    """Read poses for the bones of a skeleton: from a bones.json, joint angles, or a glTF file's first animation.

    to_scene: from the frame of the photographs' poses. Raises LumigraphError for an invalid file.
    """
    if not path.is_file():
        raise LumigraphError(f"{path} does not exist; name a file of poses that ends in {' or '.join(SUFFIXES)}")
    if path.suffix.lower() == ".glb":
        return retargeted(skinned_gltf.read_character(path).clip(0), onto, path)
    said = _said(path)
    if "angles" in said:
        return turned_joints(onto, typed(AnglesRecord, said, path, closed=True).angles, path)
    return retargeted(read_bones(path).transformed(to_scene), onto, path)


def _said(path: Path) -> dict:
    said = files.read_json(path)
    if not isinstance(said, dict) or said.get("format") != FORMAT:
        raise LumigraphError(f"{path} does not say {FORMAT!r}, as files of bones do; add that, or name another file")
    return said
