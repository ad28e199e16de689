"""Shapes: meshes and clouds of points as what is learnt from."""

from .shape import PointBatch as PointBatch
from .shape import Shape as Shape
from .shape import normalised as normalised
from .shapes import Shapes as Shapes
