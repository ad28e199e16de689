"""`lumigraph export`: a trained scene in the formats of other programs."""

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, get_args

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from ..errors import LumigraphError, LumigraphWarning
from ..export.options import (
    FOR_PHONES,
    CollisionOptions,
    EyesOptions,
    Keeping,
    LightFieldOptions,
    MeshOptions,
    PageOptions,
    PointsOptions,
    ProbesOptions,
    Scaling,
    SphereOptions,
    SplatsOptions,
)
from ..files import claim
from ..files.options import DeviceOption, Overwrite, Set, SourceOption, needed, option
from ..files.ranges import between
from ..system.plugins import offered, taken
from .common import choose_device, say, show
from .results import Exported, Reports


@dataclass(frozen=True)
class Files:
    """Source and output of an export."""

    source: SourceOption
    output: Annotated[Positional[Path], needed("FILE")]
    """The new file."""
    endings: ClassVar[tuple[str, ...]] = ()  # of the output, where it needs one

    def check(self) -> None:
        """Raises LumigraphError for an output with another ending."""
        if self.endings and self.output.suffix.lower() not in self.endings:
            raise LumigraphError(f"{self.output} should end in {', '.join(self.endings)}; rename it")


@dataclass(frozen=True)
class Loading:
    """Options of what is loaded for an export."""

    overwrite: Overwrite = False
    scaling: OmitArgPrefixes[Scaling] = Scaling()
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"


def size_text(path: Path) -> str:
    """Size of a file or folder."""
    from ..exchange import size_of

    return f"{size_of(path) / 1e6:.1f} MB"


def place_row(frame: Any, wanted: bool) -> dict[str, str]:
    """Row that says which place on Earth a file holds; none where it is unknown or unwanted."""
    if not wanted or frame.origin is None:
        return {}
    place = f"latitude {frame.origin.latitude:.6f}, longitude {frame.origin.longitude:.6f}"
    return {"place": f"the file holds {place} of its origin; --no-origin leaves them out"}


