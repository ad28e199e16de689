"""Image files of photographs: search, size, orientation, downscaling, reading as bytes."""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from ..datasets.images import ImageSource, resized
from ..errors import LumigraphError, LumigraphWarning
from ..files import is_file
from ..files.reading import reading
from ..system.memory import free_memory
from .capture import PixelPlane, Shot
from .numbers import DECODING_COPIES, Kind, as_bytes, check_pixels, is_tiff, kind_of, read_numbers, tiff_tags, turned
from .profiles import Colours, colours_of

DIGEST_SAMPLES, DIGEST_BYTES = 16, 1 << 12  # steps from one sample of a file's content to the next; bytes of a sample
DEFAULT_MAX_SIDE = 1100  # pixels of the longer side of a photograph
MAX_KEPT = 1.2  # times as long a side stays as it is, rather than losing sharpness for few pixels
HEIC_SUFFIXES = (".heic", ".heif", ".hif")
IMAGE_SUFFIXES = (
    ".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".bmp", ".exr", ".HEIC", *HEIC_SUFFIXES,
    ".avif", ".jfif", ".jp2",
)  # fmt: skip
UNSEEN = (".", "@eadir", "__macosx")  # beginnings of names of hidden files, and of folders of a NAS and of macOS
LARGE = 64_000_000  # pixels beyond which a JPEG is decoded at a half, a quarter or an eighth, from three final sizes on
NO_HEIC = "is HEIC, and pi-heif, which reads that, is missing; pip install pi-heif, or convert it to JPEG"
DEEP_SUFFIXES = (".png", ".tif", ".tiff", ".exr")  # of files that may hold more than eight bits
EXIF_ORIENTATION = 0x0112
ICC_TAG = 34675  # of TIFF
EXIF_UPRIGHT = (None, 0, 1)
EXIF_SIDEWAYS = (5, 6, 7, 8)

Size = tuple[int, int]
Image.MAX_IMAGE_PIXELS = free_memory() // (8 * DECODING_COPIES)  # refused from twice that; `check_pixels` is stricter
warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)


def find_file(path: Path) -> Path:
    """The file itself, or for a name without suffix the image of that name. The file may not exist."""
    if is_file(path) or not path.name:
        return path
    return next((p for s in IMAGE_SUFFIXES if is_file(p := path.with_name(path.name + s))), path)


def list_images(folder: Path) -> list[str]:
    """Names of the images below a folder, with / between folders, sorted as strings (10 before 2), the order in which
    programs pair them with poses."""
    if not folder.is_dir():
        return []
    files = (p for p in folder.rglob("*") if p.suffix.lower() in {s.lower() for s in IMAGE_SUFFIXES} and p.is_file())
    inner = (p.relative_to(folder) for p in files)
    return sorted(p.as_posix() for p in inner if not any(part.lower().startswith(UNSEEN) for part in p.parts))


def reductions(folder: Path) -> dict[int, Path]:
    """Folders of the same photographs at reduced size: images, images_2, images_4..., by factor."""
    found = {1: folder} if folder.is_dir() else {}
    for beside in folder.parent.glob(f"{folder.name}_*"):
        times = beside.name.removeprefix(f"{folder.name}_")
        if times.isascii() and times.isdigit() and int(times) > 1 and beside.is_dir():
            found[int(times)] = beside
    return dict(sorted(found.items()))


def versions(folders: dict[int, Path], names: list[str]) -> list[dict[int, Path]]:
    """Files of each named photograph by reduction factor.

    A file may have another suffix than the name says. A reduced folder with the same number of files but no matching
    name is matched in order of names.
    """
    found: list[dict[int, Path]] = [{} for _ in names]
    for times, place in folders.items():
        files: list[Path | None] = [place / name for name in names]
        if not all((place / name).is_file() for name in names):
            listed = list_images(place)
            by_stem = {stem(name): place / name for name in listed}
            if times > 1 and len(listed) == len(names) and by_stem.keys().isdisjoint(map(stem, names)):
                renamed = dict(zip(sorted(names), listed, strict=True))
                files = [place / renamed[name] for name in names]
            else:
                files = [place / name if (place / name).is_file() else by_stem.get(stem(name)) for name in names]
        for file, known in zip(files, found, strict=True):
            if file is not None:
                known[times] = file
    return found


