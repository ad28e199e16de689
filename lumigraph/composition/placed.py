"""Placed: a method at a pose, cropped by a box or a sphere; and the common frame of several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..camera import Camera
from ..camera.crop import Crop, CropBox
from ..camera.rays import Look, Rays, Rendering, Samples
from ..datasets.scene import Frame
from ..gaussians import Gaussians
from ..gaussians.cloud import cleaned
from ..geometry import Similarity
from ..method import Method
from ..method.capabilities import HasDensity, HasGaussians, HasLooks, RendersRays, needs
from ..method.controls import Value

MAX_REACH = 64.0


@dataclass(frozen=True)
class Placed:
    """One part of a picture.

    place:  from the frame of the method to that of the picture
    crop:   visible part in the method's own frame; None for all
    leads:  whether the picture's cameras are this part's: then `Frame.near` applies to them, and so do its learnt
            values of each photograph. Cameras may come arbitrarily close to any other part
    """

    method: Method
    place: Similarity
    crop: Crop | None = None
    leads: bool = False

    def look(self, rays: Rays) -> Look:
        """The last look of a method that marches: distances and density per unit of the picture, clipped to the crop.

        A ray of a part that does not lead begins `Frame.near` behind the eye, since the method samples nothing nearer.
        """
        scale, behind = self.place.scale, 0.0 if self.leads else self.method.frame.near
        local = self._inward(rays, behind)
        found = needs(self.method, HasLooks).looks(local)[-1]
        begin, end = found.samples.t_start, found.samples.t_end
        if self.crop is not None:
            ray = found.samples.ray_index
            enter, leave = self.crop.through(local)
            begin, end = torch.maximum(begin, enter[ray]), torch.minimum(end, leave[ray])
        keep, rgb = begin < end, found.rgb
        if self.crop is not None and not self.crop.convex:
            points, _ = Samples(begin, end, found.samples.ray_starts).along(local)
            keep, rgb = keep & self.crop.holds(points), self.crop.coloured(points, rgb)
        begin, end = ((t - behind).clamp_min(0) * scale for t in (begin, end))
        keep = keep & (begin < end)
        samples = Samples(begin, end, found.samples.ray_starts).keep(keep)
        return Look(found.name, samples, found.density[keep] / scale, rgb[keep])

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per unit of the picture, at points of the picture's frame."""
        local = self.place.inverse.points(points)
        return needs(self.method, HasDensity).density(local) / self.place.scale * self._holds(local)

    def gaussians(self) -> Gaussians:
        """The cloud in the picture's frame, without Gaussians whose centres are outside the crop."""
        return cleaned(needs(self.method, HasGaussians).gaussians(), self.crop).transformed(self.place.matrix)

    def rendering(self, camera: Camera) -> Rendering:
        """Rendering of any method by a camera of the picture, over black. A crop removes pixels by their depth."""
        local = self.camera(camera)
        seen = self.method.render(local)
        background = torch.tensor(self.method.frame.background, device=seen.rgb.device)
        rgb = seen.rgb - (1 - seen.opacity)[..., None] * background
        rays = local.rays(local.pixels()).to(seen.depth.device)
        there = rays.at(seen.depth.reshape(-1).nan_to_num(0, 0, 0))
        opacity = seen.opacity * self._holds(there).view(seen.opacity.shape)
        return Rendering(rgb, seen.depth * self.place.scale, opacity)

    def rendered_rays(self, rays: Rays) -> Rendering:
        """Rendering of rays of the picture by a RayMethod, over black and without its crop."""
        background = torch.zeros(1, 3, device=rays.origins.device)
        seen = needs(self.method, RendersRays).render_rays(self._inward(rays, 0.0), background)
        return replace(seen, depth=seen.depth * self.place.scale)

    def with_controls(self, controls: dict[str, Value]) -> Placed:
        """The same part with the values of controls that its method has."""
        mine = {x.name for x in self.method.controls if self.leads or not x.of_photographs} & controls.keys()
        return replace(self, method=self.method.given(**{name: controls[name] for name in mine})) if mine else self

    def refined(self, cameras: Camera) -> Camera:
        """Cameras of the picture with the method's pose refinement."""
        there = cameras.transformed(self.place.inverse.matrix)
        known = self.method.refined(there)
        return cameras if known is there else known.transformed(self.place.matrix)

    def _inward(self, rays: Rays, behind: float) -> Rays:
        """Rays in the method's frame, beginning a distance behind their origins."""
        back = self.place.inverse
        directions = back.directions(rays.directions)
        origins = back.points(rays.origins) - behind * directions
        index = rays.image_index if self.leads else None
        return replace(rays, origins=origins, directions=directions, image_index=index)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the picture in the frame of the method."""
        moved = camera.transformed(self.place.inverse.matrix)
        return moved if self.leads else replace(moved, image_index=None)

    def _holds(self, points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"]:
        """Mask of points of the method's frame inside the crop; all without one."""
        if self.crop is None:
            return torch.ones(len(points), dtype=torch.bool, device=points.device)
        return self.crop.holds(points)


def standing(
    part: Frame, lead: Frame, at: Float[Tensor, " 3"] | None = None, scale: float = 1.0, turn: float = 0.0
) -> Similarity:
    """Similarity of an upright part in the lead's scene, from the part's source to the lead's.

    at:    position of the part's foot, the centre of its box of interest's lower side, in the lead's source; None for
           the lead's own foot
    scale: units of the lead's source to one of the part's
    turn:  degrees about the vertical, counterclockwise seen from above
    """
    here, there = part.to_source, lead.to_source
    angle = math.radians(turn)
    cosine, sine = math.cos(angle), math.sin(angle)
    turned = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    rotation = there.rotation @ turned @ here.rotation.T
    goal = there.points(foot(lead)) if at is None else at.double()
    return Similarity.make(scale, rotation, goal - scale * rotation @ here.points(foot(part)))


def foot(frame: Frame) -> Float[Tensor, " 3"]:
    """The middle of the lower side of a frame's box of interest, in the scene's frame."""
    lower, upper = torch.tensor(frame.bounds, dtype=torch.float64)
    x, y, _ = (0.5 * (lower + upper)).tolist()
    return torch.tensor([x, y, float(lower[2])], dtype=torch.float64)


def frame_around(lead: Frame, others: Sequence[tuple[Frame, Similarity, CropBox | None]]) -> Frame:
    """The lead's frame, with bounds and reach extended to other parts: their frames, places in it, and boxes.

    Its box of interest may then be larger than [-1, 1]^3, unlike that of any single scene.
    """
    corners = [torch.tensor(lead.bounds)]
    farthest = lead.reach
    for frame, place, box in others:
        interest = box or CropBox(*frame.bounds)
        corners.append(interest.transformed(place).corners.float())
        all_of_it = interest if box or not frame.is_open else CropBox((-frame.reach,) * 3, (frame.reach,) * 3)
        farthest = max(farthest, float(all_of_it.transformed(place).corners.abs().max()))
    points = torch.cat(corners)
    lower, upper = ((x, y, z) for x, y, z in (points.amin(0).tolist(), points.amax(0).tolist()))
    reach = lead.reach
    while reach < min(farthest - 1e-6, MAX_REACH):
        reach *= 2
    return replace(lead, bounds=(lower, upper), reach=reach)
