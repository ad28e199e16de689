"""Readers of captures and shapes: one file per layout, and the steps from a Capture to a Scene.

Bounds, scale, splits and the loading of images are in one module, `assemble`.
"""

from __future__ import annotations

import warnings
from importlib import import_module
from pathlib import Path
from types import ModuleType

from ..errors import LumigraphError, LumigraphWarning
from ..files import exists
from ..files.foreign import about_file, about_poses, is_pose_file
from ..files.readers import LISTED, NAMES, OWN_NAMES
from ..files.reading import reads
from ..system.plugins import taken
from .assemble import Before as Before
from .assemble import assemble as assemble
from .capture import Capture as Capture
from .capture import Shot as Shot
from .part import CapturePart as CapturePart
from .part import Places as Places
from .part import places_of as places_of
from .pictures import list_images
from .surveyed import describe_cloud, is_cloud
from .unposed import Unposed as Unposed
from .views import multiscale as multiscale

READERS: dict[str, ModuleType] = {n: import_module(f".{n.replace('-', '_')}", __package__) for n in OWN_NAMES}
for _name in NAMES[len(OWN_NAMES) :]:  # of other packages: modules with the same three names
    try:
        READERS[_name] = taken("readers", _name)
    except LumigraphError as _fault:
        warnings.warn(str(_fault), LumigraphWarning, stacklevel=2)


@reads()
def choose_reader(folder: Path, name: str | None = None) -> ModuleType:
    """The reader that recognises a folder. Raises LumigraphError if none does."""
    if not exists(folder):
        raise LumigraphError(f"{folder} does not exist; check the path")
    if is_cloud(folder):
        raise LumigraphError(describe_cloud(folder))
    if not folder.is_dir():
        raise LumigraphError(
            about_file(folder)
            or (about_poses(folder.parent) if is_pose_file(folder) else None)
            or f"{folder} is a file; name the folder that holds the photographs and their poses, "
            f"or find those of a video or of photographs first: lumigraph capture {folder}"
        )
    if not any(folder.iterdir()):
        raise LumigraphError(f"{folder} is empty; name a folder that holds photographs and their poses")
    if name is not None and name not in READERS:
        raise LumigraphError(f"there is no reader called {name}; there are {LISTED}")
    asked = READERS if name is None else {name: READERS[name]}
    for reader in asked.values():
        if reader.recognises(folder):
            return reader
    pictures = len(list_images(folder))
    below = (one for pattern in ("*/", "*/*/") for one in sorted(folder.glob(pattern)) if one.name[0] not in "._")
    inner = next((one for one in below if any(reader.recognises(one) for reader in asked.values())), None)
    raise LumigraphError(
        (f"{folder} holds no camera poses itself, and {inner} does; name that folder" if inner else None)
        or about_poses(folder)
        or f"{folder} holds no camera poses ({pictures} images were found); find the poses first: lumigraph capture "
        f"{folder}. Looked for {'; '.join(map(looked_for, asked.values()))}"
    )


def looked_for(reader: ModuleType) -> str:
    """Sentence part on the files by which a reader recognises a folder, for each program that writes such."""
    pairs = reader.EXPECTED_FILES.items()
    return "; ".join(f"{' and '.join(files)} ({program})" if files else program for program, files in pairs)
