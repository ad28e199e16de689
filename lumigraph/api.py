"""Photographs to a scene, a scene to a run, a run to films and files, from Python.

    run = lumigraph.train("photos", "gaussian-splatting", seconds=60)
    run.film("film.mp4")
    run.export("web", "page.html")

Each call is a command of the command line, with the same options; `commands.calls` says how they are written. Long work
shows its progress on stderr. All but `train` and `call` also take progress=FUNCTION, which hears of each stage: its
description, the items done, and all of them or None; what it raises ends the work, and so does true as its result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, overload

import numpy as np
from jaxtyping import Num

from . import methods
from .camera import Camera
from .camera.rays import Rendering
from .commands.calls import command, finished, quietly
from .commands.capture import scene_folder
from .commands.notebook_bar import NotebookBar, in_notebook
from .commands.notebook_page import shown
from .commands.results import Evaluation, Exported, Film, Reports
from .datasets.dataset import Dataset
from .datasets.scene import Scene
from .errors import LumigraphError
from .export.cameras import pictures
from .large import open_any
from .large.opening import SAMPLE
from .method import Method
from .opening import open_scene
from .run import Opened
from .run.records import flat
from .system.progress import Listener, heard_by
from .training.loggers import Logger


class Model:
    """An opened run, splat file or composition. Its weights are loaded once, for all calls, until the run learns more.

    All else that the opened object has is an attribute of this one: path, frame, cameras(), state, settings ...
    What another program changes in the file of splats or of a composition shows after it is opened again.

    opened: the object itself
    """

    def __init__(self, opened: Opened):
        self.opened = opened

    def __getattr__(self, name: str) -> Any:
        if name == "opened" or name.startswith("__"):  # of a copy that is being made
            raise AttributeError(name)
        return getattr(self.opened, name)

    def __fspath__(self) -> str:
        return str(self.opened.path)

    def __repr__(self) -> str:
        return f"Model of {self.opened!r}"

    def __dir__(self) -> list[str]:
        return [name for name in [*vars(type(self)), *vars(self)] if not name.startswith("_")]

    def _repr_html_(self) -> str:
        """A notebook's view: a small page to turn, or a still, and a table of facts."""
        return shown(self.opened)

    @overload
    def render(self, cameras: Camera, device: str = "auto", **controls: Any) -> Rendering: ...
    @overload
    def render(
        self, cameras: Sequence[Camera], device: str = "auto", **controls: Any
    ) -> Rendering | list[Rendering]: ...
    def render(self, cameras: Any, device: str = "auto", **controls: Any) -> Any:
        """Pictures of cameras in the scene's frame, as those of `cameras()` and `placed`, with depth in `depth_unit`.

        cameras:  a batch of one, for leading axes (height, width); several of one size, or a list, for (camera, height,
                  width); a list of several sizes, for a list of renderings (height, width)
        controls: values of the method's controls, such as time=0.3
        The rendering's `extra` has normals and others, where the method has them. An `Equirectangular` lens, as of
        `Camera.spinning`, gives ranges.
        """
        found = list(self.rendered(cameras, device, **controls))
        if isinstance(cameras, Camera) and len(cameras) == 1:
            return found[0]
        if len({one.depth.shape for one in found}) == 1:
            return Rendering.cat([one.reshape(1, *one.depth.shape) for one in found])
        return found

    def rendered(
        self, cameras: Camera | Iterable[Camera], device: str = "auto", **controls: Any
    ) -> Iterator[Rendering]:
        """Pictures (height, width) of cameras of any sizes, in order, for more than memory holds; see `render`.

        Small pictures of Gaussians are rendered several at a time, each by one thread, and a few ahead.
        """
        batches = [cameras] if isinstance(cameras, Camera) else cameras
        several = [batch[i] for batch in batches for i in range(len(batch))]
        if not several:
            raise LumigraphError("There are no cameras to render; give one at least")
        method, unit = self.opened.ready(device).given(**controls), self.opened.frame.to_export.scale
        return (replace(one, depth=one.depth * unit) for one in pictures(method, several))

    @property
    def depth_unit(self) -> str:
        """Unit of depth: "metres" where a length is known (a depth camera, GPS, control points, `metres` of `open`,
        --scale-by), else a sentence that says what it is and how to make it metres."""
        if self.opened.frame.in_metres:
            return "metres"
        return (
            "units of the photographs' frame, for no length of this scene is known; give metres to a unit: "
            f"lumigraph.open({str(self.opened.path)!r}, metres=...)"
        )

    def placed(self, cameras: Camera) -> Camera:
        """Cameras with poses in the frame of exports (the photographs', or metres), in the scene's frame."""
        return cameras.transformed(self.opened.frame.to_export.inverse.matrix)

    def film(self, file: Path | str, /, **options: Any) -> Film:
        """Render a film: .mp4, .gif or .webp. options: those of `lumigraph render`, such as path, frames, size."""
        return self._made("render", output=file, **options)

    def export(self, kind: str, file: Path | str, /, **options: Any) -> Exported:
        """Write files for other programs. kind: mesh, splats, points, web, panorama and others, as in
        `lumigraph export`; options: those of `lumigraph export KIND`."""
        return self._made(f"export {kind}", file, **options)

    def evaluate(self, **options: Any) -> Evaluation:
        """Compare with held-out photographs or shapes: the contents of eval.json, which is written anew.

        options: those of `lumigraph eval`
        Raises LumigraphError for what is no run.
        """
        return self._made("eval", **{"overwrite": True, **options})

    def convert(self, method: str, output: Path | str, /, **options: Any) -> Model:
        """Run of another method, initialised from this one. options: those of `lumigraph convert`."""
        return open(self._made("convert", method, output=output, **options).path)

    def compress(self, output: Path | str, /, **options: Any) -> Model:
        """Run of a fraction of the size. options: those of `lumigraph compress`."""
        return open(self._made("compress", output=output, **options).path)

    def clean(self, output: Path | str, /, **options: Any) -> Model:
        """Run or splat file without floaters, or cropped. options: those of `lumigraph clean`."""
        return open(self._made("clean", output=output, **options).path)

    def metrics(self) -> dict[str, Num[np.ndarray, " row"]]:
        """Training metrics as columns by name, such as step, psnr and loss/tv; NaN in rows without a value.

        `pandas.DataFrame(run.metrics())` is a table of them. Empty where unknown.
        """
        rows = [flat(row) for row in self.opened.metrics()]
        names = dict.fromkeys(name for row in rows for name, value in row.items() if isinstance(value, int | float))
        return {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}

    def _made(self, name: str, *arguments: object, progress: Listener | None = None, **options: Any) -> Any:
        """Result of a command on what is opened."""
        asked: Reports = command(name, self.opened.path, *arguments, **options)
        return quietly(lambda: asked.of(self.opened), progress)[0]


