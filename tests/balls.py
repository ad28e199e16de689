"""Balls of one colour, as each kind of method would hold them: exact samples, Gaussians, pictures alone."""

from __future__ import annotations

import torch
from solids import Seen, ball

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.camera.rays import Look, Rendering, Samples
from lumigraph.datasets.scene import Frame
from lumigraph.gaussians import Gaussians, splatting
from lumigraph.geometry import look_at, unit
from lumigraph.kernels.spherical_harmonics import K00
from lumigraph.method import Method, RayMethod
from lumigraph.volume import packed

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.8)
PIECES = 40  # samples of a ray that meets a ball
WHITE = Frame(near=0.1, background=(1.0, 1.0, 1.0), has_alpha=True)


class Marched(RayMethod):
    """A ball of even density: samples of equal length on each ray that meets it, beyond the frame's near distance."""

    def __init__(self, colour, radius=0.5, centre=(0.0, 0.0, 0.0), thickness=200.0, frame=WHITE):
        super().__init__(frame, None)
        self.colour, self.radius, self.thickness = torch.tensor(colour), radius, thickness
        self.centre = torch.tensor(centre)

    def looks(self, rays):
        offset = rays.origins - self.centre
        b = (offset * rays.directions).sum(-1)
        under = b * b - offset.square().sum(-1) + self.radius**2
        half = under.clamp_min(0).sqrt()
        begin, end = (-b - half).clamp_min(self.frame.near), -b + half
        hit = (under > 0) & (begin < end)
        share = torch.linspace(0, 1, PIECES + 1)
        edges = begin[hit, None] + (end - begin)[hit, None] * share
        samples = Samples(edges[:, :-1].flatten(), edges[:, 1:].flatten(), packed(PIECES * hit.long()))
        density = torch.full((len(samples),), self.thickness)
        return [Look("samples", samples, density, self.colour.expand(len(samples), 3))]


class Dense(Marched):
    """The same, and it knows its density."""

    def density(self, points):
        return self.thickness * ((points - self.centre).norm(dim=-1) < self.radius).float()


class Splatted(Method):
    """A shell of many small opaque Gaussians."""

    def __init__(self, colour, radius=0.5, centre=(0.0, 0.0, 0.0), antialiased=False, degree=0):
        super().__init__(WHITE, None)
        count = 1500
        k = torch.arange(count) + 0.5
        z, angle = 1 - 2 * k / count, k * torch.pi * (3 - 5**0.5)
        shell = torch.stack([(1 - z * z).sqrt() * angle.cos(), (1 - z * z).sqrt() * angle.sin(), z], -1)
        harmonics = torch.zeros(count, (degree + 1) ** 2, 3)
        harmonics[:, 0] = (torch.tensor(colour) - 0.5) / K00
        self.cloud = Gaussians(
            radius * shell + torch.tensor(centre),
            torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
            torch.full((count, 3), 0.05 * radius).log(),
            torch.full((count,), 5.0),
            harmonics,
            antialiased,
        )

    def batch(self, data, generator):
        raise NotImplementedError

    def gaussians(self):
        return self.cloud

    def render(self, camera):
        return splatting.render(self.cloud, camera, self.frame.background, 0.01)


class Pictured(Seen):
    """Something that only renders."""

    def __init__(self, colour, radius=0.5, centre=(0.0, 0.0, 0.0)):
        super().__init__(ball(radius, centre), WHITE)
        self.colour = torch.tensor(colour)

    def render_rays(self, rays, background):
        seen = super().render_rays(rays, background)
        return Rendering(torch.where(seen.opacity[:, None] > 0, self.colour, background), seen.depth, seen.opacity)


def eye(position, target=(0.0, 0.0, 0.0), size: int = 33) -> Camera:
    """One camera that looks at a point, upright, with an odd number of pixels so that one is in the middle."""
    position, target = torch.tensor([position]), torch.tensor([target])
    pose = look_at(position, unit(target - position), torch.tensor([0.0, 0.0, 1.0]))
    lens = Pinhole(torch.full((1, 2), 1.2 * size), torch.full((1, 2), size / 2))
    return Camera(pose, lens, torch.full((1, 2), size))
