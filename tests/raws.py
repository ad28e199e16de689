"""Raw photographs made in code: a folder of mosaics, and the smallest DNG that LibRaw reads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import tifffile
from PIL import Image

from lumigraph.readers.raw.photo import repeated, srgb_from_camera

BLACK, WHITE, GAINS = 500, 12_500, (2.0, 1.0, 1.5)
MATRIX = [[0.9020, -0.2890, -0.0715], [-0.4535, 1.2436, 0.2348], [-0.0934, 0.1919, 0.7086]]
PATTERNS = {"RGGB": ((0, 1), (1, 2)), "BGGR": ((2, 1), (1, 0)), "GRBG": ((1, 0), (2, 1)), "GBRG": ((1, 2), (0, 1))}


def mosaic_of(rgb: np.ndarray, pattern: str = "RGGB", exposure: float = 1.0) -> np.ndarray:
    """What a sensor without noise reads of linear sRGB (height, width, 3): uint16 (height, width)."""
    camera = rgb @ np.linalg.inv(srgb_from_camera(np.array(MATRIX))).T / GAINS
    filters = repeated(PATTERNS[pattern], (rgb.shape[1], rgb.shape[0])).astype(int)
    light = exposure * np.take_along_axis(camera, filters[..., None], -1)[..., 0]
    return np.rint(BLACK + light * (WHITE - BLACK)).clip(0, 65_535).astype(np.uint16)


def write_mosaics(
    folder: Path, mosaics: dict[str, np.ndarray], exposures: dict[str, float] | None = None, **said
) -> Path:
    """A folder of mosaics, .png or .raw by their names, and mosaics.json."""
    folder.mkdir(parents=True, exist_ok=True)
    photographs = {}
    for name, mosaic in mosaics.items():
        if name.endswith(".raw"):
            mosaic.astype("<u2").tofile(folder / name)
        else:
            Image.fromarray(mosaic).save(folder / name)
        photographs[name] = {"exposure": exposures[name]} if exposures else {}
    height, width = next(iter(mosaics.values())).shape
    common = {"pattern": "RGGB", "black": BLACK, "white": WHITE, "gains": GAINS, "colour_matrix": MATRIX}
    common |= {"width": width, "height": height} | said
    common = {k: v for k, v in common.items() if v is not None}
    (folder / "mosaics.json").write_text(json.dumps({"all": common, "photographs": photographs}))
    return folder


def write_dng(path: Path, mosaic: np.ndarray, orientation: int = 1, seconds: float | None = 1 / 30) -> Path:
    """An uncompressed DNG of a camera that nobody makes."""

    def rational(values) -> list[int]:
        return [n for value in values for n in (round(value * 10_000), 10_000)]

    tags = [
        (274, "H", 1, orientation, True),
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),  # DNGVersion
        (50708, "s", 0, "Lumigraph Test", True),  # UniqueCameraModel
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, bytes([0, 1, 1, 2]), True),  # CFAPattern
        (50714, "H", 1, BLACK, True),
        (50717, "H", 1, WHITE, True),
        (50721, "2i", 9, rational(np.ravel(MATRIX)), True),  # ColorMatrix1
        (50728, "2I", 3, rational(1 / np.array(GAINS)), True),  # AsShotNeutral
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
        (271, "s", 0, "Lumigraph", True),
        (272, "s", 0, "Test", True),
        (33437, "2I", 1, (28, 10), True),
    ]
    if seconds is not None:
        tags.append((33434, "2I", 1, (1, round(1 / seconds)), True))
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)
    return path


def gradient(width: int = 48, height: int = 32) -> np.ndarray:
    """Linear sRGB that changes slowly."""
    y, x = np.mgrid[:height, :width]
    return np.stack([0.1 + 0.2 * x / width, 0.15 + 0.2 * y / height, 0.3 - 0.1 * x / width], -1)
