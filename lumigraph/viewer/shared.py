"""Subject: the viewer's view of a scene. Shared: state common to all clients."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from ..camera import Camera
from ..camera.crop import Crop, Sphere
from ..camera.rays import Rays, Rendering
from ..composition.floaters import CANDIDATE_COLOUR, FloaterEvidence, evidence
from ..datasets.scene import Frame, Scene, Vector
from ..gaussians import Gaussians, splatting
from ..gaussians.cloud import gone, painted, unwanted
from ..method import Method, RayMethod
from ..method.capabilities import HasGaussians, needs
from ..paths import Surroundings
from ..paths.opening import Backdrop, Opening, opening_of_scene, pivot, subject_of
from ..system.allocation import give_back_memory
from .cameras import ViewRequest
from .scenery import Scenery
from .turns import Turns

NAME = re.compile(r"\w[\w .-]{0,80}")  # of a saved file or folder
NAME_RULE = "A name is made of letters, digits, spaces, dots and dashes"
CROPPED_MAX_SCALE = 0.25  # extents of the crop; larger Gaussians stick out of it
Masks = Mapping[str, Bool[Tensor, " gaussian"]]  # of Gaussians to remove, by reason
Keep = Callable[[str, Masks], str]
Locate = Callable[[Vector, Vector], Vector | None]  # point of the scene on a ray from an origin along a direction


@dataclass(frozen=True)
class ExportOption:
    """An option of an export.

    default: its default as text, "" for one that is computed; or False for a switch
    choices: all values, where they are few
    hint:    the default in words
    """

    name: str
    default: str | bool
    choices: tuple[str, ...] = ()
    hint: str = ""


@dataclass(frozen=True)
class ExportFormat:
    """A format: the usual suffix of its files, its description, its options."""

    ending: str
    about: str
    options: tuple[ExportOption, ...] = ()


@dataclass(frozen=True)
class Exporter:
    """Exports of a scene.

    formats: by name
    command: command line of an export, from the format's name, the file's name, options and a client's view
    run:     runs an export with a callback for lines of progress, and returns the result as text; it raises
             LumigraphError if the export fails
    """

    formats: Mapping[str, ExportFormat]
    command: Callable[[str, str, Mapping[str, str | bool], ViewRequest], list[str]]
    run: Callable[[list[str], Callable[[str], None]], str]


@dataclass(frozen=True)
class Subject:
    """A scene in the viewer.

    title:          shown above the controls
    cameras:        of the photographs, by split, in the scene's frame
    paths:          folder of saved camera paths
    render_command: command line that renders films of the scene, without `--path`
    open_scene:     opens the photographs, for thumbnails and sparse points; None without photographs
    rows:           of metrics.jsonl, up to the trained step
    keep:           saves the cloud without some Gaussians under a name, and returns its path; None if nothing can be
                    saved
    part_ending:    suffix of the suggested name of a part: empty for a new run, which has cameras and background too
    page:           makes a page (HTML) that renders the scene in the browser; None for server-side rendering only
    behind:         sky colours and floor of an unbounded scene
    exporter:       exports the scene; None if nothing can be exported
    set_scale:      stores units of exports per unit of the photographs' frame; None in training
    embedded:       whether it is a part of the app's page: dark as its stage, no frusta at first
    """

    title: str
    frame: Frame
    cameras: dict[str, Camera]
    paths: Path
    render_command: str
    open_scene: Callable[[], Scene] | None = None
    rows: list[dict[str, Any]] = field(default_factory=list)
    keep: Keep | None = None
    part_ending: str = ".ply"
    page: Callable[[], bytes] | None = None
    behind: Backdrop | None = None
    exporter: Exporter | None = None
    set_scale: Callable[[float], None] | None = None
    embedded: bool = False

    @property
    def label(self) -> str:
        """Heading of the panel."""
        return "Controls" if self.embedded else self.title

    @cached_property
    def around(self) -> Surroundings:
        """Positions and directions of all cameras."""
        return Surroundings(Camera.cat(list(self.cameras.values())).to("cpu"), self.frame)

    @cached_property
    def opening(self) -> Opening:
        """Initial camera of every client, and the limits of its movement: those of `lumigraph export web`."""
        return opening_of_scene(self.title, self.cameras["train"].to("cpu"), self.frame, behind=self.behind)

    def distance(self, camera: Camera) -> float:
        """Distance from a camera to the point that it turns about, in scene units."""
        position, forward = camera.position[0].double().cpu(), camera.forward[0].double().cpu()
        return float((pivot(self.around, position, forward) - position).norm())


@dataclass
class Shared:
    """State common to all clients: the method and the server. The viewer makes it; each visitor reads it.

    is_cloud:           whether the method has Gaussians
    server:             viser's
    tabs:               by name, for each client's own controls
    step:               trained step of the method
    stopped:            whether the viewer has ended
    """

    method: Method
    is_cloud: bool
    subject: Subject
    turns: Turns
    server: Any
    tabs: dict[str, Any]
    scenery: Scenery
    step: int = 0
    stopped: bool = False
    _picked: tuple[Any, Gaussians] | None = None  # the last part of the cloud, after the settings that it depends on
    _evidence: tuple[Any, FloaterEvidence] | None = None  # of the last cloud, in the same way

    def cloud(self, request: ViewRequest) -> Gaussians:
        """Gaussians of the method with the controls, crop and cleaning of a client; visible floaters are coloured.
        Raises LumigraphError without Gaussians. Call it inside `turns.turn`."""
        cloud = needs(self._with_settings(request), HasGaussians).gaussians()
        if not request.part:
            return cloud
        wanted = self.step, request.settings, request.crop, request.strength, request.cleaned
        if self._picked is None or self._picked[0] != wanted:
            lost = gone(self.unwanted(request))
            if (floating := self.floaters(request)) is not None and not request.cleaned:
                cloud = painted(cloud, floating, CANDIDATE_COLOUR)
            self._picked = wanted, cloud[~lost]
        return self._picked[1]

    def forget(self) -> None:
        """Free the data cached for clients."""
        self._picked = self._evidence = None
        give_back_memory()

    def unwanted(self, request: ViewRequest) -> Masks:
        """Masks of the Gaussians that a client has cropped or removed, by reason. Call it inside `turns.turn`."""
        cloud = needs(self._with_settings(request), HasGaussians).gaussians()
        max_scale = None if request.crop is None else CROPPED_MAX_SCALE
        return unwanted(cloud, request.crop, max_scale, self.floaters(request) if request.cleaned else None)

    def floaters(self, request: ViewRequest) -> Bool[Tensor, " gaussian"] | None:
        """Mask of floaters at a client's strength; None at 0. Evidence takes seconds, once for each cloud."""
        if not request.strength:
            return None
        wanted = self.step, request.settings
        if self._evidence is None or self._evidence[0] != wanted:
            photographed = self.subject.open_scene is not None
            cameras = self.subject.cameras["train"] if photographed else None
            cloud = needs(self._with_settings(request), HasGaussians).gaussians()
            self._evidence = wanted, evidence(cloud, cameras, self.subject.frame)
        return self._evidence[1].floaters(request.strength)

    def render(self, camera: Camera, request: ViewRequest) -> Rendering:
        """Rendering of the method with a client's controls and crop, on the CPU. Call it inside `turns.turn`."""
        method = self._with_settings(request)
        if not request.part:
            return method.render(camera).cpu()
        if request.crop is not None and not self.is_cloud:
            return render_inside(method, camera, request.crop).cpu()
        cloud, frame = self.cloud(request), method.frame
        return splatting.render(cloud, camera.to(method.device), frame.background, frame.near).cpu()

    def _with_settings(self, request: ViewRequest) -> Method:
        return self.method.given(**dict(request.settings)) if request.settings else self.method

    def subject_crops(self) -> tuple[Sphere, tuple[Vector, Vector]]:
        """Sphere around the subject and corners of the box, by the sparse points if the photographs have been opened,
        else by the centres of Gaussians.

        The box of an object alone is the box of interest; any other holds the sphere.
        """
        points = self.scenery.points
        if points is None and self.is_cloud and not self.turns.training:
            points = needs(self.method, HasGaussians).gaussians().means.detach().cpu()
        sphere, frame = subject_of(self.subject.around, points), self.subject.frame
        return sphere, sphere.bounds if frame.is_open else frame.bounds

    def connected(self, client: Any) -> bool:
        """True if a client is still connected."""
        return not self.stopped and client.client_id in self.server.get_clients()


