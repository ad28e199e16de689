"""`lumigraph export`: a trained scene in the formats of other programs."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from ..errors import LumigraphError, LumigraphWarning
from ..export.options import FOR_PHONES, MeshOptions
from ..files import claim
from ..files.ranges import CloudSize, Coordinate, Count, Pixels, Positive, Seconds, SphereSize, between
from .common import say
from .export_probes import ExportProbes
from .export_web import ExportWeb
from .options import (
    DeviceOption,
    Keeping,
    OriginOption,
    Overwrite,
    PhotographsOption,
    Scaling,
    Set,
    SourceOption,
    at_one_moment,
    controlled,
    needed,
    open_method,
    option,
    photographers,
    told_origin,
)
from .results import Exported, Reports


@dataclass(frozen=True)
class Files:
    """Source and output of an export."""

    source: SourceOption
    output: Annotated[Positional[Path], needed("FILE")]
    """The new file."""


@dataclass(frozen=True)
class ExportMesh(Reports, MeshOptions, Files):
    """Export a triangle mesh with vertex colours or a texture, in the frame of the photographs or upright.

    The ending chooses the format: .ply and .obj, in that frame; .glb, upright; .usdz, upright and for phones. Methods
    with signed distance or density use marching cubes on it; methods with a mesh give that; others use fusion of
    rendered depth. Only the middle of a scene is meshed.
    Unseen surface is closed (objects) or left out (rooms and open scenes).
    """

    moments: Annotated[Annotated[int, between(2, 1000)] | None, option("N", "one, as --set time says")] = None
    """Number of moments of a scene that moves, evenly spread: a mesh each, FILE-000 and on."""
    scene: PhotographsOption = None
    origin: OriginOption = True
    overwrite: Overwrite = False
    scaling: OmitArgPrefixes[Scaling] = Scaling()
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"

    def made(self) -> Exported:
        from ..export.mesh_file import files_of

        if self.moments is not None:
            return self._sequence(self.moments)
        for path in files_of(self.output, self.texture):
            claim(path, "mesh", self.overwrite, [self.source])
        opened, mesh, why = self.extracted()
        return self.written(opened, mesh, why)

    def _sequence(self, count: int) -> Exported:
        """Write a mesh of each of some moments."""
        from ..large import open_any

        times = open_any(self.source).frame.times
        if times is None:
            raise LumigraphError(f"{self.source} does not move, so it has one mesh; leave out --moments")
        made = []
        for i in range(count):
            time = times[0] + (times[1] - times[0]) * i / (count - 1)
            output = self.output.with_stem(f"{self.output.stem}-{i:03}")
            one = replace(self, output=output, moments=None, settings=(*self.settings, f"time={time:.9g}")).made()
            say(f"{i + 1} of {count}: {one}, {one.rows['triangles']}")
            made.append(one)
        files = tuple(file for one in made for file in one.files)
        counts = {name: sum(one.counts[name] for one in made) for name in made[0].counts}
        rows = {"files": f"{made[0]} to {made[-1]}", "triangles": f"{counts['triangles']:,}, all moments together"}
        return Exported(made[0].path, counts, files, rows=rows)

    def extracted(self) -> tuple[Any, Any, str]:
        """The opened source, its mesh in the frame of exports, and the source of the surface as text."""
        from ..export.mesh import best_way, extract_mesh

        opened, method, cameras = open_method(self.source, self.device, self.settings, self.scaling)
        method = at_one_moment(method)
        why = best_way(method)[1] if self.way == "auto" else f"{self.way}, as --from says"
        for_phones = self.output.suffix.lower() == ".usdz" and not self.texture and self.faces is None
        mesh = extract_mesh(
            self.part.without_floaters(method, opened),
            opened.survey(cameras["train"]),
            replace(self, faces=FOR_PHONES) if for_phones else self,
            self.part.crop(opened.frame),
            self.photographs(opened),
        )
        return opened, mesh.in_source(opened.frame), why

    def photographs(self, opened: Any) -> Any:
        """The photographs of a run, if their colours or masks are used; None, with a warning, if unavailable. Raises
        LumigraphError if they are not at --scene."""
        if opened.open_scene is None or not (self.texture or opened.masked):
            return None
        try:
            return opened.open_scene(self.scene)
        except LumigraphError as error:
            if self.scene is not None:
                raise
            if self.texture:
                warnings.warn(f"The texture is made of renderings, for {error}", LumigraphWarning, stacklevel=2)
            return None

    def written(self, opened: Any, mesh: Any, why: str, pieces: Any = None) -> Exported:
        """Write the files. why: source of the surface, and the reason; pieces: for collisions, by name"""
        from ..export.mesh_file import WITH_ORIGIN, write_mesh

        up = opened.frame.to_source.rotation[:, 2].numpy()
        origin, place = told_origin(opened.frame, self.origin and self.output.suffix.lower() in WITH_ORIGIN)
        written = write_mesh(self.output, mesh, up, lit=self.lit, origin=origin, pieces=pieces)
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        frame = "in the frame of the photographs"
        frame += f", times {opened.frame.scale:.6g}" if opened.frame.scale != 1 else ""
        rows = {
            "file": "\n".join(map(str, written)),
            "surface": f"from {why}",
            "triangles": f"{len(mesh.faces):,}, {len(mesh.vertices):,} vertices",
            "extent": " x ".join(f"{x:.4g}" for x in high - low) + f" {frame}",
            "size": f"{sum(file.stat().st_size for file in written) / 1e6:.1f} MB",
        }
        rows |= {"texture": f"{self.texture_size} x {self.texture_size} texels"} if self.texture else {}
        counts = {"triangles": len(mesh.faces), "vertices": len(mesh.vertices)}
        return Exported(self.output, counts, tuple(written), rows=rows | place)

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        from ..export.mesh_file import ending

        if self.extent is not None and self.part.crops:
            raise LumigraphError("--extent and a crop both say how much is meshed; give one of them")
        ending(self.output, self.texture)


@dataclass(frozen=True)
class Levels:
    """Levels of detail for viewers that stream large scenes."""

    lod: bool = False
    """Write a folder of streamed SOG: FILE/lod-meta.json, and chunks at several levels of detail."""
    levels: Annotated[Annotated[int, between(1, 10)] | None, option("N", "4")] = None
    """With --lod: number of levels of detail, including the finest."""
    ratio: Annotated[Annotated[float, between(1.5, 16)] | None, option("TIMES", "4")] = None
    """With --lod: Gaussians of a level per Gaussian of the next; larger makes coarser levels."""
    chunk: Annotated[Annotated[int, between(1024, 1 << 20)] | None, option("N", "65,536")] = None
    """With --lod: largest number of Gaussians in a chunk; smaller makes more files."""

    def output(self, path: Path) -> Path:
        """Path of lod-meta.json, or the path itself. Raises LumigraphError for options that need --lod."""
        if path.name == "lod-meta.json":
            return path
        if self.lod and path.suffix:
            raise LumigraphError(f"--lod writes a folder, and {path} is named like a file; name one without an ending")
        if self.given and not self.lod:
            raise LumigraphError(f"--{next(iter(self.given))} is about levels of detail; give --lod as well")
        return path / "lod-meta.json" if self.lod else path

    @property
    def given(self) -> dict[str, Any]:
        values = {name: getattr(self, name) for name in ("levels", "ratio", "chunk")}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class ExportSplats(Reports):
    """Export a trained cloud of Gaussians for splat viewers, or convert a splat file to another format.

    The ending chooses the format: .ply (lossless), .glb (glTF), .sog, .spz, .compressed.ply, .splat (no view-dependent
    colour); NEW/meta.json is a folder of SOG, NEW/lod-meta.json (or NEW with --lod) one of streamed SOG. The export of
    a run is in the frame of its photographs. Of a scene that moves, .4dgs holds every moment, the others one
    (--set time=0.3).
    """

    source: SourceOption
    output: Annotated[Positional[Path], needed("FILE")]
    """The new file."""
    detail: OmitArgPrefixes[Levels] = Levels()
    duration: Annotated[Seconds, option("SECONDS")] = 3.0
    """With .4dgs: time that the whole capture takes when it is played; longer is slower."""
    overwrite: Overwrite = False
    scaling: OmitArgPrefixes[Scaling] = Scaling()
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()

    def made(self) -> Exported:
        from ..exchange.fourdgs import is_moving_file

        return self._moving() if is_moving_file(self.output) else self._one_moment()

    def _moving(self) -> Exported:
        """Write every moment of a run or file that moves."""
        from ..exchange.fourdgs import write_moving
        from ..large import open_any
        from ..method.capabilities import HasMovingGaussians, needs

        if self.detail.given or self.detail.lod:
            raise LumigraphError("A .4dgs has no levels of detail; leave out --lod and its options")
        claim(self.output, "splats", self.overwrite, [self.source])
        opened = open_any(self.source)
        self.scaling.remember(opened)
        method = controlled(opened, opened.ready("cpu"), self.settings)
        if "time" in method.settings:
            raise LumigraphError("A .4dgs holds every moment; leave out --set time, or name a .spz for one of them")
        moving = needs(method, HasMovingGaussians).moving(self.duration)
        crop = self.part.crop(method.frame)
        kept = self.part.kept(moving.cloud, crop, method.frame, photographers(opened, method))
        moving = moving[kept]
        write_moving(self.output, moving.transformed(opened.frame.to_export.matrix))
        size, still = self.output.stat().st_size, len(moving) - moving.moving
        rows = {
            "file": str(self.output),
            "Gaussians": f"{still:,} that stand still, {moving.moving:,} spans of those that move",
            "duration": f"{moving.duration:g} s",
            "size": f"{size / 1e6:.1f} MB, {size / max(len(moving), 1):.1f} bytes each",
        }
        return Exported(self.output, {"still": still, "moving": moving.moving}, rows=rows)

    def _one_moment(self) -> Exported:
        """Write a cloud at one time."""
        from ..exchange import check_ending, claim_splats, is_splat_file, read_gaussians, size_of, write_gaussians
        from ..exchange.streamed_sog import Detail
        from ..large import open_any
        from ..method.capabilities import HasGaussians, needs
        from ..run.files import frame_of

        output = self.detail.output(self.output)
        check_ending(output)
        claim_splats(output, self.overwrite, [self.source])
        detail = Detail(**self.detail.given)
        if is_splat_file(self.source):
            self.scaling.remember(open_any(self.source))
            if self.settings:
                raise LumigraphError(f"{self.source} is a file of Gaussians, which has no controls; leave out --set")
            written = read_gaussians(self.source)
            if self.part.crops or self.part.removes:
                frame = frame_of(written)
                crop = self.part.crop(frame)
                written = self.part.of_gaussians(written, crop and crop.transformed(frame.to_source), frame, None)
        else:
            opened = open_any(self.source)
            self.scaling.remember(opened)
            method = controlled(opened, opened.ready("cpu"), self.settings)
            gaussians = needs(method, HasGaussians).gaussians()
            crop = self.part.crop(method.frame)
            gaussians = self.part.of_gaussians(gaussians, crop, method.frame, photographers(opened, method))
            written = gaussians.transformed(opened.frame.to_export.matrix)
        write_gaussians(output, written, detail)
        size = size_of(output)
        rows = {
            "file": str(output),
            "Gaussians": f"{len(written):,}",
            "size": f"{size / 1e6:.1f} MB, {size / max(len(written), 1):.1f} bytes each",
        }
        return Exported(output, {"gaussians": len(written)}, rows=rows)


@dataclass(frozen=True)
class ExportOctree(Reports):
    """Export the octree of a plenoctrees run as one .npz, for volrend and svox.

    It is in the frame of the photographs. If that is rotated against the scene's, it is in the scene's frame, because
    the format has no rotation.
    """

    source: Annotated[Positional[Path], needed("RUN")]
    """Folder of a run."""
    output: Annotated[Positional[Path], needed("FILE.npz")]
    """The new file."""
    depth: Annotated[Annotated[int, between(1, 10)] | None, option("N", "all there are")] = None
    """Largest depth of the octree; deeper levels are averaged, for a smaller file."""
    overwrite: Overwrite = False
    settings: Set = ()

    def made(self) -> Exported:
        if self.output.suffix.lower() != ".npz":
            raise LumigraphError(f"{self.output} should end in .npz, as viewers of octrees expect; rename it")
        claim(self.output, "octree", self.overwrite, [self.source])
        from ..exchange.baked import write_octree
        from ..large import open_any
        from ..method.capabilities import HasOctree, needs

        opened = open_any(self.source)
        octree = needs(controlled(opened, opened.ready("cpu"), self.settings), HasOctree).octree(self.depth)
        in_source = write_octree(self.output, octree, opened.frame)
        rows = {
            "file": str(self.output),
            "nodes": f"{len(octree.child):,}",
            "frame": "of the photographs" if in_source else "of the scene, for the format has no rotation",
            "size": f"{self.output.stat().st_size / 1e6:.1f} MB",
        }
        return Exported(self.output, {"nodes": len(octree.child)}, rows=rows)


@dataclass(frozen=True)
class ExportPoints(Reports):
    """Export coloured points with normals, spread evenly over the surfaces that the photographs show.

    They are in the frame of the photographs. Floaters are left out: several cameras must see each point.
    """

    source: SourceOption
    output: Annotated[Positional[Path], needed("FILE.ply")]
    """The new file."""
    count: Annotated[CloudSize, option("N")] = 200_000
    """Largest number of points."""
    size: Annotated[Pixels, option("PIXELS")] = 400
    """Longer side of the pictures that points are taken from, at most that of the photographs."""
    views: Annotated[Count, option("N")] = 64
    """Largest number of these pictures."""
    origin: OriginOption = True
    overwrite: Overwrite = False
    scaling: OmitArgPrefixes[Scaling] = Scaling()
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"

    def made(self) -> Exported:
        if self.output.suffix.lower() != ".ply":
            raise LumigraphError(f"{self.output} should end in .ply, the one kind of point cloud there is; rename it")
        claim(self.output, "points", self.overwrite, [self.source])
        from ..export.points import extract_points, write_points

        opened, method, cameras = open_method(self.source, self.device, self.settings, self.scaling)
        seers, method = opened.survey(cameras["train"]), at_one_moment(method)
        method, crop = self.part.without_floaters(method, opened), self.part.crop(opened.frame)
        points = extract_points(method, seers, self.count, self.size, self.views, crop).in_source(opened.frame)
        origin, place = told_origin(opened.frame, self.origin)
        write_points(self.output, points, origin)
        rows = {
            "file": str(self.output),
            "points": f"{len(points.positions):,}",
            "size": f"{self.output.stat().st_size / 1e6:.1f} MB",
        }
        return Exported(self.output, {"points": len(points.positions)}, rows=rows | place)


GridSide = Annotated[int, between(2, 64)]


@dataclass(frozen=True)
class ExportLightField(Reports):
    """Render a two-plane light field: an n x n grid of pictures around a camera, sheared to a common focal plane.

    A folder: pictures named as in the Stanford light field archive (out_ROW_COLUMN_Y_X.png) and transforms.json, by
    which it opens as a scene. A name that ends in .png: one quilt of a row of cameras, as light-field displays read it.
    """

    source: SourceOption
    output: Annotated[Positional[Path], needed("FOLDER_OR_FILE")]
    """The new folder; or a name that ends in .png, to which the quilt's layout is added (name_qs8x6a0.75.png)."""
    grid: Annotated[GridSide, option("N")] = 9
    """Pictures along each side of the grid; more are smoother between them."""
    quilt: Annotated[tuple[GridSide, GridSide], option("COLUMNS ROWS")] = (8, 6)
    """Layout of a quilt, which has as many cameras."""
    span: Annotated[Positive | None, option("LENGTH", "a tenth of the focal distance")] = None
    """Width of the grid, in units of the photographs' frame; larger gives more parallax."""
    focus: Annotated[Positive | None, option("LENGTH", "the median depth of the view")] = None
    """Distance of the focal plane, which is at the same pixels in all pictures, in units of the photographs' frame."""
    view: Annotated[str | None, option("NAME_OR_NUMBER", "the middle one")] = None
    """Photograph whose camera is in the middle of the grid."""
    size: Annotated[Pixels, option("PIXELS")] = 512
    """Longer side of each picture."""
    overwrite: Overwrite = False
    settings: Set = ()
    device: DeviceOption = "auto"

    def made(self) -> Exported:
        from ..export.light_field import SPAN, focal_distance, quilt, write_light_field
        from ..figures import save_picture
        from ..files import claim_folder
        from ..paths import Surroundings

        flat = self.output.suffix.lower() == ".png"
        if not flat:
            claim_folder(self.output, "light field")
        opened, method, cameras = open_method(self.source, self.device, self.settings)
        unit, train = opened.frame.to_export.scale, cameras["train"]
        number = Surroundings(train, opened.frame).middle if self.view is None else self._number(opened)
        camera = train[number]
        camera = camera.resized(self.size / int(camera.size.max())).to(method.device)
        focus = self.focus / unit if self.focus else focal_distance(method, camera)
        span = self.span / unit if self.span else SPAN * focus
        rows = {"focal plane": f"{focus * unit:.4g} away", "span": f"{span * unit:.4g}"}
        if flat:
            columns, lines = self.quilt
            width, height = camera.size[0].tolist()
            output = self.output.with_name(f"{self.output.stem}_qs{columns}x{lines}a{width / height:.2f}.png")
            claim(output, "quilt", self.overwrite, [self.source])
            spacing = span / (columns * lines - 1)
            save_picture(output, quilt(method, camera, columns, lines, spacing, focus), "quilt")
            views = columns * lines
            return Exported(output, {"views": views}, rows={"quilt": str(output), "views": str(views), **rows})
        write_light_field(self.output, method, camera, self.grid, span / (self.grid - 1), focus, opened.frame)
        rows = {"light field": str(self.output), "pictures": f"{self.grid} x {self.grid}", **rows}
        return Exported(self.output, {"views": self.grid**2}, rows=rows)

    def _number(self, opened: Any) -> int:
        """Row of the photograph of --view among the training photographs."""
        from .explain import find_view

        names = opened.view_names()["train"]
        name, _ = find_view(opened, "train", self.view or "0")
        return names.index(name)


