"""OpenEXR pictures: tiled or in lines, of any compression, colours or luminance and chroma, by the format's library."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from .reading import reads

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of BT.709, for files of luminance and chroma
GREY = (
    "Y",
    "Z",
    "A",
)  # channels that a picture of one number a pixel may have, in the order in which they are looked for


@reads()
def read_exr(path: Path) -> np.ndarray:
    """Numbers of a picture, (height, width, 3 or 4), or (height, width) of one channel, over the display window, and 0
    where the file has none. Raises ValueError for deep files and for channels that are no picture."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        parts = [part for part in file.parts if picture_of(part.channels) is not None]
        if not parts:
            known = ", ".join(sorted({name for part in file.parts for name in part.channels}))
            raise ValueError(f"its channels {known or 'of no kind'} are no picture")
        header, channels = parts[0].header, parts[0].channels
        names = picture_of(channels) or []
        if names[0] == "Y" and len(names) == 3:
            values = from_luminance(*(channels[name].pixels for name in names))
        else:
            values = np.stack([channels[name].pixels for name in names], -1)
        found = placed(values, header["dataWindow"], header["displayWindow"])
    return found if found.shape[-1] > 1 else found[..., 0]


def picture_of(names: Iterable[str]) -> list[str] | None:
    """Channels of a picture among names: of the first layer that has colours, else one of GREY."""
    names = list(names)
    layers = sorted({name.rpartition(".")[0] for name in names}, key=len)
    for layer in layers:
        full = {one.rpartition(".")[2]: one for one in names if one.rpartition(".")[0] == layer}
        for wanted in (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "RY", "BY")):
            if full.keys() >= {*wanted}:
                return [full[name] for name in wanted]
    plain = [name for name in GREY if name in names] or (names if len(names) == 1 else [])
    return plain[:1] or None


def from_luminance(light: np.ndarray, red: np.ndarray, blue: np.ndarray) -> np.ndarray:
    """Colours of luminance Y and of chroma (R - Y) / Y and (B - Y) / Y, which may have half the size."""
    rows, columns = light.shape
    light = light.astype(np.float32)
    chroma = [
        np.repeat(np.repeat(x.astype(np.float32), -(-rows // x.shape[0]), 0), -(-columns // x.shape[1]), 1)[
            :rows, :columns
        ]
        for x in (red, blue)
    ]
    r, b = ((1 + x) * light for x in chroma)
    g = (light - LUMINANCE[0] * r - LUMINANCE[2] * b) / LUMINANCE[1]
    return np.stack([r, g, b], -1).astype(np.float32)


def placed(values: np.ndarray, data: tuple, display: tuple) -> np.ndarray:
    """Numbers of the data window in the display window."""
    (left, top), (right, bottom) = display
    if all(np.array_equal(a, b) for a, b in zip(data, display, strict=True)):
        return values
    found = np.zeros((bottom - top + 1, right - left + 1, values.shape[-1]), values.dtype)
    x, y = int(data[0][0] - left), int(data[0][1] - top)
    rows, columns = (slice(max(-o, 0), max(n - o, 0)) for o, n in ((y, found.shape[0]), (x, found.shape[1])))
    part = values[rows, columns]
    found[max(y, 0) : max(y, 0) + part.shape[0], max(x, 0) : max(x, 0) + part.shape[1]] = part
    return found
