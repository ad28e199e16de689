"""Diagnosis of a capture: outcome for each photograph, reliability of the result, and advice."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from ..files.names import counted, natural
from ..geometry import evenly
from ..readers.colmap import poses_of
from ..readers.oddities import in_steps, jumps
from ..system.library import pycolmap
from .coverage import Coverage, coverage
from .photos import Intake, Photo
from .photos.judge import MAX_EXPOSURE_STOPS, exposure_jumps

MIN_FEATURES = 100
MIN_MATCHES = 15  # shared features of two photographs that COLMAP accepts
MIN_TRIANGULATION_ANGLE = 2.0  # degrees, median over points: below it depth is uncertain
ROTATION_SHARE = 0.6  # share of the pairs that a pure rotation of the camera explains
ALL_TURNED_SHARE = 0.9  # share from which on a model of these pairs has no depth, whatever it says
TURN_SAMPLES = 300  # pairs whose motion is looked at
FOCAL_RATIOS = 0.4, 4.0, 100  # shortest and longest focal length in terms of the longer side, and how many are tried
MAX_TURN_DEVIATION = 0.15  # deviation from a rotation, of the motion between two pictures, which a turn may have
MIN_MOTION = 0.02  # added to the motion, so that noise is small against it
MIN_OVERLAP_MATCHES = 30  # shared features from which on two neighbours count as close
MAX_REPROJECTION_ERROR = 2.0  # pixels
ANGLE_SAMPLES = 2000  # points whose angles are measured
MAX_NAMES = 8  # photographs that a warning lists

Homography = tuple[Float[np.ndarray, "3 3"], tuple[int, int], tuple[int, int]]  # and the sizes of both photographs


@dataclass(frozen=True)
class Matches:
    """Verified matches: number of inliers of each pair of names, and COLMAP's two-view geometry."""

    features: dict[str, int]
    shared: dict[tuple[str, str], int]
    turned: int  # pairs that a turn of the camera alone explains

    def best(self, name: str) -> tuple[str, int]:
        """The photograph with most matches to this one, and their number; 0 and no name without any."""
        found = [(n, b if a == name else a) for (a, b), n in self.shared.items() if name in (a, b)]
        most = max(found, default=(0, ""))
        return most[1], most[0]

    def are_turned(self, share: float = ROTATION_SHARE) -> bool:
        """True if pure rotation explains more than a share of the pairs."""
        return self.turned > share * max(len(self.shared), 1)

    def between(self, a: str, b: str) -> int:
        return self.shared.get((a, b)) or self.shared.get((b, a)) or 0

    def groups(self) -> list[set[str]]:
        """Connected components of the photographs, the largest first."""
        number = {name: i for i, name in enumerate(self.features)}
        pairs = np.array([(number[a], number[b]) for a, b in self.shared], int).reshape(-1, 2)
        graph = coo_array((np.ones(len(pairs)), pairs.T), (len(number), len(number)))
        count, group = connected_components(graph, directed=False)
        found = [{name for name, i in number.items() if group[i] == k} for k in range(count)]
        return sorted(found, key=len, reverse=True)


def read_matches(database: Path) -> Matches:
    shared, flat = {}, []
    kinds = pycolmap.TwoViewGeometryConfiguration
    with closing(pycolmap.Database.open(database)) as opened:
        images, cameras = opened.read_all_images(), {c.camera_id: c for c in opened.read_all_cameras()}
        names = {image.image_id: image.name for image in images}
        sizes = {i.image_id: (cameras[i.camera_id].width, cameras[i.camera_id].height) for i in images}
        features = {name: opened.num_keypoints_for_image(number) for number, name in names.items()}
        for number, pair in zip(*opened.read_two_view_geometries(), strict=True):
            if len(pair.inlier_matches) >= MIN_MATCHES:
                a, b = pycolmap.pair_id_to_image_pair(number)
                shared[names[a], names[b]] = len(pair.inlier_matches)
                if pair.config in (kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC):
                    flat.append((np.array(pair.H), sizes[a], sizes[b]))
    return Matches(features, shared, count_turns(flat))


def count_turns(homographies: Sequence[Homography]) -> int:
    """Number of homographies explained by a rotation and not by a plane: K R K⁻¹ with one focal length.

    Each with the widths and heights of its pictures. A plane seen by a moving camera gives R + t nᵀ, which deviates
    from a rotation in proportion to the motion; so the deviation is measured relative to the motion.
    """
    if not homographies:
        return 0
    off, _ = deviation_from_turn(homographies)
    return round(float((off < MAX_TURN_DEVIATION).mean()) * len(homographies))


