"""Exports: films, meshes, points, splats, panoramas, web pages."""

from ..system import kernel_cache as kernel_cache
