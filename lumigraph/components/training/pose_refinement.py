"""Pose refinement: a learnt small rotation and shift of each photograph's camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...camera import Camera
from ...camera.rays import Rays
from ...datasets.scene import Frame, Scene
from ...geometry import rotated
from ...method import Part
from .bundle_adjustment import adjusted, pixel_angle, rotation_vector
from .row_optimizers import RowOptimizer
from .schedules import ENDS, band_weights, falling
from .shared_points import shared_points

PLACES = 16  # along each side of a picture, and as many depths: where its motion is measured
DAMPING, LEAST = 0.1, 1e-8  # of the whitening, lambda and mu of Park 2023
WARMUP = 0.2  # share of the budget in which poses' rate grows: at first nothing is there to be aligned with
ACCURACY = 0.4  # pixels to which a feature's place is known
TIED = 12  # matches for each photograph, fewer of which are not asked where cameras stand
FINE = 0.1  # of the rate, where poses were found before the scene
FALL = 0.02  # of the rate, that is left of it at the end of the budget
POSE_LEARNING_RATE = 5e-4  # of fields: radians that a step moves a picture at most


@dataclass(frozen=True)
class PoseNumbers:
    """A Config's numbers of pose refinement."""

    refine_cameras: bool = False  # learn a correction of each photograph's pose, coarse to fine (Lin 2021, BARF)
    match_photographs: bool = True  # with refine_cameras, begin with poses from matched features; slower to begin


def poses_for(frame: Frame, numbers: PoseNumbers, rate: float = POSE_LEARNING_RATE) -> PoseRefinement | None:
    """A `PoseRefinement`, if enabled by the numbers."""
    if not numbers.refine_cameras:
        return None
    return PoseRefinement(frame.image_count, rate, numbers.match_photographs)


class PoseRefinement(Part):
    """A small rotation (radians) and shift (scene units) of each photograph's camera, in the world's frame, initially
    0.

    The rotation is about the camera's own position: the exponential map of so(3) by Rodrigues' formula (Lin 2021, BARF,
    section 3.3). The parameters `twist` are preconditioned coordinates in which a unit step of any direction moves the
    picture equally far, by radians (Park 2023, CamP): `axes` maps them to rotation and shift. Without `begin` it is the
    identity.

    learning_rate: largest movement of a picture in a step, radians
    progress:      spent share of the budget, by which `weights` adds bands of an encoding
    found:         whether initial poses come from shared points, see `find`
    matching:      whether `begin` matches features between photographs
    """

    moves_cameras: ClassVar[bool] = True
    axes: Tensor
    progress: Tensor
    found: Tensor

    def __init__(self, image_count: int, learning_rate: float = 1e-3, matching: bool = True):
        super().__init__()
        self.learning_rate, self.matching = learning_rate, matching
        self.twist = nn.Parameter(torch.zeros(image_count, 6))
        self.register_buffer("axes", torch.eye(6).repeat(image_count, 1, 1))
        self.register_buffer("progress", torch.tensor(1.0))
        self.register_buffer("found", torch.tensor(False))

    def begin(self, method: object, data: Scene, seconds: float) -> None:
        self.find(data, self.matching)

    def before_step(self, method: object, step: int, progress: float) -> None:
        self.progress.fill_(progress)

    def choose_axes(self, cameras: Camera, frame: Frame) -> None:
        """Choose the preconditioner by each camera's view. cameras: of photographs, by their `image_index`"""
        if cameras.image_index is not None:
            for i, image in enumerate(cameras.image_index.tolist()):
                self.axes[image] = whitening(cameras[i], frame)

    @torch.no_grad()
    def find(self, scene: Scene, matching: bool = True) -> None:
        """Initialise with the given poses or, if matching gives enough shared points, with those of `adjusted`."""
        self.choose_axes(scene.cameras, scene.frame)
        if not matching:
            return
        given = scene.cameras[scene.splits["train"]].to("cpu")
        seen, matches = shared_points(scene)
        tied = sum(len(m) for m in matches.values()) >= TIED * len(given)
        if given.image_index is None or not tied:
            return
        low, high = torch.tensor(scene.frame.bounds)
        found = adjusted(given, seen, matches, float((high - low).max()), ACCURACY * pixel_angle(given[0]))
        turn = rotation_vector(found.pose[:, :, :3] @ given.pose[:, :, :3].mT)
        moves = torch.cat([turn, found.position - given.position], -1).to(self.twist.device)
        image = given.image_index.to(self.twist.device)
        self.twist[image] = torch.linalg.solve(self.axes[image].mT, moves)
        self.found.fill_(True)

    @property
    def moves(self) -> Float[Tensor, "image 6"]:
        """Rotation and shift of each photograph's camera."""
        return torch.einsum("ni,nij->nj", self.twist, self.axes)

    def forward(self, rays: Rays) -> Rays:
        if rays.image_index is None:
            return rays
        omega, shift = self.moves[rays.image_index].split(3, -1)
        return replace(rays, origins=rays.origins + shift, directions=rotated(rays.directions, omega))

    def refine_rays(self, rays: Rays) -> Rays:
        return self(rays)

    @torch.no_grad()
    def refined(self, cameras: Camera) -> Camera:
        """Cameras with the corrections of their photographs; photographs outside of training have none."""
        if cameras.image_index is None:
            return cameras
        omega, shift = self.moves[cameras.image_index.to(self.twist.device)].to(cameras.pose).split(3, -1)
        axes = [rotated(cameras.pose[:, :, i], omega) for i in range(3)]
        return replace(cameras, pose=torch.stack([*axes, cameras.position + shift], -1))

    def weights(self, bands: int) -> Float[Tensor, " band"] | None:
        """Weights of an encoding's bands at this share of the budget; None when all are 1."""
        progress = float(self.progress)
        return None if progress >= ENDS else band_weights(bands, progress).to(self.twist)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [PoseAdam([{"name": "poses", "params": [self.twist]}], self.learning_rate)]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        return {"poses": self.rate(progress)}

    def rate(self, progress: float) -> float:
        """The learning rate at a share of the budget: it grows, then falls exponentially."""
        highest = (FINE if self.found else 1.0) * self.learning_rate
        return falling(highest, FALL * self.learning_rate, progress, WARMUP)


