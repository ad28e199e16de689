"""Tab `Path` of a client: keyframes from its camera, playback, saving and loading."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..camera.lens import Pinhole
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..files.names import natural
from ..geometry import to_quaternion
from ..paths.keyframes import CameraPath, Keyframe
from .cameras import Flight, pose_of
from .controls import MethodControls
from .shared import NAME, NAME_RULE, Shared

COLOUR = (200, 60, 150)
POINTS_PER_LEG = 24  # points of the drawn path between two keyframes
LEG_SECONDS = 2.0  # seconds from one keyframe to the next, unless something else is set
NONE = "none yet"


@dataclass(frozen=True)
class Stop:
    """A keyframe, and the seconds from it to the next."""

    key: Keyframe
    leg: float = LEG_SECONDS


class PathPanel:
    """Keyframes of one client. notify: notifies the client with a title and a text"""

    def __init__(
        self, client: Any, shared: Shared, flight: Flight, controls: MethodControls, notify: Callable[[str, str], None]
    ):
        self._client, self._subject, self._size = client, shared.subject, shared.scenery.size
        self._flight, self._controls, self._notify = flight, controls, notify
        self._stops: list[Stop] = []
        self._nodes: list[Any] = []
        self._filling = False  # while what the panel shows is set from here
        gui = client.gui
        with shared.tabs["Path"]:
            gui.add_button("Add keyframe here").on_click(lambda _: self._add())
            self._chosen = gui.add_dropdown("Keyframe", [NONE])
            self._actions = gui.add_button_group("This one", ("Go", "Set", "◀", "▶", "✕"))
            self._leg = gui.add_number("Seconds to next", LEG_SECONDS, min=0.05, max=600.0, step=0.05)
            self._loop = gui.add_checkbox("Loop", False)
            self._fps = gui.add_slider("Frames per second", 1, 120, 1, 30)
            play = gui.add_button_group("Preview", ("Play", "Stop"))
            self._name = gui.add_text("Name", "path-1")
            gui.add_button("Save").on_click(lambda _: self._save())
            self._saved = gui.add_dropdown("Saved", self._names())
            gui.add_button("Open").on_click(lambda _: self._open())
            self._about = gui.add_markdown("")
        does = {"Go": self._go, "Set": self._set, "◀": lambda: self._move(-1), "▶": lambda: self._move(1)}
        does["✕"] = self._remove
        self._actions.on_click(lambda _: does[self._actions.value]())
        play.on_click(lambda _: self._play() if play.value == "Play" else flight.stop())
        self._chosen.on_update(lambda _: self._choose())
        self._leg.on_update(lambda _: self._set_leg())
        self._loop.on_update(lambda _: self._choose())

    @property
    def is_drawn(self) -> bool:
        """True if keyframes are drawn in the scene."""
        return bool(self._nodes)

    @property
    def _index(self) -> int:
        """Number of the chosen keyframe; -1 if there is none."""
        return list(self._chosen.options).index(self._chosen.value) if self._stops else -1

    def path(self) -> CameraPath:
        """Current camera path. Raises LumigraphError without a keyframe."""
        seconds, keys = 0.0, []
        timed = all(stop.key.time is not None for stop in self._stops)  # keyframes of a still scene have no time
        for stop in self._stops:
            keys.append(replace(stop.key, seconds=seconds, time=stop.key.time if timed else None))
            seconds += stop.leg
        return CameraPath(tuple(keys), self._loop.value, float(self._fps.value))

    def _here(self) -> Keyframe:
        """A keyframe at the client's camera."""
        camera = self._client.camera
        angle = camera.fov
        if camera.aspect < 1:  # from the angle down a tall window to that across it
            angle = 2 * math.atan(math.tan(angle / 2) * camera.aspect)
        pose = torch.tensor([pose_of(camera.wxyz, camera.position)], dtype=torch.double)
        (rows,) = transform_poses(pose, source_from_scene(self._subject.frame)).tolist()
        a, b, c = (tuple(row) for row in rows)
        return Keyframe((a, b, c), math.degrees(angle), 0.0, self._controls.time)

    def _add(self) -> None:
        at = self._index + 1
        self._stops.insert(at, Stop(self._here()))
        self._fill(at)

    def _set(self) -> None:
        if self._stops:
            self._stops[self._index] = replace(self._stops[self._index], key=self._here())
            self._fill(self._index)

    def _remove(self) -> None:
        if self._stops:
            at = self._index
            del self._stops[at]
            self._fill(min(at, len(self._stops) - 1))

    def _move(self, by: int) -> None:
        at = self._index
        if self._stops and 0 <= at + by < len(self._stops):
            self._stops[at], self._stops[at + by] = self._stops[at + by], self._stops[at]
            self._fill(at + by)

    def _choose(self) -> None:
        if not self._filling:
            self._fill(self._index)

    def _set_leg(self) -> None:
        if self._stops and not self._filling:
            self._stops[self._index] = replace(self._stops[self._index], leg=float(self._leg.value))
            self._fill(self._index)

    def _go(self) -> None:
        if self._stops:
            key = self._stops[self._index].key
            poses, angles, _ = self._views(CameraPath((key,)), 1)
            if key.time is not None:
                self._controls.show_time(key.time)
            self._flight.fly(poses[0], self._distance, angles[0])

    def _play(self) -> None:
        try:
            path = self.path()
        except LumigraphError as error:
            self._notify("Nothing to play", str(error))
            return
        seconds = max(path.duration, 0.1)
        poses, angles, moments = self._views(path, max(2, round(30 * seconds)))

        def show_moment(frame: int) -> None:
            if moments is not None:
                self._controls.show_time(moments[frame])

        self._flight.play(poses, self._distance, angles, seconds, show_moment)

    @property
    def _distance(self) -> float:
        """Distance from the camera to the point that it turns about."""
        camera = self._client.camera
        return float(np.linalg.norm(camera.look_at - camera.position))

    def _views(
        self, path: CameraPath, frames: int
    ) -> tuple[Float[np.ndarray, "frame 3 4"], list[float], list[float] | None]:
        """Poses in the scene's frame, vertical angles for this client's window, and times if the path has them."""
        camera = self._client.camera
        size = (max(1, int(camera.image_width)), max(1, int(camera.image_height)))
        cameras = path.cameras(self._subject.frame, size, frames)
        assert isinstance(cameras.lens, Pinhole)
        angles = 2 * torch.atan(0.5 * size[1] / cameras.lens.focal[:, 1])
        moments = None if cameras.time is None else cameras.time.tolist()
        return cameras.pose.double().numpy(), angles.tolist(), moments

    def _fill(self, at: int) -> None:
        """Show the keyframes in the panel, with number `at` selected."""
        self._filling = True
        try:
            seconds, names = 0.0, []
            for i, stop in enumerate(self._stops):
                names.append(f"{i + 1} at {seconds:.2f} s")
                seconds += stop.leg
            self._chosen.options = tuple(names or [NONE])
            self._chosen.value = self._chosen.options[max(at, 0)]
            if self._stops:
                self._leg.value = self._stops[at].leg
        finally:
            self._filling = False
        self._draw()

    def _draw(self) -> None:
        for node in self._nodes:
            node.remove()
        self._nodes = []
        if not self._stops:
            return
        path = self.path()
        scene = self._client.scene
        keys = torch.tensor([stop.key.pose for stop in self._stops], dtype=torch.double)
        poses = transform_poses(keys, torch.linalg.inv(source_from_scene(self._subject.frame)))
        for i, pose in enumerate(poses):
            frustum = scene.add_camera_frustum(
                f"/path/{i}",
                fov=math.radians(self._stops[i].key.fov),
                aspect=1.5,
                scale=1.3 * self._size,
                thickness=2.0,
                thickness_units="screen",
                color=COLOUR,
                wxyz=to_quaternion(pose[:, :3]).numpy(),
                position=pose[:, 3].numpy(),
            )
            self._nodes.append(frustum)
        if len(keys) > 1:
            line = path.cameras(self._subject.frame, (2, 2), POINTS_PER_LEG * len(keys)).position.numpy()
            pieces = np.stack([line[:-1], line[1:]], 1)
            self._nodes.append(
                scene.add_line_segments("/path/line", pieces, COLOUR, thickness=2.0, thickness_units="screen")
            )

    def _names(self) -> tuple[str, ...]:
        folder = self._subject.paths
        names = sorted((path.stem for path in folder.glob("*.json")), key=natural) if folder.is_dir() else []
        return tuple(names) or (NONE,)

    def _save(self) -> None:
        name = self._name.value.strip()
        if not NAME.fullmatch(name):
            self._notify("Not saved", NAME_RULE)
            return
        file = self._subject.paths / f"{name}.json"
        try:
            self.path().save(file)
        except LumigraphError as error:
            self._notify("Not saved", str(error))
            return
        self._saved.options = self._names()
        self._saved.value = name
        self._about.content = f"Saved. A film of it: {code(f'{self._subject.render_command} --path {file}')}"

    def _open(self) -> None:
        self._saved.options, name = self._names(), self._saved.value
        if name == NONE or name not in self._saved.options:  # a browser may send any name
            self._notify("Nothing to open", f"No such path lies in {self._subject.paths}")
            return
        try:
            path = CameraPath.load(self._subject.paths / f"{name}.json")
        except LumigraphError as error:  # the keyframes that are set stay as they are
            self._notify("Not opened", str(error))
            return
        times = [key.seconds for key in path.keyframes]
        legs = [b - a for a, b in zip(times, times[1:], strict=False)]
        legs.append(path.duration - sum(legs) if path.loop and legs else LEG_SECONDS)
        self._stops = [Stop(key, leg) for key, leg in zip(path.keyframes, legs, strict=True)]
        self._filling = True
        self._loop.value, self._fps.value, self._name.value = path.loop, round(path.fps), name
        self._filling = False
        self._fill(0)


def code(text: str) -> str:
    """Text as a Markdown code span, with enough backticks around it."""
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {text} {fence}" if "`" in text else f"`{text}`"


def source_from_scene(frame: Frame) -> Float[Tensor, "4 4"]:
    return torch.tensor(frame.source_from_scene, dtype=torch.double)


def transform_poses(poses: Float[Tensor, "pose 3 4"], similarity: Float[Tensor, "4 4"]) -> Float[Tensor, "pose 3 4"]:
    """Camera-to-world poses in another frame, as in `Camera.transformed`."""
    count = len(poses)
    lens, size = Pinhole(torch.ones(count, 2), torch.ones(count, 2)), torch.ones(count, 2, dtype=torch.long)
    return Camera(poses, lens, size).transformed(similarity).pose
