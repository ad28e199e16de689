"""Bare photographs and videos: what there is to work with, before anybody knows where it was taken from."""

from .gather import gather, is_bare
from .photo import Intake, Photo
from .video import is_video

__all__ = ["Intake", "Photo", "gather", "is_bare", "is_video"]
