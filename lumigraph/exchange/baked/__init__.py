"""Fields that were worked out beforehand: an octree of harmonics, an atlas of diffuse colours and features."""

from .atlas import Atlas, ViewNetwork
from .octree import Octree

__all__ = ["Atlas", "Octree", "ViewNetwork"]
