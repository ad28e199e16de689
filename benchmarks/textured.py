"""How near renderings of textured meshes come to held-out photographs, beside the run's own views.

    lumigraph train instant-ngp LEGO --downscale 2 --seconds 90 --output A
    lumigraph export mesh A lego.glb --texture
    python benchmarks/textured.py A lego.glb

Arguments are pairs of a run and a mesh file in the frame of its photographs. The mesh is read by trimesh and rendered
with four samples a pixel: the first triangle along each ray, the texture bilinear at its texels, without light. PSNR is
the mean over views, in dB, over the pixels that the mesh covers wholly; for photographs with transparency also over
whole pictures before their background. Where photographs have masks or transparency, the silhouette is compared with
those, by IoU. The run's views are compared over the same pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from rich.table import Table

from lumigraph.camera import Camera
from lumigraph.datasets.mesh import Mesh, MeshTexture
from lumigraph.export.texture.colours import first_surface
from lumigraph.figures import save_picture
from lumigraph.files import write_json
from lumigraph.geometry import evenly
from lumigraph.metrics import intersection_over_union, psnr
from lumigraph.run import Run
from lumigraph.system.console import console
from lumigraph.system.progress import track

SAMPLES = 2  # a side of each pixel


@dataclass(frozen=True)
class Options:
    pairs: tyro.conf.Positional[tuple[Path, ...]]
    """A run and a mesh, and so on."""
    views: int = 25
    """Held-out views at most, evenly chosen."""
    sheets: Path | None = None
    """Folder for pictures of three views each: photograph, mesh, the run's own view."""
    output: Path | None = None
    """File for the figures, as JSON."""


def main(options: Options) -> None:
    given = options.pairs
    rows = [compared(Run(a), b, options) for a, b in zip(given[::2], given[1::2], strict=True)]
    names = list(dict.fromkeys(name for row in rows for name in row))
    table = Table(*names)
    for row in rows:
        table.add_row(*(f"{x:.2f}" if isinstance(x, float) else str(x) for x in (row.get(n, "") for n in names)))
    console(width=160).print(table)
    if options.output:
        write_json(options.output, rows)


@torch.no_grad()
def compared(run: Run, path: Path, options: Options) -> dict:
    mesh = read_textured(path).transformed(run.frame.to_export.inverse.matrix.numpy())
    scene, method = run.scene(), run.method()
    cameras, numbers = method.refined(run.cameras()["test"]), scene.splits["test"].tolist()
    chosen = evenly(range(len(numbers)), options.views)
    found: dict[str, list[float]] = {}
    shares, shown = [], evenly(chosen, 3)
    for i in track(chosen, "Comparing views", len(chosen)):
        photograph = scene.photograph(numbers[i])
        own = method.render(cameras[i]).rgb.cpu().clamp(0, 1)
        drawn, covered = rendered(mesh, cameras[i])
        truth = photograph.before(run.frame.background)
        trusted = torch.ones_like(covered, dtype=torch.bool) if photograph.mask is None else photograph.mask
        inside = trusted & (covered == 1)
        shares.append(float(inside.float().mean()))
        if (silhouette := photograph.alpha if photograph.mask is None else photograph.mask) is not None:
            found.setdefault("mask IoU", []).append(
                intersection_over_union((covered > 0.5).view(-1), (silhouette > 0.5).view(-1))
            )
        whole = drawn + (1 - covered[..., None]) * torch.tensor(run.frame.background)
        pixels = {"covered": inside}
        if photograph.alpha is not None:
            pixels["whole"] = trusted
        for name, mask in pixels.items():
            if mask.any():
                found.setdefault(f"mesh, {name}", []).append(psnr(whole[mask], truth[mask]))
                found.setdefault(f"run, {name}", []).append(psnr(own[mask], truth[mask]))
        if options.sheets and i in shown:
            options.sheets.mkdir(parents=True, exist_ok=True)
            save_picture(options.sheets / f"{path.stem}-{i}.png", torch.cat([truth, whole, own], 1))
    about = {"mesh": path.name, "triangles": len(mesh.faces), "texels": mesh.texture.colours.shape[0]}
    about |= {"MB": path.stat().st_size / 1e6, "views": len(chosen), "covered": float(np.mean(shares))}
    return about | {name: float(np.mean(values)) for name, values in found.items()}


def read_textured(path: Path) -> Mesh:
    """A mesh with a texture, by trimesh, in the frame of its own vertices."""
    (part,) = trimesh.load_scene(path, process=False).geometry.values()
    material = part.visual.material
    image = np.asarray(getattr(material, "baseColorTexture", None) or material.image)[..., :3]
    uv = np.asarray(part.visual.uv) * [1, -1] + [0, 1]
    colours = np.zeros((len(part.vertices), 3), np.uint8)
    return Mesh(
        np.asarray(part.vertices), np.asarray(part.faces), colours, MeshTexture(uv, np.ascontiguousarray(image))
    )


def rendered(mesh: Mesh, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours of a mesh before black, and the share of each pixel that it covers."""
    width, height = camera.size[0].tolist()
    fine = camera.resized(SAMPLES)
    face, depth = first_surface(fine, mesh.vertices, mesh.faces)
    there = np.flatnonzero(face.reshape(-1) >= 0)
    rays = fine.rays(fine.pixels()[there])
    points = rays.at(torch.from_numpy(depth.reshape(-1)[there])).double().numpy()
    corners = mesh.faces[face.reshape(-1)[there]]
    shares = trimesh.triangles.points_to_barycentric(mesh.vertices[corners], points)
    places = (shares[..., None] * mesh.texture.uv[corners]).sum(1)
    colours = np.zeros((face.size, 3), np.float32)
    colours[there] = bilinear(mesh.texture.colours, places) / 255
    covered = (face >= 0).astype(np.float32)
    blocks = height, SAMPLES, width, SAMPLES
    mean = torch.from_numpy(colours).view(*blocks, 3).mean((1, 3)), torch.from_numpy(covered).view(blocks).mean((1, 3))
    return mean


def bilinear(texels: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Colours between texels' centres; place (0, 0) is the upper left corner of the picture."""
    height, width = texels.shape[:2]
    x, y = (places * [width, height] - 0.5).clip(0, [width - 1.001, height - 1.001]).T
    left, top = x.astype(int), y.astype(int)
    u, v = (x - left)[:, None], (y - top)[:, None]
    upper = (1 - u) * texels[top, left] + u * texels[top, left + 1]
    return (1 - v) * upper + v * ((1 - u) * texels[top + 1, left] + u * texels[top + 1, left + 1])


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