@dataclass(frozen=True)
class ExportMesh(Reports, Loading, MeshOptions, Files):
    """Export a triangle mesh with vertex colours or a texture, in the frame of the photographs or upright.

    The ending chooses the format: .ply and .obj, in that frame; .glb, upright; .usdz, upright and for phones. Methods
    with signed distance or density use marching cubes on it; methods with a mesh give that; others use fusion of
    rendered depth. Only the middle of a scene is meshed.
    Unseen surface is closed (objects) or left out (rooms and open scenes).
    """

    def of(self, opened: Any) -> Exported:
        if self.moments is None:
            return self.exported(self.loaded(opened))
        made = []
        for i, loaded in enumerate(self.loaded(opened).moments(self.moments)):
            one = replace(self, output=self.output.with_stem(f"{self.output.stem}-{i:03}")).exported(loaded)
            say(f"{i + 1} of {self.moments}: {one}, {one.rows['triangles']}")
            made.append(one)
        files = tuple(file for one in made for file in one.files)
        counts = {name: sum(one.counts[name] for one in made) for name in made[0].counts}
        rows = {"files": f"{made[0]} to {made[-1]}", "triangles": f"{counts['triangles']:,}, all moments together"}
        return Exported(made[0].path, counts, files, rows=rows)

    def exported(self, loaded: Any) -> Exported:
        """Write the files of one moment."""
        from ..export.mesh import export_mesh
        from ..export.mesh_file import files_of

        for path in files_of(self.output, self.texture):
            claim(path, "mesh", self.overwrite, [self.source])
        for_phones = self.output.suffix.lower() == ".usdz" and not self.texture and self.faces is None
        mesh, why = export_mesh(loaded, replace(self, faces=FOR_PHONES) if for_phones else self)
        return self.written(loaded.frame, mesh, why)

    def written(self, frame: Any, mesh: Any, why: str, pieces: Any = None) -> Exported:
        """Write the files. why: source of the surface, and the reason; pieces: for collisions, by name"""
        from ..export.mesh_file import WITH_ORIGIN, write_mesh

        up, told = frame.to_source.rotation[:, 2].numpy(), self.origin and self.output.suffix.lower() in WITH_ORIGIN
        written = write_mesh(self.output, mesh, up, lit=self.lit, origin=frame.origin if told else None, pieces=pieces)
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        where = "in the frame of the photographs" + (f", times {frame.scale:.6g}" if frame.scale != 1 else "")
        rows = {
            "file": "\n".join(map(str, written)),
            "surface": f"from {why}",
            "triangles": f"{len(mesh.faces):,}, {len(mesh.vertices):,} vertices",
            "extent": " x ".join(f"{x:.4g}" for x in high - low) + f" {where}",
            "size": f"{sum(file.stat().st_size for file in written) / 1e6:.1f} MB",
        }
        rows |= {"texture": f"{self.texture_size} x {self.texture_size} texels"} if self.texture else {}
        counts = {"triangles": len(mesh.faces), "vertices": len(mesh.vertices)}
        return Exported(self.output, counts, tuple(written), rows=rows | place_row(frame, told))

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other, and for another ending."""
        from ..export.mesh_file import ending

        super().check()
        if self.extent is not None and self.part.crops:
            raise LumigraphError("--extent and a crop both say how much is meshed; give one of them")
        ending(self.output, self.texture)


@dataclass(frozen=True)
class ExportSplats(Reports, SplatsOptions, Files):
    """Export a trained cloud of Gaussians for splat viewers, or convert a splat file to another format.

    The ending chooses the format: .ply (lossless), .glb (glTF), .sog, .spz, .compressed.ply, .splat (no view-dependent
    colour); NEW/meta.json is a folder of SOG, NEW/lod-meta.json (or NEW with --lod) one of streamed SOG. The export of
    a run is in the frame of its photographs. Of a scene that moves, .4dgs holds every moment, the others one
    (--set time=0.3).
    """

    overwrite: Overwrite = False
    scaling: OmitArgPrefixes[Scaling] = Scaling()
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()

    def of(self, opened: Any) -> Exported:
        from ..exchange import check_ending, claim_splats, size_of
        from ..exchange.fourdgs import is_moving_file
        from ..export.loaded import export_moving, export_splats

        if is_moving_file(self.output):
            claim(self.output, "splats", self.overwrite, [self.source])
            moving = export_moving(self.loaded(opened), self.output, self)
            output, count, still = self.output, len(moving), len(moving) - moving.moving
            about = f"{still:,} that stand still, {moving.moving:,} spans of those that move"
            rows, counts = {"duration": f"{moving.duration:g} s"}, {"still": still, "moving": moving.moving}
        else:
            output = self.detail.output(self.output)
            check_ending(output)
            claim_splats(output, self.overwrite, [self.source])
            count = len(export_splats(opened, output, self, self.settings, self.part, self.scaling))
            about, rows, counts = f"{count:,}", {}, {"gaussians": count}
        each = f"{size_text(output)}, {size_of(output) / max(count, 1):.1f} bytes each"
        return Exported(output, counts, rows={"file": str(output), "Gaussians": about, **rows, "size": each})


@dataclass(frozen=True)
class ExportOctree(Reports, Files):
    """Export the octree of a plenoctrees run as one .npz, for volrend and svox.

    It is in the frame of the photographs. If that is rotated against the scene's, it is in the scene's frame, because
    the format has no rotation.
    """

    source: Annotated[Positional[Path], needed("RUN")]
    """Folder of a run."""
    output: Annotated[Positional[Path], needed("FILE.npz")]
    """The new file."""
    endings = (".npz",)
    depth: Annotated[Annotated[int, between(1, 10)] | None, option("N", "all there are")] = None
    """Largest depth of the octree; deeper levels are averaged, for a smaller file."""
    overwrite: Overwrite = False
    settings: Set = ()

    def of(self, opened: Any) -> Exported:
        from ..exchange.baked import write_octree
        from ..method.capabilities import HasOctree, needs

        claim(self.output, "octree", self.overwrite, [self.source])
        octree = needs(self.loaded(opened).method, HasOctree).octree(self.depth)
        in_source = write_octree(self.output, octree, opened.frame)
        rows = {
            "file": str(self.output),
            "nodes": f"{len(octree.child):,}",
            "frame": "of the photographs" if in_source else "of the scene, for the format has no rotation",
            "size": size_text(self.output),
        }
        return Exported(self.output, {"nodes": len(octree.child)}, rows=rows)


@dataclass(frozen=True)
class ExportPoints(Reports, Loading, PointsOptions, Files):
    """Export coloured points with normals, spread evenly over the surfaces that the photographs show.

    They are in the frame of the photographs. Floaters are left out: several cameras must see each point.
    """

    output: Annotated[Positional[Path], needed("FILE.ply")]
    """The new file; .las and .laz, of surveyors, hold integers beside a scale and an offset."""
    endings = (".ply", ".las", ".laz")

    def of(self, opened: Any) -> Exported:
        from ..export.points import export_points, write_points

        claim(self.output, "points", self.overwrite, [self.source])
        points = export_points(self.loaded(opened), self)
        told = self.origin and self.output.suffix.lower() == ".ply"
        write_points(self.output, points, opened.frame.origin if told else None)
        count = len(points.positions)
        rows = {"file": str(self.output), "points": f"{count:,}", "size": size_text(self.output)}
        return Exported(self.output, {"points": count}, rows=rows | place_row(opened.frame, told))


@dataclass(frozen=True)
class ExportLightField(Reports, LightFieldOptions, Files):
    """Render a two-plane light field: an n x n grid of pictures around a camera, sheared to a common focal plane.

    A folder: pictures named as in the Stanford light field archive (out_ROW_COLUMN_Y_X.png) and transforms.json, by
    which it opens as a scene. A name that ends in .png: one quilt of a row of cameras, as light-field displays read it.
    """

    output: Annotated[Positional[Path], needed("FOLDER_OR_FILE")]
    """The new folder; or a name that ends in .png, to which the quilt's layout is added (name_qs8x6a0.75.png)."""
    overwrite: Overwrite = False
    settings: Set = ()
    device: DeviceOption = "auto"

    def of(self, opened: Any) -> Exported:
        from ..export.light_field import export_light_field
        from ..files import claim_folder

        if not (flat := self.output.suffix.lower() == ".png"):
            claim_folder(self.output, "light field")
        path, focus, span = export_light_field(self.loaded(opened), self.output, self, self.overwrite)
        views = self.quilt[0] * self.quilt[1] if flat else self.grid**2
        count = {"views": str(views)} if flat else {"pictures": f"{self.grid} x {self.grid}"}
        rows = {"quilt" if flat else "light field": str(path), **count}
        rows |= {"focal plane": f"{focus:.4g} away", "span": f"{span:.4g}"}
        return Exported(path, {"views": views}, rows=rows)


