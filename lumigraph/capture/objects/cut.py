"""The outline of least cost: a minimum cut through a picture's superpixels (Boykov and Jolly 2001)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from .view import ObjectView

CAPACITY_SCALE = 1000  # of capacity to one of cost: the flow counts in whole numbers
SMOOTHNESS = 3.0  # cost of an outline along one pixel where colours do not change
MAX_COST = 30.0  # the largest of these costs


def cut(view: ObjectView, costs: Float[np.ndarray, " patch"]) -> Bool[np.ndarray, " patch"]:
    """Mask of the superpixels that belong to the object.

    costs: of taking each into it, in logarithms of likelihood; negative ones speak for it. They count by the width of a
           superpixel rather than its area, for the pixels of one are no independent witnesses
    An outline costs less where colours change: exp(-|a - b|^2 / 2 mean) to a pixel of its length.
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
