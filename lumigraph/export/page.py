"""Web pages to share: one HTML file that opens from disk, with the scene and its renderer inside. For unbounded scenes
with a backdrop: colours of unobserved directions, from the scene's own, and the floor as camera limit.

The programs in web/ are built from the folder `web` of the repository. Pages with WebGL have stage.js (three.js, camera
and controls) before their own program. Programs and data are compressed in the page.
"""

import base64
import dataclasses
import gzip
import io
import json
import math
import re
from collections.abc import Callable
from dataclasses import asdict, replace
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from .. import __version__
from ..camera import Camera
from ..datasets.mesh import Mesh
from ..errors import LumigraphError
from ..exchange import claim_splats, spz, streamed_sog, write_gaussians
from ..exchange.baked import Browsable, atlas_for_browser, octree_for_browser
from ..exchange.codes import TURN_MEAN
from ..figures import hex_colour, to_bytes
from ..files import write_bytes
from ..gaussians import Gaussians
from ..gaussians.moving import MovingGaussians
from ..geometry import Vector, evenly
from ..method import Method
from ..method.capabilities import HasAtlas, HasGaussians, HasOctree, can, needs
from ..paths import Surroundings, camera_path, film_size
from ..paths.opening import Backdrop, Opening, opening_of_scene
from ..system.progress import counting, track
from ..system.work import at_work
from .loaded import Loaded
from .mesh import extract_mesh
from .options import MeshOptions, PageOptions

BACKDROP_VIEWS, BACKDROP_SIZE = 12, 96  # pictures for the backdrop, and the longer side of each in pixels
MIN_OPAQUE_SHARE = 0.97  # share of them that must be opaque, or the scene's background is part of what it shows
HORIZON_BAND = math.sin(math.radians(10))  # of the horizon, above and below
MIN_SEEN_SHARE = 0.02  # share of pixels from which on something counts as seen
HAZE_SHARE, SKY_SHARE = 0.5, 0.5  # of the way to white, where no photograph shows a horizon or a sky
MAX_SHARE_BELOW_FLOOR = 0.02  # share of the surfaces in the box of interest that may lie below the floor


@torch.no_grad()
def backdrop(method: Method, cameras: Camera) -> Backdrop | None:
    """Colours of sky, horizon and ground from some of the photographs' cameras.

    `None` for an object, and for a scene that is not opaque: its background is part of the picture.
    """
    frame = method.frame
    if frame.has_alpha or not frame.is_open:
        return None
    colours, heights, opacities, places = [], [], [], []
    for i in evenly(range(len(cameras)), BACKDROP_VIEWS):
        camera = cameras[i].to("cpu")
        camera = camera.resized(min(1.0, BACKDROP_SIZE / int(camera.size.max())))
        seen, rays = method.render(camera), camera.rays(camera.pixels())
        depth = seen.depth.reshape(-1).cpu()
        solid = depth.isfinite()
        colours.append(seen.rgb.reshape(-1, 3).cpu().clamp(0, 1))
        heights.append(rays.directions[:, 2])
        opacities.append(seen.opacity.reshape(-1).cpu())
        places.append((rays.origins + depth[:, None] * rays.directions)[solid & (opacities[-1] > 0.5)])
    if (torch.cat(opacities) > 0.5).float().mean() < MIN_OPAQUE_SHARE:
        return None
    rgb, height, place = torch.cat(colours), torch.cat(heights), torch.cat(places)
    everything = torch.ones_like(height, dtype=torch.bool)
    underfoot = median(rgb, height < -HORIZON_BAND) or median(rgb, everything) or frame.background
    horizon = median(rgb, height.abs() < HORIZON_BAND) or lighter(underfoot, HAZE_SHARE)
    overhead = median(rgb, height > HORIZON_BAND) or lighter(horizon, SKY_SHARE)
    return Backdrop(overhead, horizon, underfoot, floor(place, torch.tensor(frame.bounds)))


