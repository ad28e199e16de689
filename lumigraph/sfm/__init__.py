"""Structure from motion: camera poses of photographs without any."""

from .reconstruction import MotionOptions, reconstruct
from .rig import capture_rig, is_rig

__all__ = ["MotionOptions", "capture_rig", "is_rig", "reconstruct"]
