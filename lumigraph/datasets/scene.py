"""Scene: photographs, their cameras, and the geometry known of the scene."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rays
from ..color.blending import before
from ..errors import LumigraphError
from ..figures import png
from ..files.ranges import Coordinate, Point, Row, Share, between, typed
from ..geometry import Similarity, evenly, is_similarity
from ..geometry import Vector as Vector
from .images import UNKNOWN_INDEX, ImageStore, Layer, cosines, resized
from .skeleton import Skeleton
from .tracks import BoxTrack

# How values of a layer are reduced, by its name (see `resized`); all others are picked, not averaged.
AVERAGED = {
    "colours": "sRGB",
    "raw": "linear",
    "albedo": "linear",
    "radiance": "linear",
    "mosaic": "mosaic",
    "filter": "filter",
    "flow": "pixels",
}


SHOWN_PIXELS = 200  # about, along the longer side of photographs in a notebook
Size = Annotated[float, between(1e-9, 1e9)]  # scene units


@dataclass(frozen=True)
class Forward:
    """Geometry of a forward-facing capture: its mean camera, and the near plane in front of it.

    pose:  camera-to-world of the mean camera, in scene units
    scale: factor on x / z and y / z in that camera that brings everything visible within [-1, 1]
    near:  distance of the near plane from the mean camera
    """

    pose: tuple[Row, ...]
    scale: tuple[Size, Size]
    near: Size


@dataclass(frozen=True)
class GeographicOrigin:
    """Position on Earth (WGS 84) of the origin of a frame whose axes point east, north and up, in metres.

    latitude, longitude: degrees; altitude: metres above the ellipsoid
    """

    latitude: Annotated[float, between(-90, 90)]
    longitude: Annotated[float, between(-180, 180)]
    altitude: Annotated[float, between(-1e5, 1e5)]

    @property
    def sentence(self) -> str:
        """The reference system, for comments in files."""
        return (
            f"metres east, north and up of latitude {self.latitude:.8f}, longitude {self.longitude:.8f}, "
            f"altitude {self.altitude:.2f} m (WGS 84)"
        )

    def to_json(self) -> dict[str, float]:
        return asdict(self)


@dataclass(frozen=True)
class Frame:
    """Bounds and frame of a scene, in plain numbers: sufficient to build a method, with or without photographs.

    bounds:      two corners of the box of interest, inside [-1, 1]^3
    reach:       half-size of the cube around the origin that contains the whole model: 1 for an object, a power of two
                 up to 64 for a room or an unbounded capture
    near:        near distance of rays; the space in front is empty
    background:  background colour
    has_alpha:   whether the photographs have alpha
    image_count: photographs in the scene, held-out ones included
    source_from_scene: similarity x_source = M x_scene to the capture's own frame, so that exports line up with it
    forward:     of an unbounded forward-facing capture; None for any other
    times:       first and last time of a capture with times, in its own unit; None for any other, and for a single time
    scale:       units of exports per unit of the capture's frame, by a length that the user knows
    origin:      of the capture's frame on Earth, if its photographs' GPS has determined it
    train_count: number of training photographs; 0 if unknown
    tracks:      boxes of moving rigid objects, in the scene's frame
    skeleton:    bones of a character at all times, in the scene's frame
    world_from_source: similarity from the capture's frame to that of control points, if there are any
    metric:      whether a unit of the capture's frame is a metre, as of depth cameras
    """

    bounds: tuple[Point, Point] = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    reach: Size = 1.0
    near: Size = 0.05
    background: tuple[Share, Share, Share] = (0.0, 0.0, 0.0)
    has_alpha: bool = False
    image_count: Annotated[int, between(0, 10**6)] = 0
    source_from_scene: tuple[Row, ...] = Similarity.make(1.0).rows
    forward: Forward | None = None
    times: tuple[Coordinate, Coordinate] | None = None
    scale: Size = 1.0
    origin: GeographicOrigin | None = None
    train_count: Annotated[int, between(0, 10**6)] = 0
    tracks: tuple[BoxTrack, ...] = ()
    skeleton: Skeleton | None = None
    world_from_source: tuple[Row, ...] | None = None
    metric: bool = False

    @property
    def in_metres(self) -> bool:
        """True where a length is known, so that exports are in metres: by the sensor, GPS, control points, or the
        user's length, which is taken to be in metres."""
        known = self.metric or self.origin is not None or self.world_from_source is not None
        return known or self.scale != 1.0

    @property
    def is_open(self) -> bool:
        """True for an unbounded scene: a room or outdoors, not an object."""
        return self.reach > 1

    @property
    def to_source(self) -> Similarity:
        """Similarity to the capture's own frame."""
        return Similarity.of(self.source_from_scene)

    @property
    def to_export(self) -> Similarity:
        """Similarity to the frame of exports: of control points, or of the capture in the unit of a known length."""
        world = Similarity.make(self.scale) if self.world_from_source is None else Similarity.of(self.world_from_source)
        return world @ self.to_source

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and lists, the exact inverse of `from_json`."""
        return asdict(self)

    @staticmethod
    def from_json(data: Any, where: Path | str = "a frame") -> Frame:
        """Read a run's frame. Raises LumigraphError, naming `where`, for an invalid one."""
        frame = typed(Frame, data, where, closed=True)
        low, high = frame.bounds
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise LumigraphError(f"{where}: bounds from {low} to {high} hold nothing; correct them")
        rows = [frame.source_from_scene, *([frame.world_from_source] if frame.world_from_source else [])]
        if not all(is_similarity(torch.tensor(one, dtype=torch.float64)) for one in rows):
            raise LumigraphError(f"{where}: source_from_scene does more than move, turn and scale; correct it")
        if frame.forward is not None and len(frame.forward.pose) != 3:
            raise LumigraphError(f"{where}: forward.pose should be 3 rows of 4 numbers; correct it")
        return frame


