"""A flight through a trained scene: colour and depth, as films and as pictures."""

import contextlib
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from ..camera import Camera
from ..camera.rays import Rendering
from ..color.tags import save_srgb
from ..components.training.development import decoded
from ..errors import LumigraphError
from ..figures import Range, colour_depth, depth_range, to_bytes
from ..files import claim, claim_folder, replacing_folder, write_json
from ..geometry import evenly
from ..method import Method
from ..method.capabilities import HasGaussians, can
from ..method.controls import Value
from ..paths import film_cameras, fitting
from ..paths.keyframes import CameraPath
from ..run.opened import stations_of
from ..system.memory import ask_for_picture
from ..system.progress import track
from ..system.work import at_work
from .loaded import Loaded
from .options import AUTO, MAX_FILM_SIZE, MAX_RAYS_SIZE, PATH_KINDS, FilmOptions
from .video import kind_of, open_video

DEFAULT_FPS = 30.0  # frames per second
PROBES, PROBE_SIZE = 6, 64  # frames, and their pixels, for the range of depth


def render_film(
    loaded: Loaded,
    file: Path | None = None,
    options: FilmOptions = FilmOptions(),
    animations: Iterable[str] = (),
    overwrite: bool | None = None,
) -> tuple[Path, str, dict[str, Any]]:
    """Render a film of what is loaded. Returns its file, the name of its path, and the contents of its JSON file.

    file: None for one that is called after the path, in the opened run's folder of films
    animations: controls that change over the film, NAME=A:B
    """
    flight = read_path(options)
    fps = options.fps or (flight.fps if flight else DEFAULT_FPS)
    train, opened = loaded.cameras["train"], loaded.opened
    path = fitting(train, loaded.frame) if options.path == AUTO else options.path
    file = file or opened.renders / f"{Path(path).stem}.mp4"
    kind_of(file, fps)
    claim_film(file, options, overwrite, [opened.path, *([Path(path)] if flight else [])])
    most = MAX_FILM_SIZE if can(loaded.method, HasGaussians) else MAX_RAYS_SIZE
    size = options.size or min(most, int(train.size.max()))
    cameras = film_cameras(loaded.cameras, loaded.frame, flight or path, options.frames, size)
    stations = stations_of(opened, loaded.method, animations)
    shown = animated(loaded.method, stations, len(cameras)) if stations else loaded.method
    return file, path, film(shown, cameras, file, replace(options, fps=fps))


def read_path(options: FilmOptions) -> CameraPath | None:
    """The camera path of a file; None for a path by name. Raises LumigraphError for neither."""
    if options.path in (AUTO, *PATH_KINDS):
        return None
    file = Path(options.path)
    if not file.exists() and not file.suffix:
        raise LumigraphError(
            f"There is no path called {options.path!r}; choose {', '.join(PATH_KINDS)}, or a JSON file"
        )
    flight = CameraPath.load(file)
    return replace(flight, fps=options.fps or flight.fps)


@at_work()
def film(
    method: Method | Sequence[Method], cameras: Camera, path: Path, options: FilmOptions = FilmOptions()
) -> dict[str, Any]:
    """Render every camera of one size. Returns the contents of the JSON file.

    method: one for all frames, or one for each, such as what `animated` makes
    options: of which frames per second, depth (path/orbit-depth.mp4) and pictures (path/orbit/0000.png and, with depth,
            0000-depth.png; exr adds 0000.exr, their linear light) are used
    Beside path/orbit.mp4 writes path/orbit.json with the cameras (poses in the scene's frame; source_from_scene leads
    back to the capture's) and the controls of the method. Raises LumigraphError, before anything is rendered, if
    something else lies there.
    """
    depth, pictures, fps = options.depth, options.pictures, options.fps or DEFAULT_FPS
    claim_film(path, options)
    shown = [method] * len(cameras) if isinstance(method, Method) else list(method)
    assert len(shown) == len(cameras), f"{len(shown)} methods for {len(cameras)} frames"
    for one in shown:
        one.eval()
    width, height = cameras.size[0].tolist()
    ask_for_picture(width, height, shown[0].device)
    within = film_depth_range(shown, cameras) if depth else None
    with contextlib.ExitStack() as stack:
        targets = [stack.enter_context(open_video(path, fps, "film"))]
        if depth:
            targets.append(stack.enter_context(open_video(depth_beside(path), fps, "film of depth")))
        if pictures:
            folder = stack.enter_context(replacing_folder(path.with_suffix(""), "pictures of a film"))
        begin = time.perf_counter()
        for i in track(range(len(cameras)), f"Filming {path.name}", len(cameras)):
            seen = shown[i].render(cameras[i]).cpu()
            frames = [to_bytes(seen.rgb)]
            if within:
                frames.append(to_bytes(colour_depth(seen.depth, seen.opacity, within)))
            for target, ending, frame in zip(targets, ("", "-depth"), frames, strict=False):
                target.add(frame)
                if pictures:
                    save_srgb(Image.fromarray(frame.numpy()), folder / f"{i:04d}{ending}.png")
            if pictures == "exr":
                (folder / f"{i:04d}.exr").write_bytes(exr(light_of(seen)))
        seconds = (time.perf_counter() - begin) / len(cameras)
    about = {
        "frames": len(cameras),
        "fps": fps,
        "size": cameras.size[0].tolist(),
        "seconds_per_frame": seconds,
        **({"depth_range": list(within)} if within else {}),
        "source_from_scene": shown[0].frame.source_from_scene,
        "lens": cameras.lens.to_json(),
        "poses": cameras.pose.tolist(),
        **({} if cameras.time is None else {"times": cameras.time.tolist()}),
    }
    controls = {name: [one.control(name) for one in shown] for name in shown[0].settings}
    if controls:  # one value for all frames, or one for each where they differ
        about["controls"] = {name: x[0] if len(set(x)) == 1 else x for name, x in controls.items()}
    write_json(path.with_suffix(".json"), about, "cameras of a film")
    return about


