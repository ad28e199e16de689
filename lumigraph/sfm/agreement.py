"""Agreement of a model with the matches of its photographs.

Mapping keeps inliers and discards the rest, so a wrong model has a small error too. But it contradicts verified matches
of two photographs.
"""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Integer

from ..geometry import evenly
from ..system.library import pycolmap
from .diagnosis import MIN_MATCHES, Matches

MAX_PAIRS = 4000  # pairs of photographs that are looked at
MAX_EPIPOLAR_ERROR = 0.003  # distance from the epipolar line, of a photograph's longer side
MAX_STILL_MOTION = 0.003  # of a feature that stays where it is in the picture, of its longer side
MIN_CAMERA_TURN = 4.0  # degrees between two cameras, from which what they look at should move in the picture
MIN_STILL_MATCHES = 15  # matches of two photographs that stay where they are and contradict the cameras


@dataclass(frozen=True)
class Agreement:
    """Numbers of matches: all in the model's connected component, and those within the model's epipolar error. Matches
    of unregistered photographs are not confirmed."""

    matches: int
    confirmed: int

    @property
    def share(self) -> float:
        """Confirmed share of the matches; 1 without matches."""
        return self.confirmed / self.matches if self.matches else 1.0


def agreement(model: pycolmap.Reconstruction, database: Path, matched: Matches) -> Agreement:
    """Agreement of a model of perspective photographs with the matches in COLMAP's database, read as `matched`."""
    placed = {image.name: image for image in model.images.values() if image.has_pose}
    near = {name for group in matched.groups() if not group.isdisjoint(placed) for name in group}
    matches = confirmed = 0
    with closing(pycolmap.Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        features = {number: opened.read_keypoints(number)[:, :2] for number in names}
        pairs = [
            (a, b, found.inlier_matches)
            for number, found in zip(*opened.read_two_view_geometries(), strict=True)
            for a, b in [pycolmap.pair_id_to_image_pair(number)]
            if len(found.inlier_matches) >= MIN_MATCHES and names[a] in near
        ]
    for a, b, pair in evenly(pairs, MAX_PAIRS):
        matches += len(pair)
        first, second = placed.get(names[a]), placed.get(names[b])
        if first is not None and second is not None:
            confirmed += int(on_epipolar_lines(model, first, second, features[a], features[b], pair).sum())
    return Agreement(matches, confirmed)


def still_share(model: pycolmap.Reconstruction, database: Path) -> float:
    """Share of the pairs of cameras turned apart whose pictures have matches at the same place that contradict the
    cameras: the background of a subject that was turned before a camera at rest. Verification leaves such matches out.
    """
    placed = {image.image_id: image for image in model.images.values() if image.has_pose}
    turned = still = 0
    with closing(pycolmap.Database.open(database)) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        own = {image.name: image for image in placed.values()}
        features = {number: opened.read_keypoints(number)[:, :2] for number, name in names.items() if name in own}
        pairs = [pycolmap.pair_id_to_image_pair(number) for number in opened.read_two_view_geometries()[0]]
        for a, b in evenly([pair for pair in pairs if set(pair) <= features.keys()], MAX_PAIRS):
            first, second = own[names[a]], own[names[b]]
            motion = second.cam_from_world() * first.cam_from_world().inverse()
            if np.degrees(motion.rotation.angle()) < MIN_CAMERA_TURN:
                continue
            pair = opened.read_matches(a, b)
            side = max(model.cameras[first.camera_id].width, model.cameras[first.camera_id].height)
            moved = np.linalg.norm(features[a][pair[:, 0]] - features[b][pair[:, 1]], axis=1)
            pair = pair[moved < MAX_STILL_MOTION * side]
            against = ~on_epipolar_lines(model, first, second, features[a], features[b], pair) if len(pair) else pair
            turned, still = turned + 1, still + (int(np.sum(against)) >= MIN_STILL_MATCHES)
    return still / turned if turned else 0.0


def on_epipolar_lines(
    model: pycolmap.Reconstruction,
    first: pycolmap.Image,
    second: pycolmap.Image,
    first_features: Float[np.ndarray, "first 2"],
    second_features: Float[np.ndarray, "second 2"],
    matched: Integer[np.ndarray, "match 2"],
) -> Bool[np.ndarray, " match"]:
    """True for the matches of two photographs whose Sampson distance is small under the model's poses."""
    cameras = model.cameras[first.camera_id], model.cameras[second.camera_id]
    x, y = (
        np.c_[camera.cam_from_img(found[index]), np.ones(len(index))]
        for camera, found, index in zip(cameras, (first_features, second_features), matched.T, strict=True)
    )
    motion = second.cam_from_world() * first.cam_from_world().inverse()
    essential = np.cross(np.eye(3), motion.translation) @ motion.rotation.matrix()
    lines, back = x @ essential.T, y @ essential
    gradient = (lines[:, :2] ** 2).sum(-1) + (back[:, :2] ** 2).sum(-1)
    distance = np.abs((y * lines).sum(-1)) / np.sqrt(gradient.clip(1e-24))
    limit = MAX_EPIPOLAR_ERROR * max(max(c.width, c.height) / c.mean_focal_length() for c in cameras)
    return distance < limit
