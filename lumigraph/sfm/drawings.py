"""Two pictures of a capture: cameras and points from above and from the side, and all photographs with remarks."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from ..figures import RAMP, fit_into, ramp, save_picture
from ..files.names import natural
from ..system.library import pycolmap
from .diagnosis import Diagnosis
from .photos import Intake

INK_COLOUR, FAINT_COLOUR, PAPER_COLOUR = "#1b1d22", "#6d717a", "#fbfaf8"
LEFT_OUT_COLOUR, BLURRED_COLOUR, DUPLICATE_COLOUR = "#c0392b", "#d98200", "#3f6fb0"
LACKING_COLOUR = "#c0392b"  # of circles where photographs are lacking
PANEL_SIDE, MARGIN, LINE_HEIGHT = 720, 28, 20
SUPERSAMPLING = 2  # for smooth lines and dots
POINT_SHADE = 0.85  # factor on points' colours, so that white ones show on paper
MIN_TRACK_LENGTH = 3  # photographs that show a drawn point
OUTLIER_SHARE = 0.04  # of the points on each side, ignored for the extent of the drawing
MAX_DISTANCE_FACTOR = 2.0  # times the distance from cameras to points that is shown around the cameras
MIN_COLUMN, MAX_SHEET_WIDTH = 110, 1720  # pixels of a column and of the columns together, on the sheet of photographs
FRUSTUM_DEPTH = 0.05  # as a share of the drawing's extent


@dataclass(frozen=True)
class Sketch:
    """Geometry to draw, in a frame with +z up. corners: each camera's eye and the four corners of its picture

    lacking: positions for photographs that would fill gaps
    """

    eyes: Float[np.ndarray, "photo 3"]
    corners: Float[np.ndarray, "photo 4 3"]
    points: Float[np.ndarray, "point 3"]
    colours: UInt8[np.ndarray, "point 3"]
    lacking: Float[np.ndarray, "place 3"]


def draw_capture(path: Path, model: pycolmap.Reconstruction, diagnosis: Diagnosis, keep_axes: bool = False) -> None:
    """Draw an upright model. keep_axes: whether x goes right, as where x is east"""
    sketch = sketch_of(model, diagnosis.registered, keep_axes, diagnosis.coverage.places if diagnosis.coverage else [])
    low, high = interesting(sketch)
    extent = high - low
    height = [round(PANEL_SIDE * min(max(extent[k] / extent[0], 0.35), 1.25)) for k in (1, 2)]
    sheet = Image.new("RGB", (2 * PANEL_SIDE + 3 * MARGIN, max(height) + 3 * MARGIN + 2 * LINE_HEIGHT), PAPER_COLOUR)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN - 8), heading(diagnosis), INK_COLOUR, ImageFont.load_default(18))
    for i, (name, axis) in enumerate((("from above", 2), ("from the side", 1))):
        corner = MARGIN + i * (PANEL_SIDE + MARGIN), 2 * MARGIN + LINE_HEIGHT
        draw.text((corner[0], corner[1] - LINE_HEIGHT), name, FAINT_COLOUR, ImageFont.load_default(14))
        sheet.paste(draw_view(sketch, axis, low, high, (PANEL_SIDE, height[i])), corner)
    foot = "cameras from first (dark) to last (bright); points in their own colours"
    if diagnosis.coverage and (advice := diagnosis.coverage.advice):
        foot += f"; circles: add {advice[0]}" + (f", and {len(advice) - 1} more" if len(advice) > 1 else "")
    draw.text((MARGIN, sheet.height - MARGIN), foot, FAINT_COLOUR, ImageFont.load_default(14))
    save_picture(path, sheet, "capture")


def heading(diagnosis: Diagnosis) -> str:
    return (
        f"{len(diagnosis.registered)} of {diagnosis.given} photographs placed · {diagnosis.points:,} points · "
        f"{diagnosis.error:.2f} pixels of error"
    )


def sketch_of(
    model: pycolmap.Reconstruction, names: list[str], keep_axes: bool, lacking: Sequence[tuple[float, float, float]]
) -> Sketch:
    by_name = {image.name: image for image in model.images.values() if image.has_pose}
    eyes, corners = [], []
    for name in names:
        image = by_name[name]
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().inverse().matrix()
        focal = camera.width / 2 if camera.is_spherical() else camera.mean_focal_length()
        half = np.array([camera.width, camera.height]) / (2 * focal)
        directions = np.array([[x * half[0], y * half[1], 1.0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        eyes.append(pose[:, 3])
        corners.append(directions @ pose[:, :3].T)
    found = [point for point in model.points3D.values() if point.track.length() >= MIN_TRACK_LENGTH]
    found = found or list(model.points3D.values())
    turn = np.eye(3) if keep_axes else longest_first(np.array(eyes))
    return Sketch(
        np.array(eyes) @ turn.T,
        np.array(corners) @ turn.T,
        np.array([point.xyz for point in found]).reshape(-1, 3) @ turn.T,
        np.array([point.color for point in found], np.uint8).reshape(-1, 3),
        np.array(lacking).reshape(-1, 3) @ turn.T,
    )


def longest_first(eyes: Float[np.ndarray, "photo 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation about +z of the cameras' principal horizontal direction to x."""
    flat = eyes[:, :2] - eyes[:, :2].mean(0)
    _, vectors = np.linalg.eigh(flat.T @ flat)
    x, y = vectors[:, 1]
    return np.array([[x, y, 0], [-y, x, 0], [0, 0, 1.0]])