@dataclass(frozen=True)
class SphereExport(Reports, SphereOptions, Files):
    """Base of exports of the whole sphere around a place."""

    output: Annotated[Positional[Path], needed("FILE")]
    """The new picture."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"

    def claimed(self, opened: Any) -> Any:
        """Loaded source, after a check of the output."""
        from ..export.panorama import picture_format, sphere_size

        picture_format(self.output)
        sphere_size(self.size)
        claim(self.output, "panorama", self.overwrite, [self.source])
        return self.loaded(opened)


@dataclass(frozen=True)
class ExportPanorama(SphereExport):
    """All that is seen from one place, as an equirectangular picture that viewers and headsets show as a sphere.

    The horizon is level, the photographs' main direction in the middle. The ending says which format: .png or .jpg.
    """

    def of(self, opened: Any) -> Exported:
        from ..export.panorama import export_panorama

        where = export_panorama(self.claimed(opened), self.output, self)
        rows = {"panorama": str(self.output), "size": f"{self.size}x{self.size // 2}", "from": where}
        return Exported(self.output, {"width": self.size, "height": self.size // 2}, rows=rows)


CONTRACTED = (
    "This open capture was baked whole, in contracted coordinates, which Lumigraph opens again and SNeRG's viewer "
    "shows out of shape; for that viewer train with --no-whole, which bakes the box of interest alone"
)


@dataclass(frozen=True)
class ExportSnerg(Reports):
    """Export a baked run as the folder of SNeRG's own viewer: scene_params.json and slices of its atlas as PNG.

    It is in the scene's frame with +y up. Such a folder also opens like a run. A folder of an open capture is
    contracted (docs/methods/snerg.md), which other viewers do not undo, unless trained with --no-whole.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FOLDER")]
    """Folder of a baked run, or one that SNeRG's viewer opens."""
    output: Annotated[Positional[Path], needed("FOLDER")]
    """The new folder."""

    def of(self, opened: Any) -> Exported:
        from ..exchange import snerg
        from ..files import claim_folder
        from ..method.capabilities import HasAtlas, needs

        claim_folder(self.output, "atlas")
        atlas = needs(opened.ready("cpu"), HasAtlas).atlas()
        snerg.write(self.output, atlas)
        if atlas.contracted:
            warnings.warn(CONTRACTED, LumigraphWarning, stacklevel=2)
        x, y, z = (n * atlas.block for n in atlas.index.shape)
        rows = {
            "folder": str(self.output),
            "voxels": f"{x} x {y} x {z}, in {len(atlas.values):,} of {atlas.index.numel():,} blocks",
            "size": size_text(self.output),
        }
        return Exported(self.output, {"voxels": x * y * z, "blocks": len(atlas.values)}, rows=rows)