def stem(name: str) -> str:
    return name.rsplit(".", 1)[0]


@dataclass(frozen=True)
class Chosen:
    """A photograph's file at its final size: its pixels, the size of its lens calibration, and the target size.

    plane: all its bits, where they are more than eight
    digest: of its file, see `digest_of`; empty without a file
    """

    picture: ImageSource
    calibrated: Size
    wanted: Size
    plane: PixelPlane | None = None
    digest: str = ""


def choose(shot: Shot, downscale: int | None) -> Chosen:
    """Choose a shot's file to read, and its reduction: `downscale` times the size that the lens was calibrated for.

    Raises LumigraphError for a file that is no image or whose aspect ratio contradicts the lens.
    """
    if isinstance(shot.image, dict):
        return choose_file(shot, shot.image, downscale)
    pixels = shot.image
    own = (pixels.shape[1], pixels.shape[0]) if isinstance(pixels, np.ndarray) else shot.size
    assert own is not None, f"{shot.name} is made when asked, so its size must be said"
    calibrated = shot.size or own
    wanted = reduced(calibrated, downscale)
    size = smaller(own, wanted)

    def make() -> np.ndarray:
        with reading(shot.name):
            made = pixels if isinstance(pixels, np.ndarray) else pixels()
        return np.asarray(Image.fromarray(made).resize(size, Image.Resampling.BOX))

    identity = shot.identity if shot.mask is None and shot.alpha is None else None
    return Chosen(ImageSource(size, masked(make, shot, size, False), identity), calibrated, wanted)


def choose_file(shot: Shot, files: dict[int, Path], downscale: int | None) -> Chosen:
    calibrated = shot.size or upright_size(files)
    wanted = reduced(calibrated, downscale)
    times = max(1, round(max(calibrated) / max(wanted)))
    fitting = [k for k in files if times % k == 0 or (downscale is None and k <= times)]
    path = files[max(fitting) if fitting else min(files, key=lambda k: (k > times, abs(k - times)))]
    stored, orientation = measure(path)
    turned = stored[::-1] if orientation in EXIF_SIDEWAYS else stored
    # Most programs that find poses read pixels as they are stored; some turn them upright first.
    if shot.size is not None and same_shape(stored, calibrated):
        turn, own = False, stored
    elif same_shape(turned, calibrated):
        turn, own = orientation not in EXIF_UPRIGHT, turned
    else:
        raise LumigraphError(
            f"{path} is {stored[0]}x{stored[1]} pixels, but its camera was calibrated for "
            f"{calibrated[0]}x{calibrated[1]}, which is another shape; "
            f"correct the camera's width and height or restore the image"
        )
    size = smaller(own, wanted)
    identity = f"{path.resolve()} {stat(path)} {turn}"
    for beside in (shot.mask, shot.alpha):
        if isinstance(beside, Path):
            identity += f" {beside.resolve()} {stat(beside)}"
    if isinstance(shot.mask, np.ndarray):
        identity += f" {zlib.crc32(shot.mask.tobytes())}"
    return Chosen(
        ImageSource(
            size,
            masked(lambda: read_image(path, turn, size), shot, size, turn),
            identity,
            DECODING_COPIES * 4 * math.prod(stored),
        ),
        calibrated,
        wanted,
        deep_plane(path, turn, identity),
        digest_of(path),
    )


def check_downscale(downscale: int | None) -> None:
    if downscale is not None and downscale < 1:
        raise LumigraphError(f"--downscale {downscale} cannot be; it is a whole number from 1 on")


def reduced(size: Size, downscale: int | None) -> Size:
    """Width and height of a photograph after `downscale`; None: with the default longer side, if it is longer."""
    times = float(downscale or max(size) / DEFAULT_MAX_SIDE)
    if downscale is None and times <= MAX_KEPT:
        times = 1.0
    return max(round(size[0] / times), 1), max(round(size[1] / times), 1)


