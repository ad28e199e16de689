"""Gaussians: a cloud in any frame, how a camera sees it, what it is cleaned of, and several as one."""

from .cloud import Gaussians as Gaussians
from .cloud import turned as turned
from .joining import joined as joined
from .merging import simplified as simplified
