"""Segmentation of an object in all its photographs at once, by its colours and as the silhouette of one solid body.

After Campbell, Vogiatzis, Hernández and Cipolla 2010 ("Automatic object segmentation from calibrated images"): the
region that all cameras fixate is the first estimate. Then colour models are learnt, photographs are cut, and the cuts
carve cells of space, repeatedly. Here cuts go through superpixels, and a table plane fitted to sparse points bounds the
object from below.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.cluster.vq import kmeans2
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from torch import Tensor

from ...errors import LumigraphError
from ...geometry import evenly
from ...system.progress import track
from .view import GRID_SIDE, ObjectView, Region, find_region

MAX_DISAGREEMENTS = (0.35, 0.3, 0.25, 0.2, 0.15, 0.15)  # share of the views that may see past a cell, round by round
CORE_RADIUS = 0.35  # of the region's radius: where colours are first learnt, without sparse points
SHADOW_SHARE = 0.25  # share of surrounding colours that also count as shaded
SHADOW_BRIGHTNESS = 0.35  # of the darkest shadow
PLAIN_SHARE, PLAIN_DISTANCE = 0.8, 3.0  # share of a plain backdrop within this CIELAB distance of its median
BODY_LOG_LIKELIHOOD = 2.5  # log-likelihood added to the pixels that a body covers
MAX_COLOUR_LOG_LIKELIHOOD = 4.0  # limit of the evidence of colours alone
MAX_REST_DEVIATION = 4.0  # CIELAB units by which photographs may differ at a pixel that shows a background at rest
COLOUR_RANGE = 50.0  # CIELAB units along each axis, over which an object's colours spread
MIN_REST_VIEWS, MAX_REST_VIEWS = 3, 24  # photographs that show it at a pixel; photographs that are compared
MIN_REST_SHARE = 0.8  # share of the background's pixels that agree with it
SURE_REST = 3.0  # log-likelihood ratio of pixels that are background wherever they lie
REST_PIXELS = 3  # by which an outline may grow
MIN_CELLS = 20  # of a body
MIN_OVERLAP = 0.75  # of a cut with the body, below which a warning names the photograph
Patches = np.ndarray  # bool: which superpixels of one picture; each picture has a number of its own
Mask = Bool[np.ndarray, "height width"]
COMPONENTS = 10  # Gaussians of a mixture
MIN_PIXELS = 50  # per Gaussian
MIN_DEVIATION = 2.0  # units of CIELAB by which colours of one surface differ at the least
MAX_SAMPLES = 20_000  # pixels from which a mixture is learnt
CAPACITY_SCALE = 1000  # of capacity to one of cost: the flow counts in whole numbers
SMOOTHNESS = 3.0  # cost of an outline along one pixel where colours do not change
MAX_COST = 30.0  # the largest of these costs


@dataclass(frozen=True)
class Mixture:
    """A mixture of Gaussians over CIELAB colours; the object and its surroundings have one each (Rother 2004, 3.1)."""

    weights: Float[np.ndarray, " kind"]
    means: Float[np.ndarray, "kind 3"]
    roots: Float[np.ndarray, "kind 3 3"]  # of the inverse covariances

    @staticmethod
    def of(colours: Float[np.ndarray, "pixel 3"]) -> Mixture:
        """Fit a mixture to colours by k-means."""
        chance = np.random.default_rng(0)
        some = colours[chance.permutation(len(colours))[:MAX_SAMPLES]].astype(np.float64)
        count = int(np.clip(len(some) // MIN_PIXELS, 1, COMPONENTS))
        means, kinds = kmeans2(some, count, minit="++", seed=0)
        found = [k for k in range(count) if (kinds == k).sum() > 3]
        weights = np.array([(kinds == k).mean() for k in found])
        spreads = [np.cov(some[kinds == k].T) + MIN_DEVIATION**2 * np.eye(3) for k in found]
        roots = np.stack([np.linalg.cholesky(np.linalg.inv(spread)) for spread in spreads])
        return Mixture(weights, means[found], roots)

    def log_likelihood(self, colours: Float[np.ndarray, "*pixel 3"]) -> Float[np.ndarray, "*pixel"]:
        """Natural logarithm of the density of each colour."""
        likely = np.zeros(colours.shape[:-1])
        for weight, mean, root in zip(self.weights, self.means, self.roots, strict=True):
            away = (colours - mean) @ root
            likely += weight * np.linalg.det(root) * np.exp(-0.5 * np.square(away).sum(-1))
        return np.log(likely / (2 * np.pi) ** 1.5 + 1e-12)


@dataclass(frozen=True)
class Segmentation:
    """Result of a segmentation.

    views:    the photographs, small
    inside:   superpixels of each that belong to the object;  masks: its pixels
    body:     cells of space that the object fills
    overlaps: intersection over union of each cut and the body's silhouette
    distinct: accuracy of classifying superpixels by colour alone; 0.5 is chance
    """

    views: list[ObjectView]
    inside: list[Patches]
    masks: list[Mask]
    body: Float[Tensor, "cell 3"]
    region: Region
    overlaps: Float[np.ndarray, " view"]
    distinct: float

    @property
    def doubtful(self) -> list[str]:
        """Names of photographs whose cut disagrees with the others'."""
        return [view.name for view, overlap in zip(self.views, self.overlaps, strict=True) if overlap < MIN_OVERLAP]


