"""Points shared by photographs: matched SIFT features, verified by two-view geometry."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from ...camera import Camera
from ...datasets.scene import Photograph, Scene
from ...system.library import pycolmap
from ...system.progress import track

MAX_SIDE = 800  # pixels of the longer side, to which larger photographs are reduced
MIN_SIDE = 400  # to which smaller ones are enlarged: features have a size that pictures of 100 pixels lack
MAX_ENLARGEMENT = 4.0  # times that a small one is enlarged
FEATURES = 2000  # of a photograph, at most
CONTRAST = 0.003  # of a feature's peak, at least
RATIO = 0.8  # of the distances to the best and the second-best feature (Lowe 2004, section 7.1)
MAX_ANGLE = 0.7  # angle between descriptors that may be the same, radians
NEIGHBOURS = 16  # photographs that each one is compared with: those that look most alike by their poses
SIDEWAYS = math.radians(75)  # between two views, beyond which they are not compared
ERROR = 4.0  # of FOCAL, off the epipolar line that the two views' own best motion may leave
RESECTION_ERROR = 6.0  # of FOCAL, between a feature and its point seen from the pose that most of them agree on
FOCAL = 1000.0  # in which pixels of all lenses are compared
FLAT = 0.1  # cosine off the axis, beyond which a picture has no flat plane
MIN_MATCHES = 8  # matches of two views, fewer of which are chance


@dataclass(frozen=True)
class Seen:
    """Features of one photograph.

    bearings:    unit directions in the camera's own frame
    descriptors: root-SIFT of unit length (Arandjelovic and Zisserman 2012)
    """

    bearings: Float[Tensor, "feature 3"]
    descriptors: Float[Tensor, "feature 128"]


@dataclass(frozen=True)
class Tracks:
    """Tracks of points in several photographs, an observation to a row.

    point, view: numbers of the point and of the photograph
    bearing:     observed unit direction in the photograph's camera frame
    """

    point: Int[Tensor, " row"]
    view: Int[Tensor, " row"]
    bearing: Float[Tensor, "row 3"]


Matches = dict[tuple[int, int], Int[Tensor, "match 2"]]  # features of both, by pairs of photographs


@cache
def finder() -> Any:
    """COLMAP's feature extractor on a CPU, silent, for pictures in memory."""
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads, options.sift.max_num_features = False, 1, FEATURES
    options.sift.peak_threshold, pycolmap.logging.minloglevel = CONTRAST, 1
    with warnings.catch_warnings():  # its successor gives no arrays
        warnings.simplefilter("ignore", DeprecationWarning)
        return pycolmap.Sift(options, pycolmap.Device.cpu)


def features(photograph: Photograph) -> Seen:
    """Scale-invariant features (Lowe 2004) of a photograph's trusted pixels, upscaled if it is small."""
    photograph = photograph.to("cpu")
    camera, mask = photograph.camera, photograph.mask
    grey = (photograph.before(torch.full((3,), 0.5)) @ torch.tensor([0.299, 0.587, 0.114]))[None, None]
    longest = max(grey.shape[2:])
    scale = min(1.0, MAX_SIDE / longest) if longest > MIN_SIDE else min(MAX_ENLARGEMENT, MIN_SIDE / longest)
    grey = interpolate(grey, scale_factor=scale, mode="bicubic", antialias=scale < 1)[0, 0].clamp(0, 1)
    places, found = finder().extract((255 * grey + 0.5).byte().contiguous().numpy())
    shrink = torch.tensor([camera.size[0, 0] / grey.shape[1], camera.size[0, 1] / grey.shape[0]])
    pixels = torch.from_numpy(np.array(places[:, :2], np.float32)) * shrink
    descriptors = torch.from_numpy(np.array(found, np.float32))
    descriptors = normalize(normalize(descriptors, p=1, dim=-1).sqrt(), dim=-1)
    if mask is not None:
        x, y = pixels.long().unbind(-1)
        trusted = mask[y.clamp(0, mask.shape[0] - 1), x.clamp(0, mask.shape[1] - 1)]
        pixels, descriptors = pixels[trusted], descriptors[trusted]
    return Seen(camera.lens.unproject(pixels), descriptors)


def matched(a: Seen, b: Seen) -> Int[Tensor, "match 2"]:
    """Mutual nearest features of two photographs that pass the ratio test."""
    none = torch.empty(0, 2, dtype=torch.int64)
    if min(len(a.bearings), len(b.bearings)) < 2:
        return none
    alike = a.descriptors @ b.descriptors.T
    best, there = alike.topk(2, -1)
    angles = best.clamp(max=1).acos()
    mine = torch.arange(len(alike))
    good = (angles[:, 0] < MAX_ANGLE) & (angles[:, 0] < RATIO * angles[:, 1]) & (alike.argmax(0)[there[:, 0]] == mine)
    pairs = torch.stack([mine, there[:, 0]], -1)[good]
    return one_motion(a, b, pairs) if len(pairs) >= MIN_MATCHES else none


