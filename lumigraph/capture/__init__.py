"""Photographs become a Scene: one reader per format, procedural scenes, and one place that finds bounds and splits."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from ..errors import LumigraphError
from ..scene import Scene
from . import blender, colmap, llff, picture, transforms
from .assemble import assemble as assemble
from .capture import Capture as Capture
from .capture import Shot as Shot
from .fewer import with_fewer_views
from .multiscale import multiscale as multiscale
from .pictures import list_images

# Asked in this order. A transforms.json comes first because someone made it on purpose, often beside the model that it
# came from; COLMAP's lenses know more than LLFF's. `reader` overrides the order.
READERS: dict[str, ModuleType] = {"transforms": transforms, "blender": blender, "colmap": colmap, "llff": llff}
PROCEDURAL = "procedural:"


def open_scene(
    source: str | Path,
    downscale: int | None = None,
    reader: str | None = None,
    memory: int | None = None,
    cache: Path | None = None,
    views: int | None = None,
    scales: int = 1,
) -> Scene:
    """The Scene in a folder of posed photographs, a single picture as a scene, or a procedural one.

    source:    a folder, an image file, or "procedural:<name>"
    downscale: how many times to reduce what the lenses were calibrated for; None reduces to at most about 1000 pixels
    reader:    transforms, blender, colmap or llff; None looks into the folder
    memory:    bytes of images to keep in memory, before they go to a file; None means a share of the machine's
    cache:     where that file goes; None means the user's cache folder
    views:     learn from so many photographs, spread evenly over the cameras; None means all
    scales:    every photograph so many times, each half as large as the one before; see `multiscale`
    Raises LumigraphError for anything that keeps the photographs from becoming a scene.
    """
    if str(source).startswith(PROCEDURAL):
        from . import procedural

        capture = procedural.read(str(source).removeprefix(PROCEDURAL))
    elif picture.recognises(path := Path(source).expanduser()):
        capture, downscale = picture.read(path, downscale), 1  # it is reduced by now
    else:
        capture = choose_reader(path, reader).read(path)
    scene = assemble(capture, downscale, memory, cache)
    if views is not None:
        scene = with_fewer_views(scene, views)
    return multiscale(scene, scales, memory, cache)


def choose_reader(folder: Path, name: str | None = None) -> ModuleType:
    """The reader that knows what lies in a folder. Raises LumigraphError if none does."""
    if not folder.exists():
        raise LumigraphError(f"{folder} does not exist; check the path")
    if not folder.is_dir():
        raise LumigraphError(
            f"{folder} is a file; name the folder that holds the photographs and their poses, "
            f"or find those of a video or of photographs first: lumigraph capture {folder}"
        )
    if not any(folder.iterdir()):
        raise LumigraphError(f"{folder} is empty; name a folder that holds photographs and their poses")
    if name is not None and name not in READERS:
        raise LumigraphError(f"there is no reader called {name}; there are {', '.join(READERS)}")
    asked = READERS if name is None else {name: READERS[name]}
    for reader in asked.values():
        if reader.recognises(folder):
            return reader
    pictures = len(list_images(folder))
    raise LumigraphError(
        f"{folder} holds no camera poses ({pictures} images were found): looked for "
        f"{'; '.join(reader.LOOKED_FOR for reader in asked.values())}; find the poses first: lumigraph capture {folder}"
    )
