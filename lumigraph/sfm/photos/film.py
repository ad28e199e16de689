"""Films as they say that they are to be shown: upright, with square pixels, whole frames, in sRGB."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.filter import Graph
from av.sidedata.sidedata import Type
from av.video.frame import VideoFrame
from av.video.reformatter import Colorspace
from av.video.stream import VideoStream
from jaxtyping import Float
from PIL import Image

from ...color.display import BT709, BT2020, HLG, HLG_PEAK, PQ, UNKNOWN, WHITE, is_known, is_srgb, light_of, srgb_of
from ...errors import LumigraphError

VIDEOS = {
    ".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp", ".wmv", ".ogv", ".flv",
    ".ts", ".mxf", ".vob", ".m2v",
}  # fmt: skip
MATRICES = {
    1: Colorspace.ITU709,
    4: Colorspace.FCC,
    5: Colorspace.ITU601,
    6: Colorspace.ITU601,
    7: Colorspace.SMPTE240M,
    9: Colorspace.BT2020,
    10: Colorspace.BT2020,
}  # by their numbers in H.273; fmt: skip
RGB = 0  # a matrix: the channels are red, green and blue
SMALL_HEIGHT = 576  # pixels; an untagged film that is no higher has the matrix of BT.601, others that of BT.709
LOOKED_AT = 8  # frames that show whether a film is interlaced
PEAK_FRAMES, PEAK_SIDE, PEAK_SHARE = 24, 192, 99.9  # frames, pixels and per cent, for a film's brightest light
FIELDS = {  # names of H.273's numbers, for the record of a capture
    "primaries": {1: "BT.709", 5: "BT.601 (625)", 6: "BT.601 (525)", 9: "BT.2020", 11: "DCI-P3", 12: "Display P3"},
    "transfer": {1: "BT.709", 6: "BT.601", 8: "linear", 13: "sRGB", 14: "BT.2020", 15: "BT.2020", 16: "PQ", 18: "HLG"},
    "matrix": {0: "RGB", 1: "BT.709", 5: "BT.601", 6: "BT.601", 9: "BT.2020", 10: "BT.2020"},
}


@dataclass(frozen=True)
class Tags:
    """Description of the pictures in a film. Numbers are those of ITU-T H.273, and 2 where it says nothing.

    aspect:     width of a pixel by its height
    interlaced: whether a frame is two fields of two moments
    turn:       (a, b, c, d) of the display matrix as signs: x = a x + c y, y = b x + d y, on a screen with y down
    white:      diffuse white of HLG and PQ, cd/m2;  peak: brightest light, cd/m2
    fault:      what it says of its colours and cannot be followed, with the way out
    """

    primaries: int = UNKNOWN
    transfer: int = UNKNOWN
    matrix: int = UNKNOWN
    full_range: bool = False
    aspect: tuple[int, int] = (1, 1)
    interlaced: bool = False
    turn: tuple[int, int, int, int] = (1, 0, 0, 1)
    white: float = 0.0
    peak: float = 0.0
    fault: str = ""

    def __str__(self) -> str:
        said = [f"{FIELDS[k].get(v, v)} {k}" for k in FIELDS if (v := getattr(self, k)) != UNKNOWN]
        said += ["full range"] if self.full_range else []
        said += [f"pixels of {self.aspect[0]}:{self.aspect[1]}"] if self.aspect != (1, 1) else []
        said += ["interlaced"] if self.interlaced else []
        mirrored = self.turn[0] * self.turn[3] - self.turn[1] * self.turn[2] < 0
        said += [] if self.turn == Tags.turn else ["mirrored" if mirrored else "turned"]
        return (
            ", ".join(
                said + ([f"white at {self.white:.0f} and light up to {self.peak:.0f} cd/m2"] if self.peak else [])
            )
            or "no tags"
        )


@dataclass(frozen=True)
class OpenedFilm:
    """An opened film: its first track that is no cover picture."""

    path: Path
    container: InputContainer
    stream: VideoStream
    tags: Tags

    @property
    def rate(self) -> float:
        """Frames per second, on average."""
        return float(self.stream.average_rate or self.stream.guessed_rate or 30)

    @property
    def seconds(self) -> float:
        """Length as the file says; 0 where it does not."""
        if self.stream.duration is not None and self.stream.time_base is not None:
            return float(self.stream.duration * self.stream.time_base)
        return (self.container.duration or 0) / av.time_base

    def frames(self) -> Iterator[tuple[VideoFrame, float]]:
        """Whole frames in order, and when each is shown, in seconds. What comes after damage is left out. Raises
        LumigraphError where no frame can be decoded."""
        count = 0
        try:
            for frame in deinterlaced(self._decoded()) if self.tags.interlaced else self._decoded():
                yield frame, count / self.rate if frame.time is None else float(frame.time)
                count += 1
        except av.FFmpegError as fault:
            if count == 0:
                raise LumigraphError(
                    f"{self.path} cannot be decoded ({reason(fault)}); take it from its source again, or convert it "
                    "to MP4"
                ) from fault

    def _decoded(self) -> Iterator[VideoFrame]:
        yield from self.container.decode(self.stream)

    def picture(self, frame: VideoFrame) -> Image.Image:
        """A frame as it is to be seen."""
        tags = self.tags
        width = max(round(frame.width * tags.aspect[0] / tags.aspect[1]), 1)
        plain = is_srgb(tags.primaries, tags.transfer)
        pixels = rgb(frame, tags, width, frame.height, "rgb24" if plain else "rgb48le")
        if not plain:
            encoded = srgb_of(pixels, tags.primaries, tags.transfer, tags.white, tags.peak)
            pixels = np.rint(255 * encoded).astype(np.uint8)
        a, b, c, d = tags.turn
        across, down = (a, d) if a else (c, b)
        pixels = pixels if a else pixels.swapaxes(0, 1)
        return Image.fromarray(np.ascontiguousarray(pixels[::down, ::across]))


def is_video(path: Path) -> bool:
    """True if a file is a video, by its suffix."""
    return path.suffix.lower() in VIDEOS and path.is_file()


def is_film(path: Path) -> bool:
    """True if a file is a video, by its content; a picture of any kind is none."""
    with contextlib.suppress(LumigraphError), container_of(path) as container:
        track_of(path, container)
        return not container.format.name.endswith(("_pipe", "image2"))
    return False


@contextlib.contextmanager
def opened(path: Path, tags: Tags | None = None) -> Iterator[OpenedFilm]:
    """A film with pictures. Raises LumigraphError where there are none. tags: to be seen by; None: by its own"""
    tags = tags or tags_of(path)
    with container_of(path) as container:
        yield OpenedFilm(path, container, track_of(path, container), tags)


@contextlib.contextmanager
def container_of(path: Path) -> Iterator[InputContainer]:
    try:
        container = av.open(str(path))
    except (av.FFmpegError, ValueError) as fault:
        raise LumigraphError(
            f"{path} cannot be read as a video ({reason(fault)}); take it from its source again, or convert it to MP4"
        ) from fault
    with container:
        yield container


def track_of(path: Path, container: InputContainer) -> VideoStream:
    """The first track of pictures that is no cover."""
    covers = av.stream.Disposition.attached_pic
    tracks = [stream for stream in container.streams.video if not stream.disposition & covers]
    if not tracks:
        raise LumigraphError(f"{path} holds no pictures, only other tracks such as sound; name another video")
    tracks[0].thread_type = "AUTO"
    return tracks[0]


def tags_of(path: Path) -> Tags:
    """Description of the pictures in a film, by its tracks and its first frames."""
    stat = path.stat()
    return _tags_of(path, stat.st_mtime_ns, stat.st_size)


@lru_cache(64)
def _tags_of(path: Path, modified: int, size: int) -> Tags:
    with container_of(path) as container:
        stream, first = track_of(path, container), []
        with contextlib.suppress(av.FFmpegError):
            for frame in container.decode(stream):
                first.append(frame)
                if len(first) == LOOKED_AT:
                    break
        if not first:
            return Tags()
        frame, aspect = first[0], stream.sample_aspect_ratio or Fraction(1)
        tags = Tags(
            int(frame.color_primaries),
            int(frame.color_trc),
            int(frame.colorspace),
            int(frame.color_range) == 2 or frame.format.name.startswith("yuvj"),
            (aspect.numerator, aspect.denominator) if aspect > 0 else (1, 1),
            any(frame.interlaced_frame for frame in first),
            turn_of(frame),
        )
        tags = replace(tags, fault=not_followed(tags, stream))
        return measured(container, stream, tags) if tags.transfer in (PQ, HLG) else tags


def not_followed(tags: Tags, stream: VideoStream) -> str:
    """Colours of a film that cannot be followed, as the end of a sentence; empty where there are none."""
    if stream.codec_context.codec_tag in ("dvh1", "dvhe") and tags.transfer == UNKNOWN:
        return (
            "the film is Dolby Vision without a base that other programs show (profile 5), so its colours will be "
            "wrong; export it as HDR10, HLG or SDR"
        )
    if is_known(tags.primaries, tags.transfer):
        return ""
    primaries, transfer = (FIELDS[k].get(getattr(tags, k), getattr(tags, k)) for k in ("primaries", "transfer"))
    return (
        f"the film has colours of primaries {primaries} and transfer {transfer}, which are not converted, so they may "
        "look wrong; convert it to BT.709"
    )


def turn_of(frame: VideoFrame) -> tuple[int, int, int, int]:
    """`Tags.turn` of a frame's display matrix, at the nearest quarter of a turn."""
    found: Any = frame.side_data.get(Type.DISPLAYMATRIX)  # type: ignore[call-overload]  # its stub says text
    if found is None:
        return Tags.turn
    a, b, _, c, d = (int(x) for x in np.frombuffer(bytes(found), np.int32)[:5])
    sign = [int(np.sign(x)) for x in ((a, 0, 0, d) if abs(a) >= abs(b) else (0, b, c, 0))]
    return (sign[0], sign[1], sign[2], sign[3]) if any(sign) else Tags.turn