def open(path: str | Path, metres: float | None = None) -> Model:
    """Open a run, a splat file or a composition. Raises LumigraphError for anything else.

    metres: to a unit of the photographs' frame or of the file, where it is known; nothing is written
    """
    opened = open_any(path)
    if metres is not None:
        if not 0 < metres < math.inf:
            raise LumigraphError(f"metres={metres} is no length; give the metres to a unit, such as 1.0")
        opened.frame = replace(opened.frame, scale=metres, world_from_source=None, metric=True)
    return Model(opened)


def sample(name: str = "still-life") -> Model:
    """Open a small cloud that comes with the package, to try things on: "still-life" or "room" (in metres).

    Both show procedural scenes and are in the public domain (CC0); commands open them as sample:NAME.
    """
    return Model(open_any(f"{SAMPLE}{name}"))


def call(name: str, /, *arguments: object, **options: Any) -> dict[str, str]:
    """Run a command by its name, as "export mesh" or "bench views", with its arguments in order and its options.

    Returns the rows that the command line prints: text by name.
    Raises LumigraphError for what the command refuses, and KeyboardInterrupt after Ctrl-C, with the work saved.
    """
    code, rows = quietly(command(name, *arguments, **options).run)
    finished(code)
    return {title: str(value) for title, value in rows.items()}


def capture(photographs: str | Path | Iterable[str | Path], output: str | Path | None = None, **options: Any) -> Scene:
    """Find the camera poses of photographs or of a video, and open the scene.

    photographs: a folder, a video, or image files
    output:  folder of the scene; None: scenes/NAME. What lies there already of the same photographs is not done again
    options: those of `lumigraph capture`, and progress
    """
    many = [photographs] if isinstance(photographs, str | Path) else list(photographs)
    folder = Path(output) if output is not None else scene_folder(tuple(map(Path, many)))
    with heard_by(options.pop("progress", None)):
        call("capture", *many, output=folder, **options)
    return open_scene(folder)


def train(
    scene: str | Path | Dataset,
    method: str | type[Method] = "gaussian-splatting",
    output: str | Path | None = None,
    *,
    progress: Callable[[int, float, dict[str, Any]], object] | None = None,
    loggers: Sequence[str | Logger] = (),
    **options: Any,
) -> Model:
    """Train a method, and open the run.

    scene:    a path, "procedural:NAME", or a dataset as `capture` or `open_scene` opened it, which is opened again
    method:   its name, or a class of your own
    output:   folder of the run; None: runs/SCENE-METHOD-N
    progress: told after each step: its number, the share of the budget that is spent, and the line of metrics.jsonl,
              which most steps leave empty. Returns true to end training, as Ctrl-C does: the run is saved and resumes.
              None: a bar in a notebook, lines on stderr elsewhere
    loggers:  names ("tensorboard", "wandb", "trackio", "rerun") or objects that receive metrics and previews
    options:  those of `lumigraph train METHOD`
    """
    if not isinstance(scene, str | Path):
        if not scene.source:
            raise LumigraphError("This dataset came from no path, so a run could not open it again; train it by `fit`")
        options = {**getattr(scene, "options", {}), **options}
        scene = scene.source
    if isinstance(method, type):
        methods.register(method)
        method = methods.name_of(method)
    made = command("train", method, scene, output=output, **options)
    bar = NotebookBar() if progress is None and in_notebook() else None
    told = progress or bar
    (folder, code), _ = quietly(lambda: made.learn(told and SimpleNamespace(asked=False, note=told), loggers))
    finished(code)
    if bar:
        bar.end()
    return open(folder)
