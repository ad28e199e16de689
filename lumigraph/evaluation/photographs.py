"""Examination of a run's training photographs: residuals of their renderings, findings, and the five worst."""

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import NamedTuple

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..composition.floaters import STRENGTH, evidence
from ..datasets.scene import Photograph, Scene
from ..depth_maps import DepthMap, free
from ..figures import ERROR_GAIN, Row, colour_depth, colour_error, contact_sheet, depth_range, save_picture
from ..files import read_json, write_json
from ..files.ranges import typed
from ..geometry import evenly
from ..method import Method, RayMethod
from ..method.capabilities import HasGaussians, can, needs
from ..metrics import psnr
from ..opening import read_capture
from ..run import Run
from ..sfm.doctor import MIN_JUDGED, Finding, Residual, findings, label, of_residuals
from ..system.progress import track
from .baseline import Baselines

PIXEL_BUDGET = 800_000  # rendered pixels of all photographs together, so that the check takes seconds
MAX_SECONDS = 10.0  # of rendering; slow methods render smaller, and fewer photographs
MIN_SIDE, MAX_SIDE = 48, 256  # pixels of the longer side of a rendering
NEIGHBOURS = 12  # nearest cameras that free space is asked of
SURFACE_SAMPLES = 500  # points of each rendered surface
SHEET_SIDE = 400.0  # pixels of the longer side in the report
SURE_STRENGTH = 0.2  # of cleaning, at which floaters are probable
MIN_FLOATERS = 1e-3  # share of the Gaussians, from which on floaters are a finding
SHOWN = 5  # worst photographs in the report
RESULT_FILE, SHEET_FILE = "photographs.json", "photographs.png"
Turn = Callable[[], AbstractContextManager[None]]


class Compared(NamedTuple):
    """Residual of a photograph of the scene, by its number, and the longer side in pixels of its rendering."""

    residual: Residual
    number: int
    side: float


@dataclass(frozen=True)
class Examined:
    """Contents of RUN/photographs.json."""

    findings: list[Finding] = field(default_factory=list)
    residuals: list[Residual] = field(default_factory=list)

    def of(self, split: str) -> list[Residual]:
        """Residuals of a split, lowest PSNR first."""
        return sorted((one for one in self.residuals if one.split == split), key=lambda one: one.psnr)


def examine(run: Run, method: Method, scene: Scene, turn: Turn = nullcontext) -> Examined:
    """Findings on the photographs of a run, worst first, and residuals; written to RUN/photographs.json, the
    five worst photographs with rendering, error and depth to RUN/photographs.png.

    turn: context of each rendering, where others render too: `viewer.turns.Turns.turn`
    Raises LumigraphError where the source's files have become unreadable.
    """
    compared = compare_all(method, scene, turn)
    residuals = [one.residual for one in compared]
    if Path(scene.source).expanduser().is_dir():
        capture = read_capture(scene.source, run.settings.scene.options.get("reader"))
        names = set(scene.names)
        capture = replace(capture, shots=[shot for shot in capture.shots if shot.name in names])
        found = findings(capture, None, scene.frame.to_source.rotation.T.double().numpy(), residuals)
    else:
        found = of_residuals(residuals, (), set())
    found += of_floaters(run, method, scene)
    result = Examined(found, residuals)
    write_json(run.folder / RESULT_FILE, asdict(result), ours=True)
    if compared:
        chosen = worst(compared, found)
        save_picture(run.folder / SHEET_FILE, sheet(method, scene, chosen, found, len(compared), turn), ours=True)
    return result


def of_floaters(run: Run, method: Method, scene: Scene) -> list[Finding]:
    """Finding on the floaters of a cloud of Gaussians; none below one in a thousand, and for other methods."""
    if not can(method, HasGaussians):
        return []
    gaussians = needs(method, HasGaussians).gaussians()
    cameras = method.refined(scene.cameras[scene.splits["train"]])
    score = evidence(gaussians, cameras, scene.frame).score
    count, sure = (int((score > 1 - strength).sum()) for strength in (STRENGTH, SURE_STRENGTH))
    if count < max(1, MIN_FLOATERS * len(gaussians)):
        return []
    text = (
        f"{count:,} of {len(gaussians):,} Gaussians may be floaters, with a score above {1 - STRENGTH:g}; "
        f"{sure:,} of them probably are, above {1 - SURE_STRENGTH:g}"
    )
    return [Finding("", "floaters", text, f"to remove them: lumigraph clean {quote(str(run.folder))} --output NEW")]


def examined(run: Run) -> Examined | None:
    """Findings of an earlier examination; None if there was none. Raises LumigraphError for a damaged file."""
    path = run.folder / RESULT_FILE
    return typed(Examined, read_json(path), path) if path.is_file() else None


@torch.no_grad()
def compare_all(method: Method, scene: Scene, turn: Turn = nullcontext) -> list[Compared]:
    """Each photograph beside its rendering by the refined camera, with its own trained exposure or appearance; empty
    for fewer than four photographs."""
    splits = {int(i): name for name, index in scene.splits.items() for i in index}
    chosen = sorted(splits)
    if len(chosen) < MIN_JUDGED:
        return []
    method.eval()
    with turn():
        chosen, side = affordable(method, scene.cameras[chosen[0]], chosen)
    found: list[Compared] = []
    maps: list[DepthMap] = []
    stand_ins = Baselines(scene, method.evidence_views)
    for index in track(chosen, "Examining photographs", len(chosen)):
        with turn():
            shot, camera, seen = rendered(method, scene, index, side)
        truth = shot.before(scene.frame.background)
        mask = torch.ones(truth.shape[:2], dtype=torch.bool) if shot.mask is None else shot.mask
        if not mask.any():
            continue
        maps.append(DepthMap.of_rendering(camera, seen, scene.frame.background))
        rgb = seen.rgb.clamp(0, 1)
        straight, mirrored = (fit(rgb[m], image[m]) for image, m in ((truth, mask), (truth.flip(1), mask.flip(1))))
        trivial = {} if splits[index] == "train" else stand_ins.of(index, (truth.shape[0], truth.shape[1]))
        others = {name: fit(picture[mask], truth[mask]) for name, picture in trivial.items()}
        residual = Residual(label(scene.names[index]), splits[index], straight, mirrored, 0.0, others)
        found.append(Compared(residual, index, side))
    shares = floating(maps)
    return [
        one._replace(residual=replace(one.residual, floating=share)) for one, share in zip(found, shares, strict=True)
    ]


