"""Structure from motion: where bare photographs were taken from."""

from .reconstruction import Options, reconstruct

__all__ = ["Options", "reconstruct"]
