"""Contents of a run or a scene as a printed tree."""

import contextlib
from collections.abc import Sequence
from typing import Any

from rich.text import Text
from rich.tree import Tree

from ..budget import Budget
from ..datasets.dataset import Dataset
from ..datasets.scene import Frame, Scene
from ..datasets.shapes import Shapes
from ..derive.compression.compress import folder_bytes
from ..errors import LumigraphError
from ..evaluation.photographs import examined
from ..exchange import size_of
from ..files.names import natural
from ..gaussians import Gaussians
from ..gaussians.moving import MovingGaussians
from ..geometry import evenly
from ..large import BlockRun
from ..metrics import scores_of
from ..metrics.rows import last_psnr
from ..run import Run
from ..run.derived import Compressed, Converted, Inferred
from ..sfm.doctor import Finding, grouped
from ..system.console import bold, dim
from ..training.display import extent, pixel_sizes
from ..training.verdict import cameras_moved

MAX_MEMBERS = 12  # shapes that are listed


def run_tree(run: Run) -> Tree:
    settings = run.settings
    tree = Tree(bold(run.folder) + f"  a run of {run.method_name}")
    options = dict(settings.scene.options)
    if (part := options.get("part")) is not None:  # of a block
        options["part"] = f"{len(part['photographs'])} photographs of a larger scene"
    if rows := run_rows(run):
        branch(tree, "run", rows)
    branch(tree, "scene", {"source": settings.scene.source, **settings.splits, **options})
    branch(tree, "frame", frame_rows(run.frame))
    if controls := control_rows(run):
        branch(tree, "controls, by --set", controls)
    if run.has_state:
        state = run.state
        rows = {"step": state.step, "seconds": state.seconds, "compiling, beside": state.compile_seconds}
        branch(
            tree,
            "trained",
            rows
            | {
                "budget": settings.budget and str(Budget.from_json(settings.budget)),
                "seed": settings.seed,
                "on": settings.device,
            },
        )
    if run.has_state and settings.config.get("refine_cameras"):
        if moved := cameras_moved(run.method("cpu"), run.cameras()["train"]):
            branch(tree, "cameras", {"moved by": str(moved)})
    if made := Compressed.read(run.folder):
        smaller = f"{made.times:.1f} times smaller, {made.bytes_after / 1e6:.3g} MB of {made.bytes_before / 1e6:.3g} MB"
        branch(tree, "compressed", {"from": made.source, "model": smaller, "dB": f"{made.psnr_after:.2f}"})
    if inferred := Inferred.of(settings, run.folder / "config.json"):
        seen = f"{inferred.views} photographs" if inferred.seed is None else f"seed {inferred.seed}"
        branch(tree, "inferred", {"by": inferred.prior, "of": seen})
    if converted := Converted.read(run.folder):
        like = f"{converted.psnr:.2f} dB, of {converted.views} held-out views against the source's"
        origin: dict[str, Any] = {"from": f"{converted.source}, a {converted.teacher.method}", "by": converted.how}
        branch(tree, "converted", origin | {"alike": like, "then learnt from": converted.learnt_from})
    if evaluation := run.evaluation():
        figures: dict[str, Any] = {}
        figures["seconds per view"] = evaluation.get("seconds_per_view")
        protocol = ("split", "views", "shapes", "members", "resolution")
        branch(tree, "evaluation", figures | {name: evaluation["protocol"].get(name) for name in protocol})
    if checked := examined(run):
        add_findings(tree, checked.findings)
    places = [path for folder in (run.folder, run.folder / "renders") if folder.is_dir() for path in folder.iterdir()]
    pages = [path for path in places if path.is_file() and path.suffix in (".mp4", ".html", ".png")]
    pages.sort(key=lambda path: natural(path.as_posix()))
    if pages:
        branch(tree, "files", {str(path.relative_to(run.folder)): size(path.stat().st_size) for path in pages})
    branch(tree, "config", settings.config)
    return tree


def run_rows(run: Run) -> dict[str, Any]:
    """Size of the model, size on disk, resolution of the photographs, duration of training, PSNR."""
    rows: dict[str, Any] = {}
    if run.has_state:
        with contextlib.suppress(LumigraphError):
            count, unit = extent(run.method("cpu"))
            rows["model"] = f"{count:,} {unit}"
        rows["on disk"] = f"{size(run.model_bytes)} the model, {size(folder_bytes(run.folder))} the whole run"
    if run.photographed and len(cameras := run.cameras()["train"]):
        rows["photographs"] = f"{len(cameras):,} of {pixel_sizes(cameras.size)} pixels"
    if run.has_state:
        rows["training"] = f"{run.state.step:,} steps in {run.state.seconds:.0f} s"
    if (psnr := last_psnr(run.metrics())) is not None:
        rows["PSNR of training photographs"] = f"{psnr:.2f} dB"
    scores = {f"{score.name} of the evaluation": str(score) for score in scores_of(run.evaluation() or {})}
    return rows | scores