def segment(views: Sequence[ObjectView], points: Float[Tensor, "point 3"] | None) -> Segmentation:
    """Segment the object in all views.

    points: sparse points, in the scene's frame
    Raises LumigraphError if no body agrees with the cuts.
    """
    region = find_region(views, points)
    if len(region.cells) < MIN_CELLS:
        raise LumigraphError("The photographs do not look at one thing together, so there is no object to find")
    allowed = [view.mean((view.shadow(region.cells, region.size) > 0.5).astype(float)) > 0.5 for view in views]
    shown = [behind(region, view) for view in views]
    body = first_guess(region, points)
    shares = [view.mean(view.shadow(body, region.size)) for view in views]
    inside = [share > 0.5 for share in shares]
    strength = 0.0  # at first the body is a guess, and only colours speak
    for slack in track(MAX_DISAGREEMENTS, "Cutting the object out", len(MAX_DISAGREEMENTS)):
        own, around = learn_colours(views, inside)
        resting = at_rest(views, [own[view.patches] for view, own in zip(views, inside, strict=True)])
        inside = []
        for view, share, may, still in zip(views, shares, allowed, resting, strict=True):
            colour = around.log_likelihood(view.colours) - own.log_likelihood(view.colours) + view.mean(still)
            costs = colour.clip(-MAX_COLOUR_LOG_LIKELIHOOD, MAX_COLOUR_LOG_LIKELIHOOD) - strength * (2 * share - 1)
            inside.append(cut(view, np.where(may, costs, MAX_COST)))
        body = carved(region, shown, inside, slack)
        shares = [view.mean(view.shadow(body, region.size)) for view in views]
        strength = BODY_LOG_LIKELIHOOD
    overlaps = np.array([overlap(view, a, b > 0.5) for view, a, b in zip(views, inside, shares, strict=True)])
    told_apart = distinctness(views, inside, own, around)
    return Segmentation(list(views), inside, outlined(views, inside), body, region, overlaps, told_apart)