def median(rgb: Float[Tensor, "pixel 3"], chosen: Tensor) -> Vector | None:
    """Median colour of the chosen ones, channel by channel; None for too few."""
    if chosen.float().mean() < MIN_SEEN_SHARE:
        return None
    red, green, blue = rgb[chosen].median(0).values.tolist()
    return red, green, blue


def lighter(colour: Vector, share: float) -> Vector:
    red, green, blue = (value + share * (1 - value) for value in colour)
    return red, green, blue


def floor(places: Float[Tensor, "point 3"], bounds: Float[Tensor, "2 3"]) -> float:
    """Height of the floor: nearly all surfaces above or below the centre of the box of interest are above it."""
    low, high = bounds
    near = places[((places >= low) & (places <= high))[:, :2].all(-1)]
    return float(near[:, 2].quantile(MAX_SHARE_BELOW_FLOOR)) if len(near) else float(low[2])


WEB = Path(__file__).parent / "web"
ARC_SHARE = 0.8  # of the arc that photographs cover is shown
HARMONICS_STEPS = 2, 4  # of 1/128: steps of the harmonics, a quarter of those that .spz files have by custom
MAX_CROP_SCALE = 1.45  # times larger than fits, at most, is a picture without a plain background, to fill the window
WEBP_QUALITY = 90  # of the pictures, as WebP
MAX_PAGE_BYTES = 100e6  # bytes of a page with a volume
# How to move, with a mouse and with fingers.
ORBIT_HELP = "Drag to turn · scroll to zoom · right-drag to move", "Drag to turn · pinch to zoom"
LOOK_HELP = "Drag to look around", "Drag to look around"
PARALLAX_HELP = "Move the mouse to look behind things", "Tilt the phone, or drag, to look behind things"


def splats_page(path: Path, gaussians: Gaussians, opening: Opening, budget: int | None = None) -> None:
    """Write a page that renders a cloud in the scene's frame as splats with harmonics, stored as .spz, with its loss,
    those with the largest contribution first. budget: Gaussians drawn at most; None for the device's"""
    settings = asdict(opening) | {
        "webgl": True,
        "packed": False,
        "antialiased": gaussians.antialiased,
        "budget": budget,
    }
    with counting(f"Packing {len(gaussians):,} Gaussians"):
        packed = spz.gzipped(gaussians[contributions(gaussians).argsort(descending=True)], steps=HARMONICS_STEPS)
    write_bytes(path, page_bytes("splats", settings, packed), "page")


def contributions(gaussians: Gaussians) -> Float[Tensor, " gaussian"]:
    """Opacity times the area of the largest cross-section, in the frame's units squared, up to a factor."""
    return gaussians.opacities.sigmoid() * gaussians.log_scales.topk(2).values.sum(-1).exp()


def streamed_page(
    path: Path, meta: Path, to_scene: Float[Tensor, "4 4"], opening: Opening, budget: int | None = None
) -> None:
    """Write a page that loads a streamed SOG over HTTP, the coarsest level first, then those that its camera needs.

    meta: lod-meta.json, in the page's folder or below. to_scene: similarity from the frame of its files
    """
    name = quote(meta.resolve().relative_to(path.resolve().parent).as_posix())
    settings = {"webgl": True, "packed": False, "stream": name, "placed": to_scene.flatten().tolist(), "budget": budget}
    write_bytes(path, page_bytes("splats", asdict(opening) | settings, b""), "page")


def moving_page(path: Path, moving: MovingGaussians, opening: Opening) -> None:
    """Write a page that plays a moving cloud in the scene's frame: its spans as .spz, and the times and velocities of
    each, the latter in 16 bits. Gaussians of one source lie beside each other, so that what they share is packed away.
    """
    with counting(f"Packing {len(moving):,} Gaussians"):
        packed = spz.gzipped(moving.cloud, steps=HARMONICS_STEPS)
        times = torch.stack([moving.middles, moving.begins, moving.ends, 1 / moving.fades])
        velocities = (moving.velocities.cpu().numpy() * TURN_MEAN).T.astype("<f2")
        rest = times.cpu().numpy().astype("<f4").tobytes() + np.ascontiguousarray(velocities).tobytes()
    settings = asdict(opening) | {"webgl": True, "packed": False, "antialiased": moving.cloud.antialiased}
    settings |= {"splats": len(packed), "duration": moving.duration}
    write_bytes(path, page_bytes("splats", settings, packed + gzip.compress(rest, 9, mtime=0)), "page")


