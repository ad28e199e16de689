"""Films in the format of their suffix: H.264 in MP4 with PyAV, GIF and WebP."""

from __future__ import annotations

import contextlib
import tempfile
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from jaxtyping import Float, Int, UInt8
from PIL import Image
from torch import Tensor

from ..errors import LumigraphError, LumigraphWarning
from ..files import Kind, replacing
from ..system.progress import counting, track

ENCODERS: dict[str, tuple[str, dict[str, str]]] = {  # of an .mp4; the first that PyAV has is used
    "libx264": ("H.264", {"crf": "17", "preset": "slow"}),  # constant rate factor: 0 is lossless, 18 looks it
    "libvpx-vp9": ("VP9", {"crf": "18", "b": "0", "cpu-used": "4", "row-mt": "1"}),
    "mpeg4": ("MPEG-4", {"flags": "+qscale", "global_quality": "236"}),  # FFmpeg's own; twice its finest step
}
WEBP_QUALITY = 85  # of 100
GIF_COLOURS = 255  # of a GIF; its 256th means "as before"
PALETTE_SAMPLES = 400_000  # pixels of all frames together that choose a GIF's colours
MAX_GIF_FPS = 50  # per second, of a GIF: browsers slow quicker ones down to 10


@contextlib.contextmanager
def open_video(path: Path, fps: float = 30.0, what: Kind = "film") -> Iterator[Video]:
    """A film to add frames to, in order; the file appears after the block succeeds.

    fps:  frames per second
    what: kind of the file, see `files.replacing`
    Raises LumigraphError for an unknown suffix, for frames of different sizes, or if the disk refuses.
    """
    kind = kind_of(path, fps)
    with (
        replacing(path, what) as partial,
        av.open(str(partial), "w", format=kind.format, options=kind.options) as container,
        contextlib.ExitStack() as stack,
    ):
        begun = kind(path, container, Fraction(fps).limit_denominator(1001), stack)
        yield begun
        begun.finish()


def kind_of(path: Path, fps: float) -> type[Video]:
    """Video class of a file ending. Raises LumigraphError for an unknown one, or a frame rate that it cannot have."""
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        raise LumigraphError(f"{path} should end in {', '.join(KINDS)}, the kinds of film there are; rename it")
    if kind is Gif and fps > MAX_GIF_FPS:
        raise LumigraphError(
            f"{path} cannot show {fps:g} frames per second, a GIF's most is {MAX_GIF_FPS}; lower --fps or take .webp"
        )
    return kind


class Video(ABC):
    """Encoder of frames of one size into a container."""

    format: ClassVar[str]
    options: ClassVar[dict[str, str]] = {}

    def __init__(self, path: Path, container: OutputContainer, fps: Fraction, stack: contextlib.ExitStack):
        self.path, self.container, self.fps, self.stack = path, container, fps, stack
        self.size: tuple[int, int] | None = None  # width, height
        self.codec: VideoStream

    def add(self, frame: UInt8[Tensor, "height width 3"]) -> None:
        """A frame in sRGB bytes."""
        pixels = self.padded(frame.cpu().numpy())
        size = (pixels.shape[1], pixels.shape[0])
        if self.size is None:
            self.size = size
            self.begin()
        elif size != self.size:
            raise LumigraphError(f"{self.path} cannot hold frames of several sizes; render them at one --size")
        self.encode(np.ascontiguousarray(pixels))

    def finish(self) -> None:
        """Finish the film. Raises LumigraphError without a frame."""
        if self.size is None:
            raise LumigraphError(f"{self.path} would hold no frame; give it at least one")
        self.flush()

    def stream(self, codec: str, pixel_format: str, options: dict[str, str]) -> VideoStream:
        stream = self.container.add_stream(codec, rate=self.fps)
        assert isinstance(stream, VideoStream) and self.size is not None
        (stream.width, stream.height), stream.pix_fmt, stream.options = self.size, pixel_format, dict(options)
        return stream

    def padded(self, pixels: np.ndarray) -> np.ndarray:
        """The frame padded to the format's size."""
        return pixels

    @abstractmethod
    def begin(self) -> None:
        """Make the stream `codec`. Called once, when the size is known."""

    @abstractmethod
    def encode(self, pixels: UInt8[np.ndarray, "height width 3"]) -> None: ...

    def flush(self) -> None:
        """Write the packets that the codec holds back."""
        self.container.mux(self.codec.encode(None))


class Mp4(Video):
    format = "mp4"
    options: ClassVar[dict[str, str]] = {"movflags": "+faststart"}  # a browser can begin before it has all

    def padded(self, pixels: np.ndarray) -> np.ndarray:
        """An odd last row or column is repeated, because the encoders halve the colours' size."""
        height, width = pixels.shape[:2]
        return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")

    def begin(self) -> None:
        name = next(filter(has_encoder, ENCODERS), "mpeg4")
        coding, options = ENCODERS[name]
        if name != "libx264":
            warnings.warn(
                f"PyAV has no H.264 here, so {self.path} holds {coding}, which fewer players show; for H.264 install "
                "PyAV's own wheel",
                LumigraphWarning,
                stacklevel=2,
            )
        self.codec = self.stream(name, "yuv420p", options)
        context = self.codec.codec_context
        context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
        context.color_primaries, context.color_trc = 1, 1  # BT.709, both

    def encode(self, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
        picture = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        yuv = picture.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG)
        self.container.mux(self.codec.encode(yuv))


