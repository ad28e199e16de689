"""`lumigraph export web`: a trained scene as one HTML page."""

from __future__ import annotations

import re
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from ..errors import LumigraphError
from ..export.options import MeshOptions
from ..files import claim
from ..files.ranges import Seconds, between
from .common import choose_device, show
from .options import (
    DeviceOption,
    Keeping,
    Overwrite,
    Set,
    SourceOption,
    at_one_moment,
    needed,
    open_method,
    option,
    photographers,
)
from .results import Exported, Reports

FACES = 300_000  # of a mesh in a page, at most: about 4 MB
Kind = Literal["auto", "splats", "volume", "mesh", "views"]


@dataclass(frozen=True)
class ExportWeb(Reports):
    """Export one HTML file that opens from disk, in any browser, without a server or a network.

    Gaussians are drawn as splats, with a slider of the moment where they move; octrees and atlases by ray marching.
    Other fields of objects are converted to an octree first; `lumigraph convert` keeps one. --as views and --as mesh
    need no conversion: pictures rendered from all around, or a coloured mesh.
    """

    source: SourceOption
    output: Annotated[Positional[Path], needed("FILE.html")]
    """The page."""
    kind: Annotated[
        Kind,
        arg(
            name="as",
            help_behavior_hint="(default: splats for Gaussians, volume for fields of objects, views for the rest)",
        ),
    ] = "auto"
    """Representation in the page: splats and volume render the scene itself, mesh is coarser, views are pictures."""
    title: Annotated[str | None, option("TEXT", "the run's name")] = None
    """Title of the page."""
    background: Annotated[
        str | None, option("#RRGGBB", "the training background; for open scenes the colours of sky and ground")
    ] = None
    """Colour behind splats, a volume or the mesh."""
    views: Annotated[int, between(2, 1000), option("N")] = 72
    """Number of pictures in a page of views; more turn more smoothly and take more bytes."""
    size: Annotated[int, between(16, 4096), option("PIXELS")] = 640
    """Longer side of these pictures in pixels."""
    degree: Annotated[int, between(0, 3), option("N")] = 3
    """Highest degree of an octree's harmonics; a lower one makes a smaller page, with weaker reflections."""
    seconds: Annotated[Seconds, option("S")] = 30.0
    """Training time of the octree that a field is converted to, in seconds."""
    duration: Annotated[Seconds, option("SECONDS")] = 3.0
    """Time that a capture of moving splats takes when it is played; longer is slower."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"

    def made(self) -> Exported:
        from ..export.page import backdrop
        from ..paths.opening import opening_of_scene

        if self.output.suffix.lower() not in (".html", ".htm"):
            raise LumigraphError(f"{self.output} should end in .html, as pages do; rename it")
        background = self._background()
        claim(self.output, "page", self.overwrite, [self.source])
        opened, method, cameras = open_method(self.source, self.device, self.settings)
        kind = self._kind(opened, method)
        rows: dict[str, str] = {}
        if kind == "volume":
            method, rows = self._baked(opened, method)
        still = at_one_moment(method)
        behind = backdrop(still, cameras["train"]) if kind != "views" and not self.part.crops else None
        title = self.title or opened.title
        opening = opening_of_scene(title, cameras["train"], opened.frame, background, behind)
        held, counts = self._write(kind, method if kind == "splats" else still, opened, cameras["train"], opening)
        size = f"{self.output.stat().st_size / 1e6:.1f} MB"
        return Exported(self.output, counts, rows=rows | {"page": str(self.output), "holds": held, "size": size})

    def _write(self, kind: str, method: Any, opened: Any, cameras: Any, opening: Any) -> tuple[str, dict[str, int]]:
        """Write the page. Returns its contents in words, and in numbers."""
        from ..export.mesh import extract_mesh
        from ..export.page import mesh_page, moving_page, splats_page, views_page, volume_page
        from ..method.capabilities import HasGaussians, HasMovingGaussians, can, needs

        if kind == "splats":
            seers, crop = photographers(opened, method), self.part.crop(method.frame)
            if can(method, HasMovingGaussians) and "time" not in method.settings and method.frame.times:
                moving = method.moving(self.duration)
                moving = moving[self.part.kept(moving.cloud, crop, method.frame, seers)]
                moving_page(self.output, moving, opening)
                still = len(moving) - moving.moving
                held = f"{still:,} Gaussians that stand still, {moving.moving:,} spans of those that move"
                return held, {"still": still, "moving": moving.moving}
            gaussians = needs(method, HasGaussians).gaussians()
            gaussians = self.part.of_gaussians(gaussians, crop, method.frame, seers)
            splats_page(self.output, gaussians, opening)
            held = f"{len(gaussians):,} Gaussians, harmonics of degree {gaussians.degree}"
            return held, {"gaussians": len(gaussians)}
        if kind == "volume":
            volume, held = browsable(method, self.degree)
            volume_page(self.output, volume, opening)
            return held, {name: volume.settings[name] for name in ("leaves", "blocks") if name in volume.settings}
        if kind == "views":
            views_page(self.output, self.part.of_method(method, opened), cameras, opening, self.views, self.size)
            return f"{self.views} views", {"views": self.views}
        whole, crop = self.part.without_floaters(method, opened), self.part.crop(method.frame)
        mesh = extract_mesh(whole, cameras, MeshOptions(faces=FACES), crop)
        mesh_page(self.output, mesh, opening)
        return f"{len(mesh.faces):,} triangles", {"triangles": len(mesh.faces)}

    def _kind(self, opened: Any, method: Any) -> str:
        from ..method.capabilities import HasGaussians, can

        if self.kind != "auto":
            return self.kind
        if can(method, HasGaussians):
            return "splats"
        if self.part.crops:
            return "views"
        return "volume" if is_baked(method) or (not self.settings and can_be_baked(opened, method)) else "views"

    def _baked(self, opened: Any, method: Any) -> tuple[Any, dict[str, str]]:
        """A volume for the page, and the cost of its conversion."""
        if self.part.crops:
            raise LumigraphError("A volume is shown as a whole; leave out --box and --sphere, or give --as views")
        if is_baked(method):
            return method, {}
        if self.settings:
            raise LumigraphError("A conversion has no controls; leave out --set, or give --as views")
        about = f"to an octree, which then learns on for {self.seconds:.0f} s; --as views is quicker"
        show({"converts": about})
        made, took = converted(opened, self.seconds, choose_device(self.device))
        return made, {"converted": took}

    def _background(self) -> tuple[float, float, float] | None:
        from ..figures import hex_colour

        if self.background is None:
            return None
        if not re.fullmatch(r"#[0-9a-fA-F]{6}", self.background):
            raise LumigraphError(f"{self.background!r} is no colour; give --background one such as '#101114'")
        red, green, blue = hex_colour(self.background).tolist()
        return red, green, blue


INTO = "plenoctrees"


def is_baked(method: Any) -> bool:
    from ..method.capabilities import HasAtlas, HasOctree, can

    return can(method, HasOctree) or can(method, HasAtlas)


def browsable(method: Any, degree: int = 3) -> tuple[Any, str]:
    """A baked method's volume for browsers, and its description. degree: largest degree of an octree's harmonics"""
    from ..exchange.baked import atlas_for_browser, octree_for_browser
    from ..method.capabilities import HasAtlas, HasOctree, can, needs

    if can(method, HasOctree):
        volume = octree_for_browser(method.octree(), degree)
        return volume, f"{volume.settings['leaves']:,} leaves of an octree, harmonics of degree {volume.degree}"
    volume = atlas_for_browser(needs(method, HasAtlas).atlas())
    return volume, f"{volume.settings['blocks']:,} blocks of {volume.settings['block']}^3 voxels"


def can_be_baked(opened: Any, method: Any) -> bool:
    """True if a method's field can be converted to an octree, which supports objects only."""
    from ..derive.conversion import check, way
    from ..methods import find

    try:
        check(opened, find(INTO))
    except LumigraphError:
        return False
    return not opened.frame.is_open and way(type(method), find(INTO)) == "field"


def converted(opened: Any, seconds: float, device: Any) -> tuple[Any, str]:
    """The opened method converted to an octree, and the cost as text. seconds: training time after initialisation"""
    from ..derive.conversion import ConversionTarget, convert
    from ..large import open_any

    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lumigraph-") as folder:
        made = convert(opened, INTO, Path(folder) / INTO, ConversionTarget(seconds=seconds), device, show=True)
        method = open_any(Path(folder) / INTO).method(device)
    return method, f"{time.monotonic() - begin:.0f} s, {made.psnr:.1f} dB to {made.teacher.method}"