def at_rest(views: Sequence[ObjectView], masks: Sequence[Mask]) -> list[Float[np.ndarray, "height width"]]:
    """Log-likelihood ratios of pixels for a background at rest in the picture: plain, or behind a subject that turns.

    ln N(colour; median, deviation) + 3 ln COLOUR_RANGE, of the views that show background at a pixel. 0 where they are
    few or differ, and everywhere where much of the background disagrees, or photographs differ in size.
    masks: of the object so far
    """
    nothing = [np.zeros(mask.shape) for mask in masks]
    if len({mask.shape for mask in masks}) > 1:
        return nothing
    some = evenly(range(len(views)), MAX_REST_VIEWS)
    stack, own = np.stack([views[i].lab for i in some]).astype(np.float32), np.stack([masks[i] for i in some])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a pixel that is inside in all views has no median
        middle = np.nanmedian(np.where(own[..., None], np.nan, stack), 0)
        spread = np.nanmedian(np.where(own, np.nan, np.linalg.norm(stack - middle, axis=-1)), 0)
    deviation = np.maximum(spread, MIN_DEVIATION)
    known = ((~own).sum(0) >= MIN_REST_VIEWS) & (deviation < MAX_REST_DEVIATION)
    found, limit = [], MAX_COLOUR_LOG_LIKELIHOOD
    for view in views:
        away = np.linalg.norm(view.lab - middle, axis=-1) / deviation
        ratio = 3 * np.log(COLOUR_RANGE / (deviation * (2 * np.pi) ** 0.5)) - 0.5 * away**2
        found.append(np.where(known, ratio.clip(-limit, limit), 0.0))
    agreeing = [(ratio > 0)[~mask].mean() for ratio, mask in zip(found, masks, strict=True) if not mask.all()]
    return found if agreeing and np.mean(agreeing) >= MIN_REST_SHARE else nothing


def outlined(views: Sequence[ObjectView], inside: Sequence[Patches]) -> list[Mask]:
    """Masks of the superpixels, corrected by pixels before a background at rest: outside is what agrees with it and is
    connected to the outside, or agrees surely; inside is what disagrees close to the object."""
    masks, found = [own[view.patches] for view, own in zip(views, inside, strict=True)], []
    for mask, ratio in zip(masks, at_rest(views, masks), strict=True):  # once: a vase looks alike from all sides
        smooth = ndimage.gaussian_filter(ratio, 1.0)
        outside = ndimage.binary_propagation(~mask, mask=~mask | (smooth > 0)) | (smooth > SURE_REST)
        found.append(ndimage.binary_dilation(~outside, mask=~outside | (smooth < 0), iterations=REST_PIXELS))
    return found


def distinctness(views: Sequence[ObjectView], inside: Sequence[Patches], own: Mixture, around: Mixture) -> float:
    """Balanced accuracy of classifying superpixels by colour alone."""
    likely = [own.log_likelihood(view.colours) > around.log_likelihood(view.colours) for view in views]
    told, true = np.concatenate(likely), np.concatenate(list(inside))
    return 0.5 * float(told[true].mean() + (~told[~true]).mean())


def first_guess(region: Region, points: Float[Tensor, "point 3"] | None) -> Float[Tensor, "cell 3"]:
    """Cells near sparse points inside the region; those near its centre without points."""
    if points is not None:
        some = points[region.holds(points)]
        if len(some) >= MIN_CELLS:
            middle = some.median(0).values
            radius = (some - middle).norm(dim=-1).median()
            return region.cells[(region.cells - middle).norm(dim=-1) <= 1.2 * radius]
    middle = region.cells.mean(0)
    away = (region.cells - middle).norm(dim=-1)
    return region.cells[away <= CORE_RADIUS * away.max()]


def learn_colours(views: Sequence[ObjectView], inside: Sequence[Patches]) -> tuple[Mixture, Mixture]:
    """Colour models of the object and of the background."""
    own = np.concatenate([view.colours[i] for view, i in zip(views, inside, strict=True)])
    around = np.concatenate([view.colours[~i] for view, i in zip(views, inside, strict=True)])
    if min(len(own), len(around)) < MIN_CELLS:
        raise LumigraphError("No object stands out from what is around it; take photographs that show it whole")
    return Mixture.of(own), Mixture.of(np.concatenate([around, shaded(around)]))