def mesh_page(path: Path, mesh: Mesh, opening: Opening, reach: float = 0.0) -> None:
    """Write a page of a mesh in the scene's frame, unlit, since its colours contain light. Positions have 16 bits an
    axis.

    reach: of the camera to all sides, scene units: then it follows the pointer or a phone's tilt instead of turning
    """
    low = mesh.vertices.min(0).astype(np.float64)
    size = np.maximum(mesh.vertices.max(0) - low, 1e-12)
    steps = np.rint((mesh.vertices - low) / size * 65535).astype("<u2")
    data = mesh.faces.astype("<u4").tobytes() + steps.tobytes()
    held: dict[str, Any] = {"vertices": len(steps), "faces": len(mesh.faces)}
    held |= {"low": low.tolist(), "high": (low + size).tolist(), "reach": reach}
    if mesh.texture is None:
        data += mesh.colours.tobytes()
    else:
        data += np.rint(mesh.texture.uv.clip(0, 1) * 65535).astype("<u2").tobytes()
        held["picture"] = len(data)
        data += webp(torch.from_numpy(mesh.texture.colours) / 255)
    settings = asdict(opening) | {"webgl": True, "packed": True} | held
    help_text = PARALLAX_HELP if reach else None
    write_bytes(path, page_bytes("mesh", settings, gzip.compress(data, 9, mtime=0), help_text), "page")


def volume_page(path: Path, volume: Browsable, opening: Opening) -> None:
    """Write a page of a baked volume in the scene's frame, which the browser ray-marches.

    Raises LumigraphError if the page would have MAX_PAGE_BYTES bytes or more.
    """
    with counting(f"Packing {path.name}"):
        page = volume_bytes(volume, opening)
    write_bytes(path, page, "page")


def volume_bytes(volume: Browsable, opening: Opening) -> bytes:
    """Bytes of the page of `volume_page`."""
    packed = gzip.compress(volume.data, 6, mtime=0)
    if (size := len(packed) * 4 / 3) > MAX_PAGE_BYTES:
        smaller = f"give --degree {volume.degree - 1}" if volume.degree else "bake larger voxels, or give --as views"
        raise LumigraphError(
            f"The page would have {size / 1e6:.0f} MB; browsers open {MAX_PAGE_BYTES / 1e6:.0f} MB with ease; {smaller}"
        )
    return page_bytes("volumes", asdict(opening) | {"webgl": True, "packed": True} | volume.settings, packed)


@at_work()
def views_page(
    path: Path, method: Method, cameras: Camera, opening: Opening, options: PageOptions = PageOptions()
) -> None:
    """Pictures rendered here, from all around or along the arc that photographs cover; dragging turns them over.

    cameras: of the photographs
    """
    method.eval()
    around = Surroundings(cameras, method.frame)
    closed = around.arc[1] == math.pi
    seen_from = views(around, options.views, film_size(cameras, options.size))
    pictures, ends = [], [0]
    for i in track(range(len(seen_from)), f"Rendering {path.name}", len(seen_from)):
        pictures.append(webp(method.render(seen_from[i]).rgb))
        ends.append(ends[-1] + len(pictures[-1]))
    settings = asdict(opening) | {
        "webgl": False,
        "packed": False,
        "closed": closed,
        "crop": 1.0 if method.frame.has_alpha else MAX_CROP_SCALE,
        "first": 0 if closed else len(seen_from) // 2,
        "pictures": list(zip(ends[:-1], ends[1:], strict=True)),
        "poses": seen_from.pose.tolist(),
    }
    write_bytes(path, page_bytes("views", settings, b"".join(pictures)), "page")


