"""Gaussians: a cloud in any frame, how a camera sees it, and what it is cleaned of."""

from .cloud import Gaussians as Gaussians
from .cloud import turned as turned
