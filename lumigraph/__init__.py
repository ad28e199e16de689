"""Lumigraph: photographs become radiance fields, and radiance fields become new views."""

from __future__ import annotations

from .system.isolation import ignore_working_directory

ignore_working_directory()  # before the imports below

import importlib  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from .system import threads  # noqa: E402

if TYPE_CHECKING:
    from .api import Model as Model
    from .api import call as call
    from .api import capture as capture
    from .api import open as open
    from .api import sample as sample
    from .api import train as train
    from .camera import Camera as Camera
    from .camera.lens import Lens as Lens
    from .camera.rays import Rays as Rays
    from .camera.rays import Rendering as Rendering
    from .camera.rays import Samples as Samples
    from .commands.results import Evaluation as Evaluation
    from .commands.results import Exported as Exported
    from .commands.results import Film as Film
    from .datasets.collection import Collection as Collection
    from .datasets.dataset import Dataset as Dataset
    from .datasets.scene import Scene as Scene
    from .datasets.shapes import Shapes as Shapes
    from .errors import LumigraphError as LumigraphError
    from .gaussians import Gaussians as Gaussians
    from .gaussians.rasterization import rasterization as rasterization
    from .gsplat import rasterization_2dgs as rasterization_2dgs
    from .large import open_any as open_any
    from .method import Method as Method
    from .method import RayMethod as RayMethod
    from .opening import open_dataset as open_dataset
    from .opening import open_scene as open_scene
    from .run import Opened as Opened
    from .run import Run as Run
    from .training.loop import fit as fit
    from .volume import composite as composite

__version__ = "0.1.0"

threads.settle()  # before anything below loads PyTorch
threads.share_one_pool()

_homes = {
    "Camera": "camera",
    "Collection": "datasets.collection",
    "Dataset": "datasets.dataset",
    "Evaluation": "commands.results",
    "Exported": "commands.results",
    "Film": "commands.results",
    "Gaussians": "gaussians",
    "Lens": "camera.lens",
    "LumigraphError": "errors",
    "Method": "method",
    "Model": "api",
    "RayMethod": "method",
    "Opened": "run",
    "Rays": "camera.rays",
    "Rendering": "camera.rays",
    "Run": "run",
    "Samples": "camera.rays",
    "Scene": "datasets.scene",
    "Shapes": "datasets.shapes",
    "call": "api",
    "capture": "api",
    "composite": "volume",
    "fit": "training",
    "open": "api",
    "open_any": "large",
    "open_dataset": "opening",
    "open_scene": "opening",
    "rasterization": "gaussians.rasterization",
    "sample": "api",
    "rasterization_2dgs": "gsplat.rendering",
    "train": "api",
}
__all__ = sorted(_homes)


def __getattr__(name: str) -> Any:
    """Load a public name when it is first asked for, so that `lumigraph --help` need not wait for PyTorch."""
    if name not in _homes:
        raise AttributeError(f"module 'lumigraph' has no attribute {name!r}")
    home = importlib.import_module(f".{_homes[name]}", __name__)
    value = getattr(home, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
