"""Clouds of Gaussians for other programs: those to keep of a run or file, in the frame of exports."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import LumigraphError
from ..exchange import write_gaussians
from ..exchange.fourdgs import write_moving
from ..exchange.streamed_sog import Detail
from ..gaussians import Gaussians
from ..gaussians.moving import MovingGaussians
from ..run import Opened
from ..run.files import SplatFile
from .loaded import Loaded
from .options import Keeping, Scaling, SplatsOptions


def export_splats(
    opened: Opened,
    path: Path,
    options: SplatsOptions = SplatsOptions(),
    settings: Sequence[str] = (),
    part: Keeping = Keeping(),
    scaling: Scaling = Scaling(),
) -> Gaussians:
    """Write a cloud as it is at one moment, and return it. A splat file's own numbers stay as they are.

    settings: controls, NAME=VALUE
    """
    if isinstance(opened, SplatFile):
        if settings:
            raise LumigraphError(f"{opened.path} is a file of Gaussians, which has no controls; leave out --set")
        scaling.remember(opened)
        cloud = opened.source_gaussians()
        if part.crops or part.removes:
            loaded = Loaded(opened, opened.ready("cpu"), {}, part)
            cloud = cloud[loaded.kept(cloud, loaded.crop and loaded.crop.moved(opened.frame.to_source))]
    else:
        loaded = Loaded.of(opened, "cpu", settings, part, scaling)
        cloud = loaded.gaussians().transformed(opened.frame.to_export.matrix)
    write_gaussians(path, cloud, Detail(**options.detail.given))
    return cloud


def export_moving(loaded: Loaded, path: Path, options: SplatsOptions = SplatsOptions()) -> MovingGaussians:
    """Write every moment of a scene that moves, as .4dgs, and return it. Raises LumigraphError for levels of detail."""
    if options.detail.given or options.detail.lod:
        raise LumigraphError("A .4dgs has no levels of detail; leave out --lod and its options")
    if "time" in loaded.method.settings:
        raise LumigraphError("A .4dgs holds every moment; leave out --set time, or name a .spz for one of them")
    moving = loaded.moving(options.duration)
    write_moving(path, moving.transformed(loaded.frame.to_export.matrix))
    return moving