Place = Annotated[
    tuple[Coordinate, Coordinate, Coordinate] | None, option("X Y Z", "the position of the middle camera", name="from")
]


@dataclass(frozen=True)
class SphereExport(Reports):
    """Base of exports of the whole sphere around a point."""

    source: SourceOption
    output: Annotated[Positional[Path], needed("FILE")]
    """The new picture."""
    place: Place = None
    """Position of the camera, or of the middle between two eyes, in the frame of the photographs."""
    size: Annotated[SphereSize, option("PIXELS")] = 2048
    """Width in pixels; the height of each sphere is half of it."""
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()
    device: DeviceOption = "auto"

    def opened(self) -> tuple[Any, Any, Any, Any, str]:
        """Open the source and find the standpoint: the source, its method, place and heading in the scene's frame, and
        the place in words."""
        from ..export.panorama import picture_format, sphere_size, standpoint

        picture_format(self.output)
        sphere_size(self.size)
        claim(self.output, "panorama", self.overwrite, [self.source])
        opened, method, cameras = open_method(self.source, self.device, self.settings)
        return opened, self.part.of_method(method, opened), *standpoint(cameras["train"], opened.frame, self.place)


@dataclass(frozen=True)
class ExportPanorama(SphereExport):
    """All that is seen from one place, as an equirectangular picture that viewers and headsets show as a sphere.

    The horizon is level, the photographs' main direction in the middle. The ending says which format: .png or .jpg.
    """

    def made(self) -> Exported:
        from ..export.panorama import panorama, save_sphere

        _, method, place, heading, where = self.opened()
        save_sphere(self.output, panorama(method, place, heading, self.size).rgb, whole=True)
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

    def made(self) -> Exported:
        from ..exchange import size_of, snerg
        from ..files import claim_folder
        from ..large import open_any
        from ..method.capabilities import HasAtlas, needs

        claim_folder(self.output, "atlas")
        atlas = needs(open_any(self.source).ready("cpu"), HasAtlas).atlas()
        snerg.write(self.output, atlas)
        if atlas.contracted:
            warnings.warn(CONTRACTED, LumigraphWarning, stacklevel=2)
        x, y, z = (n * atlas.block for n in atlas.index.shape)
        rows = {
            "folder": str(self.output),
            "voxels": f"{x} x {y} x {z}, in {len(atlas.values):,} of {atlas.index.numel():,} blocks",
            "size": f"{size_of(self.output) / 1e6:.1f} MB",
        }
        return Exported(self.output, {"voxels": x * y * z, "blocks": len(atlas.values)}, rows=rows)


