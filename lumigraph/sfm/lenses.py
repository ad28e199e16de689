"""Group photographs by lens, and write COLMAP's database with the known parameters of each before matching."""

from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

from ..errors import LumigraphError
from ..system.library import pycolmap
from .photos import Photo

Sharing = Literal["auto", "single", "per-device", "per-image", "spherical"]

DEFAULT_FOCAL = 1.2  # longer sides of the picture: 43 mm on full frame
MODEL = "SIMPLE_RADIAL"  # COLMAP's name of the lens that mapping begins with: a focal length and a coefficient
SPHERE = "EQUIRECTANGULAR"  # COLMAP's name of the lens of a panorama of 360 by 180 degrees, which has no parameters
MIN_FULL_MODEL_VIEWS = 30  # photographs of one lens that determine two focal lengths and four distortion coefficients
MIN_SAME_SIZE_SHARE = 0.5  # of the photographs of unknown device; from it on one size means one lens


def group_by_lens(photos: Sequence[Photo], in_order: bool, sharing: Sharing = "auto") -> list[list[Photo]]:
    """Photographs in groups that share a lens.

    auto: by device and size. If files name no device, frames of a video share one, and photographs if most have one
    size; collections from many cameras seldom do.
    Raises LumigraphError where one lens is requested and sizes differ, and for a panorama that is not 2:1.
    """
    if sharing in ("single", "spherical") and len({p.size for p in photos}) > 1:
        raise LumigraphError(
            f"--camera {sharing} needs photographs of one size, and these have several; use --camera per-device"
        )
    width, height = photos[0].size
    if sharing == "spherical" and width != 2 * height:
        raise LumigraphError(
            f"{photos[0].name} is {width}x{height} pixels, and a panorama of 360 by 180 degrees is twice as wide as "
            f"high; export it as equirectangular, or leave out --camera spherical"
        )
    unknown = Counter(p.size for p in photos if p.device is None)
    shared = {
        size
        for size, n in unknown.items()
        if in_order or sharing == "per-device" or n > MIN_SAME_SIZE_SHARE * unknown.total()
    }

    def lens(photo: Photo) -> tuple:
        if sharing in ("single", "spherical"):
            return ()
        if sharing == "per-image" or (photo.device is None and photo.size not in shared):
            return (photo.name,)
        return photo.device, photo.size

    groups: dict[tuple, list[Photo]] = {}
    for photo in photos:
        groups.setdefault(lens(photo), []).append(photo)
    return list(groups.values())


def prior(group: Sequence[Photo]) -> tuple[float, bool]:
    """Initial focal length in pixels, and whether it is reliable: the median of the files' values."""
    known = sorted(p.focal for p in group if p.focal)
    return (known[len(known) // 2], True) if known else (DEFAULT_FOCAL * max(group[0].size), False)


def write_database(path: Path, groups: Sequence[Sequence[Photo]], model: str) -> None:
    """A new database with a camera for each group and an image for each photograph. model: COLMAP's name of the lens"""
    with closing(pycolmap.Database.open(path)) as database:
        for group in groups:
            focal, known = prior(group)
            camera = pycolmap.Camera.create_from_model_name(1, model, focal, *group[0].size)
            camera.has_prior_focal_length = known or camera.is_spherical()
            camera_id = database.write_camera(camera)
            rig = pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id))
            rig_id = database.write_rig(rig)
            for photo in group:
                image = pycolmap.Image(name=photo.name, camera_id=camera_id)
                image.image_id = database.write_image(image)
                frame = pycolmap.Frame()
                frame.rig_id = rig_id
                frame.add_data_id(image.data_id)
                database.write_frame(frame)
