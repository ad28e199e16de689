"""Evaluate a trained method on held-out views, under a stated protocol.

A method with a code for each photograph is fitted to the left half of a held-out one and compared on the right
(`halves`). Raw photographs are compared as noise-free linear light (Mildenhall 2022, section 5.1).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..components.training.development import decoded, encoded
from ..datasets.dataset import Dataset
from ..datasets.scene import Photograph, Scene
from ..errors import LumigraphError
from ..figures import ERROR_GAIN, Row, colour_depth, colour_error, contact_sheet, depth_range
from ..geometry import evenly
from ..method import Method
from ..method.depth import DEPTH_LAYER
from ..metrics import WINDOW, Score, psnr, scores_of, ssim_map
from ..metrics.detail import FineDetail, detail
from ..metrics.lpips import DEFINITION, Lpips
from ..readers.views import with_fewer_views
from ..system.progress import counting, track
from ..system.work import at_work
from .baseline import Baselines
from .halves import LEFT_HALVES, RIGHT_HALVES, judged_by_halves, left_half, right_half
from .held_out import held_out_kinds
from .held_out_poses import PROTOCOL, held_out_poses, pose_scores
from .options import EvaluationOptions

SHEET_VIEWS = 8  # views of the contact sheet, evenly spread; the worst one joins them
MOVING_LAYER, MOVING = "moving", 1  # the layer that marks what moves, and its mark
CLEAN_LAYER = "clean"  # the layer of photographs in their own light without passers-by
WARM_UP_SIZE = 32  # pixels; the first rendering compiles kernels, which is no time of the view
CAPTURED_POSES = "as captured"
LIGHT_LAYER = "radiance"  # the layer that holds it, 1 for white
LIGHT_PROTOCOL = (
    "sRGB of light without noise, clipped at white; each rendering's linear light is aligned with it by a factor and "
    "an offset per colour, least squares, before both are encoded"
)

Picture = Float[Tensor, "height width 3"]
Likeness = Float[Tensor, "inner_height inner_width 3"]  # SSIM of the windows within a picture


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view: PSNR in dB, SSIM, rendering seconds, LPIPS if its weights are available, PSNR against the
    photograph without transient objects if known, PSNR and SSIM of moving objects if their mask is known, and fine
    detail if the photograph has any.

    held_out: of a dynamic capture, camera or time; see `held_out_kinds`
    """

    name: str
    resolution: str
    psnr: float
    ssim: float
    seconds: float
    lpips: float | None = None
    clean_psnr: float | None = None
    moving_psnr: float | None = None
    moving_ssim: float | None = None
    detail: FineDetail | None = None
    held_out: str | None = None
    depth_error: float | None = None  # mean over pixels with a measured depth, percent of the distance
    baselines: dict[str, float] = field(default_factory=dict)  # PSNR of trivial stand-ins, see `baseline`


