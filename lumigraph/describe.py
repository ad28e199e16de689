"""What a run or a scene is, as a printed tree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.tree import Tree

from .gaussians import Gaussians
from .run import Run
from .scene import Frame, Scene


def run_tree(run: Run) -> Tree:
    config = run.config
    tree = Tree(f"[bold]{run.folder}[/bold]  a run of {run.method_name}")
    branch(tree, "scene", {"source": config["scene"]["source"], **config["splits"], **config["scene"]["options"]})
    branch(tree, "frame", frame_rows(run.frame))
    branch(tree, "config", config["config"])
    if run.has_state:
        state = run.state
        rows = {"step": state.step, "seconds": state.seconds, "compiling, beside": state.compile_seconds}
        branch(tree, "trained", rows | {"budget": config["budget"], "seed": config["seed"], "on": config["device"]})
    if evaluation := run.evaluation():
        measured = ("psnr", "ssim", "lpips", "seconds_per_view")
        rows = {name: evaluation[name] for name in measured if evaluation.get(name) is not None}
        branch(
            tree, "evaluated", rows | {name: evaluation["protocol"][name] for name in ("split", "views", "resolution")}
        )
    found = sorted(
        path for path in run.folder.rglob("*") if path.is_file() and path.suffix in (".mp4", ".html", ".png")
    )
    pages = [path for path in found if path.parent in (run.folder, run.folder / "renders")]
    if pages:
        branch(tree, "files", {str(path.relative_to(run.folder)): size(path) for path in pages})
    return tree


def scene_tree(scene: Scene) -> Tree:
    cameras = scene.cameras
    tree = Tree(f"[bold]{scene.source}[/bold]  a scene of {len(scene)} photographs")
    sizes, counts = cameras.size.unique(dim=0, return_counts=True)
    shapes = (f"{count} of {w}x{h}" for (w, h), count in zip(sizes.tolist(), counts.tolist(), strict=True))
    photographs = {name: f"{len(index)} views" for name, index in scene.splits.items()}
    photographs |= {"sizes": ", ".join(shapes), "lens": type(cameras.lens).__name__}
    branch(tree, "photographs", photographs)
    branch(tree, "frame", frame_rows(scene.frame))
    if scene.points is not None:
        branch(tree, "points", {"count": len(scene.points)})
    return tree


def cloud_tree(name: str, cloud: Gaussians) -> Tree:
    tree = Tree(f"[bold]{name}[/bold]  a cloud of {len(cloud):,} Gaussians")
    rows: dict[str, Any] = {"file": size(Path(name)), "harmonics": f"degree {cloud.degree}"}
    rows["opacities"] = "antialiased (Mip-Splatting's 2-D filter)" if cloud.antialiased else "as in the first release"
    if len(cloud):
        low, high = cloud.means.amin(0), cloud.means.amax(0)
        rows["bounds"] = f"{vector(tuple(low.tolist()))} to {vector(tuple(high.tolist()))}"
        rows["middle"] = vector(tuple(cloud.means.median(0).values.tolist()))
        rows["deviation"] = f"{cloud.log_scales.mean(-1).median().exp().item():.4g}, in the middle"
        rows["opacity"] = f"{cloud.opacities.sigmoid().median().item():.3g}, in the middle"
    branch(tree, "cloud", rows)
    return tree


def frame_rows(frame: Frame) -> dict[str, Any]:
    low, high = frame.bounds
    scale = sum(x * x for x in frame.source_from_scene[0][:3]) ** 0.5
    return {
        "bounds": f"{vector(low)} to {vector(high)}",
        "reach": frame.reach,
        "near": frame.near,
        "cameras": frame.forward and f"forward-facing, near plane at {frame.forward.near:.3g}",
        "background": vector(frame.background) + (" behind alpha" if frame.has_alpha else ""),
        "one scene unit": f"{scale:.4g} of the source's",
    }


def branch(tree: Tree, title: str, rows: dict[str, Any]) -> None:
    node = tree.add(f"[bold]{title}[/bold]")
    width = max(map(len, rows))
    for name, value in rows.items():
        if value is not None:
            node.add(f"[dim]{name:<{width}}[/dim]  {f'{value:.4g}' if isinstance(value, float) else value}")


def vector(numbers: tuple[float, ...]) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in numbers) + ")"


def size(path: Path) -> str:
    count = path.stat().st_size
    return f"{count / 1e6:.1f} MB" if count >= 1e5 else f"{count / 1e3:.0f} kB"
