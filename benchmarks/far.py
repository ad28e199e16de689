"""A capture far from the origin, end to end: errors of every export against doubles, and georeferencing by five points.

    python benchmarks/far.py --capture FOLDER_WITH_TRANSFORMS_JSON --output NEW_FOLDER

The capture is moved to (500000, 5200000, 300), as UTM has it, and trained shortly. Exports are read with the offset
that their format has for it: a Gaussian's error is its distance from the exact centre in double precision, in median
sizes of a Gaussian; of points and meshes in typical distances of neighbours. Then five control points, each seen in
three photographs and placed by a known similarity, lead the same run to another zone; their residuals and the error
there.
"""

from __future__ import annotations

import base64
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from foreign.packages import laspy, usd
from rich.table import Table
from scipy.spatial import cKDTree

from lumigraph.commands.cli import main as main_of
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.control_points import own_size
from lumigraph.exchange import offset_file, read_gaussians, spz
from lumigraph.exchange.codes import TURN_MEAN
from lumigraph.files.ply import columns, read_rows
from lumigraph.gaussians import Gaussians
from lumigraph.geometry import Similarity, evenly
from lumigraph.large import open_any
from lumigraph.method.capabilities import HasGaussians, needs
from lumigraph.system.console import console

UTM = np.array([500_000.0, 5_200_000.0, 300.0])
SPLATS = ("a.ply", "a.glb", "a.spz", "a.splat", "a.compressed.ply", "a.sog")
LAYERS = ("a.usdc", "a.usda")
TURN = torch.linalg.matrix_exp(torch.tensor([[0, 0.4, 0.1], [-0.4, 0, 0.2], [-0.1, -0.2, 0]], dtype=torch.float64))
ZONE = torch.tensor([412_345.0, 5_654_321.0, 87.0], dtype=torch.float64)
CONTROL = Similarity.make(2.5, TURN, ZONE) @ Similarity.make(1.0, translation=torch.from_numpy(-UTM))
CONTROL_POINTS, VIEWS, APART = 5, 3, 0.3  # scene units between control points


@dataclass(frozen=True)
class Options:
    capture: Path
    output: Path
    steps: int = 300
    downscale: int = 8


@torch.no_grad()
def main(options: Options) -> None:
    run = options.output / "run"
    if not run.exists():
        moved = moved_capture(options.capture, options.output / "capture")
        words = ["--steps", str(options.steps), "--downscale", str(options.downscale)]
        lumigraph("train", "gaussian-splatting", moved, *words, "--output", run)
    opened = open_any(run)
    cloud = needs(opened.method(), HasGaussians).gaussians().to("cpu")
    size = float(cloud.log_scales.double().mean(-1).exp().median()) * opened.frame.to_export.scale
    exact = places(opened.frame.to_export, cloud)
    table = Table(
        "file",
        "largest error",
        "of",
        title=f"{len(cloud):,} Gaussians, median size {size:.3g}, near {exact.mean(0).round()}",
    )
    folder = options.output / "exports"
    for name, error in of_splats(run, exact, folder).items():
        table.add_row(name, f"{error / size:.2g}", "a Gaussian's size")
    table.add_row("page.html", f"{of_page(run, exact, folder) / size:.2g}", "a Gaussian's size")
    for name, (error, spacing) in of_surfaces(run, folder).items():
        table.add_row(name, f"{error / spacing:.2g}", "neighbours' distance")
    console().print(table)
    survey(run, cloud, exact, options.output)