@dataclass(frozen=True)
class ExportStereo(SphereExport):
    """An omnidirectional stereo pair on one square picture, the left eye on top.

    The horizon is level, the photographs' main direction in the middle. The ending chooses the format: .png or .jpg.
    Photographs seldom determine the scale of a scene. If yours is in metres (GPS, a measured model), real sizes need
    the option --interpupillary 0.064.
    """

    interpupillary: Annotated[Positive | None, option("LENGTH", "1/50 of the median distance to what is around")] = None
    """Distance between the eyes, in units of the photographs' frame; larger makes the scene look smaller and deeper."""

    def made(self) -> Exported:
        from ..export.panorama import EYE_DISTANCE_SHARE, save_sphere, stereo_pair, surrounding_distances, top_bottom

        opened, method, place, heading, where = self.opened()
        unit = opened.frame.to_export.scale
        near, middle = surrounding_distances(method, place, heading)
        apart = EYE_DISTANCE_SHARE * middle if self.interpupillary is None else self.interpupillary / unit
        if apart > near:
            raise LumigraphError(
                f"Eyes {apart * unit:.4g} apart do not fit where things are {near * unit:.4g} away; "
                "give a smaller --interpupillary or another --from"
            )
        pair = stereo_pair(method, place, heading, self.size, apart, near)
        save_sphere(self.output, top_bottom(*pair), whole=False)
        rows = {
            "stereo pair": f"{self.output}, the left eye on top",
            "size": f"{self.size}x{self.size}",
            "from": where,
            "eyes": f"{apart * unit:.4g} apart; half of all is nearer than {middle * unit:.4g}",
        }
        return Exported(self.output, {"width": self.size, "height": self.size}, rows=rows)


