"""Equirectangular panoramas of any method, and pictures of any lens.

Methods with rays of any lens render it directly. Gaussians are rendered on flat pictures only, so a sphere or the
picture of a fisheye is assembled from many small ones, each for a few columns and a band of rows, with interpolation.

Omnidirectional stereo is a panorama for each eye. The rays of both eyes are tangents of a level circle
(`lens.OmnidirectionalStereo`; Peleg 2001), so the eyes are side by side in every direction. At the poles parallax
fades.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from PIL.PngImagePlugin import PngInfo
from torch import Tensor
from torch.nn.functional import grid_sample

from ..camera import Camera
from ..camera.lens import Equirectangular, OmnidirectionalStereo, Pinhole
from ..camera.rays import Rendering
from ..color.tags import save_srgb
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..figures import to_image
from ..files import replacing
from ..geometry import look_at
from ..method import Method
from ..paths import Surroundings
from ..system.memory import ask_for_picture
from ..system.progress import track
from ..system.work import at_work
from .loaded import Loaded
from .options import EyesOptions, SphereOptions

PIXELS_PER_CHUNK = 1 << 18  # pixels rendered between two updates of the progress bar
BANDS = 3  # of rows, each seen by flat pictures that are pitched towards it
PATCH_ANGLE, LAP_SHARE = math.radians(40), 0.1  # of a flat picture's part of a fisheye's, and of that its overlap
COLUMNS = 8  # flat pictures around the horizon, where one place sees all
OVERSAMPLING = 1.25  # pixels of a flat picture's middle for one of the panorama's equator
BORDER_PIXELS = 2  # pixels around what is read of a flat picture
JPEG_QUALITY = 95
MIN_WIDTH, MAX_WIDTH = 64, 16_384  # pixels

Vector = tuple[float, float, float]
Point = Float[Tensor, " 3"]  # or a direction, in the scene's frame
Lines = tuple[Int[Tensor, " _"], Float[Tensor, " _"]]  # rows or columns of a picture, and their weights


def export_panorama(loaded: Loaded, path: Path, options: SphereOptions = SphereOptions()) -> str:
    """Write all that is seen from one place as one picture. Returns the place in words."""
    place, heading, words = standpoint(loaded.cameras["train"], loaded.frame, options.place)
    save_sphere(path, panorama(loaded.kept_method(), place, heading, options.size).rgb, whole=True)
    return words


def export_stereo(
    loaded: Loaded, path: Path, options: SphereOptions = SphereOptions(), eyes: EyesOptions = EyesOptions()
) -> tuple[str, float, float]:
    """Write a stereo pair as one picture. Returns the place in words, and in the unit of exports the distance of the
    eyes and the median distance of what is around. Raises LumigraphError for eyes that do not fit there."""
    place, heading, words = standpoint(loaded.cameras["train"], loaded.frame, options.place)
    method, unit = loaded.kept_method(), loaded.frame.to_export.scale
    near, middle = surrounding_distances(method, place, heading)
    apart = EYE_DISTANCE_SHARE * middle if eyes.interpupillary is None else eyes.interpupillary / unit
    if apart > near:
        raise LumigraphError(
            f"Eyes {apart * unit:.4g} apart do not fit where things are {near * unit:.4g} away; "
            "give a smaller --interpupillary or another --from"
        )
    pair = stereo_pair(method, place, heading, options.size, apart, near)
    save_sphere(path, top_bottom(*pair), whole=False)
    return words, apart * unit, middle * unit


def panorama(method: Method, place: Point, heading: Point, width: int) -> Rendering:
    """Panorama from a point in the scene's frame, (width / 2, width) pixels; up is +z.

    heading: direction of the middle column, made level
    """
    return sphere(method, level_camera(place, heading, Equirectangular(sphere_size(width))), "Panorama")


@at_work()
def sphere(method: Method, camera: Camera, name: str, columns: int | None = None) -> Rendering:
    """Rendering of an upright camera with an `Equirectangular` lens, or a subclass of it.

    columns: width of the flat pictures for methods other than ray methods; `None` if all rays have one origin, which
             gives eight blended pictures around
    """
    method.eval()
    width, height = camera.size[0].tolist()
    ask_for_picture(width, height, method.device)
    if method.any_lens:
        step = max(1, PIXELS_PER_CHUNK // width)
        tops = range(0, height, step)
        parts = [method.render(rows_of(camera, top, min(step, height - top))) for top in track(tops, name, len(tops))]
        return Rendering.cat([Rendering(x.rgb.cpu(), x.depth.cpu(), x.opacity.cpu()) for x in parts])
    lap, each = (width // (4 * COLUMNS), -(-width // COLUMNS)) if columns is None else (0, columns)
    strips = [fading(x, min(x + each, width), lap, -lap, width + lap) for x in range(0, width, each)]
    return by_flat_pictures(method, camera, divided(height, BANDS, lap), strips, name)


@at_work()
def through_lens(method: Method, camera: Camera) -> Rendering:
    """Rendering of a camera whose lens has no flat picture, such as a fisheye's, for methods that have no other."""
    method.eval()
    width, height = camera.size[0].tolist()
    ask_for_picture(width, height, method.device)
    rim = torch.tensor([[0, height / 2], [width, height / 2], [width / 2, 0], [width / 2, height]])
    left, right, top, bottom = camera.lens.unproject(rim)
    axis = camera.lens.unproject(rim.mean(0, keepdim=True))[0]
    across, down = (sum(float((axis @ x).clamp(-1, 1).acos()) for x in pair) for pair in ((left, right), (top, bottom)))
    columns, rows = (max(1, math.ceil(angle / PATCH_ANGLE)) for angle in (across, down))
    lap = int(LAP_SHARE * min(width / columns, height / rows))
    strips, bands = divided(width, columns, lap), divided(height, rows, lap)
    return by_flat_pictures(method, camera, bands, strips, "Through its lens")


