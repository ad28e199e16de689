"""Cameras of a rig: their times, the encoded pictures, and the background of each."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import grid_sample, interpolate

from ...camera.rays import Rays
from ...datasets.scene import Frame, Scene
from ...errors import LumigraphError
from ...method import Part

SAME_POSE = 1e-4  # up to which entries of two poses are those of one camera
UNKNOWN = -1  # in the place of a camera
FIRST_BACKGROUND = 0.5  # grey


class Rig(Part):
    """Cameras that photograph several moments, and small pictures of some of them at each moment.

    times:    of the moments, ascending
    pictures: of the encoded cameras at each moment, bytes
    mean, deviation: of their colours
    """

    grows: ClassVar[tuple[str, ...]] = ("times", "pictures")
    times: Tensor
    pictures: Tensor
    mean: Tensor
    deviation: Tensor

    def __init__(self, cameras: int, side: int):
        super().__init__()
        self.cameras, self.side = cameras, side
        self.register_buffer("times", torch.zeros(1))
        self.register_buffer("pictures", torch.zeros(1, cameras, 3, side, side, dtype=torch.uint8))
        self.register_buffer("mean", torch.full((3,), 0.5))
        self.register_buffer("deviation", torch.tensor(1.0))

    def begin(self, method: object, data: Scene, seconds: float) -> None:
        train = data.splits["train"]
        times = torch.zeros(len(data)) if data.cameras.time is None else data.cameras.time
        moments = times[train].unique()
        camera_of = cameras_of(data)
        everywhere = [
            camera
            for camera in camera_of[train].unique().tolist()
            if len(times[train][camera_of[train] == camera].unique()) == len(moments)
        ]
        if len(everywhere) < 2:
            raise LumigraphError(
                f"neural-volumes encodes each moment from several cameras that stand still, and in {data.source} "
                f"{len(everywhere) or 'no'} camera photographs every moment; train nerfies or nsff on it"
            )
        position = {camera: data.cameras.position[train[camera_of[train] == camera][0]] for camera in everywhere}
        chosen = spread(position, self.cameras)
        pictures = torch.zeros(len(moments), self.cameras, 3, self.side, self.side, dtype=torch.uint8)
        for m, moment in enumerate(moments):
            for k, camera in enumerate(chosen):
                there = train[(times[train] == moment) & (camera_of[train] == camera)]
                rgb = data.photograph(int(there[0])).before(data.frame.background).permute(2, 0, 1)[None]
                small = interpolate(rgb, (self.side, self.side), mode="bilinear", antialias=True, align_corners=False)
                pictures[m, k] = (small[0].clamp(0, 1) * 255).round().byte()
        self.times, self.pictures = moments.to(self.times), pictures.to(self.pictures.device)
        self.mean.copy_(pictures.float().mean((0, 1, 3, 4)) / 255)
        self.deviation.copy_((pictures.float() / 255 - self.mean.cpu()[:, None, None]).std().clamp_min(0.01))

    def inputs(self, moment: int) -> Float[Tensor, "1 camera 3 side side"]:
        """The pictures of a moment, with a mean of 0 and a deviation of 1."""
        rgb = self.pictures[moment][None].float() / 255
        return (rgb - self.mean[:, None, None]) / self.deviation


class Backgrounds(Part):
    """Backgrounds: a picture for each camera of the rig, by the direction of a ray in the camera, and a gain for its
    colours. Other cameras get the mean.

    row:    camera of each photograph in the first frame; -1 for one outside the rig
    turn:   rotation from world to camera, of each; extent: tangents of its half angles of view
    """

    row: Tensor
    turn: Tensor
    extent: Tensor

    def __init__(self, frame: Frame, side: int, learns_background: bool):
        super().__init__()
        count = max(frame.image_count, 1)
        self.pictures = (
            nn.Parameter(torch.full((count, 3, side, side), FIRST_BACKGROUND)) if learns_background else None
        )
        self.log_gain = nn.Parameter(torch.zeros(count, 3))
        self.register_buffer("row", torch.full((count,), UNKNOWN))
        self.register_buffer("turn", torch.eye(3).repeat(count, 1, 1))
        self.register_buffer("extent", torch.ones(count, 2))

    def begin(self, method: Any, data: Scene, seconds: float) -> None:
        camera_of, train, cameras = cameras_of(data), data.splits["train"], data.cameras
        known = torch.isin(camera_of, camera_of[train])
        self.row.copy_(torch.where(known, camera_of, UNKNOWN))
        self.turn.copy_(cameras.pose[:, :, :3].mT)
        for i in train.tolist():
            camera = cameras[i]
            rays = camera.rays(camera.pixels()).directions @ camera.pose[0, :, :3]
            self.extent[int(camera_of[i])] = (rays[:, :2] / rays[:, 2:].clamp_min(1e-3)).abs().amax(0)
        if self.pictures is not None:
            self.pictures.data[:] = method.rig.mean[:, None, None]

    def gain(self, rays: Rays) -> Float[Tensor, "#ray 3"]:
        """Factor on colours of the volume, mean 1 over the rig."""
        used = self.row[self.row >= 0].unique()
        if rays.image_index is None or not len(used):
            return self.log_gain.new_ones(1, 3)
        row = self.rows(rays)
        gain = (self.log_gain[row.clamp_min(0)] - self.log_gain[used].mean(0)).exp()
        return torch.where(row[:, None] >= 0, gain, 1.0)

    def colours(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Float[Tensor, "#ray 3"]:
        """Colours behind the volume."""
        used = self.row[self.row >= 0].unique()
        if self.pictures is None or not len(used):
            return background
        mean = self.pictures[used].mean((0, 2, 3))[None]
        if rays.image_index is None:
            return mean
        row = self.rows(rays)
        inward = (self.turn[row.clamp_min(0)] @ rays.directions[:, :, None])[..., 0]
        place = inward[:, :2] / inward[:, 2:].clamp_min(1e-3) / self.extent[row.clamp_min(0)]
        found = mean.expand(len(rays), 3)
        for camera in row.unique().tolist():
            if camera >= 0:
                own = row == camera
                grid = place[own][None, :, None]
                seen = grid_sample(self.pictures[camera][None], grid, padding_mode="border", align_corners=True)
                found = found.index_copy(0, own.nonzero()[:, 0], seen[0, :, :, 0].T)
        return found

    def rows(self, rays: Rays) -> Int[Tensor, " ray"]:
        assert rays.image_index is not None
        return torch.where(
            rays.image_index < len(self.row), self.row[rays.image_index.clamp(max=len(self.row) - 1)], -1
        )


def cameras_of(data: Scene) -> Int[Tensor, " photograph"]:
    """Camera number of each photograph: the first photograph with the same pose."""
    poses = data.cameras.pose.flatten(1)
    same = (poses[:, None] - poses[None]).abs().amax(-1) < SAME_POSE
    return same.int().argmax(1)


def spread(position: dict[int, Tensor], count: int) -> list[int]:
    """Farthest-point sampling of cameras from the first one; repeats some if there are few."""
    names, places = list(position), torch.stack(list(position.values()))
    chosen = [0]
    while len(chosen) < min(count, len(names)):
        away = torch.cdist(places, places[chosen]).amin(1)
        chosen.append(int(away.argmax()))
    return [names[chosen[i % len(chosen)]] for i in range(count)]
