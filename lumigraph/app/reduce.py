"""Downscaling of a photograph of any size with little more memory than its pixels take.

Run as a script with a file and a number of pixels, it writes a JPEG to standard output, so that the memory of a large
photograph is freed with the process. It imports nothing of the package, so it starts in a tenth of a second.
"""

import io
import sys

from PIL import Image

STRIP_PIXELS = 1 << 22  # that are converted at a time
ORIENTATION = 0x0112  # of EXIF
QUALITY = 92


def reduced(image: Image.Image, side: int) -> Image.Image:
    """RGB of 8 bits, reduced to at most twice the requested longer side; smaller images keep their size.

    An unread JPEG is reduced during decoding, other formats strip by strip.
    """
    image.draft("RGB", (side, side))
    factor = max(1, max(image.size) // side)
    made = Image.new("RGB", (-(-image.width // factor), -(-image.height // factor)))
    rows = factor * max(1, STRIP_PIXELS // (image.width * factor))
    image.load()
    for top in range(0, image.height, rows):
        strip = rgb(image.crop((0, top, image.width, min(top + rows, image.height))))
        made.paste(strip.reduce(factor), (0, top // factor))
    return made


def rgb(image: Image.Image) -> Image.Image:
    """RGB of 8 bits, also from 16 bits of grey or linear floating-point numbers."""
    if image.mode.startswith("I"):
        return image.convert("I").point(lambda value: value * (1 / 257)).convert("L").convert("RGB")
    if image.mode == "F":
        return image.point(lambda value: value * 255.0).convert("L").convert("RGB")
    if image.mode == "RGBa":  # colours times alpha
        image = image.convert("RGBA")
    return image.convert("RGB")


def jpeg_of(image: Image.Image, side: int) -> bytes:
    """JPEG of an image, reduced, which keeps its orientation as stored and its profile."""
    exif = Image.Exif()
    exif[ORIENTATION] = image.getexif().get(ORIENTATION, 1)
    profile = image.info.get("icc_profile") if image.mode.startswith("RGB") else None
    reduced(image, side).save(out := io.BytesIO(), "JPEG", quality=QUALITY, exif=exif, icc_profile=profile)
    return out.getvalue()


def main() -> None:
    try:
        import pi_heif

        pi_heif.register_heif_opener()
    except ImportError:
        pass
    with Image.open(sys.argv[1]) as image:
        sys.stdout.buffer.write(jpeg_of(image, int(sys.argv[2])))


if __name__ == "__main__":
    main()
