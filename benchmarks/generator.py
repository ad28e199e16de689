"""EG3D by its figures: training with snapshots, then FID over training, sheets, consistency, nearest photographs and an
inversion.

    python benchmarks/generator.py procedural:toys,count=240,views=40 --run runs/toys-eg3d --steps 15000
    python benchmarks/generator.py procedural:toys,count=240,views=40 --run runs/toys-eg3d --figures figures

Training goes on where it stopped; a snapshot of the averaged generator is kept every `--snapshot` steps. Figures:

    fid.svg            FID with the features that ship, over the pictures seen; dashed, between photographs alone
    drawn.png          seeds at four views each; truncated.png: the same, closer to the average
    consistency.png    a view carried into another by its depth, and that view itself; figures of both kinds of pictures
    nearest.png        drawn objects beside the nearest photographs that were learnt from, by pixels and by features
    inverted.png       unseen objects found in one photograph: its own view, and two held-out ones beside the truth
    figures.json       all figures
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import safetensors.torch
import torch
import tyro
from torch import Tensor

from lumigraph.camera import Camera
from lumigraph.commands.draw import magnified, turned
from lumigraph.components.fields.kept_photographs import square
from lumigraph.datasets.collection import Collection
from lumigraph.depth_maps import DepthMap
from lumigraph.evaluation.drawings import drawn_pictures, photographs_of
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.figures.charts import Series, line_chart, standalone
from lumigraph.files import write_bytes, write_json
from lumigraph.geometry import evenly
from lumigraph.methods.eg3d import EG3D
from lumigraph.metrics import psnr
from lumigraph.metrics.distribution import RandomFeatures, distances, features_of
from lumigraph.opening import open_dataset
from lumigraph.readers.views import with_fewer_views
from lumigraph.run import Run, build
from lumigraph.training import fit

ANGLES = 15, 30, 60  # degrees between two views of a consistency
FIGURES = "drawn", "consistency", "inversion", "fid", "nearest"


@dataclass(frozen=True)
class Options:
    collection: tyro.conf.Positional[str]
    run: Path = Path("runs/eg3d")
    steps: int = 15_000
    snapshot: int = 250  # steps from one snapshot to the next
    film: bool = False  # train pi-GAN's field instead of planes
    figures: Path | None = None  # folder of the figures; none trains
    only: tuple[Literal["drawn", "consistency", "inversion", "fid", "nearest"], ...] = FIGURES
    pictures: int = 500  # of each set that FID compares
    snapshots: int = 12  # at most, evenly over training, that FID is computed for
    seeds: int = 16
    inverted: int = 4  # unseen objects


def train(options: Options, data: Collection) -> None:
    """Train in stretches of `snapshot` steps, and keep the averaged generator after each."""
    if (options.run / "config.json").exists():
        run = Run(options.run)
    else:
        config = replace(EG3D.cpu_preset(), field="film" if options.film else "planes")
        run = Run.create(options.run, build(EG3D, data.frame, config, torch.device("cpu"), 0), data)
    (options.run / "snapshots").mkdir(exist_ok=True)
    step, signal = run.state.step if run.has_state else 0, None
    while step < options.steps and signal is None:
        method, pause = run.new_method("cpu"), step + options.snapshot
        signal = fit(method, data, run, steps=options.steps, pause_at=pause, show=False, rehearsal=False).signal
        step = run.state.step
        weights = {name: value.half() for name, value in method.averaged.state_dict().items()}
        safetensors.torch.save_file(weights, options.run / "snapshots" / f"{step:06d}.safetensors")
        rounded = {name: round(value, 3) for name, value in method.figures.items()}
        print(step, f"{time.process_time():.0f} s of a processor", rounded, flush=True)


def fid_over_training(options: Options, run: Run, data: Collection, folder: Path) -> dict[str, Any]:
    """FID and KID of snapshots against photographs; of other photographs, and of unseen objects', for comparison."""
    network, count = RandomFeatures(), options.pictures
    real, cameras = photographs_of(data, count, 0)
    floors = {
        "photographs of the same objects": photographs_of(data, count, 1)[0],
        "photographs of unseen objects": photographs_of(data, count, 2, "test")[0],
    }
    found: dict[str, Any] = {name: [x.value for x in distances(real, other, network)] for name, other in floors.items()}
    states: dict[int, Path | None] = {0: None}  # the generator before any step, snapshots, and the run as it is
    snapshots = sorted((options.run / "snapshots").glob("*.safetensors"))
    states |= {int(path.stem): path for path in evenly(snapshots, options.snapshots)}
    rows = []
    for step in [*states, *([run.state.step] if run.state.step not in states else [])]:
        method, path = run.method("cpu") if step else run.new_method("cpu"), states.get(step)
        if path:
            weights = {name: value.float() for name, value in safetensors.torch.load_file(path).items()}
            method.averaged.load_state_dict(weights, strict=False)
        fid, kid = distances(real, drawn_pictures(method, cameras, 0), network)
        rows.append((step * method.config.pictures_per_step, fid.value, kid.value))
        print("pictures, FID, KID:", *rows[-1], flush=True)
    seen, fids, kids = zip(*rows, strict=True)
    ends = (seen[0], seen[-1])
    series = [Series("drawn", seen, fids)]
    series += [Series(name, ends, [value[0]] * 2, dash=1 + i) for i, (name, value) in enumerate(found.items())]
    chart = line_chart(series, "photographs seen", "FID, random features", log=True, marks=True, smoothed=False)
    write_bytes(folder / "fid.svg", standalone(chart))
    return found | {"photographs seen": seen, "FID": fids, "KID": kids, "pictures of each set": count}