def views(around: Surroundings, count: int, size: tuple[int, int]) -> Camera:
    """Cameras once around the scene, or evenly along the arc that photographs cover. size: (width, height)."""
    path = camera_path("orbit", around.cameras, around.frame, count, size)
    middle, half = around.arc
    if half == math.pi:
        return path
    azimuth = torch.linspace(middle - ARC_SHARE * half, middle + ARC_SHARE * half, count, dtype=torch.double)
    return dataclasses.replace(path, pose=around.poses(azimuth, *around.typical(azimuth)).float())


def webp(rgb: Float[Tensor, "height width 3"]) -> bytes:
    held = io.BytesIO()
    Image.fromarray(to_bytes(rgb.cpu()).numpy()).save(held, "WEBP", quality=WEBP_QUALITY, method=4)
    return held.getvalue()


def page_bytes(program: str, settings: dict[str, Any], data: bytes, help_text: tuple[str, str] | None = None) -> bytes:
    """A page with a program of web/, its settings and its data. help_text: how to move, by mouse and by fingers"""
    mouse, touch = help_text or (ORBIT_HELP if settings["inward"] else LOOK_HELP)
    bright = float(np.dot(settings["background"], (0.299, 0.587, 0.114))) > 0.5
    ink, edge = ("#16181c", "#ffffff") if bright else ("#ffffff", "#000000")
    red, green, blue = (round(255 * value) for value in settings["background"])
    scripts = ["stage", program] if settings["webgl"] else [program]
    source = b"".join((WEB / f"{name}.js").read_bytes() for name in scripts)
    parts = {
        "version": escape(__version__),
        "title": escape(settings["title"]),
        "ground": f"rgb({red} {green} {blue})",
        "ink": ink,
        "edge": edge,
        "mouse": mouse,
        "touch": touch,
        "connect": " 'self'" if "stream" in settings else "",
        "settings": json.dumps(settings, allow_nan=False).replace("<", "\\u003c"),
        "data": base64.b64encode(data).decode(),
        "program": base64.b64encode(gzip.compress(source, 9, mtime=0)).decode(),
    }
    parts["size"] = f"{sum(map(len, parts.values())) / 1e6:.1f} MB"
    page = (WEB / "page.html").read_text("utf-8")
    pieces = page.split("@@")  # text, name, text, name, ..., text
    pieces[1::2] = [parts[name] for name in pieces[1::2]]
    return "".join(pieces).encode()


MAX_FACES = 300_000  # triangles of a mesh in a page, about 4 MB


