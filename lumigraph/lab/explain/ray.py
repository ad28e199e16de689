"""One ray: samples of a method along it, and the composition of the pixel's colour."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...camera import Camera
from ...camera.rays import Look
from ...errors import LumigraphError
from ...method import Method
from ...method.capabilities import HasLooks, needs
from ...volume import composite, weights_of

MIN_WEIGHT = 1e-3  # weight from which on a sample shows in a picture of 256 levels
INSET_PIXELS = 400  # pixels of the small picture's longer side, at most


@dataclass(frozen=True)
class RayPass:
    """One pass along the ray, in the notation of Mildenhall 2020, eq. 3.

    start, end:    of each sample, in scene units from the camera
    density:       sigma_i, per scene unit
    rgb:           c_i, sRGB-encoded
    weight:        w_i = T_i (1 - exp(-sigma_i delta_i))
    transmittance: T_i in front of each sample, and behind the last
    so_far:        sum_{j<i} w_j c_j + T_i background: the colour if the ray ended in front of each sample; and behind
                   the last, the pixel's own
    """

    name: str
    start: Float[Tensor, " sample"]
    end: Float[Tensor, " sample"]
    density: Float[Tensor, " sample"]
    rgb: Float[Tensor, "sample 3"]
    weight: Float[Tensor, " sample"]
    transmittance: Float[Tensor, " sample_plus_one"]
    so_far: Float[Tensor, "sample_plus_one 3"]

    @staticmethod
    def of(look: Look, background: Float[Tensor, "1 3"]) -> RayPass:
        tau, weight = look.density * look.samples.length, weights_of(look.samples, look.density)
        T = torch.exp(-torch.nn.functional.pad(tau.cumsum(0), (1, 0)))
        colour = torch.nn.functional.pad((weight[:, None] * look.rgb).cumsum(0), (0, 0, 1, 0))
        columns = look.samples.t_start, look.samples.t_end, look.density, look.rgb, weight, T
        return RayPass(look.name, *(x.cpu() for x in (*columns, colour + T[:, None] * background)))

    def __len__(self) -> int:
        return len(self.weight)

    def to_json(self) -> dict[str, Any]:
        names = ("start", "end", "density", "rgb", "weight", "transmittance", "so_far")
        return {"name": self.name, **{name: getattr(self, name).tolist() for name in names}}


@dataclass(frozen=True)
class Sight:
    """A pixel (column, row) of a picture, and all passes along its ray.

    passes:     the composited one last
    rgb:        of the pixel, over the background
    depth:      expected distance, in scene units; infinity for an empty ray
    opacity:    accumulated opacity
    picture:    the camera's small picture
    photograph: the photograph's colour at the pixel, if known
    """

    camera: Camera
    pixel: tuple[int, int]
    passes: list[RayPass]
    rgb: Float[Tensor, " 3"]
    depth: float
    opacity: float
    picture: Float[Tensor, "height width 3"]
    photograph: Float[Tensor, " 3"] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole picture."""
        width, height = self.camera.size[0].tolist()
        return width, height

    def beside(self, photograph: Float[Tensor, "height width 3"]) -> Sight:
        """The same with the photograph's colour at the pixel."""
        return replace(self, photograph=photograph[self.pixel[1], self.pixel[0]])

    def rows(self) -> dict[str, str]:
        """Figures for the text, by name."""
        last, counts = self.passes[-1], ", ".join(f"{len(each)} {each.name}" for each in self.passes)
        found = {"pixel": triple(self.rgb)}
        if self.photograph is not None:
            found["photograph"] = triple(self.photograph)
        return found | {
            "opacity": f"{self.opacity:.4f}",
            "depth": f"{self.depth:.4g} scene units, expected" if self.depth < float("inf") else "none",
            "samples": f"{counts}; {int((last.weight > MIN_WEIGHT).sum())} with a weight above {MIN_WEIGHT:g}",
        }

    def to_json(self) -> dict[str, Any]:
        return {
            "pixel": self.pixel,
            "size": self.size,
            "rgb": self.rgb.tolist(),
            "photograph": None if self.photograph is None else self.photograph.tolist(),
            "depth": self.depth if self.depth < float("inf") else None,
            "opacity": self.opacity,
            "passes": [each.to_json() for each in self.passes],
        }


def triple(rgb: Float[Tensor, " 3"]) -> str:
    return " ".join(f"{value:.3f}" for value in rgb.tolist())


@torch.no_grad()
def along_ray(method: Method, camera: Camera, pixel: tuple[int, int]) -> Sight:
    """Samples and passes of a method in eval mode along the ray through the middle of a pixel (column, row).

    Raises LumigraphError if the method does not march along rays, the pixel lies outside the picture, or there are no
    samples on its ray.
    """
    width, height = camera.size[0].tolist()
    x, y = pixel
    if not (0 <= x < width and 0 <= y < height):
        last = f"{width - 1} {height - 1}"
        raise LumigraphError(f"Pixel ({x}, {y}) lies outside of the picture; give --pixel from 0 0 to {last}")
    rays = camera.rays(torch.tensor([[x + 0.5, y + 0.5]])).to(method.device)
    looks = needs(method, HasLooks).looks(rays)
    last = looks[-1]
    if not len(last.samples):
        raise LumigraphError(
            f"No sample is taken along the ray of pixel ({x}, {y}), so there is only background to see; "
            f"choose another --pixel"
        )
    seen = composite(last.samples, last.density, last.rgb, method.background)
    return Sight(
        camera,
        pixel,
        [RayPass.of(look, method.background) for look in looks if len(look.samples)],
        seen.rgb[0].cpu(),
        float(seen.depth),
        float(seen.opacity),
        method.render(camera.resized(min(1.0, INSET_PIXELS / max(width, height)))).rgb.cpu(),
    )
