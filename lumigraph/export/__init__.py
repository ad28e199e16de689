"""Exports: films, meshes, points, splats, panoramas, web pages."""