def divided(size: int, count: int, lap: int) -> list[Lines]:
    """Parts of a picture's rows or columns, which overlap; nothing fades at its rim."""
    edges = [-math.inf, *(round(size * i / count) for i in range(1, count)), math.inf]
    return [fading(begin, end, lap, 0, size) for begin, end in pairwise(edges)]


def by_flat_pictures(
    method: Method, camera: Camera, bands: Sequence[Lines], strips: Sequence[Lines], name: str
) -> Rendering:
    """A picture from flat ones, each of some columns and a band of rows; exact where their rays share an origin. They
    are cross-faded where they overlap, since the order of Gaussians differs between them."""
    width, height = camera.size[0].tolist()
    rgb, opacity, total = torch.zeros(height, width, 3), torch.zeros(height, width), torch.zeros(height, width)
    depth = torch.empty(height, width)
    patches = [(band, strip) for strip in strips for band in bands]
    for (rows, low), (some, across) in track(patches, name, len(patches)):
        y, x = torch.meshgrid(rows, some, indexing="ij")
        flat, at = flat_camera(camera, torch.stack([x, y], -1).reshape(-1, 2) + 0.5)
        seen = method.render(flat).cpu()
        weight, place = low[:, None] * across, (rows[:, None], some % width)
        rgb[place] += weight[..., None] * read(seen.rgb, at).view(*x.shape, 3)
        opacity[place] += weight * read(seen.opacity[..., None], at).view(x.shape)
        total[place] += weight
        nearest = read(seen.depth[..., None], at, "nearest").view(x.shape)  # infinity has no mean
        depth[place] = torch.where((low > 0.5)[:, None] & (across > 0.5), nearest, depth[place])
    return Rendering(rgb / total[..., None], depth, opacity / total)


def fading(begin: float, end: float, lap: int, first: int, last: int) -> Lines:
    """Pixels among [first, last) that a patch reaches, and their weights: half at the patch's edges."""
    pixels = torch.arange(max(first, begin - lap), min(last, end + lap)).long()
    inside = torch.minimum(pixels + 0.5 - begin, end - pixels - 0.5)  # pixels from the nearer edge
    return pixels, (0.5 + inside / max(2 * lap, 1e-6)).clamp(0, 1)