def blocks_tree(run: BlockRun) -> Tree:
    """A run in blocks, with a line for each."""
    from ..large.monitor import described, stand_of
    from ..large.planning import place_of

    tree, plan = Tree(bold(run.folder) + f"  a run of {run.method_name} in {len(run.plan.blocks)} blocks"), run.plan
    branch(tree, "scene", {"source": plan.scene.source, **run.settings.splits, **plan.scene.options})
    branch(tree, "frame", frame_rows(run.frame))
    branch(tree, "config", plan.config)
    each = " ".join(f"{value} {name}" for name, value in plan.budget.items())
    rows: dict[str, Any] = {"each learns for": each, "weights": f"{run.model_bytes / 1e6:.1f} MB"}
    for block in plan.blocks:
        new = f", learnt again from {block.scene.source}" if block.scene else ""
        where = ", ".join(f"{x:.4g}" for x in block.centre)
        stand = described(stand_of(place_of(run.folder, block)))
        rows[block.name] = f"{len(block.photographs)} photographs within {block.radius:.4g} of {where}; {stand}{new}"
    branch(tree, "blocks", rows)
    if evaluation := run.evaluation():
        branch(tree, "evaluated", {score.name: str(score) for score in scores_of(evaluation)})
    return tree


def control_rows(run: Run) -> dict[str, str]:
    """Ranges or choices of the method's controls, some of which depend on the weights; empty without controls, or if
    the method cannot be opened."""
    try:
        controls = (run.method() if run.has_state else run.new_method()).controls
    except LumigraphError:
        return {}
    return {x.name: f"{x.domain} (default: {x.default}). {x.about}".rstrip() for x in controls}


def dataset_tree(data: Dataset) -> Tree:
    """A dataset of any kind."""
    if isinstance(data, Scene):
        return scene_tree(data)
    if isinstance(data, Shapes):
        return shapes_tree(data)
    tree = Tree(bold(data.source) + f"  a collection of {len(data.names)}")
    branch(tree, "members", {name: ", ".join(data.names[i] for i in index) for name, index in data.splits.items()})
    return tree


def shapes_tree(shapes: Shapes) -> Tree:
    tree = Tree(bold(shapes.source) + f"  {len(shapes)} shape{'' if len(shapes) == 1 else 's'}")
    branch(tree, "splits", {name: len(index) for name, index in shapes.splits.items()})
    for shape in evenly(shapes.members, MAX_MEMBERS):
        count = f"{len(shape.mesh.vertices):,} vertices, {len(shape.mesh.faces):,} triangles"
        surface = "points alone" if shape.is_cloud else "closed" if shape.closed else "not closed"
        unit = f"{shape.frame.to_source.scale:.4g} of the source's"
        branch(tree, shape.name, {"size": count, "surface": surface, "one scene unit": unit})
    return tree


def scene_tree(scene: Scene) -> Tree:
    cameras = scene.cameras
    tree = Tree(bold(scene.source) + f"  a scene of {len(scene)} photographs")
    sizes, counts = cameras.size.unique(dim=0, return_counts=True)
    shapes = (f"{count} of {w}x{h}" for (w, h), count in zip(sizes.tolist(), counts.tolist(), strict=True))
    photographs = {name: f"{len(index)} views" for name, index in scene.splits.items()}
    photographs |= {"sizes": ", ".join(shapes), "lens": type(cameras.lens).__name__}
    branch(tree, "photographs", photographs)
    if scene.layers:
        beside = {name: f"{layer.encoding}, {layer.dtype}, of {len(layer)}" for name, layer in scene.layers.items()}
        branch(tree, "of each pixel", beside)
    branch(tree, "frame", frame_rows(scene.frame))
    if scene.points is not None:
        branch(tree, "points", {"count": len(scene.points)})
    return tree


