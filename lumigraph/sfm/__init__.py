"""Structure from motion: where bare photographs were taken from."""

from .reconstruction import MotionOptions, reconstruct
from .rig import capture_rig, is_rig

__all__ = ["MotionOptions", "capture_rig", "is_rig", "reconstruct"]
