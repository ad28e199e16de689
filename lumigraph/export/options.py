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

    extent: Annotated[
        Annotated[float, between(0.001, 1000)] | None, option("TIMES", "1 for objects, 1.5 for the rest")
    ] = None
    """Size of the meshed region, times the box of interest in `lumigraph info`; or give --box or --sphere."""
    cell_size: Annotated[Positive | None, option("LENGTH", "1/256 of the box")] = None
    """Side of the marching cubes, in units of the photographs' frame; smaller gives finer detail and more triangles."""
    way: Annotated[
        Literal["auto", "distance", "density", "own", "depth"],
        arg(name="from", help_behavior_hint="(default: the first of these that the method has)"),
    ] = "auto"
    """Source of the surface: the signed distance, the density field, the method's own mesh, or rendered depth."""
    level: Annotated[Positive | None, option("DENSITY", "estimated at the rendered depth")] = None
    """Density of the surface, per unit of the scene's own frame; higher shrinks the mesh."""
    smooth: Annotated[int, between(0, 1000), option("N")] = 10
    """Rounds of smoothing; more round off detail, 0 is none."""
    faces: Annotated[
        Annotated[int, between(4, 1_000_000_000)] | None,
        option("N", f"all, for phones {FOR_PHONES:,}, with --texture {TEXTURED_FACES:,}"),
    ] = None
    """Number of triangles after simplification; fewer make a smaller file."""
    texture: bool = False
    """Give the mesh a texture and a normal map (.glb, .obj, .usdz), from the photographs where they are at hand."""
    texture_size: Annotated[int, between(64, 32_768), option("TEXELS")] = 2048
    """Width and height of the texture; larger shows finer print, and takes more memory and a larger file."""
    lit: bool = False
    """Let lights of a viewer act on a textured mesh; otherwise it shines in the photographs' own light."""
    keep: Annotated[Share, option("SHARE")] = 0.01
    """Smallest piece to keep, as a share of the largest one's area; larger removes more fragments."""
    unseen: Annotated[Literal["close", "cut"] | None, option("{close,cut}", "close objects, cut the rest")] = None
    """Unseen surface: close it for a watertight mesh, or cut it."""
    size: Annotated[Pixels, option("PIXELS")] = 400
    """Longer side of the pictures for colours and depth, at most that of the photographs; larger is finer, slower."""
    views: Annotated[Count, option("N")] = 64
    """Largest number of these pictures, and of photographs for a texture."""
