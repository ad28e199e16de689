"""The scenes that come with the package: one file or folder each, found by its name."""

import importlib
import pkgutil
from types import ModuleType
from typing import Any

from ...errors import LumigraphError
from .. import categories
from ..stage import Pictures, SyntheticStage


def available() -> list[str]:
    return sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__))


def options(name: str) -> type[Pictures]:
    """Options of a scene. Raises LumigraphError for an unknown name."""
    return getattr(scene(name), "Options", Pictures)


def stage(name: str, size: int = 200, views: int = 100, seed: int = 0, **further: Any) -> SyntheticStage:
    """Build a scene. size: of the pictures, pixels; views: for training; seed: of the camera positions; further: its
    other `Options`. Raises LumigraphError for an unknown name."""
    return scene(name).stage(size, views, seed, **further)


def scene(name: str) -> ModuleType:
    if name not in available():
        raise LumigraphError(
            f"procedural:{name} does not exist; choose one of {', '.join(available())}, "
            f"or of the collections {', '.join(categories.available())}"
        )
    return importlib.import_module(f".{name.replace('-', '_')}", __name__)