def moved_capture(source: Path, target: Path) -> Path:
    """The capture with its cameras at UTM, photographs linked."""
    target.mkdir(parents=True)
    about = json.loads((source / "transforms.json").read_text())
    about["frames"] = [frame for frame in about["frames"] if (source / frame["file_path"]).exists()]
    for frame in about["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, 3] += UTM
        frame["transform_matrix"] = matrix.tolist()
    (target / "transforms.json").write_text(json.dumps(about))
    for name in {Path(frame["file_path"]).parts[0] for frame in about["frames"]}:
        (target / name).symlink_to((source / name).resolve())
    return target


def lumigraph(*words: object) -> None:
    """A command, in this process. Raises SystemExit if it fails."""
    with torch.enable_grad():
        failed = main_of([*map(str, words)])
    if failed:
        raise SystemExit(f"lumigraph {' '.join(map(str, words))} failed")


def places(frame: Similarity, cloud: Gaussians) -> np.ndarray:
    return frame.points(cloud.means.double()).numpy()


def furthest(exact: np.ndarray, found: np.ndarray) -> float:
    """Largest distance from a found place to the nearest exact one."""
    middle = np.median(exact, 0)
    return float(cKDTree(exact - middle).query(found.astype(np.float64) - middle)[0].max())


def of_splats(run: Path, exact: np.ndarray, folder: Path) -> dict[str, float]:
    """Errors of the formats of clouds, by name; in brackets what lies beside."""
    found = {}
    for name in (*SPLATS, *LAYERS):
        path = folder / name
        lumigraph("export", "splats", run, path, "--overwrite")
        if name in LAYERS:
            centres = usd(path)["positions"] * TURN_MEAN
        else:
            centres = read_gaussians(path).means.double().numpy()
        beside = f" ({offset_file(path).name})" if offset_file(path).exists() else ""
        assert len(centres) == len(exact), f"{name} holds {len(centres)} of {len(exact)}"
        found[name + beside] = furthest(exact, centres)
    return found


def of_page(run: Path, exact: np.ndarray, folder: Path) -> float:
    """Error of the page, which holds the cloud in the scene's frame, led back by the run's."""
    lumigraph("export", "web", run, folder / "page.html", "--overwrite")
    text = (folder / "page.html").read_bytes()
    packed = max(re.findall(rb"[A-Za-z0-9+/]{1000,}={0,2}", text), key=len)
    (folder / "page.spz").write_bytes(base64.b64decode(packed))
    return furthest(exact, places(open_any(run).frame.to_export, spz.read(folder / "page.spz")))


def of_surfaces(run: Path, folder: Path) -> dict[str, tuple[float, float]]:
    """Errors of points and meshes beside their .ply, whose places are doubles, and the distance of neighbours."""
    for name in ("points.ply", "points.las", "points.laz"):
        lumigraph("export", "points", run, folder / name, "--count", 20_000, "--overwrite")
    for name in ("mesh.ply", "mesh.obj", "mesh.glb"):
        lumigraph("export", "mesh", run, folder / name, "--overwrite")
    found = {}
    for kind, others in (("points", ("las", "laz")), ("mesh", ("obj", "glb"))):
        rows = read_rows(folder / f"{kind}.ply", ["vertex"])["vertex"]
        assert rows.dtype["x"].itemsize == 8, f"{kind}.ply has no doubles"
        exact = columns(rows, ["x", "y", "z"], np.float64)
        spacing = float(np.median(cKDTree(exact - exact[0]).query(exact - exact[0], 2)[0][:, 1]))
        for end in others:
            path = folder / f"{kind}.{end}"
            if kind == "points":
                centres = laspy(path)["positions"]
            elif end == "obj":
                lines = path.read_text().splitlines()
                centres = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], np.float64)
            else:
                scene = trimesh.load_scene(path, process=False)
                local = next(iter(scene.geometry.values())).vertices.astype(np.float64)
                about = json.loads(
                    path.read_bytes()[20:].split(b"\0")[0][: int.from_bytes(path.read_bytes()[12:16], "little")]
                )
                centres = local + np.array(
                    next(node for node in about["nodes"] if node.get("mesh") == 0)["translation"]
                )
            found[path.name] = furthest(exact, centres), spacing
    return found


def survey(run: Path, cloud: Gaussians, exact: np.ndarray, output: Path) -> None:
    """Georeference by five opaque Gaussians, seen exactly, and print residuals and the error of a PLY there."""
    opened = open_any(run)
    scene, taken, lines = opened.open_scene(None), list[np.ndarray](), list[str]()
    for i in torch.argsort(cloud.opacities, descending=True).tolist():
        point = cloud.means[i].numpy()
        if len(taken) == CONTROL_POINTS or np.linalg.norm(point) > 1:  # outside the box of interest
            continue
        pixels = [(name, seen_at(scene, k, point)) for k, name in enumerate(scene.names)]
        seen = [(name, *pixel) for name, pixel in pixels if pixel is not None]
        if len(seen) < VIEWS or any(np.linalg.norm(point - other) < APART for other in taken):
            continue
        taken.append(point)
        target = CONTROL.points(opened.frame.to_source.points(torch.from_numpy(point)[None].double()))[0]
        place = ",".join(f"{x:.6f}" for x in target.tolist())
        lines += [
            f"{name},{u:.4f},{v:.4f},{place}" for name, u, v in (seen[k] for k in evenly(range(len(seen)), VIEWS))
        ]
    (output / "points.csv").write_text("\n".join(["image,u,v,x,y,z", *lines]) + "\n")
    lumigraph("georeference", run, output / "points.csv")
    size = float(cloud.log_scales.double().mean(-1).exp().median()) * open_any(run).frame.to_export.scale
    lumigraph("export", "splats", run, path := output / "exports/surveyed.ply", "--overwrite")
    truth = CONTROL.points(torch.from_numpy(exact)).numpy()
    error = np.linalg.norm(read_gaussians(path).means.double().numpy() - truth, axis=1) / size
    console().print(f"{path.name}: errors {np.median(error):.2g} (median), {error.max():.2g} of a Gaussian's size")


def seen_at(scene: Scene, number: int, point: np.ndarray) -> tuple[float, float] | None:
    """Pixel of a point in a photograph of its own size, where it is within."""
    camera = scene.cameras[number]
    pose = camera.pose[0].double()
    local = (torch.from_numpy(point).double() - pose[:, 3]) @ pose[:, :3]
    if local[2] <= 0.1:
        return None
    pixel = (camera.lens.project(local[None].float())[0][0] / camera.size[0] * own_size(scene, number)).tolist()
    inside = all(0 < x < most for x, most in zip(pixel, own_size(scene, number).tolist(), strict=True))
    return (pixel[0], pixel[1]) if inside else None


if __name__ == "__main__":
    main(tyro.cli(Options))
