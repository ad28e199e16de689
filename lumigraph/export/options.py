"""Options of exports: dataclasses that the functions take and the commands derive from. None needs PyTorch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, arg

from ..errors import LumigraphError
from ..files.options import DownscaleOption, PhotographsOption, ReaderOption, option
from ..files.ranges import (
    CloudSize,
    Coordinate,
    Count,
    FramesPerSecond,
    Pixels,
    Positive,
    Seconds,
    Share,
    SphereSize,
    between,
)

FOR_PHONES = 100_000  # triangles that a phone shows with ease
TEXTURED_FACES = 50_000  # triangles whose texture holds the finer detail
AUTO = "auto"
PATH_KINDS = ("orbit", "sweep", "spiral", "interpolate", "still", "held-out")  # of films
MAX_FILM_SIZE, MAX_RAYS_SIZE = 1280, 640  # pixels by default, of Gaussians and of methods that cast rays
DURATION, DURATION_TEXT = 3.0, "3, or that of a file that moves"  # seconds
FILM_SIZES = f"that of the photographs, at most {MAX_FILM_SIZE}, and {MAX_RAYS_SIZE} for methods that cast rays"
ORIGIN = "Write latitude and longitude of the frame's origin into the file, where they are known."
OriginOption = Annotated[bool, arg(help=ORIGIN)]
Six = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
Four = tuple[Coordinate, Coordinate, Coordinate, Positive]
Seven = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Positive]
GridSide = Annotated[int, between(2, 64)]
ProbesAlong = Annotated[int, between(1, 65_535)]
Place = tuple[Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class Scaling:
    """The unit of exports, by one known length."""

    scale_by: Annotated[Seven | None, option("X0 Y0 Z0 X1 Y1 Z1 LENGTH", "the scale that the run remembers")] = None
    """Two points in the frame of the photographs, and their distance in the unit that exports shall have."""

    def check(self) -> None:
        """Raises LumigraphError for two points in one place."""
        if self.scale_by is not None and self.scale_by[:3] == self.scale_by[3:6]:
            raise LumigraphError("--scale-by names one point twice; give two points, and the distance between them")

    def remember(self, opened: Any) -> None:
        """Set the scale of an opened run, once and for all exports. Raises LumigraphError for what remembers none."""
        if self.scale_by is not None:
            opened.set_scale(self.scale_by[6] / math.dist(self.scale_by[:3], self.scale_by[3:6]))


@dataclass(frozen=True)
class Cropping:
    """Crop the scene to a box or a sphere."""

    box: Annotated[Six | None, option("X0 Y0 Z0 X1 Y1 Z1", "everything")] = None
    """Crop to the box between two corners."""
    sphere: Annotated[Four | None, option("X Y Z RADIUS", "everything")] = None
    """Crop to the inside of a sphere."""
    units: Literal["scene", "source"] = "scene"
    """Frame of --box and --sphere: scene, as in `lumigraph info` and the viewer, or source, as in the photographs and
    exports."""

    @property
    def crops(self) -> bool:
        return self.box is not None or self.sphere is not None

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.box is not None and self.sphere is not None:
            raise LumigraphError("--box and --sphere are two ways to crop; give one of them")
        if self.box is not None and not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise LumigraphError("The box holds nothing; give --box its lower corner first, then its upper one")

    def crop(self, frame: Any) -> Any:
        """The Crop, in the scene's frame; None where there is none."""
        from ..camera.crop import Crop, CropBox, Sphere

        crop: Crop
        if self.box is not None:
            crop = CropBox(self.box[:3], self.box[3:])
        elif self.sphere is not None:
            crop = Sphere(self.sphere[:3], self.sphere[3])
        else:
            return None
        return crop if self.units == "scene" else crop.transformed(frame.to_source.inverse)


@dataclass(frozen=True)
class Keeping(Cropping):
    """Crop the scene, and remove floaters from Gaussians."""

    clean: bool = False
    """Remove floaters from Gaussians, as `lumigraph clean` does."""
    strength: Annotated[Share | None, option("SHARE", "0, with --clean 0.4")] = None
    """Remove Gaussians with a floater score above 1 - strength; a larger value removes more."""
    max_scale: Annotated[Positive | None, option("SHARE", "any")] = None
    """Remove Gaussians with a larger standard deviation, in extents of the cloud; a smaller value removes more."""

    @property
    def removes(self) -> bool:
        """True if Gaussians go for another reason than a crop."""
        return self.clean or bool(self.strength) or self.max_scale is not None


