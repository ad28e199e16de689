"""Two-plane light fields of any method: a grid of cameras on a plane, sheared to a common focal plane."""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image

from ..camera import Camera
from ..camera.lens import OpenCV, Pinhole
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..figures import to_image
from ..files import replacing_folder, write_json
from ..method import Method
from ..system.progress import track
from .depth import about

SPAN = 0.1  # width of the grid, in distances of the focal plane, where none is given
ABOUT = "lightfield.json"


def focal_distance(method: Method, camera: Camera) -> float:
    """Median depth along the axis in a camera's view. Raises LumigraphError for an empty view."""
    small = camera.resized(min(1.0, 64 / int(camera.size.max())))
    seen = method.render(small).cpu()
    cosine = (small.rays(small.pixels()).directions @ small.forward[0]).cpu()
    depth = seen.depth.flatten() * cosine
    known = depth[depth.isfinite() & (seen.opacity.flatten() > 0.5)]
    if not len(known):
        raise LumigraphError("The middle camera sees no surface, so there is no focal plane; give --focus or --view")
    return float(known.median())


def grid_of(camera: Camera, rows: int, columns: int, spacing: float, focus: float) -> list[list[Camera]]:
    """Cameras row by row, from the upper left one; scene units. Raises LumigraphError for lenses of spheres."""
    if not isinstance(camera.lens, Pinhole | OpenCV):
        raise LumigraphError("A light field has flat pictures; choose a --view that a flat lens took")
    size = camera.size[0]
    lens = Pinhole(camera.lens.focal, size[None] / 2)
    flat = Camera(camera.pose, lens, camera.size)
    y, x = ((torch.arange(n) - (n - 1) / 2).tolist() for n in (rows, columns))
    return [[flat.sheared(spacing * b, spacing * a, focus) for b in x] for a in y]


def write_light_field(
    folder: Path, method: Method, camera: Camera, count: int, spacing: float, focus: float, frame: Frame
) -> None:
    """Write count x count pictures named as in the Stanford archive, out_ROW_COLUMN_Y_X.png, and transforms.json, by
    which the folder opens as a scene. Positions are in the frame of exports."""
    grid, to_export = grid_of(camera, count, count, spacing, focus), frame.to_export
    places = [(row, column) for row in range(count) for column in range(count)]
    frames, scale = [], to_export.scale * spacing
    with replacing_folder(folder, "light field") as partial:
        for row, column in track(places, "Light field", len(places)):
            x, y = (scale * (k - (count - 1) / 2) for k in (column, row))
            name = f"out_{row:02}_{column:02}_{y:.6f}_{x:.6f}.png"
            to_image(method.render(grid[row][column]).cpu().rgb).save(partial / name)
            frames.append({"file_path": name, **about(grid[row][column], to_export)})
        write_json(partial / "transforms.json", {"camera_model": "PINHOLE", "frames": frames}, ours=True)


def quilt(method: Method, camera: Camera, columns: int, rows: int, spacing: float, focus: float) -> Image.Image:
    """Pictures of a row of cameras on one, for displays with horizontal parallax: the leftmost at the lower left, then
    to the right and upwards."""
    line = grid_of(camera, 1, columns * rows, spacing, focus)[0]
    views = [to_image(method.render(one).cpu().rgb) for one in track(line, "Quilt", len(line))]
    width, height = views[0].size
    sheet = Image.new("RGB", (columns * width, rows * height))
    for i, view in enumerate(views):
        sheet.paste(view, (i % columns * width, (rows - 1 - i // columns) * height))
    return sheet
