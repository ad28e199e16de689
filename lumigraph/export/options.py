"""Options of exports: dataclasses that the functions take and the commands derive from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import arg

from ..files.options import option
from ..files.ranges import Count, Pixels, Positive, Share, between

FOR_PHONES = 100_000  # triangles that a phone shows with ease
TEXTURED_FACES = 50_000  # triangles whose texture holds the finer detail


@dataclass(frozen=True)
class MeshOptions:
    """Options of a mesh, lengths in the unit of exports."""

