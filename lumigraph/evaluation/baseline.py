"""Trivial baselines, which need no training: the mean and the nearest training photograph in place of a held-out one,
the convex hull in place of a shape.

A method with a lower score shows nothing of its data that these do not show; `below` says so in a sentence.
"""

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, Delaunay, QhullError
from torch import Tensor
from torch.nn.functional import interpolate

from ..datasets.scene import Scene
from ..geometry import evenly
from ..readers.views import distances, pose_points

MAX_AVERAGED = 64  # training photographs in the mean picture
Picture = Float[Tensor, "height width 3"]


def below(place: object, name: str, score: float, baselines: Mapping[str, float], complete: bool = False) -> str | None:
    """Sentence for a score that is lower than the best trivial baseline; None for another one.

    name: unit of the score; complete: whether longer training would change nothing
    """
    best = max(baselines, key=lambda one: baselines[one], default=None)
    if best is None or score >= baselines[best]:
        return None
    longer = "" if complete else "train for longer, or "
    return (
        f"{place} has {score:.2f} {name}, and the {best} alone, which needs no training, {baselines[best]:.2f}; "
        f"{longer}compare another method on these data"
    )


def in_hull(vertices: Float[np.ndarray, "vertex 3"], points: Float[Tensor, "point 3"]) -> Bool[Tensor, " point"] | None:
    """Mask of the points inside the convex hull of vertices; None for flat ones."""
    try:
        hull = Delaunay(vertices[ConvexHull(vertices).vertices])
    except (QhullError, ValueError):
        return None
    return torch.from_numpy(hull.find_simplex(points.numpy()) >= 0)


class Baselines:
    """Stand-ins for the held-out photographs of a scene, made of the photographs that a method had.

    evidence: number of training photographs that the method was given, evenly spread; None for all
    """

    def __init__(self, scene: Scene, evidence: int | None = None):
        train = scene.splits["train"].tolist() if "train" in scene.splits else []
        self.scene = scene
        self.train = evenly(train, evidence or len(train))
        self.points = pose_points(scene.cameras)
        self._mean: Picture | None = None

    def of(self, index: int, size: tuple[int, int]) -> dict[str, Picture]:
        """Stand-ins for a photograph, by name. size: (height, width)"""
        if not self.train:
            return {}
        if self._mean is None:
            shape = tuple(self.scene.cameras.size[self.train[0]].flip(0).tolist())
            pictures = [self._picture(i, shape) for i in evenly(self.train, MAX_AVERAGED)]
            self._mean = torch.stack(pictures).mean(0)
        others = [i for i in self.train if i != index]
        near = others[int(distances(self.points[others], self.points[index]).argmin())] if others else self.train[0]
        return {"mean photograph": resized(self._mean, size), "nearest photograph": self._picture(near, size)}

    def _picture(self, index: int, size: tuple[int, int]) -> Picture:
        """A photograph at a size; pixels that its mask rules out have the mean colour of the others."""
        shot = self.scene.photograph(index)
        picture = shot.before(self.scene.frame.background)
        if shot.mask is not None and shot.mask.any():
            picture = torch.where(shot.mask[..., None], picture, picture[shot.mask].mean(0))
        return resized(picture, size)


def resized(picture: Picture, size: tuple[int, int]) -> Picture:
    if tuple(picture.shape[:2]) == tuple(size):
        return picture
    return interpolate(picture.permute(2, 0, 1)[None], size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