def matrix_of(tags: Tags, frame: VideoFrame) -> Colorspace | None:
    """The matrix of luma and chroma."""
    if tags.matrix in MATRICES:
        return MATRICES[tags.matrix]
    if tags.matrix == RGB or frame.format.is_rgb:
        return None
    if tags.primaries == BT2020:
        return Colorspace.BT2020
    small = frame.height <= SMALL_HEIGHT and tags.primaries != BT709
    return Colorspace.ITU601 if small else Colorspace.ITU709


def rgb(frame: VideoFrame, tags: Tags, width: int, height: int, form: str) -> np.ndarray:
    """Red, green and blue of a frame in another size, as the film encodes them. form: FFmpeg's name of the format"""
    same = (width, height) == (frame.width, frame.height)
    way = None if same else "AREA" if width < frame.width else "LANCZOS"
    return frame.reformat(width, height, form, matrix_of(tags, frame), interpolation=way).to_ndarray()


def measured(container: InputContainer, stream: VideoStream, tags: Tags) -> Tags:
    """Tags with the white and the peak of HLG or PQ, by frames all over the film.

    Films of SDR are put into HLG in two ways, with white at 203 cd/m2 (BT.2408) or at HLG's own peak. Where more than
    half of what is seen were brighter than white, it is the second.
    """
    length, seen = stream.duration or 0, []
    for i in range(PEAK_FRAMES):
        with contextlib.suppress(av.FFmpegError, StopIteration):
            container.seek((stream.start_time or 0) + length * i // PEAK_FRAMES, stream=stream)
            frame = next(container.decode(stream))
            small = small_size(frame, PEAK_SIDE)
            seen.append(light_of(rgb(frame, tags, *small, "rgb48le"), tags.transfer).max(-1).ravel())
    light = np.concatenate(seen) if seen else np.zeros(1)
    unscaled = tags.transfer == HLG and float(np.median(light)) > WHITE
    return replace(tags, white=HLG_PEAK if unscaled else WHITE, peak=float(np.percentile(light, PEAK_SHARE)))


def small_size(frame: VideoFrame, longest: int) -> tuple[int, int]:
    """Width and height of a frame whose longer side is at most so many pixels."""
    times = max(frame.width / longest, frame.height / longest, 1.0)
    return max(round(frame.width / times), 1), max(round(frame.height / times), 1)


def deinterlaced(frames: Iterator[VideoFrame]) -> Iterator[VideoFrame]:
    """A whole frame for each frame of two fields (the filter bwdif); others as they are."""
    graph, count = Graph(), 0
    for frame in frames:
        if count == 0:
            source = graph.add_buffer(
                width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base
            )
            graph.link_nodes(source, graph.add("bwdif", "mode=send_frame:deint=interlaced"), graph.add("buffersink"))
            graph.configure()
        count += 1
        graph.vpush(frame)
        yield from waiting(graph)
    if count:
        graph.vpush(None)
        yield from waiting(graph)


def waiting(graph: Graph) -> Iterator[VideoFrame]:
    """Frames that have come through a graph."""
    with contextlib.suppress(av.error.BlockingIOError, av.error.EOFError):
        while True:
            yield graph.vpull()


def grey(frame: VideoFrame, longest: int) -> Float[np.ndarray, "height width"]:
    """Luminance from 0 to 255, reduced so that the longer side is at most `longest` pixels. Not turned upright."""
    reduced = frame.reformat(*small_size(frame, longest), format="gray", interpolation="AREA")
    return reduced.to_ndarray().astype(np.float32)


def reason(fault: Exception) -> str:
    return (getattr(fault, "strerror", None) or str(fault)).lower()