def shaded(colours: Float[np.ndarray, "patch 3"]) -> Float[np.ndarray, "shaded 3"]:
    """Colours darkened as in the object's own shadow, which occurs nowhere else; none for a plain backdrop, which
    receives no shadow. All three CIELAB numbers shrink together with light."""
    away = np.linalg.norm(colours - np.median(colours, 0), axis=-1)
    some = colours[:: round(1 / SHADOW_SHARE)] if np.quantile(away, PLAIN_SHARE) > PLAIN_DISTANCE else colours[:0]
    return some * np.random.default_rng(0).uniform(SHADOW_BRIGHTNESS, 1, (len(some), 1))


def behind(region: Region, view: ObjectView) -> Int[np.ndarray, " cell"]:
    """Superpixel at each cell's projection; -1 outside the picture."""
    places, pictured = view.at(region.cells)
    return np.where(pictured, view.patches[tuple(places.T)], -1).astype(np.int32)


def carved(
    region: Region, shown: Sequence[np.ndarray], inside: Sequence[Patches], slack: float
) -> Float[Tensor, "cell 3"]:
    """Cells inside the object in all but a share of the pictures that contain them; the largest connected piece.

    shown: by picture, the superpixel of each cell, see `behind`
    """
    past, seen = np.zeros(len(region.cells)), np.zeros(len(region.cells))
    for patch, own in zip(shown, inside, strict=True):
        seen += patch >= 0
        past += (patch >= 0) & ~own[patch]
    keep = past <= slack * seen
    grid = np.zeros((GRID_SIDE,) * 3, bool)
    index = tuple(((region.cells.numpy() + 1) / region.size).astype(int).T)
    grid[index] = keep
    pieces, _ = ndimage.label(grid)
    largest = 1 + int(np.argmax(np.bincount(pieces.ravel(), minlength=2)[1:]))
    body = region.cells[torch.from_numpy((pieces == largest)[index])]
    if len(body) < MIN_CELLS:
        raise LumigraphError("No body looks like the outlines found, so no object can be told from the rest")
    return body


def overlap(view: ObjectView, a: Bool[np.ndarray, " patch"], b: Bool[np.ndarray, " patch"]) -> float:
    """Intersection over union of two sets of superpixels, by pixels; 1 where both are empty."""
    union = view.sizes[a | b].sum()
    return float(view.sizes[a & b].sum() / union) if union else 1.0


def cut(view: ObjectView, costs: Float[np.ndarray, " patch"]) -> Bool[np.ndarray, " patch"]:
    """Mask of the superpixels of the object by a minimum cut (Boykov and Jolly 2001).

    costs: of assigning each to the object, negative log likelihood ratios, weighted by the width of a superpixel rather
           than its area, since its pixels are not independent
    Boundary terms are exp(-|a - b|^2 / 2 mean) per pixel of length, less where colours change.
    """
    count = len(costs)
    weighed = np.clip(costs, -MAX_COST, MAX_COST) * np.sqrt(view.sizes)
    a, b = view.edges.T
    apart = np.square(view.colours[a] - view.colours[b]).sum(-1)
    along = SMOOTHNESS * view.lengths * np.exp(-apart / (2 * apart.mean() + 1e-9))
    source, sink = count, count + 1
    every = np.arange(count)
    tails = np.concatenate([np.full(count, source), every, a, b])
    heads = np.concatenate([every, np.full(count, sink), b, a])
    capacity = np.concatenate([np.maximum(-weighed, 0), np.maximum(weighed, 0), along, along])
    whole = np.minimum(capacity * CAPACITY_SCALE, 2**30).astype(np.int32)
    graph = csr_matrix((whole, (tails, heads)), (count + 2, count + 2))
    left = graph - maximum_flow(graph, source, sink).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = breadth_first_order(left, source, return_predecessors=False)
    inside = np.zeros(count + 2, bool)
    inside[reached] = True
    return inside[:count]
