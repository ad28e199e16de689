"""Compositing of blocks: rendering a scene that is too large for one field.

Tancik et al. 2022 (Block-NeRF, arXiv 2202.05263), section 4.3: each block within reach of a camera and of sufficient
visibility (4.3.1) is rendered by itself, and the pictures are mixed by the camera's distance to each (4.3.2).
Clouds of Gaussians become one cloud: a block models badly what lies beyond its own ground, so each contributes only the
Gaussians in its own cell, and cells do not overlap (Lin 2024, VastGaussian, section 3.4; Liu 2024, CityGaussian,
section 3.3).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NoReturn

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..camera import Camera
from ..camera.rays import Rendering
from ..color.blending import over
from ..composition import Placed
from ..datasets.scene import Frame, Photograph
from ..errors import LumigraphError
from ..gaussians import Gaussians, joined
from ..method import Method
from ..method.capabilities import ColourPairs
from ..method.controls import Control, Value
from ..method.ray_method import POSE_RAYS
from .alignment import EXPOSURE, Asked, exposed
from .block_cache import Nearby
from .weights import PREVIEW_SIDE, UNSEEN_WEIGHT, Mixing, inverse_distance, saw, seeing, shares

MIN_WEIGHT = 1e-3  # share of a picture below which a block is not rendered: a quarter of a step of 8 bits
FULL_WEIGHT = 0.02  # share of a picture from which on a block counts fully where pixels are mixed one by one


class InBlocks(Method):
    """Several placed methods, each for a part of one large scene. For rendering only.

    frame:     the common frame of cameras, centres and radii
    parts:     one per block: its method, on its device, and the similarity from its own frame to the common one,
               `frame.to_source.inverse @ part_frame.to_source`. No part leads: cameras of the common frame belong to no
               block's photographs. `Nearby` opens them where a camera comes near
    radii:     distance from its centre within which a camera uses a block; a camera in reach of none uses the nearest
    exposures: of the capture's photographs, by their `image_index`, as in `Scene.about["exposure"]`, where known

    Blocks are rendered at one exposure, the median of their usual ones. The control `exposure` counts stops from there;
    the blocks' other controls, except those that name photographs, are passed on to all. With a Photograph as evidence
    each block in reach of its camera fits its own appearance to it.
    """

    any_lens = True
    centres: Tensor
    radii: Tensor

    def __init__(
        self,
        frame: Frame,
        parts: Sequence[Placed] | Nearby,
        centres: Float[Tensor, "block 3"],
        radii: Float[Tensor, " block"],
        mixing: Mixing | None = None,
        exposures: Float[Tensor, " photograph"] | None = None,
    ):
        super().__init__(frame, mixing or Mixing())
        if not len(parts) == len(centres) == len(radii) > 0:
            raise LumigraphError(f"{len(parts)} blocks need as many centres and radii, and at least one block")
        parts = Nearby.of(parts)
        self.asked = Asked.of(parts)
        self.usual = self.asked.usual
        self.poses = True if self.asked.refined else None
        self.register_buffer("centres", centres.float(), persistent=False)
        self.register_buffer("radii", radii.float(), persistent=False)
        self.exposures = exposures
        self.blocks = parts.each(partial(exposed, exposure=self.usual))
        self.eval()

    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        weights = self.weights(camera)
        chosen = (weights >= MIN_WEIGHT).nonzero()[:, 0]
        seen = [self.blocks[i].rendering(camera) for i in chosen.tolist()]
        if self.config.by in ("points", "visibility"):
            return mixed(seen, self._by_pixel(camera, chosen, weights[chosen], seen), self.frame)
        return mixed(seen, shares(weights[chosen]).expand(*seen[0].depth.shape, -1), self.frame)

    @torch.no_grad()
    def weights(self, camera: Camera) -> Float[Tensor, " block"]:
        """Weight of each block in a camera's picture, with sum 1; points or visibility have weights per pixel."""
        c = self.config
        distance = (camera.position.to(self.centres) - self.centres).norm(dim=-1)
        weights = inverse_distance(distance, self.radii, c.power, c.most)
        chosen = (weights > 0).nonzero()[:, 0]
        if len(chosen) > 1:
            small = camera.resized(min(1.0, PREVIEW_SIDE / int(camera.size.max())))
            sights = [saw(self.blocks[i], small, self.blocks[i].rendering(small)).mean() for i in chosen.tolist()]
            weights[chosen] *= seeing(torch.stack(sights), c.threshold)
        if c.by == "nearest":
            weights = nn.functional.one_hot(weights.argmax(), len(weights)).to(weights)
        return shares(weights)

    def colour_pairs(self, photograph: Photograph) -> ColourPairs:
        """Colours as a function of a photograph's pose at random trusted pixels, of blocks mixed by the camera's
        distance; see `RefinesPoses`."""
        weights = self.weights(photograph.camera.to(self.device))
        chosen = (weights >= MIN_WEIGHT).nonzero()[:, 0]
        parts, share = [self.blocks[i] for i in chosen.tolist()], shares(weights[chosen]).tolist()

        def pairs(poses: Any, generator: torch.Generator) -> tuple[Float[Tensor, "ray 3"], Float[Tensor, "ray 3"]]:
            batch = photograph.sample_rays(POSE_RAYS, generator).to(self.device)
            seen = [part.rendered_rays(poses(batch.rays)) for part in parts]
            rgb, opacity = (
                torch.stack([w * getattr(x, name) for w, x in zip(share, seen, strict=True)]).sum(0)
                for name in ("rgb", "opacity")
            )
            return over(rgb, opacity, self.background), batch.before(self.background)

        return pairs

    def _by_pixel(
        self, camera: Camera, chosen: Tensor, weights: Float[Tensor, " chosen"], seen: Sequence[Rendering]
    ) -> Float[Tensor, "height width chosen"]:
        """Weights per pixel: by the distance of the visible point from a block's centre, or by its visibility in the
        block; at most the block's weight in the picture."""
        c, entered = self.config, (weights / FULL_WEIGHT).clamp(max=1)
        if c.by == "visibility":
            found = [saw(self.blocks[i], camera, x) for i, x in zip(chosen.tolist(), seen, strict=True)]
            return shares(torch.stack(found, -1).clamp_min(UNSEEN_WEIGHT) * entered)
        rays = camera.rays(camera.pixels())
        far = 2 * self.frame.reach
        distances = [
            (rays.at(x.depth.reshape(-1).clamp(max=far)) - self.centres[i]).norm(dim=-1).view(x.depth.shape)
            for i, x in zip(chosen.tolist(), seen, strict=True)
        ]
        distance = torch.stack(distances, -1).clamp_min(UNSEEN_WEIGHT)
        return shares((distance / distance.amin(-1, keepdim=True)) ** -c.power * entered)

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per unit of the common frame: that of blocks in reach of the points, mixed by inverse distance.
        Raises LumigraphError for a block without density."""
        weights = self._at(points)
        density = torch.zeros_like(points[:, 0])
        for i in (weights > MIN_WEIGHT).any(0).nonzero()[:, 0].tolist():
            here = (weights[:, i] > MIN_WEIGHT).nonzero()[:, 0]
            density = density.index_add(0, here, weights[here, i] * self.blocks[i].density(points[here]))
        return density

    def _at(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point block"]:
        """Weights of blocks at points."""
        distance = (points[:, None] - self.centres).norm(dim=-1)
        return shares(inverse_distance(distance, self.radii, self.config.power, self.config.most))

    @property
    def accepts(self) -> tuple[type, ...]:  # type: ignore[override]  # it depends on the blocks
        return (Photograph,) if self.asked.photographs else ()

    @property
    def controls(self) -> tuple[Control, ...]:
        """Exposure, and the blocks' other controls that do not name photographs."""
        found = self.asked.controls
        if self.asked.exposures and self.usual is not None:
            least, most = (x - self.usual for x in self.asked.exposures)
            about = "As if photographed with so much more or less exposure than usual, within what was photographed."
            found = (*found, Control(EXPOSURE, 0.0, (least, most), unit="stops", about=about))
        return found

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Give controls to the blocks that have them, and a Photograph to each block in reach of its camera, which fits
        its appearance."""
        passed = {name: value for name, value in self.settings.items() if name != EXPOSURE and name in controls}
        parts = self.blocks.each(lambda part: part.with_controls(passed))
        if EXPOSURE in controls and self.usual is not None:
            parts = parts.each(partial(exposed, exposure=self.usual + float(self.settings[EXPOSURE])))
        for photograph in evidence:
            parts = self._seen_in(photograph, parts)
        self.blocks = parts

    def _seen_in(self, photograph: Photograph, parts: Nearby) -> Nearby:
        """Parts in the appearance and, if known, the exposure of a photograph, for those in reach of its camera."""
        camera, exposure = photograph.camera.to(self.device), None
        if self.exposures is not None and camera.image_index is not None:
            found = float(self.exposures[int(camera.image_index[0])].log2())
            exposure = found if abs(found) < float("inf") else None
        distance = (camera.position - self.centres).norm(dim=-1)
        asked = inverse_distance(distance, self.radii, self.config.power, self.config.most) > 0
        lit = {}
        for i in asked.nonzero()[:, 0].tolist():
            part = exposed(parts[i], exposure)
            local = replace(photograph, camera=part.camera(photograph.camera))
            lit[i] = replace(part, method=part.method.given(local))
        return parts.but(lit)

    def batch(self, data: Any, generator: torch.Generator) -> NoReturn:
        raise LumigraphError("A scene in blocks does not learn as a whole; train its blocks, each by itself")


def mixed(seen: Sequence[Rendering], weights: Float[Tensor, "height width block"], frame: Frame) -> Rendering:
    """Mix pictures over black by weights per pixel, and composite them over a frame's background.

    Depth is the mean over opaque ones, by the same weights; infinity where most are empty.
    """
    rgb, opacity, depth = (torch.stack([getattr(x, name) for x in seen], -1) for name in ("rgb", "opacity", "depth"))
    rgb, opacity = (rgb * weights[..., None, :]).sum(-1), (opacity * weights).sum(-1)
    there = depth.isfinite() * weights
    held = there.sum(-1)
    distance = (there * depth.nan_to_num(posinf=0.0)).sum(-1) / held.clamp_min(1e-6)
    background = rgb.new_tensor(frame.background)
    return Rendering(rgb + (1 - opacity)[..., None] * background, torch.where(held > 0.5, distance, torch.inf), opacity)


@torch.no_grad()
def merged(parts: Sequence[Placed], centres: Float[Tensor, "block 3"] | None = None) -> Gaussians:
    """One cloud in the parts' common frame: the Gaussians of each part whose centres lie in its cell.

    parts:   one for each block, its method a cloud; a part's crop, in the part's own frame, applies besides its cell
    centres: of the blocks, in the order of the parts, in the common frame; a part's cell is its Voronoi cell, unbounded
             for the outermost blocks, so that the sky is kept once as well. None where the parts' crops are the cells
    Cells are vertical where all centres have the same height. Harmonics, and the meaning of opacities, as in `joined`.
    Raises LumigraphError for different numbers of parts and centres, for no part, and for a part that is no cloud.
    """
    if not parts or (centres is not None and len(centres) != len(parts)):
        raise LumigraphError(
            f"{len(parts)} blocks of splats and {0 if centres is None else len(centres)} centres do not go together; "
            "give each block its centre"
        )
    clouds = [part.gaussians() for part in parts]
    if centres is not None:
        clouds = [cloud[nearest(cloud.means, centres) == i] for i, cloud in enumerate(clouds)]
    return joined(clouds)


def nearest(points: Float[Tensor, "point 3"], centres: Float[Tensor, "block 3"]) -> Int[Tensor, " point"]:
    """Number of the centre nearest to each point, the first of equals."""
    best = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    least = torch.full((len(points),), torch.inf, dtype=torch.float64, device=points.device)
    for i, centre in enumerate(centres.to(points.device).double()):
        squared = (points - centre).square().sum(-1)
        best = torch.where(squared < least, i, best)
        least = torch.minimum(squared, least)
    return best