def claim_film(
    path: Path, options: FilmOptions = FilmOptions(), overwrite: bool | None = None, reads: Collection[Path] = ()
) -> None:
    """Raise LumigraphError unless a film and its accompanying files may be written; see `files.claim`."""
    claim(path, "film", overwrite, reads)
    claim(path.with_suffix(".json"), "cameras of a film", overwrite, reads)
    if options.depth:
        claim(depth_beside(path), "film of depth", overwrite, reads)
    if options.pictures:
        claim_folder(path.with_suffix(""), "pictures of a film")


def depth_beside(path: Path) -> Path:
    """Path of the depth film."""
    return path.with_stem(f"{path.stem}-depth")


def animated(method: Method, stations: Mapping[str, Sequence[Value]], frames: int) -> list[Method]:
    """The method for each frame of a film, with controls interpolated between stations (`Control.over`).

    Raises LumigraphError for unknown controls and invalid values.
    """
    method.given(**{name: values[0] for name, values in stations.items()})
    controls = {control.name: control for control in method.controls}
    values = {name: controls[name].over(given, frames) for name, given in stations.items()}
    return [method.given(**{name: value[i] for name, value in values.items()}) for i in range(frames)]


def film_depth_range(methods: Sequence[Method], cameras: Camera) -> Range:
    """One depth range for all frames, from a few small ones, so that colours do not flicker."""
    probes = evenly(range(len(cameras)), PROBES)
    chosen = cameras[torch.tensor(probes)]
    small = chosen.resized(min(1.0, PROBE_SIZE / int(chosen.size.max())))
    frames = track(enumerate(probes), "Measuring depths", len(probes))
    seen = [methods[frame].render(small[i]).cpu() for i, frame in frames]
    return depth_range(torch.cat([x.depth.flatten() for x in seen]), torch.cat([x.opacity.flatten() for x in seen]))


PIXEL_FORMAT = "gbrpf32le"  # planes of 32-bit floats


def light_of(seen: Rendering) -> Float[Tensor, "height width 3"]:
    """Linear light of a rendering, 1 for white: its `radiance` if it has one, else its decoded colours."""
    return seen.extra["radiance"] if "radiance" in seen.extra else decoded(seen.rgb.clamp(0, 1))


def exr(light: Float[Tensor, "height width 3"]) -> bytes:
    """Bytes of an OpenEXR file of linear sRGB as 32-bit floats, losslessly compressed, by FFmpeg."""
    pixels = np.ascontiguousarray(light.detach().cpu().numpy(), np.float32)
    codec = av.CodecContext.create("exr", "w")
    assert isinstance(codec, av.VideoCodecContext)
    codec.height, codec.width = pixels.shape[:2]
    codec.pix_fmt, codec.time_base, codec.options = PIXEL_FORMAT, Fraction(1), {"compression": "zip16"}
    frame = av.VideoFrame.from_ndarray(pixels, format=PIXEL_FORMAT)
    return b"".join(bytes(packet) for packet in [*codec.encode(frame), *codec.encode(None)])
