"""`lumigraph view`: a trained scene in the browser."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from ..ranges import Port
from ..signals import until_interrupted
from .common import needed, option, show
from .controls import Set, open_method


@dataclass(frozen=True)
class ViewCommand:
    """Look at a run, a splat file or a composition in the browser: fly, orbit, crop, and set paths for films.

    Gaussians are drawn by the browser, everything else here. Ctrl-C ends it. `lumigraph train --view` shows a scene
    while it is learnt.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of the run, a splat file (.ply, .spz, .sog, .glb, .splat), or a composition (.json)."""
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine alone")] = "127.0.0.1"
    """Where to listen; 0.0.0.0 lets other machines look too."""
    port: Annotated[Port | None, option("N", "8080, or the next that is free")] = None
    """Port to listen at."""
    told: Set = ()
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..viewer import Viewer, choose_address

        opened, method, cameras = open_method(self.source, self.device, self.told)
        subject = subject_of(opened, cameras, page=page_of(opened, method, cameras))
        address = choose_address(self.host, self.port)
        with until_interrupted(), Viewer(method, subject, address) as viewer:
            tell(viewer)
            viewer.serve()
        return 0


def page_of(opened: Any, method: Any, cameras: Any) -> Any:
    """What makes a page that draws a baked method in the browser; None for any other, and while it is not baked yet."""
    from .exports.volumes import browsable, is_baked

    if not is_baked(method):
        return None
    try:
        volume, _ = browsable(method)
    except LumigraphError:
        return None

    def page() -> bytes:
        from ..export.page import opening_of_scene, volume_bytes

        return volume_bytes(volume, opening_of_scene(opened.title, cameras["train"], opened.frame))

    return page


def subject_of(opened: Any, cameras: Any = None, finished: bool = True, page: Any = None) -> Any:
    """Something Opened, as the viewer wants it.

    cameras:  by split, where the method sees them otherwise
    finished: whether what is opened is what is shown, so that part of it can be saved
    page:     makes a page on which the browser draws it, where it can
    """
    from ..viewer import Subject

    return Subject(
        opened.path.name,
        opened.frame,
        cameras or opened.cameras(),
        opened.paths,
        f"lumigraph render {opened.path}",
        opened.open_scene,
        opened.metrics(),
        saver(opened) if finished else None,
        page,
    )


def saver(opened: Any) -> Any:
    """What saves a part of a cloud of Gaussians beside it, as `lumigraph clean` does: a splat file or a new run."""

    def save(name: str, crop: Any, floaters: Mapping[str, float]) -> str:
        from ..capabilities import HasGaussians, needs
        from ..gaussians.cleaning import gone, unwanted
        from ..run.picking import save_picked

        output = opened.path.parent / name
        if os.path.lexists(output):
            raise LumigraphError(f"{output} is there already; choose another name")
        reasons = unwanted(needs(opened.method(), HasGaussians).gaussians(), crop, **floaters)
        keep = ~gone(reasons)
        if not keep.any():
            raise LumigraphError("No Gaussian is left; crop or clean less")
        save_picked(opened, keep, output, {"removed": {reason: int(some.sum()) for reason, some in reasons.items()}})
        return str(output)

    return save


@contextlib.contextmanager
def watching(wanted: bool, method: Any, data: Any, run: Any, host: str, port: int | None) -> Iterator[Any]:
    """A Viewer for `fit(..., watch=...)` while it trains a run; None if nobody wants to look."""
    if not wanted:
        yield None
        return
    import dataclasses

    from ..viewer import Viewer, choose_address

    subject = subject_of(run, finished=False)
    if run.photographed:
        subject = dataclasses.replace(subject, open_scene=lambda: data)
    with Viewer(method, subject, choose_address(host, port), training=True) as viewer:
        tell(viewer)
        yield viewer


def keep_showing(viewer: Any, signal: int | None) -> None:
    """After training: go on until Ctrl-C, unless that is what ended it."""
    if viewer is not None and signal is None:
        viewer.end_training()
        with until_interrupted():
            viewer.serve()


def tell(viewer: Any) -> None:
    show({"view": f"{viewer.address.url} (Ctrl-C ends it)"})
