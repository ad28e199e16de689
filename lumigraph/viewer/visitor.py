"""Visitor: one client of the viewer, with its own camera, controls, path and painter."""

import asyncio
import math
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from .. import kernels
from ..camera import Camera
from ..camera.lens import Pinhole
from ..camera.rays import Rendering
from ..datasets.scene import Vector
from ..errors import LumigraphError
from ..figures import to_bytes
from ..gaussians import Gaussians
from ..geometry import look_at, to_matrix, unit
from ..paths.opening import upright
from .cameras import Flight, ViewRequest, angle_across, angle_for, pose_of, rows
from .controls import Controls, MethodControls
from .crop_panel import CropPanel
from .export_panel import ExportPanel
from .modes import along_axis, extra_modes, picture
from .painter import MOVING_SECONDS, MovingPace, Pace, Painter
from .path_panel import PathPanel
from .reprojection import SharpPicture, sharpened
from .ruler_panel import RulerPanel
from .shared import Shared
from .strokes_panel import StrokesPanel
from .turns import NotWantedError

DEPTH_SIZE = 320  # pixels along the longer side of the depth that goes with a picture
DEPTH_STEP = 256e-5  # scene units, to which that depth is rounded so that it packs well
MIN_BAND_ROWS = 16  # of a band
DETAIL_DIVISOR = 2.5  # of the height of a picture at rest, up to which a moving one needs none of its detail
PICKED_PIXELS = 5  # a side of the picture around a click
QUALITY, QUALITY_MOVING = 90, 70  # of JPEG
MAX_RECOLOURED_GAUSSIANS = 500_000  # Gaussians; more are too many to send again whenever the camera rests
REST_SECONDS = 0.25  # seconds without movement from which on a camera beyond its limits returns
LIMIT_TOLERANCE = 0.02  # of the first distance to the target, that a camera may rest beyond its limits
PLACE_TOLERANCE = 1e-3  # scene units and cosines, within which a camera is where it began
LIMIT_NOTE = "Untick `Stay near the scene` in the tab View to go farther"
RECOLOUR_EYE_SHIFT = 0.03  # how far the eye must move, as a share of its distance to the middle, for colours to change
Wanted = Callable[[], bool]


