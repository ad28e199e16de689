"""Georeferencing by GPS: up, metric scale and position on Earth; without GPS only up, from camera orientations."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..camera import Camera
from ..camera.lens import Pinhole
from ..readers.up import common_up, turn_onto_z
from ..system.library import pycolmap
from .photos import Photo

MAX_GPS_ERROR = 10.0  # metres; a position with a larger error is an outlier
MAX_RELATIVE_ERROR = 0.25  # typical error of positions, as a share of their spread along the longest axis
MIN_POSITIONS = 3
MIN_INLIER_SHARE = 0.5  # of the positions


@dataclass(frozen=True)
class Georeference:
    """Georeference of a model by GPS.

    new_from_old: similarity of the model to metres east, north and up of the origin; None if undetermined
    say:          sentence on the result, or on the reason for none
    origin:       latitude and longitude in degrees, altitude in metres
    error:        typical distance between cameras and GPS positions, metres
    """

    new_from_old: pycolmap.Sim3d | None
    say: str
    origin: tuple[float, float, float] | None = None
    error: float | None = None


def gps_positions(photos: Sequence[Photo]) -> Float[np.ndarray, "photo 3"]:
    """Metres east, north and up of the median position; NaN for photographs without GPS."""
    return local(photos, middle(photos)) if any(p.gps for p in photos) else np.full((len(photos), 3), np.nan)


def middle(photos: Sequence[Photo]) -> tuple[float, float, float]:
    """The median latitude, longitude and altitude."""
    latitude, longitude, altitude = np.median([p.gps for p in photos if p.gps], axis=0).tolist()
    return latitude, longitude, altitude


def local(photos: Sequence[Photo], origin: tuple[float, float, float]) -> Float[np.ndarray, "photo 3"]:
    known = np.array([p.gps or (np.nan,) * 3 for p in photos], np.float64)
    found = np.full((len(photos), 3), np.nan)
    there = np.isfinite(known).all(-1)
    found[there] = pycolmap.GPSTransform().ellipsoid_to_enu(known[there], *origin)
    return found


def georeference(centres: Float[np.ndarray, "photo 3"], photos: Sequence[Photo]) -> Georeference | None:
    """The similarity from a model to metres east, north and up. None if no photograph has a position.

    centres: of the cameras in the model. Robust least squares (Umeyama 1991, in random samples); refused where
    positions lie on a line, or no farther apart than GPS errs.
    """
    known = [i for i, p in enumerate(photos) if p.gps]
    if not known:
        return None
    some = [photos[i] for i in known]
    origin = middle(some)
    source, target = centres[known], local(some, origin)
    if len(known) < MIN_POSITIONS:
        return Georeference(None, f"GPS is not used: {len(known)} of the photographs have a position, and 3 are needed")
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = MAX_GPS_ERROR, 0
    found = pycolmap.estimate_sim3d_robust(source, target, options)
    if not found:
        return Georeference(None, "GPS is not used: positions and photographs contradict each other")
    matrix = found["tgt_from_src"]
    error = np.linalg.norm(source @ matrix.matrix()[:, :3].T + matrix.translation - target, axis=-1)
    kept = error <= MAX_GPS_ERROR
    if kept.sum() < max(MIN_POSITIONS, MIN_INLIER_SHARE * len(known)):
        return Georeference(None, "GPS is not used: positions and photographs contradict each other")
    typical = float(np.sqrt((error[kept] ** 2).mean()))
    spread = np.linalg.svd(target[kept] - target[kept].mean(0), compute_uv=False) / np.sqrt(kept.sum())
    if typical > MAX_RELATIVE_ERROR * spread[1]:
        return Georeference(
            None,
            f"GPS is not used: its error ({typical:.1f} m) is too large for positions that spread {spread[0]:.1f} m "
            f"one way and {spread[1]:.1f} m across",
        )
    say = f"turned and scaled to metres by GPS, which agrees to {typical:.1f} m"
    return Georeference(matrix, say, origin, typical)


def upright(
    poses: Float[np.ndarray, "photo 3 4"], points: Float[np.ndarray, "point 3"] | None = None
) -> pycolmap.Sim3d:
    """Rotation to +z up from camera orientations. poses: camera-to-world"""
    count = len(poses)
    lens = Pinhole(torch.ones(count, 2), torch.ones(count, 2))
    up = common_up(Camera(torch.from_numpy(poses).float(), lens, torch.ones(count, 2, dtype=torch.long)), points)
    turn = np.eye(3) if up is None else turn_onto_z(up)
    return pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn), np.zeros(3))
