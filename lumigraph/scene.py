"""Scene: photographs, where they were taken from, and what is known of the space between them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from .camera import Camera
from .images import ImageStore
from .plain import from_plain
from .rays import Rays

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Forward:
    """How a capture looks one way: the mean of its cameras, before a plane that they look through.

    pose:  camera-to-world of the mean camera, in scene units
    scale: of x / z and y / z in that camera, bringing all that the cameras see within [-1, 1]
    near:  distance of that plane from the mean camera; what is to be modelled lies beyond
    """

    pose: tuple[tuple[float, float, float, float], ...]
    scale: tuple[float, float]
    near: float


@dataclass(frozen=True)
class Frame:
    """Where a scene is, in plain numbers; all that a method must know to be built, with or without photographs.

    bounds:      two corners of the box of interest, inside [-1, 1]^3
    reach:       half-size of the cube around the origin that holds everything to be modelled: 1 for an object, a power
                 of two up to 64 for a room or an unbounded capture
    near:        distance from a camera at which its rays may begin; nothing is nearer
    background:  colour behind everything
    has_alpha:   whether the photographs say how opaque each pixel is
    image_count: photographs in the scene, held-out ones included
    source_from_scene: the similarity x_source = M x_scene back to the frame that the capture came in, so that exports
                 line up with it
    forward:     of a capture without bounds whose cameras all look one way; None for any other
    """

    bounds: tuple[Vector, Vector] = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    reach: float = 1.0
    near: float = 0.05
    background: Vector = (0.0, 0.0, 0.0)
    has_alpha: bool = False
    image_count: int = 0
    source_from_scene: tuple[tuple[float, float, float, float], ...] = (
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.0, 0.0, 0.0, 1.0),
    )
    forward: Forward | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain numbers and lists; `from_json` turns them back exactly."""
        return asdict(self)

    @staticmethod
    def from_json(data: dict[str, Any]) -> Frame:
        return from_plain(Frame, data)


@dataclass(frozen=True)
class Batch:
    """Rays, and what the photographs say they saw.

    rgb:   sRGB-encoded, not multiplied by alpha
    alpha: opacity, where the photographs have it
    """

    rays: Rays
    rgb: Float[Tensor, "ray 3"]
    alpha: Float[Tensor, " ray"] | None = None

    def __len__(self) -> int:
        return len(self.rgb)

    def before(self, background: Float[Tensor, "#ray 3"]) -> Float[Tensor, "ray 3"]:
        """The colours with a background behind what is not opaque."""
        return self.rgb if self.alpha is None else background + self.alpha[:, None] * (self.rgb - background)

    def to(self, device: torch.device | str) -> Batch:
        alpha = None if self.alpha is None else self.alpha.to(device)
        return Batch(self.rays.to(device), self.rgb.to(device), alpha)


@dataclass(frozen=True)
class Photograph:
    """One whole photograph, and what took it.

    rgb:   sRGB-encoded, not multiplied by alpha
    alpha: opacity, where the photographs have it
    mask:  which pixels are to be trusted; None for all
    """

    camera: Camera
    rgb: Float[Tensor, "height width 3"]
    alpha: Float[Tensor, "height width"] | None = None
    mask: Bool[Tensor, "height width"] | None = None

    def __len__(self) -> int:
        """Pixels."""
        return self.rgb.shape[0] * self.rgb.shape[1]

    def to(self, device: torch.device | str) -> Photograph:
        rgb, alpha, mask = (None if x is None else x.to(device) for x in (self.rgb, self.alpha, self.mask))
        assert rgb is not None
        return Photograph(self.camera.to(device), rgb, alpha, mask)

    def reduced(self, factor: int) -> Photograph:
        """A whole number of times smaller: means over squares of pixels. What does not fill a square is left out."""
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
        lens = self.camera.lens.resized(torch.full((1, 2), 1 / factor, device=self.rgb.device))
        size = self.camera.size.new_tensor([[width // factor, height // factor]])
        return Photograph(replace(self.camera, lens=lens, size=size), rgb, alpha, mask)


@dataclass(frozen=True)
class Scene:
    """Image i was taken by camera i and is called names[i].

    cameras: in the scene's frame; image_index counts them
    frame:   bounds, reach, background, and the way back to the source's frame
    splits:  image numbers by purpose: "train", "test", maybe "val"
    points:  sparse points in the scene's frame, where structure from motion gave some
    source:  the folder it came from, or "procedural:<name>"
    warnings: what the user should know about the capture, one sentence each
    """

    cameras: Camera
    images: ImageStore
    frame: Frame
    splits: dict[str, Int[Tensor, " image"]]
    names: list[str]
    source: str = ""
    points: Float[Tensor, "point 3"] | None = None
    point_colours: UInt8[Tensor, "point 3"] | None = None
    warnings: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.names)

    def sample_rays(self, count: int, generator: torch.Generator, split: str = "train") -> Batch:
        """Random pixels of random photographs: photographs evenly, then their trusted pixels evenly."""
        drawn = self.images.draw(count, self.splits[split], generator)
        rays = self.cameras.rays(drawn.xy, drawn.image)
        rgb = drawn.rgba[:, :3].float().div_(255)
        alpha = drawn.rgba[:, 3].float().div_(255) if self.images.has_alpha else None
        return Batch(rays, rgb, alpha)

    def photograph(self, index: int) -> Photograph:
        """One photograph with all that is known of it."""
        camera, image = self.view(index)
        alpha = image[..., 3] if image.shape[-1] == 4 else None
        return Photograph(camera, image[..., :3].contiguous(), alpha, self.images.mask(index))

    def view(self, index: int) -> tuple[Camera, Float[Tensor, "height width channel"]]:
        """One photograph and its camera: sRGB-encoded in [0, 1], a fourth channel where the photographs have alpha."""
        return self.cameras[index], self.images[index].div(255)
