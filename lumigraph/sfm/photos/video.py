"""Selection of frames from a video: sharp, evenly spread over the camera's movement, without duplicates.

The film is read twice. First every frame, or every second or fourth of a fast film, is judged at small size: its
sharpness, and the accumulated movement of the picture. The film is then cut into as many segments as frames are wanted,
each with equal movement, so that a resting camera gives few frames and a quick turn many; a share of TIME goes by the
clock, for movement that is not measured. The sharpest frame of each segment, with a preference for its middle, is
written in the second pass, unless it repeats an earlier one.
"""

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.fft import irfft2, rfft2

from ...errors import LumigraphError, LumigraphWarning
from ...files import is_file, read_json, replacing_folder, write_json
from ...files.ranges import Lasted
from .copies import save
from .film import Tags, grey, opened, tags_of
from .judge import DUPLICATE_CORRELATION, JUDGED_SIDE, sharpness, signature
from .photo import Track, untracked

FRAMES_PER_SECOND, MIN_FRAMES, MAX_FRAMES = 2.5, 20, 150  # default number of frames
JUDGED_PER_SECOND = 15.0  # frames per second that are judged, or
CANDIDATES_PER_FRAME = 4  # for each selected frame, if that is more
TIME_SHARE = 0.2  # weight of the clock in even spacing; the rest is movement
EDGE_PENALTY = 0.3  # log sharpness that a frame at the end of its interval must have above one in the middle
Row = Float[np.ndarray, " frame"]
MIN_DURATION_SHARE = 0.9  # share of its length that a complete film must have
MOVEMENT_SIDE = 192  # pixels, the longer side for measuring movement
TILE_SIDE = 32  # pixels
REFERENCE_STRIDE = 3  # pixels of movement after which a new reference is taken
MIN_VARIANCE = 9.0  # of values 0 to 255, of a tile that can be tracked
WINDOW_MEAN_SQUARE = (3 / 8) ** 2  # mean square of the window that fades out a tile's border


@dataclass(frozen=True)
class Index:
    """frames.json: source film of the frames beside it, their requested number, and their times.

    film: description of its pictures, by which they were converted
    """

    video: str = ""
    modified: int = 0
    bytes: int = 0
    asked: int | None = None
    film: Tags = Tags()
    frames: dict[str, Lasted] = field(default_factory=dict)


def extract(path: Path, folder: Path, frames: int | None = None, track: Track = untracked) -> list[tuple[Path, float]]:
    """Frames of a video as upright JPEGs in `folder`, in order, with times in seconds from the first on.

    frames: their number; None: FRAMES_PER_SECOND, from MIN_FRAMES to MAX_FRAMES. There are fewer where the film is
            shorter or repeats itself
    An existing folder of the same file and options is reused; any other is replaced.
    Raises LumigraphError if the film cannot be read or has no frames.
    """
    if frames is not None and frames < 2:
        raise LumigraphError(f"{frames} frames of {path} are too few to find cameras for; ask for 2 at least")
    stat = path.stat()
    wanted, index = Index(path.name, stat.st_mtime_ns, stat.st_size, frames, tags_of(path)), folder / "frames.json"
    known = read_json(index, Index) if index.is_file() else Index()
    complete = all(Path(name).name == name and is_file(folder / name) for name in known.frames)
    if not complete or replace(known, frames={}) != wanted:
        chosen = choose(*judge(path, frames, track), frames)
        with replacing_folder(folder, ours=True) as partial:
            written = write(path, partial, chosen, track)
            write_json(partial / "frames.json", asdict(replace(wanted, frames=written)), ours=True)
        known = read_json(index, Index)
    return [(folder / name, seconds) for name, seconds in known.frames.items()]


def judge(path: Path, frames: int | None, track: Track) -> tuple[list[int], Row, Row, Row]:
    """Numbers of the judged frames, their seconds from the first on, sharpness, and accumulated movement."""
    rows: list[tuple[int, float, float, float]] = []
    odometer, end = Odometer(), 0.0
    with opened(path) as film:
        total = film.stream.frames or max(round(film.seconds * film.rate), 1)
        most = total / (CANDIDATES_PER_FRAME * frames) if frames else math.inf
        step = max(int(min(film.rate / JUDGED_PER_SECOND, most)), 1)
        for number, (frame, end) in enumerate(track(film.frames(), f"Watching {path.name}", total)):
            if number % step == 0:
                luminance = grey(frame, JUDGED_SIDE)
                rows.append((number, end, sharpness(luminance), odometer.show(grey(frame, MOVEMENT_SIDE))))
        if not rows:
            raise LumigraphError(f"{path} has no frames; record it again or take it from its source")
        if end - rows[0][1] < MIN_DURATION_SHARE * film.seconds - 1 / film.rate:
            text = f"{path} breaks off after {end:.1f} of {film.seconds:.1f} s; what comes before is used"
            warnings.warn(LumigraphWarning(text), stacklevel=2)
    numbers = [number for number, *_ in rows]
    times, sharp, travelled = np.array([figures for _, *figures in rows]).T
    return numbers, times - times[0], sharp, travelled