class WebP(Video):
    """Animated WebP, lossy, looping."""

    format = "webp"
    options: ClassVar[dict[str, str]] = {"loop": "0"}

    def begin(self) -> None:
        self.codec = self.stream("libwebp_anim", "bgra", {"quality": str(WEBP_QUALITY), "lossless": "0"})

    def encode(self, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
        picture = av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(format="bgra")
        self.container.mux(self.codec.encode(picture))


class Gif(Video):
    """Animated GIF, looping: one palette for all frames, so frames wait in a file until it is known.

    Ordered dithering: a pixel that does not change is dithered equally in every frame, so nothing flickers.
    """

    format = "gif"
    options: ClassVar[dict[str, str]] = {"loop": "0"}

    def begin(self) -> None:
        self.count = 0
        self.waiting = self.stack.enter_context(tempfile.TemporaryFile(dir=self.path.parent))

    def encode(self, pixels: UInt8[np.ndarray, "height width 3"]) -> None:
        self.waiting.write(pixels.tobytes())
        self.count += 1

    def flush(self) -> None:
        assert self.size is not None
        width, height = self.size
        self.waiting.flush()
        frames = np.memmap(self.waiting, np.uint8, "r", shape=(self.count, height, width, 3))
        with counting("Choosing colours"):
            colours = choose_colours(frames)
        table = np.zeros((256, 4), np.uint8)  # alpha, red, green, blue
        table[: len(colours), 0], table[: len(colours), 1:] = 255, colours
        self.codec = self.stream("gif", "pal8", {})
        self.codec.codec_context.time_base = Fraction(1, 100)
        for i, frame in enumerate(track(frames, f"Encoding {self.path.name}", self.count)):
            indexed: Any = (dithered(frame, colours), table)
            picture = av.VideoFrame.from_ndarray(indexed, format="pal8")
            picture.pts, picture.time_base = round(100 * i / self.fps), Fraction(1, 100)
            self.container.mux(self.codec.encode(picture))
        super().flush()


def has_encoder(name: str) -> bool:
    try:
        av.Codec(name, "w")
    except ValueError:  # PyAV's UnknownCodecError is one
        return False
    return True


KINDS: dict[str, type[Video]] = {".mp4": Mp4, ".gif": Gif, ".webp": WebP}


def choose_colours(frames: UInt8[np.ndarray, "frame height width 3"]) -> UInt8[np.ndarray, "colour 3"]:
    """At most 255 colours for all frames, from evenly spread pixels: median cut (Heckbert 1982), then k-means."""
    pixels = frames.reshape(-1, 3)
    some = np.array(pixels[:: max(1, len(pixels) // PALETTE_SAMPLES)])
    chosen = Image.fromarray(some[None]).quantize(GIF_COLOURS, Image.Quantize.MEDIANCUT, kmeans=4)
    palette = np.array(chosen.getpalette(), np.uint8).reshape(-1, 3)
    return palette[np.unique(np.asarray(chosen))]


def dithered(
    frame: UInt8[np.ndarray, "height width 3"], colours: UInt8[np.ndarray, "colour 3"]
) -> UInt8[np.ndarray, "height width"]:
    """Each pixel as one of the colours, after a threshold pattern as strong as colours lie apart."""
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([colours, np.repeat(colours[-1:], 256 - len(colours), 0)]).tobytes())
    height, width = frame.shape[:2]
    pattern = np.tile(BAYER, (-(-height // 8), -(-width // 8)))[:height, :width, None]
    shifted = (frame + spacing(colours) * pattern + 0.5).clip(0, 255).astype(np.uint8)
    index = np.asarray(Image.fromarray(shifted).quantize(palette=palette, dither=Image.Dither.NONE))
    return np.minimum(index, len(colours) - 1)


def spacing(colours: UInt8[np.ndarray, "colour 3"]) -> float:
    """Median distance between neighbouring colours of a palette, along one channel."""
    if len(colours) < 2:
        return 0.0
    apart = np.abs(colours[:, None].astype(np.int32) - colours[None]).max(-1) + 1000 * np.eye(len(colours), dtype=int)
    return float(np.median(apart.min(-1)))


def bayer(bits: int) -> Float[np.ndarray, "side side"]:
    """Bayer's threshold matrix of side 2^bits (1973), within (-1/2, 1/2)."""
    ranks: Int[np.ndarray, "side side"] = np.zeros((1, 1), int)
    for _ in range(bits):
        ranks = np.block([[4 * ranks, 4 * ranks + 2], [4 * ranks + 3, 4 * ranks + 1]])
    return (ranks + 0.5) / ranks.size - 0.5


BAYER = bayer(3)