def sheet(options: Options, method: EG3D, folder: Path) -> None:
    around = turned(method.viewpoint, 4)
    drawn = [method.draw_object(seed) for seed in range(options.seeds)]
    rows = [Row(f"seed {i}", [magnified(one.render(around[k]).rgb) for k in range(4)]) for i, one in enumerate(drawn)]
    title = f"{options.seeds} drawn objects, four views each"
    save_picture(folder / "drawn.png", contact_sheet(title, ["0°", "90°", "180°", "270°"], rows))
    rows = [
        Row(f"seed {i}", [magnified(one.given(truncation=0.6).render(around[k]).rgb) for k in range(4)])
        for i, one in enumerate(drawn)
    ]
    title = "The same objects, truncation 0.6"
    save_picture(folder / "truncated.png", contact_sheet(title, ["0°", "90°", "180°", "270°"], rows))


def carried(method: EG3D, one: Camera, other: Camera) -> tuple[float, float, Tensor, list[Tensor]]:
    """PSNR of a view carried into another by its depth, over the pixels that both show; the same of a constant colour,
    their mean; which pixels; and pictures to look at."""
    seen = [method.render(camera) for camera in (one, other)]
    behind = method.frame.background
    maps = [DepthMap.of_rendering(camera, each, behind) for camera, each in zip((one, other), seen, strict=True)]
    points = maps[1].positions()
    rgb = maps[1].rgb[maps[1].solid]
    pixels, _, _ = maps[0].project(points)
    visible = maps[0].sees(points, edge=None)
    height, width = maps[0].depth.shape
    place = 2 * pixels / torch.tensor([width, height]) - 1
    sampled = torch.nn.functional.grid_sample(
        maps[0].rgb.permute(2, 0, 1)[None], place[None, None], align_corners=False, padding_mode="border"
    )[0, :, 0].T
    shown, truth = sampled[visible], rgb[visible]
    picture = torch.full((height, width, 3), 0.5)
    solid = maps[1].solid.nonzero()[visible]
    picture[solid[:, 0], solid[:, 1]] = shown
    return psnr(shown, truth), psnr(truth.mean(0).expand_as(truth), truth), visible, [seen[0].rgb, picture, seen[1].rgb]