@dataclass(frozen=True)
class ExportStereo(EyesOptions, SphereExport):
    """An omnidirectional stereo pair on one square picture, the left eye on top.

    The horizon is level, the photographs' main direction in the middle. The ending chooses the format: .png or .jpg.
    Photographs seldom determine the scale of a scene. If yours is in metres (GPS, a measured model), real sizes need
    the option --interpupillary 0.064.
    """

    def of(self, opened: Any) -> Exported:
        from ..export.panorama import export_stereo

        where, apart, middle = export_stereo(self.claimed(opened), self.output, self, self)
        rows = {
            "stereo pair": f"{self.output}, the left eye on top",
            "size": f"{self.size}x{self.size}",
            "from": where,
            "eyes": f"{apart:.4g} apart; half of all is nearer than {middle:.4g}",
        }
        return Exported(self.output, {"width": self.size, "height": self.size}, rows=rows)


@dataclass(frozen=True)
class ExportCollision(CollisionOptions, ExportMesh):
    """Export a mesh for game engines, with convex pieces that stand for its shape in collisions, as one .glb.

    The pieces are meshes of their own beside the mesh, named as an engine expects. The options are those of
    `lumigraph export mesh`.
    """

    endings = (".glb",)

    def exported(self, loaded: Any) -> Exported:
        from ..export.collision import convex_pieces
        from ..export.mesh import export_mesh

        claim(self.output, "mesh", self.overwrite, [self.source])
        mesh, why = export_mesh(loaded, self)
        found = convex_pieces(mesh, self)
        rows = {"pieces": f"{len(found)}, {sum(len(faces) for _, faces in found.values()):,} triangles"}
        made = self.written(loaded.frame, mesh, why, found)
        return replace(made, counts={**made.counts, "pieces": len(found)}, rows={**made.rows, **rows})