def whitening(camera: Camera, frame: Frame) -> Float[Tensor, "6 6"]:
    """Preconditioner (Sigma + lambda diag(Sigma) + mu I)^(-1/2), Sigma the mean of J^T J over one camera's view (Park
    2023, eq. 9).

    J is the derivative of a point's direction in the camera by rotation and shift: omega x d, and the part of the shift
    across d over the distance. In whitened coordinates a step along any axis moves the picture equally far, so that
    rotation and shift, which look nearly the same, are separated.
    """
    rays, t = seen_places(camera, frame)
    d, eye = rays.directions.double(), torch.eye(3, dtype=torch.float64, device=t.device)
    turns = torch.linalg.cross(eye.expand(len(d), 3, 3), d[:, None].expand(-1, 3, -1)).mT  # (ray, direction, omega)
    shifts = (d[:, :, None] * d[:, None] - eye)[:, None] / t.double()[:, :, None, None]
    jacobian = torch.cat([-turns[:, None].expand_as(shifts), shifts], -1).flatten(0, 2)
    sigma = jacobian.T @ jacobian / t.numel()
    values, vectors = torch.linalg.eigh(sigma + DAMPING * sigma.diagonal().diag() + LEAST * torch.eye(6).to(sigma))
    found = vectors * values.rsqrt() @ vectors.T
    return found.round(decimals=6).float()  # to the same bits, however threads share out the sums


def seen_places(camera: Camera, frame: Frame) -> tuple[Rays, Float[Tensor, "ray depth"]]:
    """Rays over a camera's picture and distances along them: uniform within the box of interest of a bounded scene,
    else log-uniform up to the scene's reach."""
    width, height = camera.size[0].tolist()
    x, y = ((torch.arange(PLACES, device=camera.pose.device) + 0.5) * n / PLACES for n in (width, height))
    rays = camera.rays(torch.cartesian_prod(x, y).to(camera.pose))
    share = ((torch.arange(PLACES, device=camera.pose.device) + 0.5) / PLACES).to(camera.pose)
    if frame.is_open:
        t = frame.near * (2 * frame.reach / frame.near) ** share
        return rays, t.expand(len(rays), -1)
    enter, leave = rays.through_box(rays.origins.new_tensor(frame.bounds))
    through = leave > enter.clamp_min(frame.near)
    if not through.any():  # it looks past the box
        away = max(frame.near, float(camera.position[0].norm()))
        return rays, torch.full((len(rays), PLACES), away, device=camera.pose.device)
    inside = through.nonzero()[:, 0]
    first, last = enter[inside].clamp_min(frame.near), leave[inside]
    kept = Rays(rays.origins[inside], rays.directions[inside], rays.radius[inside])
    return kept, torch.lerp(first[:, None], last[:, None], share)


class PoseAdam(RowOptimizer):
    """Adam (Kingma and Ba 2015) with one second moment for each row, that of its gradient's length.

    So a row moves along its gradient, at most by `lr`. Adam's own second moments, one for each number, would move
    undetermined directions as fast as well-determined ones. A row of zero gradient was not sampled: it stays, and its
    moments are kept.
    """

    def __init__(self, params, lr: float = 1e-3, betas: tuple[float, float] = (0.9, 0.95)):
        super().__init__(params, {"lr": lr, "betas": betas})

    def moments(self, p):
        return {"mean": torch.zeros_like(p), "square": torch.zeros_like(p[:, 0]), "steps": torch.zeros_like(p[:, 0])}

    def update(self, p, grad, state, group):
        b1, b2 = group["betas"]
        seen = grad.ne(0).any(-1).nonzero()[:, 0]
        grad = grad[seen]
        steps = state["steps"][seen] + 1
        mean = torch.lerp(grad, state["mean"][seen], b1)
        square = torch.lerp(grad.square().sum(-1), state["square"][seen], b2)
        state["steps"][seen], state["mean"][seen], state["square"][seen] = steps, mean, square
        length = (square / (1 - b2**steps)).sqrt().clamp_min(1e-30)
        p[seen] -= group["lr"] * mean / ((1 - b1**steps) * length)[:, None]
