"""Building blocks that several methods share: fields, sampling, clouds of Gaussians, training."""
