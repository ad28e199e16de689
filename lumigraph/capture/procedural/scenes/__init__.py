"""The scenes that come with the package: one file each, found by its name."""

from __future__ import annotations

import importlib
import pkgutil

from ....errors import LumigraphError
from ..stage import Stage


def available() -> list[str]:
    return sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__))


def stage(name: str, size: int = 200, views: int = 100, seed: int = 0) -> Stage:
    """Build a scene. size: of the square pictures, pixels; views: for training; seed: fixes where cameras stand.

    Raises LumigraphError for a name that nothing here has.
    """
    if name not in available():
        raise LumigraphError(f"procedural:{name} does not exist; choose one of {', '.join(available())}")
    return importlib.import_module(f".{name.replace('-', '_')}", __name__).stage(size, views, seed)
