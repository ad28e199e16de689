"""Scenery: the photographs' cameras and the sparse points, drawn for all clients."""

import threading
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..camera import Camera
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..geometry import to_quaternion
from .cameras import angles

CAMERAS, POINTS = "/cameras", "/points"
MAX_CAMERAS, MAX_POINTS = 250, 200_000  # more only fill the browser
THUMBNAIL = 96  # pixels along the longer side
WHITE = (1.0, 1.0, 1.0)  # behind what is see-through
TRAIN, TEST = (86, 134, 214), (232, 140, 60)
FRUSTUM_SHARE = 0.4  # of the distance between neighbouring cameras, as the size of a frustum
MIN_THUMBNAIL_DISTANCE = 8.0  # frustum sizes: nearer, a thumbnail fills a tenth of the window or more
MIN_FRUSTUM_SHARE, MAX_FRUSTUM_SHARE = 0.03, 0.05  # of the distance to the middle of all cameras


class Scenery:
    """Camera frusta, at first alone; thumbnails and points after the photographs are opened.

    server:   viser's
    cameras:  by split
    clicked:  called with a client and the clicked camera
    """

    def __init__(self, server: Any, cameras: dict[str, Camera], clicked: Callable[[Any, Camera], None]):
        self._server = server
        self._frusta: dict[int, Any] = {}  # by image number
        self.points: Float[Tensor, "point 3"] | None = None
        self._stopped = False
        server.scene.add_frame(CAMERAS, show_axes=False)
        server.scene.add_frame(POINTS, show_axes=False)
        everyone = Camera.cat(list(cameras.values()))
        self.size, step = frustum_size(everyone), -(-len(everyone) // MAX_CAMERAS)
        self._names: list[str] = []
        for split, group in cameras.items():
            for i in range(0, len(group), step):
                self._add(split, group[i], f"{CAMERAS}/{split}/{i}", clicked)
        self._positions = Camera.cat([group[::step] for group in cameras.values()]).position.cpu().double()

    def around(self, place: tuple[float, ...]) -> set[str]:
        """Names of the frusta so close to a position that they would occlude its view."""
        distance = (self._positions - torch.tensor(place, dtype=torch.double)).norm(dim=-1)
        return {self._names[i] for i in (distance < MIN_THUMBNAIL_DISTANCE * self.size).nonzero()[:, 0].tolist()}

    def _add(self, split: str, camera: Camera, name: str, clicked: Callable[[Any, Camera], None]) -> None:
        across, down = angles(camera)
        self._names.append(name)
        frustum = self._server.scene.add_camera_frustum(
            name,
            fov=down,
            aspect=float(torch.tensor(across / 2).tan() / torch.tensor(down / 2).tan()),
            scale=self.size,
            thickness=1.5,
            thickness_units="screen",
            color=TRAIN if split == "train" else TEST,
            wxyz=to_quaternion(camera.pose[0, :, :3].cpu()).numpy(),
            position=camera.position[0].cpu().double().numpy(),
        )
        frustum.on_click(lambda event: clicked(event.client, camera))
        if camera.image_index is not None:
            self._frusta[int(camera.image_index[0])] = frustum

    def fill(self, open_scene: Callable[[], Scene], done: Callable[[str | None], None]) -> None:
        """Open the photographs in the background and show them. done: called with the fault, or None"""

        def work() -> None:
            try:
                self.show(open_scene())
            except LumigraphError as error:
                done(str(error))
            except RuntimeError:
                if not self._stopped:  # raised when Python is about to end
                    raise
            else:
                done(None)

        threading.Thread(target=work, name="photographs", daemon=True).start()

    def stop(self) -> None:
        """Cancel opening."""
        self._stopped = True

    def show(self, scene: Scene) -> None:
        """Draw thumbnails and points of a scene."""
        if scene.points is not None and len(scene.points):
            some = slice(None, None, -(-len(scene.points) // MAX_POINTS))
            colours = scene.point_colours
            spread = (scene.points - scene.points.median(0).values).norm(dim=-1).median()
            self._server.scene.add_point_cloud(
                f"{POINTS}/sparse",
                scene.points[some].numpy(),
                (120, 120, 120) if colours is None else colours[some].numpy(),
                point_size=0.006 * float(spread),
                point_shape="circle",
                point_shading="flat",
                precision="float32",
            )
            self.points = scene.points.cpu()
        for number, frustum in self._frusta.items():
            frustum.image = thumbnail(scene.photograph(number).before(WHITE)).numpy()


def frustum_size(cameras: Camera) -> float:
    """Size of a frustum in scene units, without overlaps of neighbours."""
    position = cameras.position.cpu().double()
    distance = torch.cdist(position, position)
    spread = float((position - position.median(0).values).norm(dim=-1).median())
    spread = spread or 1.0
    nearest = distance.fill_diagonal_(torch.inf).amin(-1).median().item() if len(position) > 1 else spread
    return min(max(FRUSTUM_SHARE * nearest, MIN_FRUSTUM_SHARE * spread), MAX_FRUSTUM_SHARE * spread)


def thumbnail(rgb: Float[Tensor, "height width 3"]) -> UInt8[Tensor, "_ _ 3"]:
    """A photograph's thumbnail, at most THUMBNAIL pixels long, as bytes."""
    height, width, _ = rgb.shape
    share = min(1.0, THUMBNAIL / max(height, width))
    small = (max(1, round(share * height)), max(1, round(share * width)))
    reduced = torch.nn.functional.interpolate(rgb.permute(2, 0, 1)[None], small, mode="area")[0]
    return reduced.permute(1, 2, 0).mul(255).round().to(torch.uint8)
