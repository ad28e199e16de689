"""Photographs and videos without poses."""

from .gather import gather, is_bare
from .photo import Intake, Photo
from .video import is_video

__all__ = ["Intake", "Photo", "gather", "is_bare", "is_video"]
