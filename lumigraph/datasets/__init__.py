"""Training data: photographs with cameras, shapes, collections of either."""

from ..system import kernel_cache as kernel_cache