def rendered(method: Method, scene: Scene, index: int, side: float) -> tuple[Photograph, Camera, Rendering]:
    """A photograph reduced to a longer side, its refined camera, and the rendering with its own trained exposure or
    appearance. Whole pictures are rendered at the photograph's size and reduced like it: at small size the low-pass
    filter of Gaussians would widen them, which costs 3 to 8 dB, and texels of photographs would alias."""
    whole = scene.photograph(index)
    factor = max(1, round(int(whole.camera.size.max()) / side))
    shot = whole.reduced(factor)
    own = {control.name: str(index) for control in method.controls if control.of_photographs}
    method = method.given(**own) if own else method
    camera = method.refined(shot.camera)
    if factor == 1 or isinstance(method, RayMethod):
        return shot, camera, method.render(camera).cpu()
    seen = method.render(method.refined(whole.camera)).cpu()
    layers = {"depth": seen.depth, "opacity": seen.opacity}
    small = replace(whole, rgb=seen.rgb, alpha=None, mask=None, extra=layers).reduced(factor)
    return shot, camera, Rendering(small.rgb, small.extra["depth"], small.extra["opacity"])


def affordable(method: Method, camera: Camera, chosen: list[int]) -> tuple[list[int], float]:
    """Photographs that can be rendered in about 10 s, evenly spread, and the longer side in pixels of each.

    camera: of one of them, to measure the speed
    """
    whole = not isinstance(method, RayMethod)
    tried = camera if whole else camera.resized(min(1.0, MIN_SIDE / int(camera.size.max())))
    method.render(tried)  # compiles
    begin = time.perf_counter()
    method.render(tried).cpu()  # waits for a GPU
    seconds = time.perf_counter() - begin
    if whole:
        return evenly(chosen, max(MIN_JUDGED, int(MAX_SECONDS / seconds))), MAX_SIDE
    pixels, least = int(tried.size.prod()), int(tried.size.max())
    budget = min(PIXEL_BUDGET, MAX_SECONDS * pixels / seconds)
    chosen = evenly(chosen, max(MIN_JUDGED, int(budget / pixels)))
    return chosen, min(max(least * (budget / len(chosen) / pixels) ** 0.5, least), MAX_SIDE)


def fit(rgb: Float[Tensor, "pixel 3"], truth: Float[Tensor, "pixel 3"]) -> float:
    """PSNR in dB of colours after the least-squares gain (not negative) and offset."""
    mean, x = truth.mean(0), rgb - rgb.mean(0)
    gain = (x * (truth - mean)).mean(0) / x.square().mean(0).clamp_min(1e-9)
    return psnr((mean + gain.clamp_min(0) * x).clamp(0, 1), truth)


def floating(maps: Sequence[DepthMap]) -> list[float]:
    """Share of each map's surface that lies in the free space of at least two of the nearest other cameras."""
    places = torch.cat([seen.camera.position for seen in maps]) if maps else torch.zeros(0, 3)
    shares = []
    for i, seen in enumerate(maps):
        solid = seen.solid.flatten().nonzero()[:, 0].tolist()
        near = (places - places[i]).norm(dim=-1).argsort().tolist()
        others = [maps[k] for k in near if k != i][:NEIGHBOURS]
        if not solid or len(others) < 2:
            shares.append(0.0)
            continue
        shares.append(float(free(seen.positions(torch.tensor(evenly(solid, SURFACE_SAMPLES))), others).float().mean()))
    return shares


def worst(compared: Sequence[Compared], found: Sequence[Finding]) -> list[Compared]:
    """The five photographs with the lowest PSNR, those with a finding first."""
    named = {finding.photograph for finding in found}
    return sorted(compared, key=lambda one: (one.residual.photograph not in named, one.residual.psnr))[:SHOWN]


@torch.no_grad()
def sheet(
    method: Method, scene: Scene, compared: Sequence[Compared], found: Sequence[Finding], count: int, turn: Turn
) -> Image.Image:
    """Contact sheet of photographs, renderings, errors and depths, each with its faults, rendered anew at a larger
    size. count: photographs that were rendered before, in about the same time"""
    rows = []
    for residual, number, side in compared:
        with turn():
            shot, _, seen = rendered(method, scene, number, min(SHEET_SIDE, side * (count / len(compared)) ** 0.5))
        faults = dict.fromkeys(f.fault for f in found if f.photograph == residual.photograph)
        text = f"{residual.photograph} · {residual.psnr:.2f} dB · {', '.join(faults) or 'no fault found'}"
        depth = colour_depth(seen.depth, seen.opacity, depth_range(seen.depth, seen.opacity))
        truth, rgb = shot.before(scene.frame.background), seen.rgb.clamp(0, 1)
        rows.append(Row(text, [truth, rgb, colour_error(truth, rgb), depth]))
    title = f"The {len(rows)} worst photographs"
    return contact_sheet(title, ["photograph", "rendering", f"{ERROR_GAIN}x error", "depth"], rows)
