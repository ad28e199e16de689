"""A flight through a trained scene: colour and depth, as films and as pictures."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from ..camera import Camera
from ..display import track
from ..figures import Range, colour_depth, depth_range, to_bytes
from ..files import replacing, write_json
from ..method import Method
from .video import open_video

PROBES, PROBE_SIZE = 6, 64  # frames, and their pixels, that tell the depths to expect


def film(method: Method, cameras: Camera, path: Path, fps: float = 30.0) -> dict[str, Any]:
    """Render every camera of one size. Returns what is written to the JSON file.

    For path/orbit.mp4 also writes path/orbit-depth.mp4, the pictures path/orbit/0000.png and 0000-depth.png, and
    path/orbit.json with the cameras (poses in the scene's frame; source_from_scene leads back to the capture's).
    """
    method.eval()
    within = film_depth_range(method, cameras)
    with contextlib.ExitStack() as stack:
        targets = [stack.enter_context(open_video(x, fps)) for x in (path, path.with_stem(f"{path.stem}-depth"))]
        folder = stack.enter_context(replacing(path.with_suffix("")))
        folder.mkdir()
        begin = time.perf_counter()
        for i in track(range(len(cameras)), f"Filming {path.name}", len(cameras)):
            seen = method.render(cameras[i]).cpu()
            pictures = to_bytes(seen.rgb), to_bytes(colour_depth(seen.depth, seen.opacity, within))
            for target, ending, picture in zip(targets, ("", "-depth"), pictures, strict=True):
                target.add(picture)
                Image.fromarray(picture.numpy()).save(folder / f"{i:04d}{ending}.png")
        seconds = (time.perf_counter() - begin) / len(cameras)
    about = {
        "frames": len(cameras),
        "fps": fps,
        "size": cameras.size[0].tolist(),
        "seconds_per_frame": seconds,
        "depth_range": list(within),
        "source_from_scene": method.frame.source_from_scene,
        "lens": cameras.lens.to_json(),
        "poses": cameras.pose.tolist(),
    }
    write_json(path.with_suffix(".json"), about)
    return about


def film_depth_range(method: Method, cameras: Camera) -> Range:
    """One range for all frames, found from a few small ones, so that colours do not flicker."""
    chosen = cameras[torch.linspace(0, len(cameras) - 1, min(PROBES, len(cameras))).round().long()]
    small = chosen.resized(min(1.0, PROBE_SIZE / int(chosen.size.max())))
    seen = [method.render(small[i]).cpu() for i in range(len(small))]
    return depth_range(torch.cat([x.depth.flatten() for x in seen]), torch.cat([x.opacity.flatten() for x in seen]))
