"""`lumigraph export probes`: the light of a trained scene at the points of a grid, for games and inserted meshes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional

from ..errors import LumigraphError
from ..files.ranges import Positive, between
from .options import (
    DeviceOption,
    Keeping,
    OriginOption,
    Overwrite,
    Scaling,
    Set,
    SourceOption,
    at_one_moment,
    needed,
    open_method,
    option,
    photographers,
    told_origin,
)
from .results import Exported, Reports

Along = Annotated[int, between(1, 65_535)]


@dataclass(frozen=True)
class ExportProbes(Reports):
    """Export light probes: spherical harmonics of light and octahedral distances on a grid, as JSON and PNG.

    The grid fills the box of interest, or --box. Light is linear, in the frame of the photographs. Probes in matter
    and probes that no camera sees are marked. `lumigraph compose SCENE MESH --probes FOLDER` lights a mesh by them.
    """

    source: SourceOption
    output: Annotated[Positional[Path], needed("FOLDER")]
    """The new folder: probes.json, radiance.png and distance.png."""
    spacing: Annotated[Positive | None, option("LENGTH", "an eighth of the box's longest side")] = None
    """Distance of neighbouring probes, in units of the photographs' frame; smaller resolves light more finely."""
    counts: Annotated[tuple[Along, Along, Along] | None, option("X Y Z", "by the spacing")] = None
    """Number of probes along each axis of the box, instead of --spacing."""
    order: Annotated[int, between(2, 3), option("N")] = 3
    """Highest band of the harmonics. Band 3 is for glossy meshes; it adds nothing to irradiance."""
    resolution: Annotated[int, between(4, 256), option("PIXELS")] = 32
    """Side of the six pictures that each probe renders; larger is more exact and slower."""
    page: Annotated[Path | None, option("FILE.html", "none")] = None
    """Also write a page in which a mesh that the mouse moves is lit by the probes."""
    mesh: Annotated[Path | None, option("FILE", "a white ball")] = None
    """Mesh of the page (.glb, .obj, .ply ...)."""
    view: Annotated[str | None, option("NAME_OR_NUMBER", "the middle one")] = None
    """Photograph whose camera the page looks through."""
    origin: OriginOption = True
    overwrite: Overwrite = False
    scaling: OmitArgPrefixes[Scaling] = Scaling()
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"

    def made(self) -> Exported:
        from ..export.probes import bake_probes
        from ..files import claim, claim_folder
        from ..light.probes import FREE, MATTER, UNSEEN, write_probes

        claim_folder(self.output, "probes")
        if self.page is not None:
            claim(self.page, "page", self.overwrite, [self.source, *([self.mesh] if self.mesh else [])])
        opened, method, cameras = open_method(self.source, self.device, self.settings, self.scaling)
        method = self.part.without_floaters(at_one_moment(method), opened)
        crop = self.part.crop(opened.frame)
        box = opened.frame.bounds if crop is None else crop.bounds
        spacing = None if self.spacing is None else self.spacing / opened.frame.to_export.scale
        seers = photographers(opened, method)
        grid = bake_probes(method, seers, box, spacing, self.counts, self.order, self.resolution)
        origin, place = told_origin(opened.frame, self.origin)
        write_probes(self.output, grid, origin and origin.to_json())
        named = {"free": FREE, "matter": MATTER, "unseen": UNSEEN}
        counts = {name: int((grid.state == state).sum()) for name, state in named.items()}
        rows = {
            "probes": str(self.output),
            "grid": " x ".join(map(str, grid.counts)),
            "states": "{free:,} free, {matter:,} in matter, {unseen:,} seen by no camera".format(**counts),
        }
        if self.page is not None:
            rows |= {"page": self._page(opened, method, cameras, grid)}
        return Exported(self.output, counts, (self.output, *([self.page] if self.page else [])), rows=rows | place)

    def _page(self, opened: Any, method: Any, cameras: Any, grid: Any) -> str:
        """Write the page. Returns its name."""
        from ..export.probes_page import probes_page
        from ..paths import Surroundings
        from .explain import find_view

        assert self.page is not None
        train = cameras["train"]
        number = Surroundings(train, opened.frame).middle
        if self.view is not None:
            names = opened.view_names().get("train", [])
            number = names.index(find_view(opened, "train", self.view)[0])
        probes_page(self.page, method, train[number], grid, opened.title, self.mesh)
        return str(self.page)

    def check(self) -> None:
        """Raises LumigraphError for options that contradict each other or need others."""
        if self.spacing is not None and self.counts is not None:
            raise LumigraphError("--spacing and --counts both say how many probes there are; give one of them")
        if self.page is None and (self.mesh is not None or self.view is not None):
            raise LumigraphError("--mesh and --view are about the page; give --page FILE.html as well")
        if self.page is not None and self.page.suffix.lower() not in (".html", ".htm"):
            raise LumigraphError(f"{self.page} should end in .html, as pages do; rename it")