def deviation_from_turn(homographies: Sequence[Homography]) -> tuple[Float[np.ndarray, " pair"], float]:
    """Deviation of some of the homographies from a rotation, relative to their motion, and the focal length that
    minimises it, in terms of the longer side."""
    some, ratios = evenly(homographies, TURN_SAMPLES), np.geomspace(*FOCAL_RATIOS)
    worst = np.empty((len(some), len(ratios)))
    for row, (homography, *sizes) in zip(worst, some, strict=True):
        first, second = (calibration(size, ratios) for size in sizes)
        motion = np.linalg.inv(second) @ homography @ first
        motion /= np.cbrt(np.linalg.det(motion))[:, None, None]
        off = np.abs(motion.transpose(0, 2, 1) @ motion - np.eye(3)).max((1, 2))
        row[:] = off / (np.abs(motion - np.eye(3)).max((1, 2)) + MIN_MOTION)
    best = int(np.median(worst, axis=0).argmin())
    return worst[:, best], float(ratios[best])


def calibration(size: tuple[int, int], ratios: Float[np.ndarray, " ratio"]) -> Float[np.ndarray, "ratio 3 3"]:
    """Calibration matrices for focal lengths in terms of the longer side."""
    matrix = np.zeros((len(ratios), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = ratios * max(size)
    matrix[:, :, 2] = size[0] / 2, size[1] / 2, 1
    return matrix


@dataclass(frozen=True)
class Diagnosis:
    """Outcome of a capture.

    given:        number of files;  used: number of photographs in the reconstruction
    registered:   names of the registered photographs
    left_out:     name and reason of each unused or unregistered one
    blurred:      name and reason, of blurred ones that are used
    duplicates:   name, and the name of the one it repeats
    other_models: photographs of other connected models
    error:        mean reprojection error, pixels
    points, track_length: number of points, and mean number of photographs of each
    angle:        median triangulation angle, degrees
    filled:       mean share of a picture that its points span
    coverage:     None for cameras without a common subject
    warnings:     sentences on possible faults of the result, with advice
    """

    given: int
    used: int
    registered: list[str]
    left_out: dict[str, str]
    blurred: dict[str, str]
    duplicates: dict[str, str]
    other_models: list[list[str]]
    error: float
    points: int
    track_length: float
    angle: float
    filled: float
    coverage: Coverage | None
    warnings: list[str]


def diagnose(
    intake: Intake, used: Sequence[Photo], model: pycolmap.Reconstruction, others: list[list[str]], matches: Matches
) -> Diagnosis:
    """Diagnose a model. used: photographs in the reconstruction; others: names in other models; the model is upright"""
    placed = poses_of(model)
    registered = [photo.name for photo in used if photo.name in placed]
    poses = np.stack([placed[name] for name in registered])
    left_out = intake.unreadable | {
        photo.name: why_not(photo.name, registered, others, matches, photo.name in intake.blurred)
        for photo in used
        if photo.name not in placed
    }
    angle = triangulation_angle(model)
    error = float(model.compute_mean_reprojection_error())
    warnings = [
        f"{len(names)} photographs fit together, but not with the rest: {listed(names)}; if they show something else, "
        f"capture them alone, otherwise take some that show parts of both"
        for names in others
    ]
    if len(left_out) - sum(map(len, others)) > len(used) / 3:
        warnings.append(
            f"{len(left_out)} photographs have no place: take more between them and the rest, each overlapping the "
            f"next by two thirds"
        )
    if blurred := [name for name in intake.blurred if name in placed]:
        number = counted(len(blurred), "blurred photograph")
        warnings.append(f"{number}: {listed(blurred)}; remove or retake what is not needed")
    warnings += [
        *about_exposure([photo for photo in used if photo.name in placed], intake.in_order),
        *about_rotation(angle, matches),
        *about_jumps(registered, folds(registered, poses, matches, intake.in_order)),
    ]
    if error > MAX_REPROJECTION_ERROR:
        warnings.append(
            f"details are {error:.1f} pixels from where the model has them, on average: photographs may be blurred, or "
            f"the subject moved"
        )
    return Diagnosis(
        given=len(intake.photos) + len(intake.unreadable),
        used=len(used),
        registered=registered,
        left_out={name: left_out[name] for name in sorted(left_out, key=natural)},
        blurred=dict(intake.blurred),
        duplicates=dict(intake.duplicates),
        other_models=others,
        error=error,
        points=len(model.points3D),
        track_length=float(model.compute_mean_track_length()),
        angle=angle,
        filled=filled(model),
        coverage=None if any(c.is_spherical() for c in model.cameras.values()) else coverage(registered, poses),
        warnings=warnings,
    )


APART = "in another group of {}, which shares too little with the rest: another place, or views between are missing"


def why_not(
    name: str, registered: Sequence[str], others: Sequence[Sequence[str]], matches: Matches, blurred: bool
) -> str:
    """Reason in a few words why a photograph was not registered."""
    features = matches.features.get(name, 0)
    if features < MIN_FEATURES:
        fault = "blurred" if blurred and features else "blank, dark or out of focus"
        return f"too few details ({features} found): {fault}"
    for model in others:
        if name in model:
            return APART.format(len(model))
    neighbour, most = matches.best(name)
    if not most:
        return "shares too few details with any other photograph"
    group = next(group for group in matches.groups() if name in group)
    if group.isdisjoint(registered):
        return APART.format(len(group))
    return f"matches {neighbour} ({most} details), but its place could not be told"


def triangulation_angle(model: pycolmap.Reconstruction, seed: int = 0) -> float:
    """Median triangulation angle of the points, between outermost rays, degrees."""
    centres = {number: image.projection_center() for number, image in model.images.items() if image.has_pose}
    numbers = np.array(sorted(model.points3D.keys()))
    chosen = np.random.default_rng(seed).permutation(len(numbers))[:ANGLE_SAMPLES]
    angles = []
    for number in numbers[chosen].tolist():
        point = model.points3D[number]
        rays = np.stack([centres[e.image_id] for e in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True).clip(1e-12)
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return float(np.median(angles)) if angles else 0.0


def filled(model: pycolmap.Reconstruction) -> float:
    """Share of a picture inside the convex hull of its points, mean over pictures."""
    shares = []
    for image in model.images.values():
        if not image.has_pose:
            continue
        found = np.array([point.xy for point in image.points2D if point.has_point3D()]).reshape(-1, 2)
        camera = model.cameras[image.camera_id]
        try:
            shares.append(ConvexHull(found).volume / (camera.width * camera.height) if len(found) > 2 else 0.0)
        except QhullError:  # all on a line
            shares.append(0.0)
    return float(np.mean(shares))


def folds(
    names: Sequence[str], poses: Float[np.ndarray, "photo 3 4"], matches: Matches, in_order: bool
) -> list[tuple[int, float]]:
    """Jumps of a capture whose order is meaningful."""
    if not (in_order or in_steps(poses[:, :, 3])):
        return []
    return jumps(
        poses, [i for i in range(len(names) - 1) if matches.between(names[i], names[i + 1]) >= MIN_OVERLAP_MATCHES]
    )


def about_exposure(photos: Sequence[Photo], in_order: bool) -> list[str]:
    """Warnings of photographs more than 1.5 stops from their neighbours, or without an order, from the median."""
    found = [photos[i].name for i in exposure_jumps([photo.brightness for photo in photos], in_order)]
    if not found:
        return []
    return [
        f"exposure jumps by more than {MAX_EXPOSURE_STOPS:g} stops at {listed(found)}; lock the exposure, or "
        f"leave these out, for colours will not agree"
    ]


def about_rotation(angle: float, matches: Matches) -> list[str]:
    if angle >= MIN_TRIANGULATION_ANGLE and not matches.are_turned():
        return []
    return [
        f"the photographs were taken from nearly one place (the outermost views of a point are {angle:.1f} degrees "
        f"apart), so depth is uncertain; walk sideways instead of turning on the spot"
    ]


def about_jumps(names: Sequence[str], leaps: Sequence[tuple[int, float]]) -> list[str]:
    if not leaps:
        return []
    found = sorted(leaps, key=lambda leap: -leap[1])
    i, times = found[0]
    more = f", and there are {len(found) - 1} more such places" if len(found) > 1 else ""
    return [
        f"{names[i]} and {names[i + 1]} follow each other and show the same, but stand {times:.0f} times as far "
        f"apart as is usual{more}: the model may be folded there; look at capture.png, and try --mapper global or "
        f"--matching exhaustive"
    ]


def listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return ", ".join(names[:MAX_NAMES]) + rest
