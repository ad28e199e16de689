"""A skinned character of a glTF file, "character,file=PATH,clip=1", which plays an animation from time 0 to time 1."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ...errors import LumigraphError
from ...files.ranges import between
from ..characters import CharacterOptions, photographed
from ..skinned import SkinnedBody
from ..stage import SyntheticStage


@dataclass(frozen=True)
class Options(CharacterOptions):
    """Options of every character; file: of a skinned mesh, .glb; clip: number of its animation"""

    file: str = ""
    clip: Annotated[int, between(0, 10_000)] = 0


def stage(
    size: int = 200, views: int = 100, seed: int = 0, rig: int = 0, jitter_bones: int = 0, file: str = "", clip: int = 0
) -> SyntheticStage:
    """The character of a file. Raises LumigraphError without one."""
    if not file:
        raise LumigraphError("procedural:character needs a skinned mesh; name one, as in character,file=walker.glb")
    path = Path(file).expanduser()
    if not path.is_file():
        raise LumigraphError(f"{path} does not exist; name a skinned mesh that ends in .glb")
    return photographed(SkinnedBody(path, clip), size, views, seed, rig, jitter_bones)
