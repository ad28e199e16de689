"""Colour models of an object and of its surroundings: two mixtures of Gaussians (Rother 2004, section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.cluster.vq import kmeans2

COMPONENTS = 10  # Gaussians of a mixture
MIN_PIXELS = 50  # per Gaussian
MIN_DEVIATION = 2.0  # units of CIELAB by which colours of one surface differ at the least
MAX_SAMPLES = 20_000  # pixels from which a mixture is learnt


@dataclass(frozen=True)
class Mixture:
    """A mixture of Gaussians over CIELAB colours."""

    weights: Float[np.ndarray, " kind"]
    means: Float[np.ndarray, "kind 3"]
    roots: Float[np.ndarray, "kind 3 3"]  # of the inverse covariances

    @staticmethod
    def of(colours: Float[np.ndarray, "pixel 3"]) -> Mixture:
        """The mixture that k-means finds in some colours."""
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
