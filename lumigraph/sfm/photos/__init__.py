"""Bare photographs and videos, whose poses are not known yet."""

from .film import is_video
from .gather import gather, is_bare
from .photo import Intake, Photo

__all__ = ["Intake", "Photo", "gather", "is_bare", "is_video"]
