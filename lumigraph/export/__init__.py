"""Exports: films, meshes, points, splats, panoramas, pages. They know Method.render and no particular method."""
