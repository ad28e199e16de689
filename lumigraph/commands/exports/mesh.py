"""`lumigraph export mesh`: a mesh of a trained scene, for modellers, printers and game engines."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from ...errors import LumigraphError
from ...files import claim
from ...files.ranges import Count, Pixels, Positive, Share, between
from ..common import Overwrite, needed, option, show
from ..controls import Set, open_method
from ..keeping import Keeping

FOR_PHONES = 100_000  # triangles that a phone shows with ease


@dataclass(frozen=True)
class ExportMesh:
    """Export a triangle mesh with vertex colours, in the frame of the photographs or upright.

    The ending chooses the format: .ply and .obj, in that frame; .glb, upright; .usdz, upright and for phones. Methods
    with density use marching cubes on it; others use fusion of rendered depth. Only the middle of a scene is meshed.
    Unseen surface is closed (objects) or left out (rooms and open scenes).
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file (.ply, .spz ...), or a composition (.json)."""
    output: Annotated[Positional[Path], needed("FILE")]
    """The new file."""
    extent: Annotated[
        Annotated[float, between(0.001, 1000)] | None, option("TIMES", "1 for objects, 1.5 for the rest")
    ] = None
    """Size of the meshed region, times the box of interest in `lumigraph info`; or give --box or --sphere."""
    cell_size: Annotated[Positive | None, option("LENGTH", "1/256 of the box")] = None
    """Side of the marching cubes, in units of the photographs' frame; smaller gives finer detail and more triangles."""
    way: Annotated[
        Literal["auto", "density", "depth"],
        arg(name="from", help_behavior_hint="(default: density where the method has one)"),
    ] = "auto"
    """Source of the surface: the density field, or rendered depth."""
    level: Annotated[Positive | None, option("DENSITY", "estimated at the rendered depth")] = None
    """Density of the surface, per unit of the scene's own frame; higher shrinks the mesh."""
    smooth: Annotated[int, between(0, 1000), option("N")] = 10
    """Rounds of smoothing; more round off detail, 0 is none."""
    faces: Annotated[
        Annotated[int, between(4, 1_000_000_000)] | None,
        option("N", f"all, for phones {FOR_PHONES:,}"),
    ] = None
    """Number of triangles after simplification; fewer make a smaller file."""
    keep: Annotated[Share, option("SHARE")] = 0.01
    """Smallest piece to keep, as a share of the largest one's area; larger removes more fragments."""
    unseen: Annotated[Literal["close", "cut"] | None, option("{close,cut}", "close objects, cut the rest")] = None
    """Unseen surface: close it for a watertight mesh, or cut it."""
    size: Annotated[Pixels, option("PIXELS")] = 400
    """Longer side of the pictures for colours and depth, at most that of the photographs; larger is finer, slower."""
    views: Annotated[Count, option("N")] = 64
    """Largest number of these pictures."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ...export.mesh import extract_mesh
        from ...export.mesh_file import ending, write_mesh

        for_phones = ending(self.output) == ".usdz"
        claim(self.output, "mesh", self.overwrite, [self.source])
        opened, method, cameras = open_method(self.source, self.device, self.settings)
        mesh = extract_mesh(
            self.part.without_floaters(method),
            opened.survey(cameras["train"]),
            extent=self.extent,
            crop=self.part.crop(opened.frame),
            cell=None if self.cell_size is None else self.cell_size / opened.frame.to_source.scale,
            level=self.level,
            way=self.way,
            smooth=self.smooth,
            faces=FOR_PHONES if self.faces is None and for_phones else self.faces,
            keep=self.keep,
            closed=None if self.unseen is None else self.unseen == "close",
            size=self.size,
            views=self.views,
        ).in_source(opened.frame)
        write_mesh(self.output, mesh, opened.frame.to_source.rotation[:, 2].numpy())
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        show(
            {
                "file": str(self.output),
                "triangles": f"{len(mesh.faces):,}, {len(mesh.vertices):,} vertices",
                "extent": " x ".join(f"{x:.4g}" for x in high - low) + " in the frame of the photographs",
                "size": f"{self.output.stat().st_size / 1e6:.1f} MB",
            }
        )
        return 0

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.extent is not None and self.part.crops:
            raise LumigraphError("--extent and a crop both say how much is meshed; give one of them")
