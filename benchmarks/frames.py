"""Frames of the viewer while its camera turns: their rate, their size, their likeness to exact pictures.

    python benchmarks/frames.py RUN_OR_FILE [--size 800x800] [--turn 45] [--seconds 6] [--output frames]

Opens the viewer and connects a client without a browser, which has a cloud drawn exactly, moves its camera around the
scene 60 times a second, by so many degrees a second, and then rests. Printed:
frames per second that reached the client, milliseconds of their parts, seconds of the first sharp picture after the
camera came to rest, and PSNR of moving pictures, enlarged as the browser does, against exact ones. Written: a strip of
consecutive moving pictures above exact ones, and the figures.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from PIL import Image
from torch.nn.functional import interpolate
from tyro.conf import Positional
from websockets.exceptions import ConnectionClosed

from lumigraph import kernels
from lumigraph.commands.view import subject_of
from lumigraph.figures import to_bytes
from lumigraph.files import write_json
from lumigraph.large import open_any
from lumigraph.viewer import Viewer, choose_address
from lumigraph.viewer.cameras import ViewRequest
from lumigraph.viewer.visitor import Visitor

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from viewer_client import Client
from waiting import until

MOVES_PER_SECOND = 60  # as a browser sends them
WARM_UP_SECONDS = 3.0  # of turning before the measurement: kernels are compiled, and the pace is found
PATIENCE = 600.0  # seconds until the first picture, and until a sharp one
MIN_PICTURE_BYTES = 800  # of a message; others are shorter while the camera turns
STRIP, STRIP_HEIGHT = 6, 240  # pictures, pixels


@dataclass(frozen=True)
class Options:
    source: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN_OR_FILE")]
    size: str = "800x800"
    turn: float = 45.0
    seconds: float = 6.0
    compared: int = 8
    output: Path = Path("frames")


@dataclass(frozen=True)
class Frame:
    """A picture that was drawn: when it was done, for which view, the size it was rendered at, seconds of its parts."""

    done: float
    request: ViewRequest
    size: tuple[int, int]
    pixels: np.ndarray
    parts: dict[str, float]


def main(options: Options) -> None:
    options.output.mkdir(parents=True, exist_ok=True)
    width, height = map(int, options.size.split("x"))
    opened = open_any(options.source)
    method, subject = opened.method(), subject_of(opened)
    target, start = np.array(subject.opening.target), np.array(subject.opening.position)
    before = os.getloadavg()[0]
    with Viewer(method, subject, choose_address(port=0)) as viewer, drawn_frames() as frames:
        client = Client(viewer.address.url, tuple(start), (width, height), target, math.radians(subject.opening.angle))
        visitor: Any = until(lambda: next(iter(viewer._everyone()), None), PATIENCE)
        for handle, value in ((visitor.controls._exact, True), (visitor.controls._cameras, False)):
            client.turn(handle, value)
        client.turn(visitor.controls._sharpest, max(width, height))
        until(lambda: visitor.request().exact and not visitor.request().depth, PATIENCE)
        turning = math.radians(options.turn)

        def turn(seconds: float, angle: float) -> tuple[float, float, float]:
            begin = time.perf_counter()
            while (passed := time.perf_counter() - begin) < seconds:
                client.look_from(around(start, target, angle + turning * passed))
                time.sleep(1 / MOVES_PER_SECOND)
            return angle + turning * passed, begin, time.perf_counter()

        arrived: list[float] = []
        threading.Thread(target=listen, args=(client, arrived), daemon=True).start()
        until(lambda: frames, PATIENCE)
        angle, _, _ = turn(WARM_UP_SECONDS, 0.0)
        angle, begin, end = turn(options.seconds, angle)
        until(visitor.painter.settled.is_set, PATIENCE)
        client.close()
    moving = [frame for frame in frames if begin <= frame.done <= end]
    sharp = next(frame for frame in frames if frame.done > end and frame.size == (width, height))
    found = {
        "source": options.source.name,
        "window": options.size,
        "frames_per_second": round(sum(begin <= when <= end for when in arrived) / (end - begin), 1),
        "moving_size": "x".join(map(str, np.median([frame.size for frame in moving], 0).astype(int))),
        "first_sharp_seconds": round(sharp.done - end, 2),
        "sharp_ms": {name: round(1000 * seconds, 1) for name, seconds in sharp.parts.items()},
        "moving_ms": {
            name: round(1000 * float(np.median([frame.parts.get(name, 0.0) for frame in moving])), 1)
            for name in moving[-1].parts
        },
    }
    chosen = [moving[int(i)] for i in np.linspace(len(moving) // 3, len(moving) - 1, options.compared)]
    likeness = [psnr(enlarged(frame, (height, width)), exact(method, frame.request)) for frame in chosen]
    found |= {"psnr": round(float(np.mean(likeness)), 2), "psnr_least": round(min(likeness), 2)}
    found |= {"threads": torch.get_num_threads(), "load_before": round(before, 1), "load": round(os.getloadavg()[0], 1)}
    strip(method, moving[len(moving) // 2 :][:STRIP], (height, width), options.output / "strip.png")
    write_json(options.output / "frames.json", found, "benchmark")
    for name, value in found.items():
        print(f"{name:20} {value}")


@contextmanager
def drawn_frames() -> Iterator[list[Frame]]:
    """A list to which all pictures of visitors of the block are added, with the seconds of their parts."""
    frames: list[Frame] = []
    stream, render = Visitor._stream, Visitor._render
    parts: dict[str, float] = {}
    views: list[tuple[ViewRequest, tuple[int, int]]] = []

    def timed(name: str, call: Callable[[], Any], inputs: tuple = ()) -> Any:
        begin = time.perf_counter()
        result = call()
        parts[name] = parts.get(name, 0.0) + time.perf_counter() - begin
        return result

    def rendered(self: Any, request: ViewRequest, size: tuple[int, int], *rest: Any) -> Any:
        parts.clear()
        views.append((request, size))
        return timed("rendering", lambda: render(self, request, size, *rest))

    def streamed(self: Any, pixels: np.ndarray, *rest: Any) -> None:
        timed("encoding", lambda: stream(self, pixels, *rest))
        if views:
            frames.append(Frame(time.perf_counter(), *views[-1], pixels, dict(parts)))

    Visitor._stream, Visitor._render = streamed, rendered  # type: ignore[method-assign]
    try:
        with kernels.watching(timed):
            yield frames
    finally:
        Visitor._stream, Visitor._render = stream, render  # type: ignore[method-assign]


def listen(client: Client, arrived: list[float]) -> None:
    """Note when pictures arrive."""
    with suppress(ConnectionClosed):
        while True:
            if len(client.socket.recv()) > MIN_PICTURE_BYTES:
                arrived.append(time.perf_counter())


def around(start: np.ndarray, target: np.ndarray, angle: float) -> np.ndarray:
    """A position turned about the vertical axis through the target."""
    x, y, z = start - target
    cosine, sine = math.cos(angle), math.sin(angle)
    return target + np.array([cosine * x - sine * y, sine * x + cosine * y, z])


def exact(method: Any, request: ViewRequest) -> torch.Tensor:
    return method.render(request.camera(request.full)).rgb.clamp(0, 1).cpu()


def enlarged(frame: Frame, size: tuple[int, int]) -> torch.Tensor:
    """A picture at the window's size, interpolated as a texture is."""
    pixels = torch.from_numpy(frame.pixels).permute(2, 0, 1)[None] / 255
    return interpolate(pixels, size, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10(max(float((a - b).square().mean()), 1e-10))


def strip(method: Any, frames: list[Frame], size: tuple[int, int], path: Path) -> None:
    """Consecutive moving pictures above exact ones."""
    columns = [torch.cat([enlarged(frame, size), exact(method, frame.request)]) for frame in frames]
    picture = Image.fromarray(to_bytes(torch.cat(columns, 1)).numpy())
    scale = 2 * STRIP_HEIGHT / picture.height
    picture.resize((round(picture.width * scale), 2 * STRIP_HEIGHT), Image.Resampling.LANCZOS).save(path)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
