"""Splitting of a cloud into a selected part and the rest. Unobserved surfaces are grey, not invented."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import Delaunay, QhullError, cKDTree
from torch import Tensor

from ..gaussians import Gaussians, joined
from ..gaussians.cloud import BAND_0, painted
from ..geometry import Similarity, Vector, to_quaternion
from .distilled import Distilled

UNKNOWN_COLOUR = (0.5, 0.5, 0.5)  # of surfaces that no photograph shows, sRGB-encoded
LUMA = (0.2126, 0.7152, 0.0722)
MIN_PERIMETER = 12  # pairs of neighbours across a cut, from which on it may be closed
MAX_BEND = 0.12  # deviation of the perimeter from a plane, as a share of its extent
SPACING_NEIGHBOURS = 4  # the distance to the last of which is the spacing of Gaussians beside a cut
OPEN_SPACINGS = 1.5  # spacings around a place without Gaussians, from which on it is open
CAP_SCALES = (0.6, 0.6, 0.05)  # deviations of a disc of the closing, in spacings
CAP_OPACITY = 3.0  # logit
MAX_DISCS = 20_000  # of a closing


@dataclass(frozen=True)
class Cut:
    """Selected part and rest, in the frame of the cloud, with closing discs."""

    part: Gaussians
    rest: Gaussians


def cut(gaussians: Gaussians, chosen: Bool[Tensor, " gaussian"], points: Distilled) -> Cut:
    """Part and rest of a cloud. Unobserved Gaussians, and the discs that close the cut, are grey."""
    cloud = painted(gaussians.to("cpu"), ~points.is_seen, UNKNOWN_COLOUR)
    perimeter = between(chosen, points)
    pieces = []
    for mine in (chosen, ~chosen):
        closing = closed(perimeter, points.positions[mine & points.is_seen].numpy(), cloud)
        pieces.append(cloud[mine] if closing is None else joined([cloud[mine], closing]))
    return Cut(*pieces)


def between(chosen: Bool[Tensor, " gaussian"], points: Distilled) -> Float[np.ndarray, "pair 3"]:
    """Midpoints of neighbours on different sides of the cut."""
    neighbours, distances = points.graph
    positions = points.positions[points.is_seen].numpy()
    inside = chosen[points.is_seen].numpy()
    near = distances <= 2 * np.median(distances, 1, keepdims=True)
    a, k = np.nonzero(inside[:, None] & ~inside[neighbours] & near)
    return 0.5 * (positions[a] + positions[neighbours[a, k]])


def closed(
    perimeter: Float[np.ndarray, "pair 3"], own: Float[np.ndarray, "point 3"], like: Gaussians
) -> Gaussians | None:
    """Grey discs that close a flat cut; None for a cut that is not flat, or not open.

    own: centres of the observed Gaussians on this side of the cut
    """
    if len(perimeter) < MIN_PERIMETER or len(own) <= SPACING_NEIGHBOURS:
        return None
    middle = perimeter.mean(0)
    _, deviations, axes = np.linalg.svd(perimeter - middle, full_matrices=False)
    if deviations[2] > MAX_BEND * deviations[0]:
        return None
    flat = (perimeter - middle) @ axes.T
    tree = cKDTree(own)
    beside = own[np.unique(tree.query(perimeter)[1])]
    spacing = max(float(np.median(tree.query(beside, min(SPACING_NEIGHBOURS + 1, len(own)))[0][:, -1])), 1e-6)
    spacing = max(spacing, float(np.ptp(flat[:, :2], axis=0).prod() / MAX_DISCS) ** 0.5)
    low, high = flat[:, :2].min(0), flat[:, :2].max(0)
    grid = np.stack(np.meshgrid(*(np.arange(a, b, spacing) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
    try:
        grid = grid[Delaunay(flat[:, :2]).find_simplex(grid) >= 0]
    except QhullError:  # all of the perimeter on one line
        return None
    places = middle + grid @ axes[:2]
    places = places[tree.query(places)[0] > OPEN_SPACINGS * spacing] if len(places) else places
    if not len(places):
        return None
    turn = axes.T if np.linalg.det(axes) > 0 else axes.T * [1, 1, -1]
    count, coefficients = len(places), like.harmonics.shape[1]
    discs = Gaussians(
        torch.from_numpy(places).float(),
        to_quaternion(torch.from_numpy(turn.copy())).float().expand(count, -1).clone(),
        (spacing * torch.tensor(CAP_SCALES)).log().expand(count, -1).clone(),
        torch.full((count,), CAP_OPACITY),
        torch.zeros(count, coefficients, 3),
        like.antialiased,
    )
    return painted(discs, torch.ones(count, dtype=torch.bool), UNKNOWN_COLOUR)


def tinted(gaussians: Gaussians, colour: tuple[float, float, float]) -> Gaussians:
    """The cloud in another colour, with its own light and shade. colour: sRGB-encoded, of its mean"""
    luma = gaussians.harmonics.new_tensor(LUMA)
    grey = gaussians.harmonics @ luma
    mean = float((0.5 + BAND_0 * grey[:, 0]).clamp(0, 1).mean().clamp_min(1e-3))
    ratio = gaussians.harmonics.new_tensor(colour) / mean
    harmonics = grey[..., None] * ratio
    harmonics[:, 0] += (ratio - 1) * 0.5 / BAND_0  # for c = 1/2 + sum Y h
    return replace(gaussians, harmonics=harmonics)


def motion(points: Float[Tensor, "point 3"], shift: Vector, degrees: float) -> Similarity:
    """Rotation about the vertical through the centre of points, counterclockwise from above, and a shift."""
    angle = torch.tensor(degrees, dtype=torch.float64).deg2rad()
    cosine, sine = float(angle.cos()), float(angle.sin())
    rotation = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    middle = points.double().median(0).values
    return Similarity.make(1.0, rotation, middle - rotation @ middle + torch.tensor(shift, dtype=torch.float64))
