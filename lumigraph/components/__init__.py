"""Building blocks shared by several methods: fields, sampling, clouds of Gaussians, training."""

from ..system import kernel_cache as kernel_cache
