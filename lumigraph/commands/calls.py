"""Commands as calls from Python: photographs to a scene, a scene to a run, a run to films and files.

    run = lumigraph.train("photos", "gaussian-splatting", seconds=60)
    run.film("film.mp4")
    run.export("web", "page.html")

Each call is a command of the command line. Its options are keywords of the same names and units, with `_` for `-`:
`--few-views yes` is few_views="yes", `--no-holes` is holes=False, `--from depth` is from_="depth", `--set time=0.3` is
set={"time": 0.3}. `lumigraph COMMAND --help` lists them. Long work shows its progress on stderr.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from .. import methods
from ..datasets.dataset import Dataset
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..large import open_any
from ..method import Method
from ..opening import open_scene
from ..run import Opened
from ..system.work import at_work
from .capture import scene_folder
from .cli import parse
from .common import kept_rows
from .notebook_bar import NotebookBar, in_notebook

FRAMES = re.compile("[╭╮╰╯│─]+|-{3,}|For full helptext, run .*")  # around faults of options
Progress = Callable[[int, float, dict[str, Any]], object]


def call(command: str, /, *arguments: object, **options: Any) -> dict[str, str]:
    """Run a command by its name, as "export mesh" or "bench views", with its arguments in order and its options.

    Returns what the command line prints: text by name.
    Raises LumigraphError for what the command refuses, and KeyboardInterrupt after Ctrl-C, with the work saved.
    """
    return conducted(understood([*command.split(), *map(str, arguments), *typed(options)]))


def capture(photographs: str | Path | Iterable[str | Path], output: str | Path | None = None, **options: Any) -> Scene:
    """Find the camera poses of photographs or of a video, and open the scene.

    photographs: a folder, a video, or image files
    output:  folder of the scene; None: scenes/NAME. What lies there already of the same photographs is not done again
    options: those of `lumigraph capture`
    """
    many = [photographs] if isinstance(photographs, str | Path) else list(photographs)
    folder = Path(output) if output is not None else scene_folder(tuple(map(Path, many)))
    call("capture", *many, output=folder, **options)
    return open_scene(folder)


def train(
    scene: str | Path | Dataset,
    method: str | type[Method] = "gaussian-splatting",
    output: str | Path | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> Opened:
    """Train a method, and open the run.

    scene:    a path, "procedural:NAME", or a dataset as `capture` or `open_scene` opened it, which is opened again
    method:   its name, or a class of your own
    output:   folder of the run; None: runs/SCENE-METHOD-N
    progress: told after each step: its number, the share of the budget that is spent, and the line of metrics.jsonl,
              which most steps leave empty. Returns true to end training, as Ctrl-C does: the run is saved and resumes.
              None: a bar in a notebook, lines on stderr elsewhere
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
    command = understood(["train", method, str(scene), *typed({"output": output, **options})])
    bar = NotebookBar() if progress is None and in_notebook() else None
    told = progress or bar
    rows = conducted(command, lambda: command.run(Told(told) if told else None))
    if bar:
        bar.end()
    return open_any(rows["run"])


def open(path: str | Path) -> Opened:
    """Open a run, a splat file or a composition. Raises LumigraphError for anything else."""
    return open_any(path)


def film(opened: Opened, file: str | Path, /, **options: Any) -> Path:
    """Render a film; see `Opened.film`."""
    call("render", opened.path, output=file, **options)
    return Path(file)


def export(opened: Opened, kind: str, file: str | Path, /, **options: Any) -> Path:
    """Write files for other programs; see `Opened.export`."""
    call(f"export {kind}", opened.path, file, **options)
    return Path(file)


def evaluate(opened: Opened, **options: Any) -> dict[str, Any]:
    """Compare with held-out data; see `Opened.evaluate`."""
    from ..evaluation import stem
    from ..run.records import read_evaluation

    options = {"overwrite": True, **options}
    call("eval", opened.path, **options)
    return read_evaluation(opened.path / f"{stem(options.get('split', 'test'))}.json")


def derive(command: str, opened: Opened, output: str | Path, /, *arguments: str, **options: Any) -> Opened:
    """Make a run, or a file, of another one by `convert`, `compress` or `clean`, and open it."""
    call(command, opened.path, *arguments, output=output, **options)
    return open_any(output)


def typed(options: Mapping[str, Any]) -> list[str]:
    """Options as words of the command line. None: as if left out."""
    words = list[str]()
    for name, value in options.items():
        option = "--" + name.rstrip("_").replace("_", "-")
        if isinstance(value, bool):
            words.append(option if value else f"--no-{option[2:]}")
        elif isinstance(value, Mapping):
            words += [word for key, one in value.items() for word in (option, f"{key}={one}")]
        elif isinstance(value, Sequence) and not isinstance(value, str):
            words += [option, *map(str, value)]
        elif value is not None:
            words += [option, str(value)]
    return words


def understood(words: list[str]) -> Any:
    """The command that words of the command line are. Raises LumigraphError where they are none."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            return parse(words)
        except SystemExit:
            pass  # with its fault in `said`
    fault = " ".join(FRAMES.sub(" ", said.getvalue()).split())
    raise LumigraphError(f"{fault or words}; `lumigraph {words[0]} --help` lists what there is")


@at_work()
def conducted(command: Any, run: Callable[[], int] | None = None) -> dict[str, str]:
    """The rows that a command prints, kept from the terminal. run: in place of the command's own"""
    with kept_rows() as rows:
        code = (run or command.run)()
    if code:
        raise KeyboardInterrupt
    return {name: str(value) for name, value in rows.items()}


class Told:
    """A Watch that tells a function of each step, and never asks training to yield."""

    asked = False

    def __init__(self, progress: Progress):
        self.progress = progress

    def give_way(self, stopping: Callable[[], object]) -> None: ...

    def note(self, step: int, progress: float, row: dict[str, Any]) -> bool:
        return bool(self.progress(step, progress, row))