class Visitor:
    """A connected client: made on connection, stopped on disconnection."""

    def __init__(self, shared: Shared, client: Any):
        self._shared, self._client = shared, client
        self._pace, self._bands, self._said = Pace(), Pace(), ""  # pictures at rest, all waiting included; bands
        self._moving = MovingPace()
        self._sharp: SharpPicture | None = None  # the last picture at rest
        self._splats: Any = None
        self._sent: tuple[Any, ...] = ()  # which splats the client has
        self._eye = torch.zeros(3)  # towards which their colours are
        self._flat: Vector | None = None  # the background behind splats
        self._hidden: dict[str, Any] = {}  # frusta that are too near to the eye, and what hides each
        self.painter = Painter(self._draw, shared.turns, self._report_fault, lambda: shared.step)
        self.flight = Flight(client)
        self.controls = Controls(client, shared, self.painter.request, self._go_home)
        self.method_controls = MethodControls(client, shared, self.painter.request)
        keep = self._keep if shared.is_cloud and shared.subject.keep is not None else None
        self.crop = CropPanel(client, shared, self.painter.request, keep, self.notify, self.locate)
        self.strokes: StrokesPanel | None = None
        if "Select" in shared.tabs:
            kept = shared.subject.keep if keep is not None else None
            self.strokes = StrokesPanel(client, shared, self.request, self.painter.request, kept, self.notify)
        self.ruler = RulerPanel(client, shared, self.locate, self.painter.request, self.notify)
        self.path = PathPanel(client, shared, self.flight, self.method_controls, self.notify)
        if shared.subject.exporter is not None:
            about = shared.subject.exporter, shared.subject.title, self.request, self.notify
            self.export = ExportPanel(client, shared.tabs["Export"], *about)
        self._seen: tuple[Any, ...] = ()
        self._at_rest: asyncio.TimerHandle | None = None  # until the camera counts as resting
        self._arrived = self._at_opening(pose_of(client.camera.wxyz, client.camera.position))  # at the opening, once
        self._left = self._noted = False  # the opening; and what limits do
        client.camera.on_update(self._moved)
        if client.camera.aspect < 1:
            client.camera.fov = self._first_angle
        self.controls.show_angle(self._first_angle)  # the client's camera may still have the angle from before this
        self.offer_points()
        self.painter.request()
        self.painter.start()

    def stop(self) -> None:
        self.flight.stop()
        self.method_controls.stop()
        self.painter.stop()

    def notify(self, title: str, text: str = "") -> None:
        """Show the client a notification."""
        if self._here:
            self._client.add_notification(title, text, auto_close_seconds=8.0)

    def offer_points(self) -> None:
        """Offer the sparse points, once available, also for fitting crops."""
        if self._shared.scenery.points is not None:
            self.controls.offer_points()
            if self.crop.crop is None:
                self.crop.fit()

    @property
    def _first_angle(self) -> float:
        """Vertical angle of view of the opening in the client's window, in radians."""
        return angle_across(math.radians(self._shared.subject.opening.angle), self._client.camera.aspect)

    def _go_home(self) -> None:
        opening = self._shared.subject.opening
        self.flight.fly(opening.pose, opening.distance, self._first_angle)

    def _return(self) -> None:
        """Fly back within the opening's limits after a client has moved beyond them.

        A camera placed beyond them, as at a photograph, may stay as far beyond.
        """
        opening, camera = self._shared.subject.opening, self._client.camera
        if self.flight.flying or not (self._arrived and self.controls.stays and self._here):
            return
        position, target = opening.limited(camera.position, camera.look_at)
        placed = self.flight.placed or (position, target)
        allowed = LIMIT_TOLERANCE * opening.distance + np.linalg.norm(opening.limited(*placed)[0] - placed[0])
        if np.linalg.norm(position - camera.position) > allowed:
            goal = upright(position, target), float(np.linalg.norm(target - position)), camera.fov
            threading.Thread(target=self.flight.fly, args=goal, name="return", daemon=True).start()
            if not self._noted:
                self._noted = True
                self.notify("Nothing was photographed from there", LIMIT_NOTE)

    def fly_to(self, camera: Camera, distance: float) -> None:
        """Fly to a photograph's camera, with an angle of view that contains all of it."""
        pose = camera.pose[0].double().cpu().numpy()
        self.flight.fly(pose, distance, angle_for(camera.to("cpu"), self._client.camera.aspect))

    def _keep(self, name: str) -> str:
        """Save the remaining cloud. Raises LumigraphError if that fails."""
        assert self._shared.subject.keep is not None
        with self._shared.turns.turn():
            return self._shared.subject.keep(name, self._shared.unwanted(self.request()))

    @property
    def _here(self) -> bool:
        return self._shared.connected(self._client)

    async def _moved(self, camera: Any) -> None:
        """Request a picture from the camera's new pose. It runs in the server's thread, so it must be fast."""
        seen = *camera.wxyz, *camera.position, camera.fov, camera.image_width, camera.image_height
        if seen != self._seen:
            self._seen = seen
            self._arrived = self._arrived or self._at_opening(pose_of(camera.wxyz, camera.position))
            self.controls.show_angle(camera.fov)
            self.painter.request()
            if self._at_rest is not None:
                self._at_rest.cancel()
            self._at_rest = asyncio.get_running_loop().call_later(REST_SECONDS, self._return)

    def request(self) -> ViewRequest:
        """The current view of the client."""
        camera, controls = self._client.camera, self.controls
        return ViewRequest(
            pose_of(camera.wxyz, camera.position),
            float(camera.fov),
            (max(1, int(camera.image_width)), max(1, int(camera.image_height))),
            controls.longest,
            controls.mode,
            controls.background,
            controls.exact,
            self.crop.crop,
            controls.surrounded or self.path.is_drawn or self.crop.is_drawn or self.ruler.is_drawn or self.selected,
            self.method_controls.values,
            self.crop.strength,
            self.crop.cleaned,
        )

    @property
    def selected(self) -> bool:
        """True if a part selected by strokes is shown."""
        return self.strokes is not None and self.strokes.is_drawn

    def locate(self, origin: Vector, direction: Vector) -> Vector | None:
        """First visible surface point along a ray: the median depth of a few pixels around it."""
        pose = look_at(torch.tensor([origin]), torch.tensor([direction]), torch.tensor([0.0, 0.01, 1.0]))
        request = self.request()
        focal = 0.5 * request.full[1] / math.tan(0.5 * request.angle)
        lens = Pinhole(torch.full((1, 2), focal), torch.full((1, 2), PICKED_PIXELS / 2))
        camera = Camera(pose, lens, torch.full((1, 2), PICKED_PIXELS))
        with self._shared.turns.turn():
            seen = self._shared.render(camera, request)
        depth = seen.depth[(seen.opacity > 0.5) & seen.depth.isfinite()]
        if not len(depth):
            return None
        x, y, z = (camera.position[0] + depth.median() * camera.forward[0]).tolist()
        return x, y, z

    def _draw(self, seconds: float, wanted: Wanted) -> bool:
        """Show the best picture that can be rendered in a time; returns whether no better one is possible."""
        request = self.request()
        self._step_out(tuple(row[3] for row in request.pose))
        by_browser = self._shared.is_cloud and request.mode == "colour" and not request.exact
        if by_browser:
            still = self._begins(request)
            done = self._draw_splats(request, seconds, wanted, still)
            if not still:
                return done
            request = replace(request, depth=False)  # before the rendering, however deep
        elif self._splats is not None:
            self._splats.visible = False
        moving, size = seconds == MOVING_SECONDS, request.full
        divisor = self._moving.divisor(size) if moving else 1
        if moving:
            size = max(1, round(size[0] / divisor)), max(1, round(size[1] / divisor))
        elif seconds != float("inf"):
            size = self._pace.size(size, seconds)
        begin = time.perf_counter()
        rendering, camera = self._render(request, size, wanted)
        took = time.perf_counter() - begin
        if not moving or self._pace.costs is None:
            self._pace.note(size[0] * size[1], took)
        self._show(rendering, camera, request, moving)
        if moving:
            self._moving.note(divisor, time.perf_counter() - begin)
        if not by_browser:
            self._say(f"{size[0]} x {size[1]} in {1000 * took:.0f} ms")
        return size == request.full and not moving  # its JPEG is coarse, and it is not kept for its detail

    def _begins(self, request: ViewRequest) -> bool:
        """True until the client first moves or changes the scene, unless it is in training.

        A slow browser takes many seconds to draw its first splats. Until then it shows our rendering behind them.
        """
        here = self._at_opening(request.pose)
        changed = request.part or bool(request.settings) or self._shared.turns.training
        self._left = self._left or changed or (self._arrived and not here)
        self._arrived = self._arrived or here
        return here and not self._left

    def _at_opening(self, pose: tuple[tuple[float, ...], ...]) -> bool:
        """True for the initial pose of every client. A browser may report another one first."""
        return bool(np.abs(np.array(pose) - self._shared.subject.opening.pose).max() < PLACE_TOLERANCE)

    def _render(self, request: ViewRequest, size: tuple[int, int], wanted: Wanted) -> tuple[Rendering, Camera]:
        """A rendering and its camera, in bands so that others get turns and it can be cancelled soon. A cloud is
        rendered in one, because each band would project all Gaussians."""
        camera, (width, height) = request.camera(size), size
        band = max(MIN_BAND_ROWS, int(self._bands.pixels(MOVING_SECONDS)) // width)
        band = height if self._shared.is_cloud or band >= 0.7 * height else band
        parts = []
        for first in range(0, height, band):
            if not wanted():
                raise NotWantedError
            some = rows(camera, first, min(first + band, height))
            with self._shared.turns.turn(wanted):
                begin = time.perf_counter()
                parts.append(self._shared.render(some, request))
                self._bands.note(width * len(parts[-1].rgb), time.perf_counter() - begin)
        return Rendering.cat(parts), camera

    def _show(self, rendering: Rendering, camera: Camera, request: ViewRequest, moving: bool) -> None:
        self.controls.offer_modes(extra_modes(rendering))
        shown = picture(rendering, camera, request.mode, self._shared.subject.frame.background, request.background)
        if request.mode == "colour":
            shown = self._with_detail(shown, rendering.depth, camera, request, moving)
        depth = None
        if request.depth:
            step = -(-max(request.full) // DEPTH_SIZE) if max(rendering.depth.shape) > DEPTH_SIZE else 1
            depth = along_axis(rendering, camera).nan_to_num(1e3, 1e3)[step // 2 :: step, step // 2 :: step].numpy()
            depth = np.round(np.clip(depth, 0, 1e3) / DEPTH_STEP) * DEPTH_STEP
        self._stream(to_bytes(shown).numpy(), QUALITY_MOVING if moving else QUALITY, depth)
        self._flat = None

    def _with_detail(
        self,
        shown: Float[Tensor, "height width 3"],
        depth: Float[Tensor, "height width"],
        camera: Camera,
        request: ViewRequest,
        moving: bool,
    ) -> Float[Tensor, "rows columns 3"]:
        """A moving picture with reprojected detail of the last one at rest, if much larger. One at rest is stored."""
        settings = self._shared.step, replace(request, pose=(), angle=0.0, depth=False)
        if not moving:
            self._sharp = SharpPicture(shown, depth, camera, settings)
        elif (sharp := self._sharp) is not None and sharp.settings == settings:
            if DETAIL_DIVISOR * len(shown) <= len(sharp.picture):
                return sharpened(shown, depth, request.camera(request.full), sharp)
        return shown

    def _stream(self, pixels: UInt8[np.ndarray, "height width 3"], quality: int, depth: np.ndarray | None) -> None:
        if not self._here:
            raise NotWantedError
        self._client.scene.set_background_image(pixels, "jpeg", jpeg_quality=quality, depth=depth)

    def _draw_splats(self, request: ViewRequest, seconds: float, wanted: Wanted, still: bool) -> bool:
        """Send the browser the cloud for its own rendering; returns whether that is up to date.

        still: whether a rendering is the background, instead of a colour
        """
        if not still and self._flat != request.background:
            self._stream(np.full((2, 2, 3), np.round(255 * np.array(request.background)), np.uint8), 95, None)
            self._flat = request.background
        if self._splats is not None:
            self._splats.visible = True
        now = self._shared.step, request.crop, request.settings, request.strength, request.cleaned
        eye = torch.tensor(request.pose)[:, 3]
        if self._splats is None or (seconds > MOVING_SECONDS and self._sent != now):
            self._send_splats(request, eye, wanted)
            self._sent, self._eye = now, eye
        elif seconds > MOVING_SECONDS:
            middle = torch.tensor(self._shared.subject.frame.bounds).mean(0)
            away = max(float((self._eye - middle).norm()), 0.1)
            if float((eye - self._eye).norm()) > RECOLOUR_EYE_SHIFT * away:
                self._recolour(request, eye, wanted)
                self._eye = eye
        return seconds > MOVING_SECONDS

    def _send_splats(self, request: ViewRequest, eye: torch.Tensor, wanted: Wanted) -> None:
        if request.strength:
            self._say("Looking for floaters")
        with self._shared.turns.turn(wanted):
            cloud = self._shared.cloud(request)
            made, floating = splats(cloud, eye), self._shared.floaters(request)
        if not self._here:
            raise NotWantedError
        arrays = made.centres, made.covariances, made.colours, made.opacities
        if self._splats is None:
            self._splats = self._client.scene.add_gaussian_splats("/gaussians", *arrays, scale=1 / UNIT_SCALE)
        else:
            self._splats.set_gaussians(*arrays)
        found = "" if floating is None else f", {int(floating.sum()):,} floaters"
        self._say(f"{len(cloud):,} Gaussians, drawn by the browser{found}")

    def _recolour(self, request: ViewRequest, eye: torch.Tensor, wanted: Wanted) -> None:
        """Send the view-dependent colours for the current eye at rest."""
        with self._shared.turns.turn(wanted):
            cloud = self._shared.cloud(request)
            if cloud.degree == 0 or len(cloud) > MAX_RECOLOURED_GAUSSIANS:
                return
            rgb = colours(cloud, eye).cpu().numpy()
        if self._here and len(rgb) == len(self._splats.buffer):
            self._splats.rgbs = rgb

    def _step_out(self, eye: tuple[float, ...]) -> None:
        """Hide frusta around the eye from this client alone, by nodes of its own at the same positions."""
        near = self._shared.scenery.around(eye) if self._here else set(self._hidden)
        for name in self._hidden.keys() - near:
            self._hidden.pop(name).remove()
        for name in near - self._hidden.keys():
            self._hidden[name] = self._client.scene.add_frame(name, show_axes=False, visible=False)

    def _say(self, text: str) -> None:
        """Set the panel's status line."""
        if text != self._said and self._here:
            self._said = self.controls.status.content = text

    def _report_fault(self, error: Exception) -> None:
        text = str(error) if isinstance(error, LumigraphError) else f"{type(error).__name__}: {error}"
        print(f"lumigraph: a client's picture failed: {' '.join(text.split())}", file=sys.stderr, flush=True)
        if os.environ.get("LUMIGRAPH_DEBUG"):
            traceback.print_exception(error)
        self.notify("This could not be drawn", text)


# The browser's covariances are half-precision numbers: in units this much smaller, what is fine keeps its shape.
UNIT_SCALE = 16.0
MAX_SCALE = 250.0  # standard deviation in those units; its square still is a half-precision number


@dataclass(frozen=True)
class BrowserSplats:
    """Arrays for viser's splat renderer, with lengths multiplied by UNIT_SCALE."""

    centres: Float[np.ndarray, "gaussian 3"]
    covariances: Float[np.ndarray, "gaussian 3 3"]
    colours: Float[np.ndarray, "gaussian 3"]
    opacities: Float[np.ndarray, "gaussian 1"]


@torch.no_grad()
def splats(cloud: Gaussians, eye: Float[Tensor, " 3"]) -> BrowserSplats:
    """A cloud for the browser, coloured for an eye; both in the scene's frame.

    The browser takes one colour for each Gaussian and no harmonics; `colours` are sent again when the camera rests.
    """
    deviations = (UNIT_SCALE * cloud.log_scales.detach().exp()).clamp_max(MAX_SCALE)
    axes = to_matrix(cloud.quaternions.detach()) * deviations[:, None, :]
    return BrowserSplats(
        (UNIT_SCALE * cloud.means.detach()).cpu().numpy(),
        (axes @ axes.mT).cpu().numpy(),
        colours(cloud, eye).cpu().numpy(),
        cloud.opacities.detach().sigmoid()[:, None].cpu().numpy(),
    )


@torch.no_grad()
def colours(cloud: Gaussians, eye: Float[Tensor, " 3"]) -> Float[Tensor, "gaussian 3"]:
    """Colour of each Gaussian seen from one position, in [0, 1] (Kerbl 2023; the constant is that of `Gaussians`)."""
    directions = unit(cloud.means.detach() - eye.to(cloud.means))
    values = kernels.spherical_harmonics(directions, cloud.degree + 1)
    return (0.5 + torch.einsum("nk,nkc->nc", values, cloud.harmonics.detach())).clamp(0, 1)
