"""Two-plane light fields of any method: a grid of cameras on a plane, sheared to a common focal plane."""

from pathlib import Path

import torch
from PIL import Image

from ..camera import Camera
from ..camera.lens import OpenCV, Pinhole
from ..color.tags import save_srgb
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..figures import save_picture, to_image
from ..files import claim, replacing_folder, write_json
from ..method import Method
from ..system.progress import track
from .depth import about
from .loaded import Loaded
from .options import LightFieldOptions

SPAN = 0.1  # width of the grid, in distances of the focal plane, where none is given
ABOUT = "lightfield.json"


def export_light_field(
    loaded: Loaded, path: Path, options: LightFieldOptions = LightFieldOptions(), overwrite: bool | None = None
) -> tuple[Path, float, float]:
    """Write a folder of pictures; or a quilt for a path that ends in .png, to whose name its layout is added.

    Returns what was written, and in the unit of exports the distance of the focal plane and the width of the grid.
    """
    method, unit = loaded.method, loaded.frame.to_export.scale
    camera = loaded.camera(options.view)
    camera = camera.resized(options.size / int(camera.size.max())).to(method.device)
    focus = options.focus / unit if options.focus else focal_distance(method, camera)
    span = options.span / unit if options.span else SPAN * focus
    if path.suffix.lower() != ".png":
        write_light_field(path, method, camera, options.grid, span / (options.grid - 1), focus, loaded.frame)
        return path, focus * unit, span * unit
    columns, rows = options.quilt
    width, height = camera.size[0].tolist()
    path = path.with_name(f"{path.stem}_qs{columns}x{rows}a{width / height:.2f}.png")
    claim(path, "quilt", overwrite, [loaded.opened.path])
    save_picture(path, quilt(method, camera, columns, rows, span / (columns * rows - 1), focus), "quilt")
    return path, focus * unit, span * unit


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
            save_srgb(to_image(method.render(grid[row][column]).cpu().rgb), partial / name)
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