def consistency(options: Options, method: EG3D, folder: Path) -> dict[str, Any]:
    """PSNR between views, one carried into the other by depth, of final pictures and of volume renderings."""
    found: dict[str, Any] = {}
    rows = []
    for picture in ("final", "volume"):
        for angle in ANGLES:
            scores, constants, shares = [], [], []
            for seed in range(options.seeds):
                shown = method.draw_object(seed).given(picture=picture)
                both = turned(method.viewpoint, 360 // angle)[slice(2)]
                close, constant, visible, pictures = carried(shown, both[0], both[1])
                scores.append(close)
                constants.append(constant)
                shares.append(float(visible.float().mean()))
                if angle == 30 and seed < 6:
                    rows.append(Row(f"seed {seed}, {picture}: {close:.1f} dB", list(map(magnified, pictures))))
            mean = [sum(x) / len(x) for x in (scores, constants, shares)]
            found[f"{picture}, {angle} degrees"] = dict(zip(("psnr", "constant", "share"), mean, strict=True))
            print(picture, angle, *(f"{x:.2f}" for x in mean), flush=True)
    title = "Views carried by depth, 30° (grey: hidden in the first view)"
    save_picture(folder / "consistency.png", contact_sheet(title, ["view", "carried", "other view"], rows))
    return found


def nearest(options: Options, method: EG3D, data: Collection, folder: Path) -> dict[str, Any]:
    """The photographs that were learnt from nearest to drawn ones; distances beside those of unseen objects'."""
    network, side = RandomFeatures(), method.config.picture_size
    known = []
    for _, scene in data.members("train"):
        known += [square(scene.photograph(i), scene.frame, side)[0] for i in scene.splits["train"].tolist()]
    pictures = torch.stack(known).permute(0, 2, 3, 1)
    features = features_of(pictures, network)
    _, cameras = photographs_of(data, options.seeds, 3)
    drawn = drawn_pictures(method, cameras, 3)
    unseen, _ = photographs_of(data, options.seeds, 4, "test")

    def closest(some: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        by_pixels = torch.cdist(some.flatten(1), pictures.flatten(1))
        by_features = torch.cdist(features_of(some, network), features)
        return by_pixels.min(1).values, by_pixels.argmin(1), by_features.argmin(1)

    far, by_pixels, by_features = closest(drawn)
    also_far, *_ = closest(unseen)
    pixels = drawn[0].numel() ** 0.5
    triples = zip(drawn, by_pixels.tolist(), by_features.tolist(), strict=True)
    rows = [Row("", list(map(magnified, (one, pictures[i], pictures[k])))) for one, i, k in triples]
    columns = ["drawn", "nearest by pixels", "by features"]
    save_picture(
        folder / "nearest.png", contact_sheet("Drawn objects and the nearest photographs learnt from", columns, rows)
    )
    return {
        "root mean square to the nearest, drawn": float(far.mean() / pixels),
        "root mean square to the nearest, photographs of unseen objects": float(also_far.mean() / pixels),
        "photographs": len(pictures),
    }


def inversion(options: Options, method: EG3D, data: Collection, folder: Path) -> dict[str, Any]:
    """PSNR of unseen objects, found in one photograph, from its own view and from held-out ones."""
    rows, own, others, seconds = [], [], [], []
    side = method.config.picture_size
    for name, scene in evenly(list(data.members("test")), options.inverted):
        one = with_fewer_views(scene, 1)
        one = replace(one, splits={"train": one.splits["train"]})
        begin = time.process_time()
        found = method.given(one)
        seconds.append(time.process_time() - begin)
        views = [int(one.splits["train"][0]), *evenly(scene.splits["test"].tolist(), 3)]
        pictures = []
        for view in views:
            truth, camera = square(scene.photograph(view), scene.frame, side)
            pictures += [truth.permute(1, 2, 0), found.render(camera).rgb.clamp(0, 1)]
        scores = [psnr(pictures[k], pictures[k + 1]) for k in range(0, len(pictures), 2)]
        own.append(scores[0])
        others += scores[1:]
        rows.append(
            Row(
                f"{name}: {scores[0]:.1f} dB; held out {', '.join(f'{x:.1f}' for x in scores[1:])}",
                list(map(magnified, pictures)),
            )
        )
        print(rows[-1].label, f"{seconds[-1]:.0f} s", flush=True)
    columns = ["given", "found", *["held out", "found"] * 3]
    save_picture(folder / "inverted.png", contact_sheet("Unseen objects, found in one photograph", columns, rows))
    mean = [sum(x) / len(x) for x in (own, others, seconds)]
    return dict(zip(("own view", "held-out views", "seconds of a processor"), mean, strict=True))


def main(options: Options) -> None:
    data = open_dataset(options.collection, Collection)
    assert isinstance(data, Collection)
    if options.figures is None:
        return train(options, data)
    options.figures.mkdir(parents=True, exist_ok=True)
    run = Run(options.run)
    method = run.method("cpu").eval()
    assert isinstance(method, EG3D)
    found: dict[str, Any] = {"steps": run.state.step, "pictures": run.state.step * method.config.pictures_per_step}
    if "drawn" in options.only:
        sheet(options, method, options.figures)
    if "consistency" in options.only:
        found["consistency"] = consistency(options, method, options.figures)
    if "inversion" in options.only:
        found["inversion"] = inversion(options, method, data, options.figures)
    if "fid" in options.only:
        found["FID over training"] = fid_over_training(options, run, data, options.figures)
    if "nearest" in options.only:
        found["nearest"] = nearest(options, method, data, options.figures)
    write_json(options.figures / "figures.json", found)
    return None


if __name__ == "__main__":
    main(tyro.cli(Options))