TOLERANCE = 0.01  # of the crop's size: an expected depth may lie so far outside


def render_inside(method: Method, camera: Camera, crop: Crop) -> Rendering:
    """Rendering of the inside of a crop, for a method without Gaussians.

    Rays of a RayMethod begin at their entry into the crop, so everything in front is hidden. Pixels with an expected
    depth behind the crop are removed; for all other methods, also those in front of it. Where something translucent
    inside is in front of something solid outside, their mean depth decides.
    """
    frame = method.frame
    rays = camera.rays(camera.pixels())
    if isinstance(method, RayMethod):
        rendering = from_entry(method, rays, crop)
    else:
        rendering = method.render(camera).cpu()
    width, height = camera.size[0].tolist()
    depth = rendering.depth.reshape(-1)
    inside = crop.holds(rays.at(depth.nan_to_num(0, 0)), TOLERANCE) & depth.isfinite()
    keep = inside.view(height, width)
    rendering = rendering.reshape(height, width)
    return replace(
        rendering,
        rgb=torch.where(keep[..., None], rendering.rgb, torch.tensor(frame.background)),
        depth=torch.where(keep, rendering.depth, torch.inf),
        opacity=torch.where(keep, rendering.opacity, 0.0),
        extra={name: kept(values, keep) for name, values in rendering.extra.items()},
    )


def kept(values: Shaped[Tensor, "*all"], where: Bool[Tensor, "*pixels"]) -> Shaped[Tensor, "*all"]:
    """Values of an extra within a mask, zeros elsewhere."""
    where = where.reshape(*where.shape, *(1,) * (values.ndim - where.ndim))
    return torch.where(where, values, torch.zeros_like(values))


@torch.no_grad()
def from_entry(method: RayMethod, rays: Rays, crop: Crop) -> Rendering:
    """Rendering along rays from their entry into a crop; depth is measured from their origins."""
    enter, hits = crop.entered(rays)
    chosen = hits.clone()
    chosen[0] = True  # so that a picture beside the crop has the method's extras too
    begin = torch.where(hits, enter - method.frame.near, 0).clamp_min(0)[chosen]  # not nearer
    moved = replace(rays[chosen], origins=rays[chosen].at(begin))
    background = torch.tensor(method.frame.background)
    behind = background.to(method.device)[None]
    chunks = [slice(i, i + method.rays_per_chunk) for i in range(0, len(moved), method.rays_per_chunk)]
    seen = Rendering.cat([method.render_rays(moved[c].to(method.device), behind).cpu() for c in chunks])

    def spread(values: Tensor) -> Tensor:
        return kept(values.new_zeros(len(rays), *values.shape[1:]).index_put((chosen,), values), hits)

    return Rendering(
        torch.where(hits[:, None], spread(seen.rgb), background),
        torch.where(hits, spread(seen.depth + begin), torch.inf),
        spread(seen.opacity),
        {name: spread(values) for name, values in seen.extra.items()},
    )
