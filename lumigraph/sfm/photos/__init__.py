"""Photographs and videos without poses."""

from .film import is_video
from .gather import gather, is_bare
from .photo import Intake, Photo

__all__ = ["Intake", "Photo", "gather", "is_bare", "is_video"]
