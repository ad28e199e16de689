"""Alignment of two sets of cameras by a similarity, and their remaining distances."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..geometry import Similarity
from .scene import Frame


def aligning(source: Camera, target: Camera) -> Similarity:
    """Similarity that aligns cameras with others of the same order, by least squares of positions and orientations
    (Procrustes; Umeyama 1991, eqs. 40 to 42).

    Directions count beside positions, so that cameras on a line, or in one place, have a solution too.
    """
    a, b = source.position.double(), target.position.double()
    turned_a, turned_b = source.pose[:, :, :3].double(), target.pose[:, :, :3].double()
    middle_a, middle_b = a.mean(0), b.mean(0)
    a, b = a - middle_a, b - middle_b
    spread = (a.norm() * b.norm()).clamp_min(1e-12) / len(a)
    u, _, vt = torch.linalg.svd(b.T @ a / spread + (turned_b @ turned_a.mT).sum(0))
    u[:, 2] *= torch.linalg.det(u @ vt)
    rotation = u @ vt
    square = float(a.square().sum())
    scale = float((b * (a @ rotation.T)).sum()) / square if square > 1e-12 else 1.0
    return Similarity.make(scale, rotation, middle_b - scale * rotation @ middle_a)


def angles(a: Float[Tensor, "camera 3 3"], b: Float[Tensor, "camera 3 3"]) -> Float[Tensor, " camera"]:
    """Angles between rotations in degrees, one by one: 2 asin(|A - B| / sqrt 8), accurate for small angles."""
    apart = torch.linalg.matrix_norm(a.double() - b.double())
    return (2 * (apart / 8**0.5).clamp(max=1).asin()).rad2deg().float()


@dataclass(frozen=True)
class Moves:
    """Distances between two lists of cameras in the same order, in one frame.

    turned:  degrees, of each camera
    shifted: percent of the longest side of the box of interest
    """

    turned: Float[Tensor, " camera"]
    shifted: Float[Tensor, " camera"]

    def __str__(self) -> str:
        (turn, shift), (most_turned, most_shifted) = self.median, self.largest
        return (
            f"{turn:.2f} degrees and {shift:.2f} % of the extent in the middle, "
            f"{most_turned:.2f} degrees and {most_shifted:.2f} % at most"
        )

    @property
    def median(self) -> tuple[float, float]:
        return float(self.turned.median()), float(self.shifted.median())

    @property
    def largest(self) -> tuple[float, float]:
        return float(self.turned.max()), float(self.shifted.max())


def moves(source: Camera, target: Camera, frame: Frame) -> Moves:
    """Distances between two aligned lists of cameras in the same order; photographs do not determine the frame."""
    there = source.to("cpu").transformed(aligning(source.to("cpu"), target.to("cpu")).matrix)
    low, high = torch.tensor(frame.bounds)
    apart = (there.position - target.position.cpu()).norm(dim=-1)
    return Moves(angles(there.pose[:, :, :3], target.pose[:, :, :3].cpu()), 100 * apart / (high - low).max())
