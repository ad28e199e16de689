"""Gaussians: a cloud in any frame, and how a camera sees it."""

from .cloud import Gaussians as Gaussians
from .cloud import turned as turned