PIECE_NAMES = {"unreal": "UCX_{name}_{number:02}", "godot": "{name}_{number:02}-convcolonly"}


@dataclass(frozen=True)
class ExportCollision(ExportMesh):
    """Export a mesh for game engines, with convex pieces that stand for its shape in collisions, as one .glb.

    The pieces are meshes of their own beside the mesh, named as an engine expects. The options are those of
    `lumigraph export mesh`.
    """

    engine: Literal["unreal", "godot"] = "unreal"
    """Names of the pieces: UCX_name_00 for Unreal Engine, name_00-convcolonly for Godot."""
    concavity: Annotated[float, between(0.01, 1), option("SHARE")] = 0.05
    """Largest concavity of a piece, as a share of the mesh's size; smaller makes more pieces that fit better."""
    pieces: Annotated[Annotated[int, between(1, 1000)] | None, option("N", "as many as the concavity needs")] = None
    """Largest number of pieces."""

    def made(self) -> Exported:
        from ..export.collision import convex_pieces

        claim(self.output, "mesh", self.overwrite, [self.source])
        opened, mesh, why = self.extracted()
        found = convex_pieces(mesh, self.concavity, self.pieces)
        named = {PIECE_NAMES[self.engine].format(name="source", number=i): piece for i, piece in enumerate(found)}
        rows = {"pieces": f"{len(found)}, {sum(len(faces) for _, faces in found):,} triangles"}
        made = self.written(opened, mesh, why, named)
        return replace(made, counts={**made.counts, "pieces": len(found)}, rows={**made.rows, **rows})

    def check(self) -> None:
        super().check()
        if self.output.suffix.lower() != ".glb":
            raise LumigraphError(f"{self.output} should end in .glb, which holds pieces by name; rename it")


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


@dataclass(frozen=True)
class Export:
    """Export a trained scene in the formats of other programs."""

    what: OmitSubcommandPrefixes[OmitArgPrefixes[What]]

    def run(self) -> int:
        return self.what.run()
