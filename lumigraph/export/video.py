"""Films: H.264 in MP4, which plays everywhere."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from jaxtyping import UInt8
from torch import Tensor

from ..errors import LumigraphError
from ..files import replacing


@contextlib.contextmanager
def open_video(path: Path, fps: float = 30.0, quality: int = 17) -> Iterator[Video]:
    """A film to add frames to, in order; the file appears once the block ends well.

    fps:     frames per second
    quality: x264's constant rate factor: 0 is lossless, 18 looks it, 28 is small
    Raises LumigraphError where frames differ in size or the disk refuses.
    """
    with replacing(path) as partial:
        # The index goes first, so that a browser can begin before it has all.
        with av.open(str(partial), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            begun = Video(path, container, Fraction(fps).limit_denominator(1001), quality)
            yield begun
            begun.finish()


class Video:
    def __init__(self, path: Path, container: OutputContainer, fps: Fraction, quality: int):
        self.path, self.container, self.fps, self.quality = path, container, fps, quality
        self.stream: VideoStream | None = None

    def add(self, frame: UInt8[Tensor, "height width 3"]) -> None:
        """A frame in sRGB bytes; an odd last row or column is repeated, because H.264 halves the colours' size."""
        pixels = frame.cpu().numpy()
        height, width = pixels.shape[:2]
        pixels = np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        height, width = pixels.shape[:2]
        self.stream = self.stream or self._begin(width, height)
        if (width, height) != (self.stream.width, self.stream.height):
            raise LumigraphError(f"{self.path} cannot hold frames of several sizes; render them at one --size")
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
        yuv = picture.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG)
        self.container.mux(self.stream.encode(yuv))

    def finish(self) -> None:
        if self.stream is None:
            raise LumigraphError(f"{self.path} would hold no frame; give it at least one")
        self.container.mux(self.stream.encode(None))

    def _begin(self, width: int, height: int) -> VideoStream:
        stream = self.container.add_stream("libx264", rate=self.fps)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": str(self.quality), "preset": "slow"}
        context = stream.codec_context
        context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
        context.color_primaries, context.color_trc = 1, 1  # BT.709, both
        return stream