def flat_camera(camera: Camera, pixels: Float[Tensor, "pixel 2"]) -> tuple[Camera, Float[Tensor, "pixel 2"]]:
    """A pinhole camera for some neighbouring pixels of a picture, and their positions in its own.

    Its position is the origin of the central ray.
    """
    lens, middle = camera.lens, (pixels.amin(0) + pixels.amax(0))[None] / 2
    z = lens.unproject(middle)[0]
    turn = look_at(torch.zeros(3), z, torch.tensor([0.0, -1.0, 0.0] if z[1].abs() < 0.99 else [0.0, 0.0, 1.0]))[:, :3]
    directions = lens.unproject(pixels) @ turn
    per_radian = (
        lens.size[0, 0] / (2 * math.pi)
        if isinstance(lens, Equirectangular)
        else (lens.solid_angle(middle, z[None]).rsqrt()[0])
    )
    focal = OVERSAMPLING * per_radian
    at = focal * directions[:, :2] / directions[:, 2:]
    low, high = at.amin(0), at.amax(0)
    corner = BORDER_PIXELS + 0.5 - low.floor()  # the axis goes through a pixel's centre
    size = (high.ceil() - low.floor()).long() + 1 + 2 * BORDER_PIXELS
    rotation = camera.pose[0, :, :3] @ turn
    begin = camera.rays(middle).origins[0]
    pose = torch.cat([rotation, begin[:, None]], -1)[None]
    return Camera(pose, Pinhole(focal.expand(1, 2), corner[None]), size[None]), at + corner


def read(
    picture: Float[Tensor, "height width channel"], at: Float[Tensor, "pixel 2"], how: str = "bilinear"
) -> Float[Tensor, "pixel channel"]:
    """Interpolated values of a picture at (x, y)."""
    height, width = picture.shape[:2]
    share = 2 * at / torch.tensor([width, height]) - 1
    found = grid_sample(picture.permute(2, 0, 1)[None], share[None, None], how, "border", align_corners=False)
    return found[0, :, 0].T


def rows_of(camera: Camera, top: int, count: int) -> Camera:
    """A camera for some rows of another's picture."""
    assert isinstance(camera.lens, Equirectangular)
    lens = replace(camera.lens, centre=camera.lens.centre - camera.lens.centre.new_tensor([[0, top]]))
    return replace(camera, lens=lens, size=torch.tensor([[int(camera.size[0, 0]), count]]))


def sphere_size(width: int) -> Float[Tensor, "1 2"]:
    """Size of a panorama in pixels. Raises LumigraphError for an invalid width."""
    if width % 2 or not MIN_WIDTH <= width <= MAX_WIDTH:
        raise LumigraphError(
            f"A panorama cannot be {width} pixels wide; give --size an even number from {MIN_WIDTH} to {MAX_WIDTH}"
        )
    return torch.tensor([[width, width / 2]])


def level_camera(place: Point, heading: Point, lens: Equirectangular) -> Camera:
    """An upright camera that faces a heading."""
    level = torch.stack([heading[0], heading[1], torch.zeros_like(heading[0])])
    pose = look_at(place[None], level[None], torch.tensor([0.0, 0.0, 1.0]))
    return Camera(pose, lens, lens.size.long())


def standpoint(cameras: Camera, frame: Frame, source: Vector | None = None) -> tuple[Tensor, Tensor, str]:
    """Position and heading of a panorama in the scene's frame, and the position in words.

    source: the position in the source's frame. By default that of the camera nearest to the mean, which is certainly in
            free space, with observed surroundings.
    """
    around = Surroundings(cameras, frame)
    if source is None:
        place = around.position[around.middle]
        given = frame.to_source.points(place)
        words = "where the camera in the middle of all stood"
    else:
        given = torch.tensor(source, dtype=torch.double)
        if not given.isfinite().all():
            raise LumigraphError("A position that is not finite has no panorama; give --from three numbers")
        place = frame.to_source.inverse.points(given)
        words = "as asked"
    heading = around.axes[0] if not around.inward else around.focus - place - 1e-6 * around.axes[0]
    return place.float(), heading.float(), f"{' '.join(f'{x:.4g}' for x in given.tolist())}, {words}"


def save_sphere(path: Path, rgb: Float[Tensor, "height width 3"], whole: bool) -> None:
    """Write a PNG or a JPEG, whole or not at all.

    whole: whether this is one panorama, which is declared in its metadata (Google's GPano), so that viewers show it
           as a sphere
    Raises LumigraphError for another ending.
    """
    picture_format(path)
    image, height, width = to_image(rgb), *rgb.shape[:2]
    about: dict[str, Any] = {}
    if whole and path.suffix.lower() == ".png":
        about["pnginfo"] = PngInfo()
        about["pnginfo"].add_itxt("XML:com.adobe.xmp", gpano(width, height))
    elif whole:
        about["xmp"] = gpano(width, height).encode()
    if path.suffix.lower() != ".png":
        about |= {"quality": JPEG_QUALITY, "subsampling": 0}
    with replacing(path, "panorama") as partial:
        save_srgb(image, partial, picture_format(path), **about)


