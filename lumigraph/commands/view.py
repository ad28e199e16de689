"""`lumigraph view`: show a trained scene in the browser."""

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.options import DeviceOption, Set, ViewerToken, needed, option
from ..files.ranges import Port
from ..system.signals import until_interrupted
from .common import choose_device, show


@dataclass(frozen=True)
class ViewCommand:
    """Show a run, a splat file or a composition in the browser: fly, orbit, crop, and make paths for films.

    The browser draws Gaussians; this machine renders everything else. Ctrl-C ends it. `lumigraph train --view` shows a
    scene during training.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of the run, a splat file (.ply, .spz, .sog, .glb, .splat), or a composition (.json)."""
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine only")] = "127.0.0.1"
    """Address to listen at; 0.0.0.0 gives access to other machines."""
    port: Annotated[Port | None, option("N", "8080, or the next free port")] = None
    """Port to listen at."""
    settings: Set = ()
    device: DeviceOption = "auto"
    token: ViewerToken = ""

    def run(self) -> int:
        from ..export.loaded import Loaded
        from ..large import open_any
        from ..viewer import Viewer, at_free_address
        from .export_menu import export_menu

        loaded = Loaded.of(open_any(self.source), choose_device(self.device), self.settings)
        opened, method, cameras = loaded.opened, loaded.method, loaded.cameras
        subject = replace(
            subject_of(opened, cameras, page=page_of(opened, method, cameras)),
            behind=behind_of(opened, method, cameras),
            exporter=None if self.token else export_menu(opened, method, self.settings, self.device),
            embedded=bool(self.token),
        )
        start = partial(Viewer, method, subject)
        with until_interrupted(), at_free_address(self.host, self.port, self.token, start) as viewer:
            show_address(viewer, self.token)
            viewer.serve()
        return 0


def page_of(opened: Any, method: Any, cameras: Any) -> Any:
    """A function that makes the page of a baked method; `None` for any other method, and before it is baked."""
    from ..export.page import browsable, is_baked, volume_bytes
    from ..paths.opening import opening_of_scene

    try:
        volume = browsable(method)[0] if is_baked(method) else None
    except LumigraphError:
        return None
    opening = opening_of_scene(opened.title, cameras["train"], opened.frame)
    return volume and (lambda: volume_bytes(volume, opening))


def behind_of(opened: Any, method: Any, cameras: Any) -> Any:
    """Backdrop of a cloud, as on its exported page; `None` without photographs, and for methods that are slow to render
    on a plain machine."""
    from ..export.page import backdrop
    from ..method.capabilities import HasGaussians, can

    return backdrop(method, cameras["train"]) if opened.photographed and can(method, HasGaussians) else None


def subject_of(opened: Any, cameras: Any = None, finished: bool = True, page: Any = None) -> Any:
    """The viewer's Subject for an Opened run or file.

    cameras:  by split, if the method has refined them
    finished: False during training, when no part of it can be saved
    page:     function that makes a page on which the browser draws it, if possible
    """
    from .. import methods
    from ..run import Run
    from ..viewer import Subject

    learns_on = isinstance(opened, Run) and hasattr(methods.find(opened.method_name), "prune")
    return Subject(
        opened.title,
        opened.frame,
        cameras or opened.cameras(),
        opened.paths,
        f"lumigraph render {opened.path}",
        opened.open_scene,
        opened.metrics(),
        saver(opened) if finished else None,
        "" if learns_on else ".ply",
        page,
        set_scale=opened.set_scale if finished else None,
    )


def saver(opened: Any) -> Any:
    """A function that saves a cloud without some Gaussians, as `lumigraph clean` does: a splat file or a new run."""

    def save(name: str, reasons: Mapping[str, Any]) -> str:
        from ..gaussians.cloud import gone
        from ..run.derived import save_picked

        output = opened.path.parent / name
        if os.path.lexists(output):
            raise LumigraphError(f"{output} is there already; choose another name")
        keep = ~gone(reasons).cpu()
        if not keep.any():
            raise LumigraphError("No Gaussian is left; crop or clean less")
        save_picked(opened, keep, output, {"removed": {reason: int(some.sum()) for reason, some in reasons.items()}})
        return str(output)

    return save


@contextlib.contextmanager
def watching(command: Any, method: Any, data: Any, run: Any) -> Iterator[Any]:
    """A Viewer for `fit(..., watch=...)` while it trains a run; `None` without --view.

    command: `train`, or another one with options of a viewer
    """
    if not command.view:
        yield None
        return
    from ..viewer import Viewer, at_free_address

    subject = replace(subject_of(run, finished=False), embedded=bool(command.token))
    if run.photographed:
        subject = replace(subject, open_scene=lambda: data)
    start = partial(Viewer, method, subject, training=True)
    with at_free_address(command.host, command.port, command.token, start) as viewer:
        show_address(viewer, command.token)
        yield viewer


def end_training(viewer: Any, method: Any) -> Any:
    """Let a viewer's clients render between our own renderings from now on. Returns the context that each of those
    needs."""
    from ..evaluation.tracking import tracks

    if viewer is None or tracks(method):  # a report on tracking renders without turns
        return contextlib.nullcontext
    method.eval()
    viewer.end_training()
    return viewer.turns.turn


def keep_showing(viewer: Any, signal: int | None) -> None:
    """Serve the viewer after training until Ctrl-C, unless Ctrl-C ended the training."""
    if viewer is not None and signal is None:
        viewer.end_training()
        with until_interrupted():
            viewer.serve()


def show_address(viewer: Any, token: str) -> None:
    """Print the address, unless the starter of this process has it: its token must not be in a log."""
    if not token:
        show({"view": f"{viewer.address.url} (Ctrl-C ends it)"})
