"""Growth: from strokes to a part of the scene (Goel 2023, sections 3.2 and 3.3).

Clusters of the features under the strokes, by k-means; each point is matched with the nearest cluster; the match is
smoothed by a bilateral filter on the graph of neighbours, and the part grows from the strokes over neighbours of it.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.vq import kmeans2
from scipy.sparse import csr_matrix, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

MAX_ITERATIONS = 200  # of conjugate gradients
CLUSTERS = 8  # of each kind of strokes, at most
MIN_SPREAD = 0.3  # distance in feature space within which features are alike, however plain the stroke


@dataclass(frozen=True)
class GrowthNumbers:
    """Numbers of region growing.

    tolerance: of a match without negative strokes, in spreads of the features under the strokes
    sharpness: of the match, as a logistic function
    feature_deviation, space_deviation: of the bilateral weights, in spreads and in local spacings of points
    match_weight: of a point's own match, relative to its neighbours' weights
    reach:     distance from the wanted strokes beyond which nothing matches, in extents of these strokes
    max_gap:   largest distance of neighbours over which the part grows, in local spacings
    """

    tolerance: float = 3.0
    sharpness: float = 6.0
    feature_deviation: float = 0.7
    space_deviation: float = 1.5
    match_weight: float = 0.01
    reach: float = 1.2
    max_gap: float = 4.0


Features = Float[np.ndarray, "point feature"]
Seeds = Int[np.ndarray, "_"]  # indices of points; two kinds of strokes have different numbers


def clusters(features: Features, seeds: Seeds) -> Float[np.ndarray, "cluster feature"]:
    """Centres of k-means of the features at the seeds."""
    some = features[seeds].astype(np.float64)
    count = min(CLUSTERS, len(np.unique(some, axis=0)))
    if count <= 1:
        return some[:1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty cluster keeps its centre, which is a feature
        centres, label = kmeans2(some, count, minit="++", seed=0)
    return centres[np.unique(label)]


def nearest(features: Features, centres: Float[np.ndarray, "cluster feature"]) -> Float[np.ndarray, " point"]:
    """Distance of each feature to the nearest centre."""
    return cKDTree(centres).query(features, workers=-1)[0]


def matched(
    positions: Float[np.ndarray, "point 3"], features: Features, wanted: Seeds, unwanted: Seeds, numbers: GrowthNumbers
) -> tuple[Float[np.ndarray, " point"], float]:
    """Match of each point in [-1, 1], above 0 for points nearer to wanted clusters, and the spread of the features
    under the wanted strokes. Without unwanted strokes, a fixed distance of `tolerance` spreads replaces theirs. The
    match falls with the distance from the strokes, which users draw about as long as the object."""
    near = nearest(features, clusters(features, wanted))
    spread = max(float(np.quantile(near[wanted], 0.9)), MIN_SPREAD)
    limit = numbers.tolerance * spread
    far = np.minimum(nearest(features, clusters(features, unwanted)), limit) if len(unwanted) else limit
    low, high = np.quantile(positions[wanted], [0.05, 0.95], axis=0)
    extent = max(float(np.linalg.norm(high - low)), 1e-9)
    away = nearest(positions, positions[wanted]) / (numbers.reach * extent)
    return (far - near) / np.maximum(far + near, 1e-9) - away**2, spread


def bilateral(
    features: Features,
    neighbours: Int[np.ndarray, "point neighbour"],
    distances: Float[np.ndarray, "point neighbour"],
    spread: float,
    numbers: GrowthNumbers,
) -> csr_matrix:
    """Symmetric weights of neighbours: near in space and alike in features."""
    count, each = neighbours.shape
    spacing = np.maximum(np.median(distances, 1, keepdims=True), 1e-9)
    apart = np.linalg.norm(features[:, None] - features[neighbours], axis=-1)
    exponent = (apart / (numbers.feature_deviation * spread)) ** 2
    exponent += (distances / (numbers.space_deviation * spacing)) ** 2
    weights = np.exp(-0.5 * exponent) + 1e-6
    found = csr_matrix((weights.ravel(), (np.repeat(np.arange(count), each), neighbours.ravel())), (count, count))
    return csr_matrix(found.maximum(found.T))


def walked(
    weights: csr_matrix, prior: Float[np.ndarray, " point"], wanted: Seeds, unwanted: Seeds, match_weight: float
) -> Float[np.ndarray, " point"]:
    """Probability that a random walk from each point ends at a wanted seed (Grady 2006), with each point's own match as
    a prior (Grady 2005): the minimum of sum_ij w_ij (x_i - x_j)^2 + c sum_i (x_i - p_i)^2 with x given at the seeds."""
    degree = np.asarray(weights.sum(1)).ravel()
    own = match_weight * np.maximum(degree, 1e-3)
    fixed = np.zeros(len(prior), bool)
    fixed[wanted] = fixed[unwanted] = True
    value = prior.copy()
    value[unwanted], value[wanted] = 0.0, 1.0
    free = ~fixed
    inner = weights[free]
    target = own[free] * prior[free] + inner[:, fixed] @ value[fixed]
    diagonal = degree[free] + own[free]
    system = diags_array(diagonal) - inner[:, free]
    value[free], _ = cg(system, target, value[free], rtol=1e-4, maxiter=MAX_ITERATIONS, M=diags_array(1 / diagonal))
    return value


def grown(
    positions: Float[np.ndarray, "point 3"],
    features: Features,
    neighbours: Int[np.ndarray, "point neighbour"],
    distances: Float[np.ndarray, "point neighbour"],
    wanted: Seeds,
    unwanted: Seeds,
    numbers: GrowthNumbers = GrowthNumbers(),
) -> Bool[np.ndarray, " point"]:
    """Mask of the points of the part selected by strokes.

    positions, features: of each point
    neighbours, distances: the graph; see `Distilled.graph`
    wanted, unwanted: points under the strokes
    """
    match, spread = matched(positions, features, wanted, unwanted, numbers)
    weights = bilateral(features, neighbours, distances, spread, numbers)
    prior = 1 / (1 + np.exp(-numbers.sharpness * np.maximum(match, -1)))
    inside = walked(weights, prior, wanted, unwanted, numbers.match_weight) > 0.5
    spacing = np.median(distances, 1, keepdims=True)
    joined = inside[:, None] & inside[neighbours] & (distances <= numbers.max_gap * spacing)
    rows, columns = np.nonzero(joined)
    edges = csr_matrix((np.ones(len(rows), np.int8), (rows, neighbours[rows, columns])), (len(inside),) * 2)
    _, component = connected_components(edges, directed=False)
    return inside & np.isin(component, component[wanted])
