"""Clouds of Gaussians that learn: where they begin, how they grow, how they are smoothed."""
