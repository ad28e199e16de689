"""Clouds of Gaussians: splatting, cleaning, joining, merging."""

from .cloud import Gaussians as Gaussians
from .cloud import joined as joined
from .cloud import turned as turned
from .merging import simplified as simplified
