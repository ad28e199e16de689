"""Colours of films and photographs that other programs wrote, beside their source; seconds to read many of them.

    python benchmarks/colours.py PHOTOGRAPH [--output F.json]

ffmpeg (on the path, with zimg) makes six films of the photograph (HLG, PQ, Display P3, pixels that are not square,
fields, mirrored), Pillow six photographs (Display P3, Adobe RGB, CMYK, 16 bits with a profile, HEIC with tags alone,
grey). Each is read as a capture reads it. Printed: mean colour, saturation (mean of the largest less the smallest
channel, of 255), PSNR against the source, and processor seconds of the 100 frames of a film and of 1,000 photographs,
beside what needs no conversion.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import pillow_heif
import tyro
from PIL import Image, ImageCms
from rich.table import Table
from tyro.conf import Positional

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
from deep_files import write_png16
from test_colours import icc, mirrored, with_profile

from lumigraph import files
from lumigraph.color import display
from lumigraph.color.srgb import linear_from_srgb, srgb_from_linear
from lumigraph.readers.pictures import read_image
from lumigraph.sfm.photos.film import opened
from lumigraph.system.console import console

LONGEST, FRAMES, PHOTOGRAPHS, MAX_SECONDS = 960, 100, 1000, 5.0
HDR = "zscale=pin=709:tin=iec61966-2-1:min=709:rin=limited:p=2020:m=2020_ncl:npl=203:t="
X265 = ["-c:v", "libx265", "-crf", "8", "-pix_fmt", "yuv420p10le", "-x265-params", "log-level=error"]
X264 = ["-c:v", "libx264", "-crf", "8", "-pix_fmt", "yuv420p"]
TAGS = ["-color_primaries", "bt709", "-color_trc", "iec61966-2-1", "-colorspace", "bt709"]
BT709 = "scale=out_color_matrix=bt709"
FILMS = {
    "plain": (BT709, X264 + TAGS),
    "HLG": (HDR + "arib-std-b67", X265),
    "PQ": (HDR + "smpte2084", X265),
    "Display P3": (
        "zscale=pin=709:tin=iec61966-2-1:min=709:p=smpte432:t=iec61966-2-1:m=709",
        [*X264, "-color_primaries", "smpte432", "-color_trc", "iec61966-2-1", "-colorspace", "bt709"],
    ),
    "pixels of 4:3": (f"{BT709}:w=iw*3/4:h=ih,setsar=4/3", X264 + TAGS),
    "fields": (f"{BT709},tinterlace=interleave_top", [*X264, *TAGS, "-flags", "+ildct+ilme", "-x264opts", "tff=1"]),
    "mirrored": (BT709, X264 + TAGS),
}


@dataclass(frozen=True)
class Options:
    photograph: Positional[Path]
    output: Path | None = None


@dataclass(frozen=True)
class Read:
    """A picture that was read. rgb: mean colour, of 255; seconds: of a processor, per frame or photograph"""

    rgb: list[float]
    saturation: float
    psnr: float
    seconds: float


def judged(picture: np.ndarray, seconds: float, source: np.ndarray) -> Read:
    same = np.asarray(Image.fromarray(picture).resize(source.shape[1::-1], Image.Resampling.BICUBIC))
    spread = same.max(-1).astype(float) - same.min(-1)
    psnr = float(-10 * np.log10(np.mean((same / 255 - source / 255) ** 2) + 1e-12))
    return Read(same.mean((0, 1)).round(1).tolist(), float(spread.mean()), psnr, seconds)


def read_film(path: Path) -> tuple[np.ndarray, float]:
    """A picture from the middle of a film, and processor seconds a frame of all of them."""
    begin, pictures = time.process_time(), []
    with opened(path) as film:
        for i, frame in enumerate(film.frames()):
            picture = np.asarray(film.picture(frame[0]))
            if i == FRAMES // 4:
                pictures.append(picture)
    return pictures[0], (time.process_time() - begin) / (i + 1)


def make_films(source: Path, folder: Path) -> dict[str, Path]:
    made = {}
    for name, (filters, codec) in FILMS.items():
        made[name] = folder / f"{len(made)}.mp4"
        still = ["ffmpeg", "-loglevel", "error", "-loop", "1", "-r", "30", "-i", str(source), "-frames:v", str(FRAMES)]
        subprocess.run([*still, "-vf", filters, *codec, str(made[name])], check=True)
    made["mirrored"].write_bytes(mirrored(made["mirrored"].read_bytes(), Image.open(source).width))
    return made


def make_photographs(image: Image.Image, folder: Path) -> dict[str, Path]:
    """The same picture in six other forms; LittleCMS converts to profiles, numbers convert for tags."""
    srgb, p3, adobe = ImageCms.createProfile("sRGB"), icc(display.P3, 2.2), icc(display.ADOBE, 563 / 256)

    def into(profile: bytes) -> Image.Image:
        return ImageCms.profileToProfile(image, srgb, ImageCms.ImageCmsProfile(BytesIO(profile)), renderingIntent=1)

    light = linear_from_srgb(np.asarray(image) / 255) @ np.linalg.inv(display.to_bt709(display.P3)).T
    signal = srgb_from_linear(light.clip(0, 1))
    jpeg = {"quality": 97, "subsampling": 0}
    image.save(folder / "plain.jpg", **jpeg)
    into(p3).save(folder / "p3.jpg", icc_profile=p3, **jpeg)
    into(adobe).save(folder / "adobe.jpg", icc_profile=adobe, **jpeg)
    image.convert("CMYK").save(folder / "cmyk.jpg", **jpeg)
    image.convert("L").save(folder / "grey.png")
    deep = np.rint(65535 * light.clip(0, 1) ** (1 / 2.2)).astype(np.uint16)
    write_png16(folder / "deep.png", deep)
    (folder / "deep.png").write_bytes(with_profile((folder / "deep.png").read_bytes(), p3))
    heif = pillow_heif.from_pillow(Image.fromarray(np.rint(255 * signal).astype(np.uint8)))
    heif.save(folder / "tags.heic", quality=97, chroma=444, color_primaries=12, transfer_characteristics=13)
    names = "plain.jpg", "p3.jpg", "adobe.jpg", "cmyk.jpg", "deep.png", "tags.heic", "grey.png"
    kinds = "plain", "Display P3", "Adobe RGB", "CMYK", "16 bits, Display P3", "HEIC, P3 by tags", "grey"
    return {kind: folder / name for kind, name in zip(kinds, names, strict=True)}


def read_photographs(path: Path, size: tuple[int, int]) -> tuple[np.ndarray, float]:
    """A photograph, and processor seconds of each of many copies, until `PHOTOGRAPHS` or some seconds are over."""
    begin, count = time.process_time(), 0
    while count < PHOTOGRAPHS and time.process_time() - begin < MAX_SECONDS:
        picture, count = read_image(path, True, size), count + 1
    return picture, (time.process_time() - begin) / count


def main(options: Options) -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        image = Image.open(options.photograph).convert("RGB")
        image.thumbnail((LONGEST, LONGEST))
        image = image.crop((0, 0, image.width // 24 * 24, image.height // 4 * 4))
        image.save(folder / "source.png")
        source = np.asarray(image)
        rows = {"source": judged(source, 0.0, source)}
        for name, path in make_films(folder / "source.png", folder).items():
            rows[f"film: {name}"] = judged(*read_film(path), source[:, ::-1] if name == "mirrored" else source)
        for name, path in make_photographs(image, folder).items():
            rows[f"photograph: {name}"] = judged(*read_photographs(path, image.size), source)
    table = Table("", "mean colour", "saturation", "PSNR", "processor s", caption="100 frames; 1,000 photographs")
    for name, row in rows.items():
        times = FRAMES if name.startswith("film") else PHOTOGRAPHS
        colour = " ".join(f"{x:.1f}" for x in row.rgb)
        table.add_row(name, colour, f"{row.saturation:.1f}", f"{row.psnr:.1f}", f"{times * row.seconds:.1f}")
    console().print(table)
    if options.output:
        files.write_json(options.output, {name: asdict(row) for name, row in rows.items()})


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