def cloud_tree(name: str, cloud: Gaussians) -> Tree:
    tree = Tree(bold(name) + f"  a cloud of {len(cloud):,} Gaussians")
    rows: dict[str, Any] = {"file": size(size_of(name)), "harmonics": f"degree {cloud.degree}"}
    rows["opacities"] = "antialiased (Mip-Splatting's 2-D filter)" if cloud.antialiased else "as in the first release"
    if len(cloud):
        low, high = cloud.means.amin(0), cloud.means.amax(0)
        rows["bounds"] = f"{vector(tuple(low.tolist()))} to {vector(tuple(high.tolist()))}"
        rows["middle"] = vector(tuple(cloud.means.median(0).values.tolist()))
        rows["deviation"] = f"{cloud.log_scales.mean(-1).median().exp().item():.4g}, in the middle"
        rows["opacity"] = f"{cloud.opacities.sigmoid().median().item():.3g}, in the middle"
    branch(tree, "cloud", rows)
    return tree


def moving_tree(name: str, moving: MovingGaussians) -> Tree:
    """Tree of a moving cloud."""
    tree = cloud_tree(name, moving.cloud)
    tree.label = bold(name) + f"  a moving cloud of {len(moving):,} spans of Gaussians"
    rows = {"duration": f"{moving.duration:.4g} s", "moving": f"{moving.moving:,} spans of those that move"}
    branch(tree, "motion", rows)
    return tree


def atlas_tree(opened: Any) -> Tree:
    tree = Tree(bold(opened.path) + "  an atlas for SNeRG's viewer")
    atlas = opened.atlas
    x, y, z = (number * atlas.block for number in atlas.index.shape)
    rows: dict[str, Any] = {
        "voxels": f"{x} x {y} x {z}, in {len(atlas.values):,} of {atlas.index.numel():,} blocks of {atlas.block}",
        "coordinates": "contracted" if atlas.contracted else None,
        "depends on direction": "no" if atlas.network is None else "by a small network",
    }
    branch(tree, "atlas", rows)
    branch(tree, "frame", frame_rows(opened.frame))
    return tree


def composition_tree(composition: Any) -> Tree:
    tree = Tree(bold(composition.path) + f"  a composition of {len(composition.parts)} parts")
    for number, (part, place) in enumerate(zip(composition.parts, composition.places, strict=True)):
        rows = {"source": part.source, "leads": "yes" if number == composition.lead else None}
        rows |= {"scale": place.scale, "origin": vector(tuple(place.matrix[:3, 3].tolist())) + " in the frame below"}
        rows |= {"box": part.box and f"{vector(part.box.lower)} to {vector(part.box.upper)}"}
        branch(tree, f"part {number}", rows)
    branch(tree, "frame", frame_rows(composition.frame))
    return tree


def canonical_tree(placed: Any) -> Tree:
    tree = Tree(bold(placed.path) + f"  {placed.run.folder.name} in the canonical frame of its kind")
    rows = {"source": str(placed.run.folder), "scale": placed.place.scale, "agreement": placed.agreement}
    branch(tree, "run", rows | {"origin": vector(tuple(placed.place.matrix[:3, 3].tolist()))})
    branch(tree, "frame", frame_rows(placed.frame))
    return tree


def frame_rows(frame: Frame) -> dict[str, Any]:
    low, high = frame.bounds
    return {
        "bounds": f"{vector(low)} to {vector(high)}",
        "half-extent": f"{frame.reach:g} scene units, from the middle to each side",
        "near": frame.near,
        "cameras": frame.forward and f"forward-facing, near plane at {frame.forward.near:.3g}",
        "background": vector(frame.background) + (" behind alpha" if frame.has_alpha else ""),
        "moments": frame.times and f"from {frame.times[0]:g} to {frame.times[1]:g}",
        "one scene unit": f"{frame.to_source.scale:.4g} of the source's",
    }


def add_findings(tree: Tree, found: Sequence[Finding]) -> None:
    """A branch of findings, by fault; a line that says so without any."""
    node = tree.add(bold("findings") + ("" if found else "  none"))
    for fault, sentences in grouped(found).items():
        kind = node.add(dim(fault))
        for sentence in sentences:
            kind.add(Text(sentence))


def branch(tree: Tree, title: str, rows: dict[str, Any]) -> None:
    node = tree.add(bold(title))
    width = max(map(len, rows))
    for name, value in rows.items():
        if value is not None:
            node.add(dim(f"{name:<{width}}") + f"  {f'{value:.4g}' if isinstance(value, float) else value}")


def vector(numbers: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in numbers) + ")"


def size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.0f} kB"
