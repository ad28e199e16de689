"""`lumigraph view`: a trained scene in the browser."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from .common import choose_device, needed, open_run, option, show


@dataclass(frozen=True)
class View:
    """Look at a run or a splat file in the browser: fly, orbit, crop, and set paths for films.

    Gaussians are drawn by the browser, everything else here. Ctrl-C ends it. `lumigraph train --view` shows a scene
    while it is learnt.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of the run, or a splat file: .ply, .compressed.ply, .spz, .splat."""
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine alone")] = "127.0.0.1"
    """Where to listen; 0.0.0.0 lets other machines look too."""
    port: Annotated[int | None, option("N", "8080, or the next that is free")] = None
    """Port to listen at."""
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..splat_file import SplatFile
        from ..viewer import Viewer, choose_address

        device = choose_device(self.device)
        run = open_run(self.source)
        method = run.method(device)
        subject = subject_of_file(run) if isinstance(run, SplatFile) else subject_of_run(run)
        address = choose_address(self.host, self.port)
        with contextlib.suppress(KeyboardInterrupt), Viewer(method, subject, address) as viewer:
            tell(viewer)
            viewer.serve()
        return 0


def subject_of_run(run: Any) -> Any:
    """A run, as the viewer wants it."""
    from ..viewer import Subject

    command = f"lumigraph render {run.folder}"
    folder = run.folder
    return Subject(folder.name, run.frame, run.cameras(), folder / "paths", command, run.scene, run.metrics())


def subject_of_file(file: Any) -> Any:
    """A splat file, as the viewer wants it. Paths go where films of it go."""
    from ..viewer import Subject

    command = f"lumigraph render {file.path}"
    return Subject(file.path.name, file.frame, file.cameras(), file.renders / "paths", command)


@contextlib.contextmanager
def watching(wanted: bool, method: Any, scene: Any, run: Any, host: str, port: int | None) -> Iterator[Any]:
    """A Viewer for `fit(..., watch=...)` while it trains a run; None if nobody wants to look."""
    if not wanted:
        yield None
        return
    import dataclasses

    from ..viewer import Viewer, choose_address

    subject = dataclasses.replace(subject_of_run(run), open_scene=lambda: scene)
    with Viewer(method, subject, choose_address(host, port), training=True) as viewer:
        tell(viewer)
        yield viewer


def keep_showing(viewer: Any, signal: int | None) -> None:
    """After training: go on until Ctrl-C, unless that is what ended it."""
    if viewer is not None and signal is None:
        viewer.end_training()
        with contextlib.suppress(KeyboardInterrupt):
            viewer.serve()


def tell(viewer: Any) -> None:
    show({"view": f"{viewer.address.url} (Ctrl-C ends it)"})
