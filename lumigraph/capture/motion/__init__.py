"""Structure from motion: where bare photographs were taken from."""

from .reconstruction import MotionOptions, reconstruct

__all__ = ["MotionOptions", "reconstruct"]
