"""Viewer: a scene in everybody's browser, and what its clients share."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import rich
import viser

from ..camera import Camera
from ..errors import LumigraphError
from ..gaussians import Gaussians
from ..method import Method
from ..paths import Surroundings
from ..rays import Rendering
from ..scene import Frame, Scene
from .address import Address
from .crop import Box, render_inside
from .look import angles, target
from .scenery import Scenery
from .training_panel import TrainingPanel
from .turns import Turns
from .visitor import Visitor


@dataclass(frozen=True)
class Subject:
    """What is looked at.

    title:   shown above the controls
    cameras: of the photographs, by split, in the scene's frame
    paths:   folder that camera paths are saved in
    render_command: what makes films of it, without `--path`
    open_scene: opens the photographs, for thumbnails and sparse points; None if there are none
    rows:    of metrics.jsonl, as far as it has been trained
    """

    title: str
    frame: Frame
    cameras: dict[str, Camera]
    paths: Path
    render_command: str
    open_scene: Callable[[], Scene] | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)

    @cached_property
    def around(self) -> Surroundings:
        return Surroundings(Camera.cat(list(self.cameras.values())).to("cpu"), self.frame)

    def distance(self, camera: Camera) -> float:
        """From a camera to what it looks at."""
        return float((target(camera, self.frame, self.around) - camera.position[0]).norm())


class Viewer:
    """Serves from the moment it is made until `stop`, from threads of its own.

    training: whether `fit(..., watch=viewer)` will train the method; it then shares the method with the clients

    fit() calls `asked` and `give_way` between steps, and `note` with what a step gave. Afterwards call `end_training`.
    """

    def __init__(self, method: Method, subject: Subject, address: Address, training: bool = False):
        self.method, self.subject, self.address = method, subject, address
        self.turns, self.stage = Turns(training), 0
        self._visitors: dict[int, Visitor] = {}
        self._stopped = False
        self._lock = threading.Lock()  # around the visitors
        self._welcoming = threading.Lock()  # one at a time fills the tabs
        self.is_cloud = has_gaussians(method)
        self._server = start_server(address, subject.title)
        self._arrange()

    def _arrange(self) -> None:
        """What all clients see alike."""
        server, subject = self._server, self.subject
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        first = subject.cameras.get("test") or subject.cameras["train"]
        camera = first[0].to("cpu")
        server.initial_camera.position = camera.position[0].double().numpy()
        server.initial_camera.look_at = target(camera, subject.frame, subject.around).numpy()
        server.initial_camera.fov = angles(camera)[1]
        tabs = server.gui.add_tab_group()
        self.view_tab, self.path_tab = tabs.add_tab("View"), tabs.add_tab("Path")
        if subject.rows or self.turns.training:
            with tabs.add_tab("Training"):
                self._panel: TrainingPanel | None = TrainingPanel(server, self.turns, subject.rows)
        else:
            self._panel = None
        self.scenery = Scenery(server, subject.cameras, self._clicked)
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._farewell)
        if subject.open_scene is not None:
            self.scenery.fill(subject.open_scene, self._filled)

    # What visitors ask for

    def cloud(self, box: Box | None) -> Gaussians:
        """The method's Gaussians, those inside a box. Raises LumigraphError if it has none."""
        cloud = self.method.gaussians()
        return cloud if box is None else box.cropped(cloud)

    def render(self, camera: Camera, box: Box | None) -> Rendering:
        """What a camera sees, on the CPU. Only for whoever has the turn."""
        if box is None:
            return self.method.render(camera).cpu()
        return render_inside(self.method, camera, box, self.is_cloud).cpu()

    def knows(self, client: Any) -> bool:
        """Whether a client is still there."""
        return not self._stopped and client.client_id in self._server.get_clients()

    # What fit() calls

    @property
    def asked(self) -> bool:
        """Whether training should give way now."""
        return self.turns.asked

    def give_way(self, stopping: Callable[[], object]) -> None:
        """Between two steps, with the method ready to render."""
        self.turns.give_way(stopping)

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        """A step is done. row: its line of metrics.jsonl, if it has one."""
        self.stage = step
        if self._panel is not None:
            self._panel.note(step, progress, row)

    def end_training(self) -> None:
        """The method stays as it is from now on."""
        self.turns.end_training()
        if self._panel is not None:
            self._panel.end()
        for visitor in self._everyone():
            visitor.painter.ask()

    # Coming and going

    def serve(self) -> None:
        """Wait for Ctrl-C, which raises KeyboardInterrupt."""
        while True:
            time.sleep(3600)

    def stop(self) -> None:
        """Send everybody away."""
        self._stopped = True
        for visitor in self._everyone():
            visitor.stop()
        self.scenery.stop()
        with quiet():
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *fault: object) -> None:
        self.stop()

    def _everyone(self) -> list[Visitor]:
        with self._lock:
            return list(self._visitors.values())

    def _welcome(self, client: Any) -> None:
        with self._welcoming:
            visitor = Visitor(self, client)
        with self._lock:
            self._visitors[client.client_id] = visitor
        if not self.knows(client):  # it left while its panel was being made
            self._farewell(client)

    def _farewell(self, client: Any) -> None:
        with self._lock:
            visitor = self._visitors.pop(client.client_id, None)
        if visitor is not None:
            visitor.stop()

    def _clicked(self, client: Any, camera: Camera) -> None:
        with self._lock:
            visitor = self._visitors.get(client.client_id)
        if visitor is not None:
            visitor.fly_to(camera, self.subject.distance(camera.to("cpu")))

    def _filled(self, fault: str | None) -> None:
        for visitor in self._everyone():
            if fault is not None:
                visitor.tell("Without photographs", fault)
            elif self.scenery.has_points:
                visitor.controls.offer_points()


def has_gaussians(method: Method) -> bool:
    try:
        method.gaussians()
    except LumigraphError:
        return False
    return True


def start_server(address: Address, title: str) -> Any:
    """viser's server, at this address and nowhere else. Raises LumigraphError if the port has just been taken."""
    with quiet():
        server = viser.ViserServer(address.host, address.port, label=title, verbose=False)
    if server.get_port() != address.port:
        with quiet():
            server.stop()
        raise LumigraphError(f"Port {address.port} has just been taken; start the viewer again")
    server.request_share_url = lambda *_, **__: None  # viser would connect to the outside if a client asked it to
    return server


class quiet:  # noqa: N801
    """viser greets on stdout, where our results go; inside this block it does not."""

    def __enter__(self) -> None:
        self._before, rich.get_console().quiet = rich.get_console().quiet, True

    def __exit__(self, *fault: object) -> None:
        rich.get_console().quiet = self._before
