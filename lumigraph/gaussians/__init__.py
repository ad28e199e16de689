"""Clouds of Gaussians: splatting, cleaning, joining, merging."""

from .cloud import Gaussians as Gaussians
from .cloud import turned as turned
from .joining import joined as joined
from .merging import simplified as simplified