@dataclass(frozen=True)
class ViewsEvaluation:
    """Scores of all views of a split, and the protocol.

    compile_seconds: spent before the first view
    members: of a collection, whose means are averaged, so that each has the same weight for any number of views
    """

    views: list[ViewScore]
    protocol: dict[str, Any]
    compile_seconds: float
    shown: dict[str, tuple[Tensor, Rendering]]  # some views' photograph and rendering
    poses: tuple[Score, ...] = ()  # how far refined poses are from true ones, where these are known
    members: tuple[ViewsEvaluation, ...] = ()

    @property
    def _averaged(self) -> Sequence[ViewsEvaluation | ViewScore]:
        return self.members or self.views

    @property
    def psnr(self) -> float:
        """Mean PSNR in dB over the views; of a collection, over its members' means."""
        return mean(each.psnr for each in self._averaged)

    @property
    def ssim(self) -> float:
        """Mean SSIM, likewise."""
        return mean(each.ssim for each in self._averaged)

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS over the views; None if it was not measured."""
        return mean_known(each.lpips for each in self._averaged)

    @property
    def clean_psnr(self) -> float | None:
        """Mean PSNR against photographs without transient objects; None if unknown."""
        return mean_known(each.clean_psnr for each in self._averaged)

    @property
    def moving_psnr(self) -> float | None:
        """Mean PSNR of moving objects alone; None without their mask."""
        return mean_known(each.moving_psnr for each in self._averaged)

    @property
    def moving_ssim(self) -> float | None:
        """Mean SSIM of moving objects alone, likewise."""
        return mean_known(each.moving_ssim for each in self._averaged)

    @property
    def depth_error(self) -> float | None:
        """Mean error of depth in percent of the distance; None without measurements."""
        return mean_known(each.depth_error for each in self._averaged)

    @property
    def baselines(self) -> dict[str, float]:
        """Mean PSNR of each trivial stand-in, likewise; empty for training photographs."""
        names = self._averaged[0].baselines
        return {name: mean(each.baselines[name] for each in self._averaged) for name in names}

    @property
    def detail(self) -> FineDetail | None:
        """Mean detail over the views; None if no photograph has fine detail."""
        found = [each.detail for each in self._averaged]
        sharp, gain = (mean_known(getattr(x, name, None) for x in found) for name in FineDetail.__annotations__)
        return None if sharp is None or gain is None else FineDetail(sharp, gain)

    @property
    def seconds_per_view(self) -> float:
        """Mean time to render a view."""
        return mean(view.seconds for view in self.views)

    @property
    def by_resolution(self) -> dict[str, ViewsEvaluation]:
        """The views of each size alone, sizes in the order in which they come."""
        return self._by("resolution")

    @property
    def by_held_out(self) -> dict[str, ViewsEvaluation]:
        """Views of a dynamic capture by kind: new cameras, new times or both."""
        return self._by("held_out")

    def _by(self, name: str) -> dict[str, ViewsEvaluation]:
        """The views of each value of one of their fields."""
        values = dict.fromkeys(getattr(view, name) for view in self.views)
        return {value: self._where(name, value) for value in values if value is not None}

    def _where(self, name: str, value: str) -> ViewsEvaluation:
        views = [view for view in self.views if getattr(view, name) == value]
        members = tuple(part for member in self.members if (part := member._where(name, value)).views)
        return replace(self, views=views, members=members)

    def means(self) -> dict[str, Any]:
        """PSNR, SSIM, LPIPS and the further means that are known, by the names of `eval.json`."""
        further = {name: getattr(self, name) for name in ("clean_psnr", "moving_psnr", "moving_ssim", "depth_error")}
        known = {name: value for name, value in further.items() if value is not None}
        return {"psnr": self.psnr, "ssim": self.ssim, "lpips": self.lpips} | known

    @property
    def scores(self) -> list[Score]:
        """The means as scores, then the errors of poses."""
        return [*scores_of(self.means()), *self.poses]

    @property
    def compared(self) -> str:
        """Title of the comparison."""
        parts = "right halves of " if self.protocol["halves"] else ""
        return f"{parts}{len(self.views)} {self.protocol['split']} views"

    def to_json(self) -> dict[str, Any]:
        sizes, kinds = (
            {name: part.means() | {"views": len(part.views)} for name, part in parts.items()}
            for parts in (self.by_resolution, self.by_held_out)
        )
        return {
            **self.means(),
            **({"by_resolution": sizes} if len(sizes) > 1 else {}),
            **({"by_held_out": kinds} if kinds else {}),
            **({"baselines": self.baselines} if self.baselines else {}),
            **({} if self.detail is None else {"detail": asdict(self.detail)}),
            "protocol": self.protocol,
            "seconds_per_view": self.seconds_per_view,
            "render_compile_seconds": self.compile_seconds,
            "views": [asdict(view) for view in self.views],
            "scores": [score.to_json() for score in self.scores],
        }

    def contact_sheet(self, title: str) -> Image.Image:
        """Photograph, rendering, error and depth of the shown views, the worst of all last."""
        scores = {view.name: view for view in self.views}
        worst = min(self.views, key=lambda view: view.psnr).name
        rows = []
        for name in sorted(self.shown, key=lambda name: (name == worst, list(scores).index(name))):
            photograph, seen = self.shown[name]
            label = f"{name} · {scores[name].psnr:.2f} dB · SSIM {scores[name].ssim:.3f}"
            depth = colour_depth(seen.depth, seen.opacity, depth_range(seen.depth, seen.opacity))
            pictures = [photograph, seen.rgb, colour_error(photograph, seen.rgb), depth]
            rows.append(Row(f"worst: {label}" if name == worst and len(self.views) > 1 else label, pictures))
        return contact_sheet(title, ["photograph", "rendering", f"{ERROR_GAIN}x error", "depth"], rows)


@at_work()
def evaluate(
    method: Method,
    scene: Scene,
    options: EvaluationOptions = EvaluationOptions(),
    keep: Callable[[str, Rendering], object] = lambda name, rendering: None,
    lpips: Lpips | None = None,
) -> ViewsEvaluation:
    """Render the views of a split and compare them with their photographs.

    keep:  receives each view's name and rendering
    lpips: the network of the options' files
    Cameras are those that the method refined; held-out ones are then found as `held_out_poses` says, and codes from
    there. Pixels that the photograph's mask rules out do not count, nor does a photograph that it rules out altogether.
    A method that photographs can be given to is judged by halves. Raises LumigraphError if the split has no view.
    """
    split, views, right_halves = options.split, options.views, options.right_halves
    chosen = scene.splits.get(split)
    if chosen is None or not len(chosen):
        there = ", ".join(f"{name} ({len(index)} views)" for name, index in scene.splits.items() if len(index))
        raise LumigraphError(f"{scene.source} has no views in the split {split!r}; choose one of: {there}")
    if views is not None and views < 1:
        raise LumigraphError(f"{views} views cannot be compared; give --views a number above 0")
    compared = evenly(chosen.tolist(), views or len(chosen))
    by_halves = judged_by_halves(method)
    check_sizes(scene, compared, by_halves or right_halves)
    method.eval()
    with counting("Preparing to render"):
        compile_seconds = warm_up(method, scene.cameras[compared[0]])
    spread = set(evenly(compared, SHEET_VIEWS))
    found, kinds = held_out_poses(method, scene), held_out_kinds(scene)
    stand_ins = None if split == "train" else Baselines(scene, method.evidence_views)
    known = [name for name in (CLEAN_LAYER, LIGHT_LAYER, MOVING_LAYER, DEPTH_LAYER) if name in scene.layers]
    scores: list[ViewScore] = []
    shown: dict[str, tuple[Tensor, Rendering]] = {}
    worst: dict[str, tuple[Tensor, Rendering]] = {}
    for index in track(compared, "Comparing views", len(compared)):
        shot = scene.photograph(index, known)
        camera = found.camera(index) if found else method.refined(shot.camera)
        columns = right_half(shot) if by_halves or right_halves else slice(None)
        if shot.mask is not None and not shot.mask[:, columns].any():
            continue
        photograph = shot.before(scene.frame.background)
        told = method.given(left_half(replace(shot, camera=camera))) if by_halves else method
        begin = time.perf_counter()
        seen = told.render(camera).cpu()
        seconds = time.perf_counter() - begin
        rgb = seen.rgb.clamp(0, 1)
        if LIGHT_LAYER in shot.extra:
            rgb, photograph = in_light(seen, shot.extra[LIGHT_LAYER])
            seen = replace(seen, rgb=rgb)
        score = compare(scene.names[index], rgb, shot, photograph, columns, seconds, lpips)
        if DEPTH_LAYER in shot.extra:
            score = replace(score, depth_error=depth_error(seen, shot.extra[DEPTH_LAYER]))
        trivial = {} if stand_ins is None else stand_ins.of(index, (photograph.shape[0], photograph.shape[1]))
        score = replace(score, held_out=kinds[index], baselines=trivial_scores(trivial, shot, photograph, columns))
        keep(score.name, seen)
        if index in spread:
            shown[score.name] = photograph, seen
        if all(score.psnr < other.psnr for other in scores):
            worst = {score.name: (photograph, seen)}
        scores.append(score)
    if not scores:
        raise LumigraphError(
            f"{scene.source} has masks that leave nothing of the views in the split {split!r} to compare"
        )
    stated = protocol(scene, split, compared, lpips, method, right_halves) | ({"poses": PROTOCOL} if found else {})
    poses = tuple(pose_scores(method, scene))
    return ViewsEvaluation(scores, stated, compile_seconds, shown | worst, poses)


def check_sizes(scene: Scene, compared: list[int], halves: bool) -> None:
    """Raise LumigraphError for a photograph that is smaller than a window of SSIM, or whose right half is."""
    for index in compared:
        width, height = scene.cameras.size[index].tolist()
        if min(width - width // 2 if halves else width, height) < WINDOW:
            part = f"the right half of {scene.names[index]}" if halves else scene.names[index]
            raise LumigraphError(
                f"SSIM compares {WINDOW} x {WINDOW} pixels, and {part}, of {resolution(width, height)} pixels, has "
                "fewer across; train and evaluate with larger photographs or a lower --downscale"
            )


def compare(
    name: str,
    rgb: Float[Tensor, "height width 3"],
    shot: Photograph,
    photograph: Float[Tensor, "height width 3"],
    columns: slice,
    seconds: float,
    lpips: Lpips | None = None,
) -> ViewScore:
    """A view's scores, by some of its columns.

    photograph: of the shot, before the scene's background
    """
    size = resolution(photograph.shape[1], photograph.shape[0])
    mask = None if shot.mask is None else shot.mask[:, columns]
    rgb, photograph = rgb[:, columns], photograph[:, columns]
    clean = None
    if CLEAN_LAYER in shot.extra:
        truth = shot.extra[CLEAN_LAYER][:, columns]
        clean = psnr(rgb, truth) if mask is None else psnr(rgb[mask], truth[mask])
    likeness = ssim_map(rgb, photograph)
    moving = None
    if MOVING_LAYER in shot.extra:
        moving = shot.extra[MOVING_LAYER][:, columns] == MOVING
        moving = moving if mask is None else moving & mask
    about_moving = of_pixels(rgb, photograph, likeness, moving)
    shown = detail(rgb, photograph, mask)
    if mask is None:
        closeness = psnr(rgb, photograph), float(likeness.mean())
        perceived = lpips(rgb, photograph) if lpips else None
    else:
        closeness = psnr(rgb[mask], photograph[mask]), of_windows(likeness, mask) or 0.0
        perceived = lpips(torch.where(mask[..., None], rgb, photograph), photograph) if lpips else None
    return ViewScore(name, size, *closeness, seconds, perceived, clean, *about_moving, shown)


def trivial_scores(
    pictures: dict[str, Picture], shot: Photograph, photograph: Picture, columns: slice
) -> dict[str, float]:
    """PSNR of stand-ins for a photograph, of the pixels that `compare` compares."""
    kept = torch.ones(photograph.shape[:2], dtype=torch.bool) if shot.mask is None else shot.mask
    kept, truth = kept[:, columns], photograph[:, columns]
    if LIGHT_LAYER in shot.extra:
        light = shot.extra[LIGHT_LAYER].clamp(0, 1)
        pictures = {name: encoded(aligned(decoded(rgb), light).clamp(0, 1)) for name, rgb in pictures.items()}
    return {name: psnr(rgb[:, columns][kept], truth[kept]) for name, rgb in pictures.items()}


def of_pixels(
    rgb: Picture, photograph: Picture, likeness: Likeness, mask: Bool[Tensor, "height width"] | None
) -> tuple[float | None, float | None]:
    """PSNR and SSIM of a mask's pixels; None where there are none. likeness: `ssim_map` of the whole"""
    if mask is None or not mask.any():
        return None, None
    return psnr(rgb[mask], photograph[mask]), of_windows(likeness, mask)