def smaller(own: Size, wanted: Size) -> Size:
    """The size to read at: the target size, unless the file is smaller, or equal up to another program's rounding."""
    return own if max(own) <= max(wanted) + 1 else wanted


def same_shape(a: Size, b: Size) -> bool:
    """True if two sizes have the same ratio of sides, up to 1% and one pixel of rounding."""
    return abs(math.log(a[0] * b[1] / (a[1] * b[0]))) < 0.01 + 1 / min(*a, *b)


def stat(path: Path) -> str:
    with readable(path):
        found = path.stat()
    return f"{found.st_mtime_ns} {found.st_size}"


def digest_of(path: Path) -> str:
    """Size of a file and a hash of samples of its content, to detect changed photographs."""
    with readable(path), open(path, "rb") as file:
        size, crc = path.stat().st_size, 0
        for number in range(DIGEST_SAMPLES + 1):
            file.seek(max(0, size - DIGEST_BYTES) * number // DIGEST_SAMPLES)
            crc = zlib.crc32(file.read(DIGEST_BYTES), crc)
    return f"{size}-{crc:08x}"


@cache
def reads_heic() -> bool:
    """Register HEIC support in Pillow, with orientation applied by the decoder. False without the package."""
    try:
        import pi_heif
    except ImportError:
        return False
    pi_heif.register_heif_opener()
    return True


def measure(path: Path) -> tuple[Size, int | None]:
    """Width and height as stored, and EXIF's orientation."""
    with readable(path):
        if path.suffix.lower() == ".exr":
            return kind_of(path).size, None
        if is_tiff(path):
            return kind_of(path).size, tiff_tags(path).get(EXIF_ORIENTATION)
        with Image.open(path) as image:
            large = image.format in ("JPEG", "MPO") and math.prod(image.size) > LARGE
            check_pixels(image.size, 1 if large else 4)
            return image.size, image.getexif().get(EXIF_ORIENTATION)


def upright_size(files: dict[int, Path]) -> Size:
    """Full size of a photograph from files by reduction factor, after EXIF rotation."""
    (width, height), orientation = measure(files[min(files)])
    width, height = width * min(files), height * min(files)
    return (height, width) if orientation in EXIF_SIDEWAYS else (width, height)


def read_image(path: Path, turn: bool, size: Size) -> np.ndarray:
    """Pixels as uint8 (height, width, 3 or 4), upright if asked, area-averaged down to a size."""
    if (kind := deep(path)) is not None:
        return as_bytes(resized(read_deep(path, turn), size, kind.encoding), kind.encoding)
    with readable(path), Image.open(path) as image:
        if math.prod(image.size) > LARGE:
            image.draft(None, (3 * min(size),) * 2)  # what is left is averaged
        return np.asarray(srgb_image(image, turn, size))


def srgb_image(image: Image.Image, turn: bool, size: Size | None = None) -> Image.Image:
    """An opened photograph as RGB or RGBA of 8 bits in sRGB, upright if asked, area-averaged down to a size."""
    colours = colours_of(image)
    made = ImageOps.exif_transpose(image) if turn else image
    if made.mode not in ("RGB", "RGBA"):
        made = colours.to_srgb(made)  # by its own channels
        colours = colours if made.mode in ("P", "PA") else Colours()
    made = eight_bits(made)
    return colours.to_srgb(made if size is None else made.resize(size, Image.Resampling.BOX))


def deep(path: Path) -> Kind | None:
    """Header of a photograph, if it holds more than eight bits."""
    if path.suffix.lower() not in DEEP_SUFFIXES:
        return None
    with readable(path):
        kind = kind_of(path)
    return kind if kind.deep else None


def read_deep(path: Path, turn: bool) -> np.ndarray:
    """All bits of a photograph in sRGB, RGB or RGBA, upright if asked."""
    with readable(path):
        values = read_numbers(path)
        if values.dtype.kind == "f" and (bad := int((~np.isfinite(values)).any(-1).sum() if values.ndim == 3 else 0)):
            warnings.warn(f"{path} has {bad:,} pixels that are not finite; they count as black", LumigraphWarning, 2)
            values = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
        values = deep_colours(path).deep_to_srgb(np.repeat(values[..., None], 3, -1) if values.ndim == 2 else values)
        return turned(values, measure(path)[1]) if turn else values


def deep_colours(path: Path) -> Colours:
    """Colour description of a file of more than eight bits."""
    if is_tiff(path):
        return Colours(profile=bytes(tiff_tags(path).get(ICC_TAG, b"")))
    if path.suffix.lower() != ".png":
        return Colours()
    with Image.open(path) as image:
        return colours_of(image)


def deep_plane(path: Path, turn: bool, identity: str) -> PixelPlane | None:
    """All bits of a photograph as values of a layer; None for eight bits."""
    kind = deep(path)
    if kind is None:
        return None
    whole = kind.dtype.kind == "f"
    return PixelPlane(
        partial(read_deep, path, turn),
        kind.encoding,
        scale=1.0 if whole else 1 / np.iinfo(kind.dtype).max,
        dtype=kind.dtype,
        channels=max(kind.channels, 3),
        identity=identity,
    )


def eight_bits(image: Image.Image) -> Image.Image:
    """An image of any mode, as RGB or RGBA of 8 bits."""
    if image.mode.startswith("I"):  # 16 bits of grey
        image = Image.fromarray((np.asarray(image).astype(np.uint32) // 257).clip(0, 255).astype(np.uint8))
    elif image.mode == "F":
        image = Image.fromarray(as_bytes(np.asarray(image)[..., None], "linear")[..., 0])
    see_through = image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
    return image.convert("RGBA" if see_through else "RGB")


def masked(
    make: Callable[[], np.ndarray], shot: Shot, size: Size, turn: bool
) -> Callable[[], tuple[np.ndarray, np.ndarray | None]]:
    """Reader of a shot's pixels, with alpha multiplied by the silhouette, and of its mask."""

    def read() -> tuple[np.ndarray, np.ndarray | None]:
        pixels = make()
        if shot.alpha is not None:
            grey = Image.fromarray(read_grey(shot.alpha, size, turn))
            alpha = np.asarray(grey.resize(size, Image.Resampling.BOX))
            if pixels.shape[2] == 4:
                alpha = (pixels[..., 3].astype(np.uint16) * alpha + 127) // 255
            pixels = np.concatenate([pixels[..., :3], alpha[..., None].astype(np.uint8)], -1)
        return pixels, None if shot.mask is None else read_mask(shot.mask, size, turn)

    return read


def read_grey(path: Path, size: Size, turn: bool) -> np.ndarray:
    """A mask's brightest channel, times its alpha, as uint8, in its own size, which has the photograph's shape. A black
    picture is its alpha, and of ones and zeros the ones are white."""
    with readable(path), Image.open(path) as image:
        upright = ImageOps.exif_transpose(image) if turn else image
        channels = np.asarray(eight_bits(upright)).astype(np.uint16)
        grey = channels[..., :3].max(-1)
        if channels.shape[2] == 4:
            grey = grey * channels[..., 3] // 255 if grey.any() else channels[..., 3]
        grey = grey * 255 if grey.max() == 1 else grey
        if not same_shape((grey.shape[1], grey.shape[0]), size):
            raise ValueError(f"its shape {grey.shape[1]}x{grey.shape[0]} is not the image's {size[0]}x{size[1]}")
    return grey.astype(np.uint8)


def read_mask(mask: Path | np.ndarray, size: Size, turn: bool) -> np.ndarray:
    """Mask of the pixels whose whole area is unmasked (brighter than half)."""
    grey = Image.fromarray(mask.astype(bool) if isinstance(mask, np.ndarray) else read_grey(mask, size, turn) > 127)
    return np.asarray(grey.convert("L").resize(size, Image.Resampling.BOX)) > 254


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Context that turns any error of an image library for a file into a LumigraphError of one sentence."""
    if path.suffix.lower() in HEIC_SUFFIXES and not reads_heic():
        raise LumigraphError(f"{path} {NO_HEIC}")
    with reading(path, "cannot be read as an image", "restore it, or delete it so that it is skipped"):
        yield