@dataclass(frozen=True)
class Batch:
    """Rays with the photographs' colours along them.

    rgb:   sRGB-encoded, not premultiplied
    alpha: opacity, for photographs with alpha
    extra: values of requested layers by name; see `Layer.decoded`
    """

    unit: ClassVar[str] = "rays"

    rays: Rays
    rgb: Float[Tensor, "ray 3"]
    alpha: Float[Tensor, " ray"] | None = None
    extra: dict[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rgb)

    def before(self, background: Float[Tensor, "#ray 3"]) -> Float[Tensor, "ray 3"]:
        """The colours composited over a background."""
        return before(self.rgb, self.alpha, background)

    def to(self, device: torch.device | str) -> Batch:
        alpha = None if self.alpha is None else self.alpha.to(device)
        extra = {name: values.to(device) for name, values in self.extra.items()}
        return Batch(self.rays.to(device), self.rgb.to(device), alpha, extra)


@dataclass(frozen=True)
class Photograph:
    """One whole photograph with its camera.

    rgb:   sRGB-encoded, not premultiplied
    alpha: opacity, for photographs with alpha
    mask:  trusted pixels; None for all
    extra: values of requested layers by name; see `Layer.decoded`
    """

    unit: ClassVar[str] = "rays"  # one through each pixel

    camera: Camera
    rgb: Float[Tensor, "height width 3"]
    alpha: Float[Tensor, "height width"] | None = None
    mask: Bool[Tensor, "height width"] | None = None
    extra: dict[str, Tensor] = field(default_factory=dict)

    def __len__(self) -> int:
        """Pixels."""
        return self.rgb.shape[0] * self.rgb.shape[1]

    def before(self, background: Float[Tensor, " 3"] | Vector) -> Float[Tensor, "height width 3"]:
        """The colours composited over a background."""
        return before(self.rgb, self.alpha, background)

    def trusted(self, picture: Float[Tensor, "height width 3"]) -> Float[Tensor, "pixel 3"]:
        """Colours of a picture of the same size at trusted pixels."""
        return picture.flatten(0, 1) if self.mask is None else picture[self.mask]

    def sample_rays(self, count: int, generator: torch.Generator) -> Batch:
        """Random trusted pixels, without repetition; all where there are fewer; maybe none."""
        trusted = torch.ones(len(self), dtype=torch.bool) if self.mask is None else self.mask.flatten()
        there = trusted.nonzero()[:, 0]
        chosen = there[torch.randperm(len(there), generator=generator)[:count]]
        rays = self.camera.rays(self.camera.pixels()[chosen])
        alpha = None if self.alpha is None else self.alpha.flatten()[chosen]
        return Batch(rays, self.rgb.flatten(0, 1)[chosen], alpha)

    def to(self, device: torch.device | str) -> Photograph:
        rgb, alpha, mask = (None if x is None else x.to(device) for x in (self.rgb, self.alpha, self.mask))
        assert rgb is not None
        extra = {name: values.to(device) for name, values in self.extra.items()}
        return Photograph(self.camera.to(device), rgb, alpha, mask, extra)

    def reduced(self, factor: int) -> Photograph:
        """The photograph a whole number of times smaller: means over squares of pixels; incomplete squares are cropped.

        Layers of light are averaged too; of depth, labels and all else the nearest is taken (see `resized`).
        """
        if factor == 1:
            return self
        height, width = (n // factor * factor for n in self.rgb.shape[:2])

        def mean(x: Tensor) -> Tensor:
            x = x[:height, :width]
            return x.reshape(height // factor, factor, width // factor, factor, *x.shape[2:]).mean((1, 3))

        rgb, alpha, mask = self.rgb, self.alpha, self.mask
        if alpha is not None:  # colours count as much as they cover
            covered = mean(alpha)
            rgb = mean(rgb * alpha[..., None]) / covered.clamp_min(1e-6)[..., None]
            alpha = covered
        else:
            rgb = mean(rgb)
        mask = None if mask is None else mean(mask.float()) == 1
        extra = {
            name: smaller(values[:height, :width], factor, AVERAGED.get(name, "plain"))
            for name, values in self.extra.items()
        }
        return Photograph(self.camera.reduced(factor), rgb, alpha, mask, extra)


def smaller(values: Shaped[Tensor, "height width *channels"], factor: int, encoding: str) -> Tensor:
    """Decoded values of a layer, a whole number of times smaller; see `resized`."""
    height, width = values.shape[:2]
    stored = values.cpu().numpy()
    per_pixel = stored.reshape(height, width, -1)
    known = ~np.isnan(per_pixel).any(-1) if values.is_floating_point() else (per_pixel != UNKNOWN_INDEX).any(-1)
    return torch.from_numpy(resized(stored, (width // factor, height // factor), encoding, known)).to(values.device)


@dataclass(frozen=True)
class Scene:
    """Photographs with cameras; image i is names[i], taken by camera i.

    cameras: in the scene's frame; image_index counts them
    frame:   bounds, reach, background, and the similarity to the source's frame
    splits:  image numbers by purpose: "train", "test", maybe "val"
    points:  sparse points in the scene's frame, from structure from motion if any
    source:  the folder it came from, or "procedural:<name>"
    warnings: about the capture, for the user, one sentence each
    layers:  other per-pixel values by name: depth, labels ...; read on use
    about:   other values per photograph by name: exposure, boxes ...; the first axis is the image
    full_sizes: width and height of the photographs' files before downscaling
    digests: size and hash of each photograph's file, "" without a file
    options: of the source: downscale, reader, views, scales
    """

    kind: ClassVar[str] = "photographs"

    cameras: Camera
    images: ImageStore
    frame: Frame
    splits: dict[str, Int[Tensor, " image"]]
    names: list[str]
    source: str = ""
    points: Float[Tensor, "point 3"] | None = None
    point_colours: UInt8[Tensor, "point 3"] | None = None
    warnings: list[str] = field(default_factory=list)
    layers: dict[str, Layer] = field(default_factory=dict)
    about: dict[str, Tensor] = field(default_factory=dict)
    full_sizes: Int[Tensor, "photograph 2"] | None = None
    digests: list[str] = field(default_factory=list)
    options: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def find(self, name: str) -> int:
        """Number of a photograph by its name, with or without its folder and ending, or by that number as text.

        Raises LumigraphError if there is none, or several.
        """
        paths = [Path(x) for x in self.names]
        for names in (self.names, [x.name for x in paths], [x.stem for x in paths], list(map(str, range(len(self))))):
            if names.count(name) == 1:
                return names.index(name)
        shown = ", ".join([*self.names[:4], "..."] if len(self) > 4 else self.names)
        raise LumigraphError(f"{self.source} has no photograph {name!r}; there are {shown}, from 0 to {len(self) - 1}")

    def __repr__(self) -> str:
        """Five lines: photographs, their sizes, the frame, what else is known, the source."""
        sizes = sorted({(int(w), int(h)) for w, h in self.cameras.size.tolist()}, reverse=True)
        counts = ", ".join(f"{len(index)} {split}" for split, index in self.splits.items())
        low, high = ([round(x, 3) for x in corner] for corner in self.frame.bounds)
        further = [*self.layers, *self.about, *([] if self.points is None else [f"{len(self.points):,} points"])]
        more = f" to {sizes[-1][0]}x{sizes[-1][1]}" if len(sizes) > 1 else ""
        return (
            f"Scene of {len(self)} photographs: {counts}\n"
            f"  size    {sizes[0][0]}x{sizes[0][1]}{more} pixels, {type(self.cameras.lens).__name__} lens\n"
            f"  frame   {low} to {high}, reach {self.frame.reach:g}, near {self.frame.near:.3g}\n"
            f"  also    {', '.join(further) or 'nothing else'}\n"
            f"  source  {self.source or 'none'}"
        )

    def _repr_html_(self) -> str:
        """Some photographs in a row, and the text."""
        factors = {i: max(1, int(self.cameras.size[i].max()) // SHOWN_PIXELS) for i in evenly(range(len(self)), 4)}
        some = (self.photograph(i).reduced(factor).before(torch.ones(3)) for i, factor in factors.items())
        pictures = (base64.b64encode(png(rgb)).decode() for rgb in some)
        row = "".join(f'<img src="data:image/png;base64,{one}" style="margin-right: 4px">' for one in pictures)
        return f"{row}<pre>{html.escape(repr(self))}</pre>"

    def pixels(self, split: str) -> int:
        """Number of pixels for training or comparison."""
        return int(self.images.trusted_pixels[self.splits[split]].sum())

    def layer(self, name: str) -> Layer:
        """Layer by name. Raises LumigraphError, naming the existing ones, if there is none."""
        if name not in self.layers:
            there = f", only {', '.join(self.layers)}" if self.layers else ""
            raise LumigraphError(f"{self.source} has no {name} beside its photographs{there}; add it, or do without")
        return self.layers[name]

    def sample_rays(
        self,
        count: int,
        generator: torch.Generator,
        split: str = "train",
        layers: Sequence[str] = (),
        places: bool = False,
    ) -> Batch:
        """Random pixels: photographs uniformly, then their trusted pixels uniformly.

        layers: names of layers to return in `Batch.extra`. Raises LumigraphError for an unknown one
        places: also return positions in the pictures, as shares of width and height, in `extra["place"]`
        """
        chosen = self.splits[split]
        drawn = self.images.draw(count, chosen, generator, positions=bool(layers))
        rays = self.cameras.rays(drawn.xy, drawn.image)
        rgb = drawn.rgba[:, :3].float().div_(255)
        alpha = drawn.rgba[:, 3].float().div_(255) if self.images.has_alpha else None
        extra = {"place": drawn.xy / self.cameras.size[drawn.image]} if places else {}
        for name in layers:
            layer = self.layer(name)
            assert drawn.position is not None
            cosine = partial(cosines, rays.directions, self.cameras.forward[drawn.image])
            extra[name] = layer.decoded(layer.gathered(drawn.position, chosen), cosine)
        return Batch(rays, rgb, alpha, extra)

    def preview(self) -> Camera:
        """Camera of the first held-out photograph, else of the first one."""
        held_out = self.splits.get("test")
        return self.cameras[int((held_out if held_out is not None and len(held_out) else self.splits["train"])[0])]

    def photograph(self, index: int, layers: Sequence[str] = ()) -> Photograph:
        """One photograph with its camera and the named layers. Raises LumigraphError as `layer` does."""
        camera, image = self.cameras[index], self.images[index].div(255)
        alpha = image[..., 3] if image.shape[-1] == 4 else None

        def cosine() -> Tensor:
            directions = camera.rays(camera.pixels()).directions
            return cosines(directions, camera.forward).view(image.shape[:2])

        extra = {name: self.layer(name).decoded(self.layer(name).stored(index), cosine) for name in layers}
        return Photograph(camera, image[..., :3].contiguous(), alpha, self.images.mask(index), extra)