def choose(numbers: Sequence[int], seconds: Row, sharp: Row, travelled: Row, frames: int | None = None) -> list[int]:
    """Numbers of the sharpest frames of segments of equal movement, ascending. Other arguments are those of `judge`."""
    length = float(seconds[-1])
    count = frames or min(max(round(FRAMES_PER_SECOND * length), MIN_FRAMES), MAX_FRAMES)
    clock = seconds / max(length, 1e-9)
    way = travelled / travelled[-1] if travelled[-1] > 0 else clock
    place = ((1 - TIME_SHARE) * way + TIME_SHARE * clock) * count
    stretch = np.minimum(place, count - 1).astype(int)
    worth = np.log(sharp) - EDGE_PENALTY * (2 * (place - stretch) - 1) ** 2
    return [numbers[int(max(np.flatnonzero(stretch == s), key=worth.__getitem__))] for s in np.unique(stretch)]


def write(path: Path, folder: Path, chosen: Sequence[int], track: Track) -> dict[str, float]:
    """Write the chosen frames except repetitions of earlier ones. Returns names and seconds from the first frame on."""
    written: dict[str, float] = {}
    signatures: list[np.ndarray] = []
    for number, image, seconds in track(picked(path, chosen), f"Taking frames of {path.name}", len(chosen)):
        new = signature(image.convert("L"))
        if not any(new @ old > DUPLICATE_CORRELATION for old in signatures):
            name = f"{number:06d}.jpg"
            save(image, folder / name, ".jpg")
            signatures.append(new)
            written[name] = seconds
    return written


def picked(path: Path, chosen: Sequence[int], tags: Tags | None = None) -> Iterator[tuple[int, Image.Image, float]]:
    """Numbers, pictures and seconds from the first on of chosen frames. tags: as in `opened`"""
    wanted, beginning = set(chosen), 0.0
    with opened(path, tags) as film:
        for number, (frame, seconds) in enumerate(film.frames()):
            beginning = seconds if number == 0 else beginning
            if number in wanted:
                yield number, film.picture(frame), seconds - beginning
            if number == chosen[-1]:
                return


class Odometer:
    """Accumulated movement of a picture, in pixels of small grey pictures passed one by one.

    Each is compared with a reference, which is replaced only after movement by REFERENCE_STRIDE, so that noise does not
    accumulate while the camera rests.
    """

    def __init__(self) -> None:
        self.travelled = 0.0  # up to the reference
        self._reference: np.ndarray | None = None

    def show(self, picture: Float[np.ndarray, "height width"]) -> float:
        """Add a picture. Returns the accumulated movement."""
        tiles = cut(picture)
        if self._reference is None:
            self._reference = tiles
        distance = measure_displacement(self._reference, tiles)
        if distance >= REFERENCE_STRIDE:
            self.travelled, self._reference, distance = self.travelled + distance, tiles, 0.0
        return self.travelled + distance


def cut(picture: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "tile row column"]:
    """Square tiles with a window function; incomplete tiles are left out."""
    rows, columns = max(picture.shape[0] // TILE_SIDE, 1), max(picture.shape[1] // TILE_SIDE, 1)
    whole = np.zeros((rows * TILE_SIDE, columns * TILE_SIDE), np.float32)
    part = picture[: rows * TILE_SIDE, : columns * TILE_SIDE]
    whole[: part.shape[0], : part.shape[1]] = part
    tiles = whole.reshape(rows, TILE_SIDE, columns, TILE_SIDE).swapaxes(1, 2).reshape(-1, TILE_SIDE, TILE_SIDE)
    window = np.hanning(TILE_SIDE).astype(np.float32)
    return (tiles - tiles.mean((1, 2), keepdims=True)) * window[:, None] * window


def measure_displacement(a: Float[np.ndarray, "tile row column"], b: Float[np.ndarray, "tile row column"]) -> float:
    """Mean length of the tiles' displacements by phase correlation; 0 without texture. Tiles are tracked one by one, so
    that walking forward or rolling the camera counts as well."""
    textured = np.minimum(np.square(a).mean((1, 2)), np.square(b).mean((1, 2))) > MIN_VARIANCE * WINDOW_MEAN_SQUARE
    if not textured.any():
        return 0.0
    correlation = irfft2(np.conj(rfft2(a[textured])) * rfft2(b[textured]), s=(TILE_SIDE, TILE_SIDE))
    y, x = np.unravel_index(correlation.reshape(len(correlation), -1).argmax(1), (TILE_SIDE, TILE_SIDE))
    wrapped = [(axis + TILE_SIDE // 2) % TILE_SIDE - TILE_SIDE // 2 for axis in (x, y)]
    return float(np.hypot(*wrapped).mean())