def export_page(
    loaded: Loaded, path: Path, options: PageOptions, octree: Callable[[], Method] | None = None, bakes: bool = False
) -> tuple[str, dict[str, int]]:
    """Write what is loaded as one HTML file. Returns its contents in words and in numbers.

    octree: makes an octree of it for a volume; None where it has none
    bakes:  whether it becomes an octree where the options leave the kind open
    Raises LumigraphError for options that it cannot have.
    """
    background, budget = background_of(options), budget_of(options)
    cameras, kind = loaded.cameras["train"], kind_of(loaded, options, bakes)
    if options.stream and (kind != "splats" or loaded.moves):
        raise LumigraphError("Only a cloud of Gaussians that stands still is streamed; leave out --stream")
    if options.stream and streamed(loaded, path) is None:
        claim_splats(path.with_suffix("") / streamed_sog.META)
    if kind == "volume" and loaded.part.crops:
        raise LumigraphError("A volume is shown as a whole; leave out --box and --sphere, or give --as views")
    if kind == "volume" and octree is not None and not is_baked(loaded.method):
        if loaded.method.settings:
            raise LumigraphError("A conversion has no controls; leave out --set, or give --as views")
        loaded = replace(loaded, method=octree())
    still = loaded.still
    behind = backdrop(still.method, cameras) if kind != "views" and not loaded.part.crops else None
    opening = opening_of_scene(options.title or loaded.opened.title, cameras, loaded.frame, background, behind)
    if kind == "volume":
        volume, held = browsable(still.method, options.degree)
        volume_page(path, volume, opening)
        return held, {name: volume.settings[name] for name in ("leaves", "blocks") if name in volume.settings}
    if kind == "views":
        views_page(path, still.kept_method(), cameras, opening, options)
        return f"{options.views} views", {"views": options.views}
    if kind == "mesh":
        mesh = extract_mesh(still.without_floaters(), cameras, MeshOptions(faces=MAX_FACES), loaded.crop)
        mesh_page(path, mesh, opening)
        return f"{len(mesh.faces):,} triangles", {"triangles": len(mesh.faces)}
    if loaded.moves:
        moving = loaded.moving(options.duration)
        moving_page(path, moving, opening)
        count, spans = len(moving) - moving.moving, moving.moving
        held = f"{count:,} Gaussians that stand still, {spans:,} spans of those that move"
        return held, {"still": count, "moving": spans}
    gaussians = loaded.gaussians()
    if options.stream:
        meta = streamed(loaded, path)
        to_scene = loaded.frame.to_source.inverse.matrix
        if meta is None:
            meta, to_scene = path.with_suffix("") / streamed_sog.META, torch.eye(4)
            write_gaussians(meta, gaussians)
        streamed_page(path, meta, to_scene, opening, budget)
    else:
        splats_page(path, gaussians, opening, budget)
    return f"{len(gaussians):,} Gaussians, harmonics of degree {gaussians.degree}", {"gaussians": len(gaussians)}


def streamed(loaded: Loaded, path: Path) -> Path | None:
    """lod-meta.json of what is loaded, if a page at `path` can load it as it is; None otherwise."""
    meta = loaded.opened.path / streamed_sog.META if loaded.opened.path.is_dir() else loaded.opened.path
    whole = meta.name == streamed_sog.META and not (loaded.part.crops or loaded.part.removes)
    return meta if whole and meta.resolve().is_relative_to(path.resolve().parent) else None


def budget_of(options: PageOptions) -> int | None:
    """Gaussians of --budget; None for auto. Raises LumigraphError for what is no number of them."""
    if options.budget == "auto":
        return None
    if not options.budget.isdecimal() or not int(options.budget):
        raise LumigraphError(f"{options.budget!r} is no budget; give --budget auto, or a number of Gaussians")
    return int(options.budget)


def kind_of(loaded: Loaded, options: PageOptions, bakes: bool) -> str:
    """Kind of page: that of the options, or the first that what is loaded can have."""
    if options.kind != "auto":
        return options.kind
    if can(loaded.method, HasGaussians):
        return "splats"
    if loaded.part.crops:
        return "views"
    return "volume" if is_baked(loaded.method) or (not loaded.method.settings and bakes) else "views"


def background_of(options: PageOptions) -> Vector | None:
    """Colour of --background in [0, 1]; None where none is given. Raises LumigraphError for what is no colour."""
    if options.background is None:
        return None
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", options.background):
        raise LumigraphError(f"{options.background!r} is no colour; give --background one such as '#101114'")
    red, green, blue = hex_colour(options.background).tolist()
    return red, green, blue


def is_baked(method: Method) -> bool:
    """True for methods whose volume browsers show."""
    return can(method, HasOctree) or can(method, HasAtlas)


def browsable(method: Method, degree: int = 3) -> tuple[Browsable, str]:
    """A baked method's volume for browsers, and its description. degree: largest degree of an octree's harmonics"""
    if can(method, HasOctree):
        volume = octree_for_browser(needs(method, HasOctree).octree(), degree)
        return volume, f"{volume.settings['leaves']:,} leaves of an octree, harmonics of degree {volume.degree}"
    volume = atlas_for_browser(needs(method, HasAtlas).atlas())
    return volume, f"{volume.settings['blocks']:,} blocks of {volume.settings['block']}^3 voxels"