def of_windows(likeness: Likeness, mask: Bool[Tensor, "height width"]) -> float | None:
    """Mean SSIM of the windows with centres in a mask; None without any."""
    edge = WINDOW // 2
    inner = likeness[mask[edge:-edge, edge:-edge]]
    return float(inner.mean()) if len(inner) else None


def depth_error(seen: Rendering, measured: Float[Tensor, "height width"]) -> float | None:
    """Mean error of a rendering's depth in percent of the measured distance; None without measurements.

    The error of an empty pixel, and of a surface at more than twice the distance, is 100 %.
    """
    known = measured.isfinite() & (measured > 0)
    if not known.any():
        return None
    error = (seen.depth[known] - measured[known]).abs() / measured[known]
    return 100 * float(error.nan_to_num(1.0, 1.0).clamp(max=1).mean())


def warm_up(method: Method, camera: Camera) -> float:
    """Render a very small picture, to exclude compilation on first use. Returns the seconds."""
    begin = time.perf_counter()
    method.render(camera.resized(min(1.0, WARM_UP_SIZE / int(camera.size.max()))))
    return time.perf_counter() - begin


def protocol(
    scene: Scene, split: str, compared: list[int], lpips: Lpips | None, method: Method, right_halves: bool = False
) -> dict[str, Any]:
    """Protocol: everything needed to compare these figures with others."""
    captured = scene.cameras[torch.tensor(compared)]
    refined = not torch.equal(method.refined(captured).pose.cpu(), captured.pose)
    sizes = list(dict.fromkeys(resolution(*size) for size in scene.cameras.size[compared].tolist()))
    return {
        "split": split,
        "views": len(compared),
        "of": len(scene.splits[split]),
        "resolution": sizes[0] if len(sizes) == 1 else sizes,
        "background": list(scene.frame.background) if scene.frame.has_alpha else None,
        "poses": "as the method refined them" if refined else CAPTURED_POSES,
        "controls": dict(method.settings),
        "halves": LEFT_HALVES if judged_by_halves(method) else RIGHT_HALVES if right_halves else None,
        "masked": any(scene.images.mask(i) is not None for i in compared),
        "colours": LIGHT_PROTOCOL if LIGHT_LAYER in scene.layers else "sRGB in [0, 1]; renderings clipped, not rounded",
        "psnr": "per view, then averaged",
        "ssim": "Wang 2004: Gaussian window 11x11, deviation 1.5, K1 0.01, K2 0.03, windows inside the image",
        "lpips": DEFINITION if lpips else None,
    }


