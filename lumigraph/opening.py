"""Opening of what a user names as a dataset, by its path or prefix.

Photographs become a Scene, meshes are Shapes, folders of either a Collection; a world of blocks, words and procedural
scenes have kinds of their own.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from . import synthetic
from .datasets.collection import Collection
from .datasets.dataset import Dataset
from .datasets.scene import Scene
from .datasets.shapes import Shapes
from .datasets.words import WORDS, Words
from .datasets.world import BlockLabels, BlockWorld
from .errors import LumigraphError
from .exchange import refuse_several
from .files import exists, expanded
from .files.names import natural
from .files.ranges import typed
from .files.reading import reads
from .readers import READERS, choose_reader, meshes, minecraft, single_image
from .readers.assemble import Before, assemble
from .readers.bones import with_bones
from .readers.capture import Capture
from .readers.inner_depth import with_inner_depth
from .readers.masks import with_masks
from .readers.part import CapturePart, part_of
from .readers.pictures import list_images
from .readers.raw import with_raw
from .readers.surveyed import with_surveyed
from .readers.tracks import with_tracks
from .readers.unposed import Unposed
from .readers.unposed import unposed as without_poses
from .readers.views import multiscale, with_all_views, with_fewer_views

PROCEDURAL = "procedural:"
KINDS: dict[str, type[Any]] = {kind.kind: kind for kind in (Scene, Shapes, Collection, BlockWorld, Words)}


@reads()
def open_dataset(source: str | Path, wanted: type[Any] | None = None, **options: Any) -> Dataset:
    """Open a source of any kind as a dataset.

    wanted:  the kind to open it as, where it can be several: Scene, Shapes or Collection; see `kind_of`
    options: those of `open_scene` for photographs, also for those in a collection; `partial` of
             `read_shapes`; `guidance` of `Words.read`
    Raises LumigraphError for anything that keeps the source from becoming a dataset.
    """
    kind, path = kind_of(source, wanted), folder_of(expanded(source))
    if kind is Collection:
        many = sources_of(source)
        return Collection.of({name: partial(open_dataset, one, **options) for name, one in many.items()}, str(source))
    if kind is Shapes:
        some_sides = bool(options.pop("partial", None))
        only_of_photographs(source, kind, options)
        return meshes.read_shapes(path, some_sides)
    if kind is Words:
        guidance = options.pop("guidance", None)
        only_of_photographs(source, kind, options)
        return Words.read(str(source), guidance)
    return open_scene(source, **options)


def only_of_photographs(source: str | Path, kind: type[Any], options: dict[str, Any]) -> None:
    """Raise LumigraphError for options of `open_scene` with a source of another kind."""
    if told := [name for name, value in options.items() if value not in (None, 1)]:
        name = told[0].replace("_", "-")
        raise LumigraphError(f"{source} holds {kind.kind}, and --{name} is about photographs; leave it out")


@reads()
def kind_of(source: str | Path, wanted: type[Any] | None = None) -> type[Any]:
    """Kind of dataset that `open_dataset` makes of a source, without opening it.

    A mesh, and a folder of meshes, are Shapes. A folder of several scenes or shapes is a Collection where it is no
    scene itself, or where one is wanted; so is a procedural category of objects. Everything else is left to the readers
    of photographs. Raises LumigraphError for a path that does not exist.
    """
    path = folder_of(expanded(source))
    if str(source).startswith(WORDS):
        return Words
    if (request := requested(source)) is not None:
        if synthetic.is_collection(request):
            return Collection
        return BlockWorld if synthetic.is_block_world(request) else Scene
    if not exists(path):
        raise LumigraphError(f"{path} does not exist; check the path")
    if minecraft.recognises(path):
        return BlockWorld
    if wanted is Collection and members_of(path):
        return Collection
    if path.is_dir() and any(reader.recognises(path) for reader in READERS.values()):
        return Scene
    if not list_images(path):
        refuse_several(path)
    if meshes.recognises(path) or (wanted is Shapes and any(map(meshes.is_mesh, path.rglob("*")))):
        return Shapes
    return Collection if len(members_of(path)) > 1 else Scene


def folder_of(path: Path) -> Path:
    """Folder of a capture for one of the files by which a reader recognises it; any other path unchanged."""
    if not path.is_file():
        return path
    listed = (name for reader in READERS.values() for names in reader.EXPECTED_FILES.values() for name in names)
    return next((path.absolute().parents[name.count("/")] for name in listed if path.match(name)), path)


def sources_of(collection: str | Path) -> dict[str, str]:
    """Source of each member of a collection for `open_dataset`, by its name."""
    if (request := requested(collection)) is None:
        return {name: str(place) for name, place in members_of(expanded(collection)).items()}
    return {name: f"{PROCEDURAL}{one}" for name, one in synthetic.members_of(request).items()}


def requested(source: str | Path) -> str | None:
    """Request after "procedural:"; None for a path."""
    return str(source).removeprefix(PROCEDURAL) if str(source).startswith(PROCEDURAL) else None


def members_of(folder: Path) -> dict[str, Path]:
    """The folders with poses, the folders of meshes and the meshes that lie in a folder, by name."""
    if not folder.is_dir():
        return {}
    readers = [reader.recognises for reader in READERS.values()]
    found = [
        path
        for path in folder.iterdir()
        if meshes.recognises(path) or (path.is_dir() and any(recognises(path) for recognises in readers))
    ]
    found.sort(key=lambda path: natural(path.name))
    return {path.stem if path.is_file() else path.name: path for path in found}


@reads()
def open_scene(
    source: str | Path,
    downscale: int | None = None,
    reader: str | None = None,
    memory: int | None = None,
    cache: Path | None = None,
    views: int | None = None,
    scales: int = 1,
    before: Before | None = None,
    whole: bool | None = None,
    part: CapturePart | dict[str, Any] | None = None,
    unposed: Unposed | dict[str, Any] | None = None,
    depth_from: str | Path | None = None,
) -> Scene:
    """The Scene in a folder of posed photographs, a single picture as a scene, or a procedural one.

    source:    a folder, an image file, or "procedural:<name>"
    downscale: factor of the reduction from the size of calibration; None gives 1100 pixels where there are over 1320
    reader:    a name of `readers.NAMES`; None looks into the folder
    memory:    bytes of images to keep in memory, before they go to a file; None means a share of the machine's
    cache:     where that file goes; None means the user's cache folder
    views:     learn from so many photographs, spread evenly over the cameras; None means all
    scales:    every photograph so many times, each half as large as the one before; see `multiscale`
    before:    how they were opened for a run; see `Before`
    whole:     learn from every photograph, also from those that test, unless the source itself says which do
    part:      some photographs of a large capture alone, of one place in it
    depth_from: a cloud or a mesh, in the frame of the photographs' poses, that gives their depth
    unposed:   leave out the poses of a depth camera's frames, for they are to be found; options of `unposed.unposed`
    Raises LumigraphError for anything that keeps the photographs from becoming a scene.
    """
    if requested(source) is not None:
        capture = read_capture(source)
    elif single_image.recognises(path := folder_of(expanded(source))):
        capture, downscale = single_image.read(path, downscale), 1  # it is reduced by now
    else:
        capture = read_capture(source, reader)
    if unposed is not None:
        capture = without_poses(capture, typed(Unposed, unposed, str(source)) if isinstance(unposed, dict) else unposed)
    if capture.poseless:
        raise LumigraphError(
            f"{source} has colours and depth without poses; find them from both: lumigraph track splat-slam "
            f"{source}, or from the colours alone: lumigraph capture {source}"
        )
    if part is not None:
        capture = part_of(capture, typed(CapturePart, part, str(source)) if isinstance(part, dict) else part)
    if depth_from is not None:
        capture = with_surveyed(capture, expanded(depth_from))
    scene = assemble(capture, downscale, memory, cache, before)
    if whole and not any(shot.split for shot in capture.shots):
        scene = with_all_views(scene)
    if views is not None:
        scene = with_fewer_views(scene, views)
    options = {"downscale": downscale, "reader": reader, "views": views, "scales": scales}
    return replace(multiscale(scene, scales, memory, cache), options=options)


def confirm(source: str | Path) -> None:
    """Raise LumigraphError if a source has no training data for any method."""
    if (request := requested(source)) is not None:
        synthetic.confirm(request)
        return
    if str(source).startswith(WORDS):
        return
    path = folder_of(expanded(source))
    if path.is_dir() and not list_images(path) and not members_of(path):
        choose_reader(path)


@reads()
def read_capture(source: str | Path, reader: str | None = None) -> Capture:
    """Photographs with poses as a reader finds them, without pixels. source, reader: as of `open_scene`"""
    if (request := requested(source)) is not None:
        return synthetic.read(request)
    path = folder_of(expanded(source))
    chosen = minecraft if path.is_file() and minecraft.recognises(path) else choose_reader(path, reader)
    if chosen is minecraft:  # whose pictures are traced
        labels, notes = minecraft.read(path)
        return replace(synthetic.block_capture(BlockLabels(labels), str(path)), notes=notes)
    capture = with_bones(with_tracks(chosen.read(path), path), path)
    return with_inner_depth(with_raw(with_masks(capture, path), path))
