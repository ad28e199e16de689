"""Building blocks that several methods share: fields, sampling, clouds of Gaussians, training."""

from ..system import kernel_cache as kernel_cache
