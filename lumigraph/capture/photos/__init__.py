"""Bare photographs and videos: what there is to work with, before anybody knows where it was taken from."""

from .gather import gather
from .photo import Intake, Photo

__all__ = ["Intake", "Photo", "gather"]
