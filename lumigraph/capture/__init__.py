"""Photographs become a Scene: one reader per format, procedural scenes, and one place that finds bounds and splits."""