@dataclass(frozen=True)
class ExportProbes(Reports, Loading, ProbesOptions, Files):
    """Export light probes: spherical harmonics of light and octahedral distances on a grid, as JSON and PNG.

    The grid fills the box of interest, or --box. Light is linear, in the frame of the photographs. Probes in matter
    and probes that no camera sees are marked. `lumigraph compose SCENE MESH --probes FOLDER` lights a mesh by them.
    """

    output: Annotated[Positional[Path], needed("FOLDER")]
    """The new folder: probes.json, radiance.png and distance.png."""

    def of(self, opened: Any) -> Exported:
        from ..export.probes import export_probes
        from ..files import claim_folder
        from ..light.probes import FREE, MATTER, UNSEEN

        claim_folder(self.output, "probes")
        if self.page is not None:
            claim(self.page, "page", self.overwrite, [self.source, *([self.mesh] if self.mesh else [])])
        grid = export_probes(self.loaded(opened), self.output, self)
        named = {"free": FREE, "matter": MATTER, "unseen": UNSEEN}
        counts = {name: int((grid.state == state).sum()) for name, state in named.items()}
        rows = {
            "probes": str(self.output),
            "grid": " x ".join(map(str, grid.counts)),
            "states": "{free:,} free, {matter:,} in matter, {unseen:,} seen by no camera".format(**counts),
        }
        rows |= {} if self.page is None else {"page": str(self.page)}
        files = (self.output, *([self.page] if self.page else []))
        return Exported(self.output, counts, files, rows=rows | place_row(opened.frame, self.origin))


@dataclass(frozen=True)
class ExportWeb(Reports, PageOptions, Files):
    """Export one HTML file that opens from disk, in any browser, without a server or a network.

    Gaussians are drawn as splats, with a slider of the moment where they move; octrees and atlases by ray marching.
    Other fields of objects are converted to an octree first; `lumigraph convert` keeps one. --as views and --as mesh
    need no conversion: pictures rendered from all around, or a coloured mesh.
    """

    output: Annotated[Positional[Path], needed("FILE.html")]
    """The page."""
    endings = ".html", ".htm"
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"

    def of(self, opened: Any) -> Exported:
        from ..derive.conversion import becomes_octree, octree_of
        from ..export.page import export_page

        claim(self.output, "page", self.overwrite, [self.source])
        loaded, rows = self.loaded(opened), dict[str, str]()

        def octree() -> Any:
            about = f"to an octree, which then learns on for {self.seconds:.0f} s; --as views is quicker"
            show({"converts": about})
            method, rows["converted"] = octree_of(opened, self.seconds, choose_device(self.device))
            return method

        holds, counts = export_page(loaded, self.output, self, octree, becomes_octree(opened, loaded.method))
        rows |= {"page": str(self.output), "holds": holds, "size": size_text(self.output)}
        return Exported(self.output, counts, rows=rows)


What = (
    Annotated[ExportCollision, subcommand("collision")]
    | Annotated[ExportLightField, subcommand("lightfield")]
    | Annotated[ExportMesh, subcommand("mesh")]
    | Annotated[ExportOctree, subcommand("octree")]
    | Annotated[ExportPanorama, subcommand("panorama")]
    | Annotated[ExportPoints, subcommand("points")]
    | Annotated[ExportProbes, subcommand("probes")]
    | Annotated[ExportSnerg, subcommand("snerg")]
    | Annotated[ExportSplats, subcommand("splats")]
    | Annotated[ExportStereo, subcommand("stereo")]
    | Annotated[ExportWeb, subcommand("web")]
)

for _name in sorted(set(offered("exports")) - {marks.name for _, marks in map(get_args, get_args(What))}):
    try:
        What |= Annotated[taken("exports", _name), subcommand(_name)]
    except LumigraphError as _fault:
        say(f"warning: {_fault}")


@dataclass(frozen=True)
class Export:
    """Export a trained scene in the formats of other programs."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
