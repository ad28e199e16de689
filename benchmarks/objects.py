"""Objects of scenes: selected by strokes, removed with truth behind them, lifted into other scenes.

    python benchmarks/objects.py strokes --scene procedural:still-life,size=200,views=60 --run RUN
    python benchmarks/objects.py labelled --scene FOLDER --run RUN
    python benchmarks/objects.py removal --scene procedural:still-life,size=100,views=40 --steps 1500
    python benchmarks/objects.py film --part can.ply --run RUN --into OTHER_RUN

strokes: intersection over union of each thing of a procedural scene with its true mask over held-out views, after one,
two and three strokes on one photograph. A stroke follows the longest path inside a region, as a hand would: the first
one inside the thing, each further one inside the largest region that the picture of that photograph has wrong, green
where something is missing, red where something is too much, and none where nothing thicker than two pixels is wrong.
Seconds are those of processors for a stroke and the picture of its outcome; features are distilled once before.

labelled: the same strokes on real photographs, FOLDER with `labels/` of some training and some held-out views (0 is
unknown or background), and where RUN has learnt instances, of each alone where nothing of the whole scene hides it.

removal: things are removed, and held-out views compared with the scene traced without them, at the pixels where each
thing was seen. Photographs keep its shadow on the floor, so the truth behind has that shadow: the surface behind, lit
as it was. `psnr without` has no removal at all. object-nerf learns with guidance and without it.

film: what strokes have selected and `lumigraph segment` has extracted, set on the floor of another run.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from scipy import ndimage
from skimage.graph import MCP_Geometric

from lumigraph import methods
from lumigraph import synthetic as procedural
from lumigraph.color.srgb import srgb_from_linear
from lumigraph.composition import PickedCloud
from lumigraph.exchange import read_gaussians
from lumigraph.figures import Row, contact_sheet
from lumigraph.files.ranges import changed
from lumigraph.gaussians import joined
from lumigraph.geometry import Similarity, evenly
from lumigraph.large import open_any
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.selection import Selection, Strokes, describe, distil_features, feature_network
from lumigraph.synthetic.stage import told
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

STROKES = 3
STRIP = 6  # frames
INNER = 2.5  # pixels from the edge of a region at which a stroke keeps, where there is room
WORTH = 2.0  # pixels: half the thickness of a region that is worth a stroke
BEHIND = 1e-3  # scene units in front of a surface, from where a ray sees it lit as it is
HIDDEN = 1.05  # times the depth of the whole scene, beyond which an instance is hidden
FINER = 4  # rays across a pixel of the truth
MIN_PIXELS = 60  # of a thing in the photograph for its strokes


@dataclass(frozen=True)
class StrokeOptions:
    """Segmentation by simulated strokes on a procedural scene."""

    run: Path
    scene: str = "procedural:still-life,size=200,views=60"
    distilled: int = 30  # photographs
    held_out: int = 8  # views that are compared
    features: Path | None = None
    output: Path = Path("objects-strokes.json")

    def conduct(self) -> None:
        run, scene = open_any(self.run), open_scene(self.scene)
        method, train = run.method(), scene.splits["train"].tolist()
        photographs = [scene.photograph(i) for i in evenly(train, self.distilled)]
        about: Any = describe
        if self.features:
            about = feature_network(self.features, [x.before(scene.frame.background) for x in photographs[::4]])
        begin = time.process_time()
        points = distil_features(method, photographs, about)
        distilling = time.process_time() - begin
        rows = {}
        for number, name in enumerate(scene.layer("labels").names):
            view = max(train[::4], key=lambda i: int(true_mask(scene, i, number).sum()))
            if true_mask(scene, view, number).sum() < MIN_PIXELS:
                continue
            rows[name] = self.of(Selection(method, points), scene, view, number)
            found = " ".join(f"{x:.3f}" for x in rows[name]["iou"])
            print(f"{name:12} {found}   {max(rows[name]['seconds']):.2f} s a stroke at most")
        mean = np.mean([x["iou"] for x in rows.values()], 0)
        print(f"mIoU after 1, 2, 3 strokes: {' '.join(f'{x:.3f}' for x in mean)}; distilling took {distilling:.1f} s")
        said = {"scene": self.scene, "things": rows, "miou": mean.tolist(), "distilling_seconds": distilling}
        self.output.write_text(json.dumps(said, indent=1))

    def of(self, selection: Selection, scene: Any, view: int, number: int) -> dict[str, Any]:
        """One thing: intersection over union after each stroke, and its seconds."""
        truth, camera = true_mask(scene, view, number), scene.cameras[view]
        shown, found, seconds = np.zeros_like(truth), [], []
        views = evenly(scene.splits["test"].tolist(), self.held_out)
        for count in range(STROKES):
            missing, surplus = truth & ~shown, shown & ~truth
            wanted = not count or thickness(missing) >= thickness(surplus)
            drawn = stroke_in(missing if wanted else surplus, least=0.0 if not count else WORTH)
            if drawn.any():
                none, line = torch.zeros(truth.shape, dtype=torch.bool), torch.from_numpy(drawn)
                begin = time.process_time()
                selection.add(Strokes(camera, line if wanted else none, none if wanted else line))
                chosen = selection.chosen()
                shown = (selection.mask(camera, chosen) > 0.5).numpy()
                seconds.append(time.process_time() - begin)
                masks = [(selection.mask(scene.cameras[i], chosen) > 0.5).numpy() for i in views]
            true = [true_mask(scene, i, number) for i in views]
            both = sum(int((a & b).sum()) for a, b in zip(masks, true, strict=True))
            either = sum(int((a | b).sum()) for a, b in zip(masks, true, strict=True))
            found.append(both / max(either, 1))
        return {"iou": found, "seconds": seconds}


@dataclass(frozen=True)
class LabelledOptions(StrokeOptions):
    """Strokes, and learnt instances, against hand-made labels of some photographs."""

    scene: str = "scene"
    output: Path = Path("objects-labelled.json")

    def conduct(self) -> None:
        run, scene = open_any(self.run), open_scene(self.scene)
        method, layer, splits = run.method(), scene.layer("labels"), {}
        for split in ("train", "test"):
            splits[split] = torch.tensor([i for i in scene.splits[split].tolist() if layer.planes[i] is not None])
        photographs = [scene.photograph(i) for i in evenly(scene.splits["train"].tolist(), self.distilled)]
        about: Any = describe
        if self.features:
            about = feature_network(self.features, [x.before(scene.frame.background) for x in photographs[::4]])
        points = distil_features(method, photographs, about)
        labelled = replace(scene, splits=splits)
        numbers = sorted({x for i in splits["test"].tolist() for x in np.unique(layer.stored(i)).tolist()} - {0})
        rows: dict[int, dict[str, Any]] = {}
        for number in numbers:
            view = max(splits["train"].tolist(), key=lambda i: int(true_mask(scene, i, number).sum()))
            rows[number] = self.of(Selection(method, points), labelled, view, number)
            if any(x.name == "edit" for x in method.controls):
                rows[number]["instance"] = self.alone(method, labelled, number)
            print(
                number, " ".join(f"{x:.3f}" for x in rows[number]["iou"]), rows[number].get("instance", ""), flush=True
            )
        mean = np.mean([x["iou"] for x in rows.values()], 0)
        print(f"mIoU after 1, 2, 3 strokes: {' '.join(f'{x:.3f}' for x in mean)}")
        self.output.write_text(json.dumps({"scene": self.scene, "things": rows, "miou": mean.tolist()}, indent=1))

    def alone(self, method: Any, scene: Any, number: int) -> float:
        """Intersection over union of what is seen of an instance alone, over the held-out labelled views."""
        both = either = 0
        for i in scene.splits["test"].tolist():
            whole, own = method.render(scene.cameras[i]), method.given(edit=f"alone {number}").render(scene.cameras[i])
            shown = (own.opacity > 0.5) & (own.depth < HIDDEN * whole.depth)
            truth = torch.from_numpy(true_mask(scene, i, number))
            both, either = both + int((shown & truth).sum()), either + int((shown | truth).sum())
        return both / max(either, 1)


def true_mask(scene: Any, image: int, number: int) -> np.ndarray:
    return (scene.photograph(image, ("labels",)).extra["labels"] == number).numpy()


def depth_inside(mask: np.ndarray) -> np.ndarray:
    """Distance of each pixel of a region to its edge."""
    return ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1]


def thickness(mask: np.ndarray) -> float:
    """Pixels of a region that remain two pixels from its edge."""
    return float((depth_inside(mask) >= WORTH).sum())


def stroke_in(mask: np.ndarray, least: float) -> np.ndarray:
    """The longest path inside the largest part of a region, three pixels wide; nothing in one that is thinner than
    `least`."""
    parts, count = ndimage.label(mask)
    inside = depth_inside(mask)
    if not count or inside.max() < least:
        return np.zeros_like(mask)
    numbers = np.arange(1, count + 1)
    sizes = ndimage.sum(mask, parts, numbers) * (ndimage.maximum(inside, parts, numbers) >= least)
    inside = np.where(parts == numbers[int(np.argmax(sizes))], inside, 0)
    core, count = ndimage.label(inside >= min(INNER, 0.7 * inside.max()))
    core = core == 1 + int(np.argmax(ndimage.sum(core > 0, core, np.arange(1, count + 1))))
    costs = np.where(core, 1 + 4 / np.maximum(inside, 0.5), -1.0)
    start = tuple(int(x[0]) for x in np.nonzero(core))
    for _ in range(2):  # from the farthest place to the farthest from there
        graph = MCP_Geometric(costs)
        away = np.where(core, graph.find_costs([start])[0], -1.0)
        start = tuple(int(x) for x in np.unravel_index(int(away.argmax()), away.shape))
    line = np.zeros_like(mask)
    line[tuple(np.array(graph.traceback(start)).T)] = True
    return ndimage.binary_dilation(line) & core


@dataclass(frozen=True)
class RemovalOptions:
    """Removal of things with truth behind, object-nerf with and without guidance."""

    scene: str = "procedural:still-life,size=100,views=40"
    things: tuple[str, ...] = ("castle", "checks", "ball", "abacus")
    steps: int = 1500
    held_out: int = 8
    samples: int = 1 << 15  # of a step of object-nerf
    identities: bool = False  # gaussian-splatting with identity codes as well
    output: Path = Path("objects-removal.json")

    def conduct(self) -> None:
        scene, request = open_scene(self.scene), self.scene.removeprefix("procedural:")
        kind, numbers = told(procedural.scenes.options(request.partition(",")[0]), request)
        stage = procedural.scenes.stage(kind, **{k: v for k, v in vars(numbers).items() if k != "jitter_poses"})
        views = evenly(scene.splits["test"].tolist(), self.held_out)
        names, rows, pictures = scene.layer("labels").names, {}, {}
        truths = {name: [truth_behind(stage.world, name, scene, i) for i in views] for name in self.things}
        variants: dict[str, Any] = {"object-nerf": {"guided": True}, "object-nerf, unguided": {"guided": False}}
        if self.identities:
            variants["gaussian-splatting"] = {}
        for label, options in variants.items():
            kind_of = methods.find(label.partition(",")[0])
            config = kind_of.cpu_preset()
            if "splatting" in label:
                config = changed(config, objects="yes")
            else:
                config = changed(config, samples_per_step=self.samples)
            method = build(kind_of, scene.frame, changed(config, **options), torch.device("cpu"), 0)
            begin = time.process_time()
            go_on_unless(fit(method, scene, steps=self.steps, show=False, rehearsal=False).signal)
            seconds = time.process_time() - begin
            rows[label] = {"seconds": seconds}
            for name in self.things:
                gone = method.given(edit=f"remove {names.index(name)}")
                removed = [gone.render(scene.cameras[i]).rgb for i in views]
                whole = [method.render(scene.cameras[i]).rgb for i in views]
                rows[label][name] = {
                    "psnr": hole_psnr(removed, truths[name]),
                    "psnr without removal": hole_psnr(whole, truths[name]),
                }
                pictures[label, name] = whole[0], removed[0], truths[name][0][0]
            mean = np.mean([rows[label][name]["psnr"] for name in self.things])
            rows[label]["mean"] = float(mean)
            print(label, json.dumps(rows[label]))
        self.output.write_text(json.dumps({"scene": self.scene, "steps": self.steps, "methods": rows}, indent=1))
        sheet = [Row(f"{label}: {name}", shown) for (label, name), shown in pictures.items()]
        contact_sheet(self.scene, ("whole", "removed", "truth"), sheet, 300).save(self.output.with_suffix(".png"))


def truth_behind(world: Any, name: str, scene: Any, image: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Picture without a thing, lit as with it, over the background; and the pixels at which it was seen."""
    camera = scene.cameras[image].resized(FINER)
    width, height = camera.size[0].tolist()
    rays = camera.rays(camera.pixels())
    empty = replace(world, objects=tuple(x for x in world.objects if x.name != name))
    behind = procedural.trace(empty, rays, shaded=False)
    hit = np.isfinite(behind.depth)
    begin = torch.from_numpy(np.where(hit, behind.depth - BEHIND, 0.0)).float()
    moved = replace(rays, origins=rays.at(begin))
    light = torch.from_numpy(srgb_from_linear(procedural.trace(world, moved).radiance)).float()
    rgb = torch.where(torch.from_numpy(hit)[:, None], light, torch.tensor(scene.frame.background))
    small = rgb.view(height // FINER, FINER, width // FINER, FINER, 3).mean((1, 3))
    return small, torch.from_numpy(true_mask(scene, image, world.names.index(name)))


def hole_psnr(pictures: list[torch.Tensor], truths: list[tuple[torch.Tensor, torch.Tensor]]) -> float:
    """PSNR over the pixels at which a thing was seen, of all views together."""
    error = torch.cat([(x - rgb)[hole].square().flatten() for x, (rgb, hole) in zip(pictures, truths, strict=True)])
    return float(-10 * error.mean().log10())


@dataclass(frozen=True)
class FilmOptions:
    """An extracted object on the floor of another scene, as a strip of a film."""

    part: Path  # splat file that `lumigraph segment` has written
    run: Path  # the run that it was cut from
    into: Path  # a run of Gaussians
    view: int = 8  # photograph of that run in which the place is named
    place: tuple[float, float] = (0.72, 0.88)  # of the object's foot on it, shares of width and height
    height: float = 0.25  # of the object, in distances from that camera
    output: Path = Path("objects-film.png")

    def conduct(self) -> None:
        own, other = open_any(self.run), open_any(self.into)
        part = read_gaussians(self.part).transformed(own.frame.to_source.inverse.matrix)
        solid = part.means[part.opacities.sigmoid() > 0.3]
        low, high = torch.quantile(solid, torch.tensor([0.05, 0.95]), dim=0)
        foot = torch.tensor([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]).double()
        cameras, method = other.cameras()["train"], other.method()
        camera = cameras[self.view]
        depth = method.render(camera).depth
        row, column = (int(share * n) for share, n in zip(reversed(self.place), depth.shape, strict=True))
        rays = camera.rays(camera.pixels())
        goal = rays.at(depth.flatten().nan_to_num(1, 1))[row * depth.shape[1] + column].double()
        scale = self.height * float(depth[row, column]) / float(high[2] - low[2])
        moved = part.transformed(Similarity.make(scale, None, goal - scale * foot).matrix)
        both = PickedCloud(other.frame, joined([method.gaussians(), moved]))
        order = evenly(cameras.position[:, 0].argsort().tolist(), STRIP)
        shown = [both.render(cameras[i]).rgb for i in order]
        rows = [Row("", shown[i : i + STRIP // 2]) for i in range(0, STRIP, STRIP // 2)]
        contact_sheet("", ("",) * (STRIP // 2), rows, 360).save(self.output)


Chosen = (
    Annotated[StrokeOptions, tyro.conf.subcommand("strokes")]
    | Annotated[LabelledOptions, tyro.conf.subcommand("labelled")]
    | Annotated[RemovalOptions, tyro.conf.subcommand("removal")]
    | Annotated[FilmOptions, tyro.conf.subcommand("film")]
)

if __name__ == "__main__":
    tyro.cli(Chosen).conduct()  # type: ignore[call-overload]