def resolution(width: int, height: int) -> str:
    return f"{width}x{height}"


def file_name(name: str) -> str:
    """A view's name without folders and ending."""
    return str(Path(name).with_suffix("")).strip("./").replace("/", "-")


def mean(values) -> float:
    found = list(values)
    return sum(found) / len(found)


def mean_known(values: Iterable[float | None]) -> float | None:
    """The mean of those that are known; None if none is."""
    found = [value for value in values if value is not None]
    return mean(found) if found else None


def in_light(seen: Rendering, truth: Picture) -> tuple[Picture, Picture]:
    """Rendering and truth as comparable pictures, encoded in [0, 1].

    A rendering without light of its own (`radiance`) is decoded.
    """
    light = seen.extra[LIGHT_LAYER] if LIGHT_LAYER in seen.extra else decoded(seen.rgb.clamp(0, 1))
    truth = truth.clamp(0, 1)
    return encoded(aligned(light.clamp(0, 1), truth).clamp(0, 1)), encoded(truth)


def aligned(light: Picture, truth: Picture) -> Picture:
    """a · light + b of each colour, least squares against the truth."""
    x, y = light.double(), truth.double()
    mean_x, mean_y = x.mean((0, 1)), y.mean((0, 1))
    variance = (x - mean_x).square().mean((0, 1))
    slope = ((x - mean_x) * (y - mean_y)).mean((0, 1)) / variance.clamp_min(1e-12)
    return torch.addcmul(mean_y, slope, x - mean_x).float()


def reveal(method: Method, data: Dataset) -> Method:
    """The method with a dataset as evidence if it accepts that kind: of photographs training ones only, and no more
    than `Method.evidence_views`."""
    if not isinstance(data, method.takes):
        return method
    if isinstance(data, Scene):
        there = len(data.splits["train"])
        fewer = with_fewer_views(data, min(method.evidence_views or there, there))
        return method.given(replace(fewer, splits={"train": fewer.splits["train"]}))
    return method.given(data)
