"""Structure from motion: where bare photographs were taken from."""

from .reconstruct import Options, reconstruct

__all__ = ["Options", "reconstruct"]