@dataclass(frozen=True)
class FilmOptions:
    """Options of a film."""

    path: Annotated[str, option("{" + ",".join((AUTO, *PATH_KINDS)) + ",FILE.json}")] = AUTO
    """Camera path: the name of one, or a JSON file."""
    frames: Annotated[Count | None, option("N", "120; for held-out every view; for keyframes by their seconds")] = None
    """Number of frames; more make a longer film."""
    fps: Annotated[FramesPerSecond | None, option("N", "30, or that of the path's file")] = None
    """Frames per second of the film."""
    size: Annotated[Pixels | None, option("PIXELS", FILM_SIZES)] = None
    """Longer side of the picture in pixels; larger renders slower."""
    depth: bool = False
    """Also render a film of depth, FILE-depth."""
    pictures: Annotated[Literal["png", "exr"] | None, option("{png,exr}", "none")] = None
    """Also keep each frame as a picture, in the folder FILE. exr adds linear light with its full range."""


@dataclass(frozen=True)
class MeshOptions:
    """Options of a mesh, lengths in the unit of exports."""

    extent: Annotated[
        Annotated[float, between(0.001, 1000)] | None,
        option("TIMES", "1 for objects, 1.5 for the rest, own meshes whole"),
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
    keep: Annotated[Share | None, option("SHARE", "0.01, of own meshes 0")] = None
    """Smallest piece to keep, as a share of the largest one's area; larger removes more fragments."""
    unseen: Annotated[Literal["close", "cut"] | None, option("{close,cut}", "close objects, cut the rest")] = None
    """Unseen surface: close it for a watertight mesh, or cut it."""
    size: Annotated[Pixels, option("PIXELS")] = 400
    """Longer side of the pictures for colours and depth, at most that of the photographs; larger is finer, slower."""
    views: Annotated[Count, option("N")] = 64
    """Largest number of these pictures, and of photographs for a texture."""
    moments: Annotated[Annotated[int, between(2, 1000)] | None, option("N", "one, as --set time says")] = None
    """Number of moments of a scene that moves, evenly spread: a mesh each, FILE-000 and on."""
    scene: PhotographsOption = None
    origin: OriginOption = True


@dataclass(frozen=True)
class CollisionOptions:
    """Options of convex pieces of a mesh, for collisions."""

    engine: Literal["unreal", "godot"] = "unreal"
    """Names of the pieces: UCX_name_00 for Unreal Engine, name_00-convcolonly for Godot."""
    concavity: Annotated[float, between(0.01, 1), option("SHARE")] = 0.05
    """Largest concavity of a piece, as a share of the mesh's size; smaller makes more pieces that fit better."""
    pieces: Annotated[Annotated[int, between(1, 1000)] | None, option("N", "as many as the concavity needs")] = None
    """Largest number of pieces."""


@dataclass(frozen=True)
class PointsOptions:
    """Options of points on surfaces."""

    count: Annotated[CloudSize, option("N")] = 200_000
    """Largest number of points."""
    size: Annotated[Pixels, option("PIXELS")] = 400
    """Longer side of the pictures that points are taken from, at most that of the photographs."""
    views: Annotated[Count, option("N")] = 64
    """Largest number of these pictures."""
    origin: OriginOption = True


@dataclass(frozen=True)
class LightFieldOptions:
    """Options of a light field, lengths in the unit of exports."""

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


@dataclass(frozen=True)
class SphereOptions:
    """Options of a picture of the whole sphere around a place."""

    place: Annotated[Place | None, option("X Y Z", "the position of the middle camera", name="from")] = None
    """Position of the camera, or of the middle between two eyes, in the frame of the photographs."""
    size: Annotated[SphereSize, option("PIXELS")] = 2048
    """Width in pixels; the height of each sphere is half of it."""


@dataclass(frozen=True)
class EyesOptions:
    """Options of two eyes, lengths in the unit of exports."""

    interpupillary: Annotated[Positive | None, option("LENGTH", "1/50 of the median distance to what is around")] = None
    """Distance between the eyes, in units of the photographs' frame; larger makes the scene look smaller and deeper."""


@dataclass(frozen=True)
class ProbesOptions:
    """Options of light probes, lengths in the unit of exports."""

    spacing: Annotated[Positive | None, option("LENGTH", "an eighth of the box's longest side")] = None
    """Distance of neighbouring probes, in units of the photographs' frame; smaller resolves light more finely."""
    counts: Annotated[tuple[ProbesAlong, ProbesAlong, ProbesAlong] | None, option("X Y Z", "by the spacing")] = None
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

    def check(self) -> None:
        """Raises LumigraphError for options that contradict each other or need others."""
        if self.spacing is not None and self.counts is not None:
            raise LumigraphError("--spacing and --counts both say how many probes there are; give one of them")
        if self.page is None and (self.mesh is not None or self.view is not None):
            raise LumigraphError("--mesh and --view are about the page; give --page FILE.html as well")
        if self.page is not None and self.page.suffix.lower() not in (".html", ".htm"):
            raise LumigraphError(f"{self.page} should end in .html, as pages do; rename it")


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
class SplatsOptions:
    """Options of a file of Gaussians."""

    detail: OmitArgPrefixes[Levels] = Levels()
    duration: Annotated[Seconds | None, option("SECONDS", DURATION_TEXT)] = None
    """With .4dgs: time that the whole capture takes when it is played; longer is slower."""
    spz_version: Literal["3", "4"] = "4"
    """With .spz: version of the format; more programs read 3."""


@dataclass(frozen=True)
class PageOptions:
    """Options of a page of a trained scene."""

    kind: Annotated[
        Literal["auto", "splats", "volume", "mesh", "views"],
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
    duration: Annotated[Seconds | None, option("SECONDS", DURATION_TEXT)] = None
    """Time that a capture of moving splats takes when it is played; longer is slower."""
    budget: Annotated[str, option("N", "auto: 1 M on phones, 3 M elsewhere")] = "auto"
    """Largest number of splats drawn, those that contribute most; a smaller one is faster and shows less detail."""
    stream: bool = False
    """Write splats as levels of detail in a folder beside the page, loaded over HTTP as the camera needs them."""


@dataclass(frozen=True)
class DepthOptions:
    """Options of depth maps by multi-view stereo."""

    size: Annotated[int, between(50, 4000), option("PIXELS")] = 400
    """Longer side of the depth maps, about; twice as large takes four times as long."""
    views: Annotated[Annotated[int, between(2, 100_000)] | None, option("N", "all")] = None
    """Number of photographs, spread evenly."""
    pair: Annotated[tuple[str, str] | None, option("A B", "none")] = None
    """Compare only these two photographs (names or numbers): rectification and semi-global matching, in a second."""
    downscale: DownscaleOption = None
    reader: ReaderOption = None


@dataclass(frozen=True)
class Photo3DOptions:
    """Options of a 3-D photograph."""

    size: Annotated[int, between(80, 1600), option("PIXELS")] = 320
    """Longer side of the depth maps, about; the texture has twice as many. Twice as large takes four times as long."""
    views: Annotated[int, between(2, 100), option("N")] = 8
    """Number of photographs at most, spread evenly."""
    title: Annotated[str | None, option("TEXT", "the folder's name")] = None
    """Title of the page."""
    downscale: DownscaleOption = None
    reader: ReaderOption = None
    origin: OriginOption = True


@dataclass(frozen=True)
class JumpOptions:
    """Options of a stereo panorama of a ring of cameras."""

    size: Annotated[int, between(128, 8192), option("PIXELS")] = 2048
    """Width of a panorama in pixels; the photographs should be about as sharp."""
    interpupillary: Annotated[Positive | None, option("LENGTH", "a quarter of the rig's diameter")] = None
    """Distance between the eyes, in units of the photographs' frame; smaller than the rig."""
    downscale: DownscaleOption = None
    reader: ReaderOption = None
