"""Lumigraph: photographs become radiance fields, and radiance fields become new views."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from . import threads

if TYPE_CHECKING:
    from .camera import Camera as Camera
    from .capture import open_dataset as open_dataset
    from .capture import open_scene as open_scene
    from .collection import Collection as Collection
    from .dataset import Dataset as Dataset
    from .errors import LumigraphError as LumigraphError
    from .gaussians import Gaussians as Gaussians
    from .lens import Lens as Lens
    from .method import Method as Method
    from .method import RayMethod as RayMethod
    from .rays import Rays as Rays
    from .rays import Rendering as Rendering
    from .rays import Samples as Samples
    from .run import Opened as Opened
    from .run import Run as Run
    from .run import open_any as open_any
    from .scene import Scene as Scene
    from .shapes import Shapes as Shapes
    from .train import fit as fit
    from .volume import composite as composite

__version__ = "0.1.0"

threads.settle()  # before anything below loads PyTorch
threads.share_one_pool()

_homes = {
    "Camera": "camera",
    "Collection": "collection",
    "Dataset": "dataset",
    "Gaussians": "gaussians",
    "Lens": "lens",
    "LumigraphError": "errors",
    "Method": "method",
    "RayMethod": "method",
    "Opened": "run",
    "Rays": "rays",
    "Rendering": "rays",
    "Run": "run",
    "Samples": "rays",
    "Scene": "scene",
    "Shapes": "shapes",
    "composite": "volume",
    "fit": "train",
    "open_any": "run",
    "open_dataset": "capture",
    "open_scene": "capture",
}
__all__ = sorted(_homes)


def __getattr__(name: str) -> Any:
    """Load a public name when it is first asked for, so that `lumigraph --help` need not wait for PyTorch."""
    if name not in _homes:
        raise AttributeError(f"module 'lumigraph' has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_homes[name]}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