def picture_format(path: Path) -> str:
    """Pillow's name of the format of an ending."""
    found = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}.get(path.suffix.lower())
    if found is None:
        raise LumigraphError(f"{path} should end in .png or .jpg, the kinds of picture there are; rename it")
    return found


def gpano(width: int, height: int) -> str:
    """XMP that declares a full sphere, upright (Google's Photo Sphere schema)."""
    numbers = {
        "ProjectionType": "equirectangular",
        "UsePanoramaViewer": "True",
        "FullPanoWidthPixels": width,
        "FullPanoHeightPixels": height,
        "CroppedAreaImageWidthPixels": width,
        "CroppedAreaImageHeightPixels": height,
        "CroppedAreaLeftPixels": 0,
        "CroppedAreaTopPixels": 0,
        "PosePitchDegrees": 0,
        "PoseRollDegrees": 0,
    }
    tags = "\n".join(f"   <GPano:{name}>{value}</GPano:{name}>" for name, value in numbers.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/">\n'
        ' <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">\n'
        '  <rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/">\n'
        f"{tags}\n"
        "  </rdf:Description>\n </rdf:RDF>\n</x:xmpmeta>\n"
        '<?xpacket end="r"?>'
    )


EYE_DISTANCE_SHARE = 1 / 50  # of the distance to what is around: 64 mm in a room of some three metres
PROBE_SIZE = 256  # pixels of the small panorama for distances
MAX_SHIFT_PIXELS = 0.1  # pixels by which a flat picture may be off at its edge, at what is near
MAX_COLUMNS = 32
MIN_OPACITY = 0.5  # opacity from which on something is there


def stereo_pair(
    method: Method, place: Point, heading: Point, width: int, interpupillary: float, nearest: float
) -> tuple[Rendering, Rendering]:
    """Panoramas of the left and the right eye, (width / 2, width) pixels each; up is +z.

    place:          the middle between the eyes, in the scene's frame
    interpupillary: the distance between them, scene units
    nearest:        distance to near surfaces, scene units; smaller needs more flat pictures
    """
    columns = columns_at_once(interpupillary / 2, nearest)
    eyes = []
    for name, side in (("Left eye", -0.5), ("Right eye", 0.5)):
        offset = torch.tensor([[side * interpupillary]])
        camera = level_camera(place, heading, OmnidirectionalStereo(sphere_size(width), offset=offset))
        eyes.append(sphere(method, camera, name, columns))
    return eyes[0], eyes[1]


def top_bottom(left: Rendering, right: Rendering) -> Float[Tensor, "height width 3"]:
    """The pair as one square picture, the left eye on top."""
    return torch.cat([left.rgb, right.rgb])


def surrounding_distances(method: Method, place: Point, heading: Point) -> tuple[float, float]:
    """Near (2nd percentile) and median distance of surfaces around a point, scene units.

    Directions are weighted by solid angle. Raises LumigraphError if no surface is around.
    """
    seen = sphere(method, level_camera(place, heading, Equirectangular(sphere_size(PROBE_SIZE))), "Looking around")
    rows = torch.arange(PROBE_SIZE // 2) + 0.5
    weight = torch.sin(torch.pi * rows / len(rows))[:, None].expand_as(seen.depth)
    solid = (seen.opacity > MIN_OPACITY) & seen.depth.isfinite()
    if not solid.any():
        raise LumigraphError("Nothing is around that place; give --from another one, or --interpupillary")
    depth, order = seen.depth[solid].sort()
    share = weight[solid][order].cumsum(0)
    near, middle = (depth[int(torch.searchsorted(share, q * share[-1]))].item() for q in (0.02, 0.5))
    return near, middle


def columns_at_once(radius: float, nearest: float) -> int:
    """Largest number of columns of one flat picture.

    Its camera is at the origin of the central column's rays. Rays of a column k / 2 away begin k / 2 pixels' angle
    further along the circle, which is ahead or behind by r k / 2 pixels' angle: points at a distance d and high up are
    off by up to r k / (2 d) pixels.
    """
    return max(1, min(MAX_COLUMNS, int(2 * MAX_SHIFT_PIXELS * nearest / max(radius, 1e-9))))