def interesting(sketch: Sketch) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Box to draw: all cameras, and most points, without far outliers."""
    shown = np.concatenate([sketch.eyes, sketch.lacking])
    low, high = shown.min(0), shown.max(0)
    if len(sketch.points):
        middle = np.median(sketch.points, axis=0)
        away = MAX_DISTANCE_FACTOR * np.median(np.linalg.norm(sketch.eyes - middle, axis=-1))
        inner, outer = np.quantile(sketch.points, [OUTLIER_SHARE, 1 - OUTLIER_SHARE], axis=0)
        low, high = np.minimum(low, np.maximum(inner, low - away)), np.maximum(high, np.minimum(outer, high + away))
    margin = 0.06 * (high - low).max()
    return low - margin, high + margin


def draw_view(sketch: Sketch, axis: int, low: np.ndarray, high: np.ndarray, size: tuple[int, int]) -> Image.Image:
    """One view along an axis, from above (2) or from the side (1), with equal scales to the right and upwards."""
    width, height = SUPERSAMPLING * size[0], SUPERSAMPLING * size[1]
    right, up = (0, 1) if axis == 2 else (0, 2)
    scale = min(width / (high[right] - low[right]), height / (high[up] - low[up]))

    def place(points: np.ndarray) -> np.ndarray:
        x = width / 2 + scale * (points[..., right] - (low + high)[right] / 2)
        y = height / 2 - scale * (points[..., up] - (low + high)[up] / 2)
        return np.stack([x, y], -1)

    canvas = np.full((height, width, 3), 255, np.uint8)
    order = np.argsort(sketch.points[:, axis] * (1 if axis == 2 else -1), kind="stable")
    at = place(sketch.points[order]).round().astype(int)
    dot = range(-1, 2) if len(at) > 4000 else range(-2, 3)
    colours = (POINT_SHADE * sketch.colours[order]).astype(np.uint8)
    for dx in dot:
        for dy in dot:
            x, y = at[:, 0] + dx, at[:, 1] + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            canvas[y[inside], x[inside]] = colours[inside]
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    depth = min(FRUSTUM_DEPTH * float((high - low).max()), 0.8 * typical_gap(sketch.eyes))
    for i in range(len(sketch.eyes)):
        colour = ramp_at(i / max(len(sketch.eyes) - 1, 1))
        eye = place(sketch.eyes[i])
        tips = place(sketch.eyes[i] + depth * sketch.corners[i])
        for j in range(4):
            draw.line([tuple(eye), tuple(tips[j])], colour, SUPERSAMPLING)
            draw.line([tuple(tips[j]), tuple(tips[(j + 1) % 4])], colour, SUPERSAMPLING)
        draw.ellipse([*(eye - 2.5 * SUPERSAMPLING), *(eye + 2.5 * SUPERSAMPLING)], colour)
    for at in place(sketch.lacking):
        draw.ellipse([*(at - 5 * SUPERSAMPLING), *(at + 5 * SUPERSAMPLING)], None, LACKING_COLOUR, 2 * SUPERSAMPLING)
    return image.resize(size, Image.Resampling.BOX)


def typical_gap(eyes: Float[np.ndarray, "photo 3"]) -> float:
    """Median distance to the nearest other camera, at least a fiftieth of their spread."""
    apart = np.linalg.norm(eyes[:, None] - eyes, axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(max(2 * np.median(apart.min(1)), 0.02 * np.ptp(eyes, axis=0).max()))


def ramp_at(share: float) -> str:
    """Colour of the ramp, without its pale end, which is invisible on paper: dark first, bright last."""
    place = torch.tensor(1 - share * (len(RAMP) - 2) / (len(RAMP) - 1), dtype=torch.float64)
    return f"#{bytes((255 * ramp(place)).round().byte().tolist()).hex()}"


def draw_photographs(path: Path, intake: Intake, diagnosis: Diagnosis) -> None:
    """Write a contact sheet: all photographs by name, those with a remark in a frame of its colour."""
    files = {photo.name: photo.path for photo in intake.photos}
    names = [*files, *sorted(intake.unreadable, key=natural)]
    cell = 220 if len(names) <= 60 else 150 if len(names) <= 200 else 110
    pictures = {name: thumbnail(files.get(name), cell) for name in names}
    cell = max(MIN_COLUMN, *(picture.width for picture in pictures.values()))
    columns = min(max(round((1.4 * len(names)) ** 0.5), 4), MAX_SHEET_WIDTH // cell)
    letters = cell // 6
    notes = {name: textwrap.wrap(note, letters)[:3] for name in names if (note := remark(name, diagnosis)[0])}
    gap, text = 12, 15
    rows, y = [], 2 * MARGIN + LINE_HEIGHT
    for start in range(0, len(names), columns):
        row = [(name, pictures[name]) for name in names[start : start + columns]]
        height = max(image.height for _, image in row)
        rows.append((y, height, row))
        y += height + text * (1 + max(len(notes.get(name, ())) for name, _ in row)) + gap
    sheet = Image.new("RGB", (2 * MARGIN + columns * (cell + gap) - gap, y + MARGIN - gap), PAPER_COLOUR)
    draw, small = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    draw.text((MARGIN, MARGIN - 8), heading(diagnosis), INK_COLOUR, ImageFont.load_default(18))
    x = MARGIN
    for colour, name in ((LEFT_OUT_COLOUR, "left out"), (BLURRED_COLOUR, "blurred"), (DUPLICATE_COLOUR, "duplicate")):
        draw.rectangle([x, MARGIN + LINE_HEIGHT + 2, x + 12, MARGIN + LINE_HEIGHT + 14], colour)
        draw.text((x + 18, MARGIN + LINE_HEIGHT), name, FAINT_COLOUR, small)
        x += 90
    for y, height, row in rows:
        for i, (name, image) in enumerate(row):
            x, mark = MARGIN + i * (cell + gap), remark(name, diagnosis)[1]
            left = x + (cell - image.width) // 2
            if mark == LEFT_OUT_COLOUR:
                image = Image.blend(image, Image.new("RGB", image.size, PAPER_COLOUR), 0.35)
            sheet.paste(image, (left, y))
            if mark:
                draw.rectangle([left - 3, y - 3, left + image.width + 2, y + image.height + 2], None, mark, 4)
            draw.text(
                (x, y + height + 3), name if len(name) <= letters else f"…{name[1 - letters :]}", INK_COLOUR, small
            )
            for k, line in enumerate(notes.get(name, ())):
                draw.text((x, y + height + 3 + text * (k + 1)), line, mark, small)
    save_picture(path, sheet, "capture")


def remark(name: str, diagnosis: Diagnosis) -> tuple[str, str | None]:
    """Remark on a photograph, and its colour."""
    if name in diagnosis.left_out:
        return diagnosis.left_out[name], LEFT_OUT_COLOUR
    if name in diagnosis.duplicates:
        return f"shows what {diagnosis.duplicates[name]} shows", DUPLICATE_COLOUR
    if name in diagnosis.blurred:
        return f"blurred: {diagnosis.blurred[name]}", BLURRED_COLOUR
    return "", None


def thumbnail(path: Path | None, cell: int) -> Image.Image:
    if path is None:
        return Image.new("RGB", (cell, cell * 2 // 3), "#e4e1dc")
    with Image.open(path) as image:
        image.draft("RGB", (2 * cell, 2 * cell))
        return fit_into(image.convert("RGB"), cell, cell)