def one_motion(a: Seen, b: Seen, pairs: Int[Tensor, "match 2"]) -> Int[Tensor, "kept 2"]:
    """Inlier matches of the essential matrix (RANSAC, Nister 2004); none if too few to exclude chance."""
    ends = a.bearings[pairs[:, 0]], b.bearings[pairs[:, 1]]
    ahead = (ends[0][:, 2] > FLAT) & (ends[1][:, 2] > FLAT)
    pairs, (first, second), flat = pairs[ahead], [flattened(end[ahead]) for end in ends], flat_camera()
    options = pycolmap.RANSACOptions(max_error=ERROR, random_seed=0)
    found = (
        pycolmap.estimate_essential_matrix(first, second, flat, flat, options) if len(pairs) >= MIN_MATCHES else None
    )
    kept = pairs[torch.from_numpy(np.array(found["inlier_mask"]))] if found else pairs[:0]
    return kept if len(kept) >= MIN_MATCHES else pairs[:0]


def flattened(bearings: Float[Tensor, "ray 3"]) -> np.ndarray:
    """Pixels of directions in the flat camera."""
    return (FOCAL * bearings[:, :2] / bearings[:, 2:]).double().numpy()


def flat_camera() -> Any:
    flat = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, 1, 1)
    flat.params = [FOCAL, 0.0, 0.0]
    return flat


def resected(
    points: Float[Tensor, "match 3"], bearings: Float[Tensor, "match 3"], minimum: int
) -> Float[Tensor, "3 4"] | None:
    """Pose of a camera that sees points in these directions of its own frame (perspective-n-point by LO-RANSAC, then
    least squares); None for fewer inliers than `minimum`. Points with an unknown place have NaN."""
    known = points.isfinite().all(-1) & (bearings[:, 2] > FLAT)
    if int(known.sum()) < minimum:
        return None
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error, options.ransac.random_seed = RESECTION_ERROR, 0
    found = pycolmap.estimate_and_refine_absolute_pose(
        flattened(bearings[known]), points[known].double().numpy(), flat_camera(), options
    )
    if found is None or found["num_inliers"] < minimum:
        return None
    motion = torch.from_numpy(np.array(found["cam_from_world"].inverse().matrix()))
    return motion.to(points)


def neighbours(cameras: Camera) -> list[tuple[int, int]]:
    """Pairs of views with expected overlap, by their poses: similar in direction, then in position."""
    forward, apart = cameras.forward, torch.cdist(cameras.position, cameras.position)
    turned = forward @ forward.T
    alike = (turned - 0.1 * apart / apart.median().clamp_min(1e-9)).fill_diagonal_(-math.inf)
    nearest = alike.topk(min(NEIGHBOURS, len(cameras) - 1)).indices.tolist()
    pairs = {(min(i, j), max(i, j)) for i, others in enumerate(nearest) for j in others}
    return sorted((i, j) for i, j in pairs if turned[i, j] > math.cos(SIDEWAYS))


def shared_points(scene: Scene) -> tuple[list[Seen], Matches]:
    """Features of the training photographs, in order of the split, and matches of pairs selected by poses."""
    learnt = scene.splits["train"].tolist()
    cameras = scene.cameras[scene.splits["train"]].to("cpu")
    seen = [
        features(scene.photograph(image))
        for image in track(learnt, "Looking for points that photographs share", len(learnt))
    ]
    pairs = neighbours(cameras) if len(learnt) > 1 else []
    compared = track(pairs, "Comparing photographs", len(pairs))
    return seen, {(i, j): matched(seen[i], seen[j]) for i, j in compared}


def tracks(seen: Sequence[Seen], matches: Matches) -> Tracks:
    """Tracks from matches; a point with two features in one photograph is dropped."""
    first = np.cumsum([0, *(len(one.bearings) for one in seen)])
    ends = [(first[i] + m[:, 0].numpy(), first[j] + m[:, 1].numpy()) for (i, j), m in matches.items()]
    rows, columns = (np.concatenate([end[k] for end in ends] or [np.zeros(0, int)]) for k in range(2))
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), (first[-1], first[-1]))
    _, label = connected_components(graph, directed=False)
    view = np.repeat(np.arange(len(seen)), np.diff(first))
    size = np.bincount(label, minlength=1)
    views = np.bincount(np.unique(np.stack([label, view]), axis=1)[0], minlength=len(size))
    kept = ((size > 1) & (size == views))[label]
    _, point = np.unique(label[kept], return_inverse=True)
    bearings = torch.cat([one.bearings for one in seen])[torch.from_numpy(kept)]
    return Tracks(torch.from_numpy(point), torch.from_numpy(view[kept]), bearings)
