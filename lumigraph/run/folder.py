"""A run: a self-describing folder with the training settings, the latest state, and measurements.

    config.json     method and its numbers, frame, scene, seed, budget, versions: see `settings`
    cameras.json    cameras of the photographs, if any, so that films need no photographs
    checkpoints/    the latest complete state, in a folder named after its step: see `checkpoint`
    metrics.jsonl   one line every few steps
    previews/       one view during training
    photographs.json, photographs.png: findings on its photographs, and the five worst
    eval.json, eval.png, renders/, report.html: results of commands

Nothing in it is executed when opened: a method's file is executed only if the user has loaded it before.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from .. import files, methods
from ..camera import Camera
from ..datasets.dataset import Dataset
from ..datasets.scene import Frame, Scene
from ..datasets.world import BlockWorld
from ..errors import LumigraphError
from ..files import marks
from ..files.locks import LOCK_FILE, check_place, lock_folder
from ..files.marks import MARKS_FILE
from ..files.partials import PARTIAL_NAME
from ..files.plain import alike, understood
from ..files.ranges import check
from ..geometry import Similarity
from ..method import Method
from ..opening import KINDS, open_dataset
from ..readers import Before
from .checkpoint import PACKED_FILE, Checkpoints, State
from .opened import Trained
from .records import cameras_json, cameras_of, read_cameras, read_rows, warn_of_changes
from .settings import Settings, Source, check_memory


class Run(Trained):
    """A run's folder. `Run.create` makes one, `Run(folder)` opens one; LumigraphError for any other folder.

    settings: method, dataset and budget
    """

    def __init__(self, folder: Path | str):
        self.path = self.folder = Path(folder)
        self._config, self._cameras = self.folder / "config.json", self.folder / "cameras.json"
        if not files.is_file(self._config):
            if is_block_run(self.folder):
                raise LumigraphError(
                    f"{self.folder} is a run in blocks, and this is for one of them at a time: name "
                    f"{self.folder / 'blocks' / '0'}, or another block"
                )
            if not files.exists(self.folder):
                raise LumigraphError(
                    f"{self.folder} does not exist; check the path, or make a run by `lumigraph train`"
                )
            raise LumigraphError(f"{self.folder} is not a run: it holds no config.json; `lumigraph train` makes runs")
        self.settings = Settings.read(self._config)
        self.frame = self.settings.frame
        self._checkpoints = Checkpoints(self.folder, self.method_name)

    @classmethod
    def create(
        cls,
        folder: Path | str,
        method: Method,
        data: Dataset,
        *,
        seed: int = 0,
        options: dict[str, Any] | None = None,
        budget: dict[str, Any] | None = None,
    ) -> Run:
        """Create a run in a new or empty folder.

        options: of `open_dataset` besides the source, to open the same dataset again
        budget:  {"steps": n} or {"seconds": s}
        """
        folder = Path(folder)
        check_new(folder)
        place, kind = Path(data.source), type(method)
        if methods.name_of(kind) not in methods.available():
            methods.register(kind)  # so that this process opens the run
        settings = Settings(
            method=methods.name_of(method),
            config=asdict(method.config),
            frame=method.frame,
            scene=Source(str(place.resolve()) if place.exists() else data.source, options or {}, data.kind),
            splits={name: len(index) for name, index in data.splits.items()},
            seed=seed,
            budget=budget or {},
            device=str(method.device),
            processor=processor(method.device),
            versions=versions(),
            method_file=methods.file_of(kind),
        )
        with files.explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
        with lock_folder(folder, "made a run"), taken_back(folder, lambda: not files.is_file(folder / "config.json")):
            check_new(folder)  # again, for another process may have been quicker
            if isinstance(data, Scene):
                files.write_json(folder / "cameras.json", cameras_json(data))
            settings.write(folder / "config.json")  # last: a folder with it is a run
        return cls(folder)

    @contextlib.contextmanager
    def kept_if_learnt(self) -> Iterator[None]:
        """Block in which a new run is trained. If it fails before the first checkpoint, the run is removed, so that the
        same command can use the same folder again."""
        with taken_back(self.folder, lambda: not self.has_state):
            yield

    def lock(self) -> AbstractContextManager[None]:
        """Block with a lock on this run against training by other processes. Raises LumigraphError, naming the process,
        if it is locked, and for symbolic links in the run, which would write elsewhere."""
        files.refuse_links(self.folder)
        return lock_folder(self.folder, "trained")

    def set_budget(self, **budget: Any) -> None:
        """Set another budget in config.json, as `Budget.to_json` gives it."""
        self.settings = replace(self.settings, budget=budget)
        self.settings.write(self._config)

    def set_scale(self, scale: float) -> None:
        """Remember the unit of exports. scale: see `Frame.scale`"""
        self._remember(scale=scale, world_from_source=None)

    def set_world(self, world: Similarity) -> None:
        """Remember the frame of exports. world: see `Frame.world_from_source`"""
        self._remember(scale=world.scale, world_from_source=world.rows)

    def _remember(self, **numbers: Any) -> None:
        self.frame = replace(self.frame, **numbers)
        self.settings = replace(self.settings, frame=self.frame)
        self.settings.write(self._config)

    # What was trained on what

    @property
    def learnt_from(self) -> Source:
        return self.settings.scene

    @property
    def method_name(self) -> str:
        return self.settings.method

    def new_method(self, device: torch.device | str = "cpu") -> Method:
        """The run's method, untrained."""
        if not methods.known_again(self.method_name, file := self.settings.method_file):
            raise LumigraphError(
                f"{self.folder} is a run of {self.method_name}, a method that is not installed; "
                + (f"it came from {file}, so give --method-file {file} if you trust it" if file else "")
                + ("" if file else f"there are: {', '.join(methods.available())}")
            )
        kind = methods.find(self.method_name)
        with understood(self._config):
            config = self.settings.method_config(kind, self._config)
        return build(kind, self.frame, config, torch.device(device), self.settings.seed)

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The trained method, ready to render."""
        method = self.new_method(device)
        self._checkpoints.load_weights(method)
        return method.eval()

    @property
    def kind(self) -> str:
        """Kind of its dataset: see `Dataset.kind`."""
        return self.settings.scene.kind

    @property
    def photographed(self) -> bool:
        """True if it was trained on photographs, and so has cameras."""
        return self.kind in (Scene.kind, BlockWorld.kind)

    @property
    def open_scene(self) -> Callable[..., Scene] | None:
        return self.scene if self.photographed else None

    @property
    def conversion_fault(self) -> str | None:
        return None if self.photographed else f"learnt from {self.kind}, so it has no colours that could be taken over"

    def dataset(self, source: str | None = None) -> Dataset:
        """Open the training dataset again. source: its present path, if it has moved

        Raises LumigraphError if its frame differs from the run's.
        """
        source = source or self.settings.scene.source
        if self.kind not in KINDS:
            raise LumigraphError(
                f"{self.folder} was made of {self.kind}, and nothing learns from that or is compared with it; "
                f"there are {', '.join(KINDS)}"
            )
        options = {name: value for name, value in self.settings.scene.options.items() if value is not None}
        if options.get("partial"):
            raise LumigraphError(
                f"{source} is a scan of some sides, which is no whole shape to compare with or learn from"
            )
        if self.photographed:
            names = read_cameras(self._cameras).names
            options["before"] = Before(names, self.frame.to_source.rotation.T.numpy())
        data = open_dataset(source, KINDS[self.kind], **options)
        learnt = replace(self.frame, scale=1.0, world_from_source=None, metric=data.frame.metric)
        if not alike(learnt.to_json(), data.frame.to_json()):
            what = "cameras or bounds differ" if self.photographed else "bounds differ"
            raise LumigraphError(f"{source} is not what {self.folder} was trained on: {what}; train a new run on it")
        if isinstance(data, Scene):
            warn_of_changes(self.digests(), data, self.folder)
        return data

    def scene(self, source: str | None = None) -> Scene:
        """Open the training photographs again; see `dataset`."""
        data = self.dataset(source)
        if not isinstance(data, Scene):
            raise LumigraphError(f"{self.folder} learnt from {self.kind}; it has no photographs")
        return data

    def cameras(self) -> dict[str, Camera]:
        if not self.photographed:
            return super().cameras()
        return cameras_of(self._cameras, self.frame.image_count)

    def view_names(self) -> dict[str, list[str]]:
        """Names of the photographs by split, in the order of `cameras`; empty without photographs."""
        if not self.photographed:
            return {}
        said = read_cameras(self._cameras)
        return {split: [said.names[i] for i in index] for split, index in said.splits.items()}

    @property
    def masked(self) -> bool:
        return self.photographed and read_cameras(self._cameras).masked

    def digests(self) -> dict[str, str]:
        """Sizes and hashes of the photographs' files by name, at the time of training; see `Scene.digests`."""
        said = read_cameras(self._cameras)
        return dict(zip(said.names, said.digests, strict=False))

    def facts(self) -> dict[str, object]:
        state, scores = self.state if self.has_state else State(), self.evaluation() or {}
        rows: dict[str, object] = {"run": self.folder, "method": self.method_name}
        rows |= {self.kind: self.settings.scene.source, "trained": f"{state.step:,} steps in {state.seconds:.1f} s"}
        return rows | ({"PSNR": f"{scores['psnr']:.2f} dB, held out"} if scores.get("psnr") is not None else {})

    # Its state

    @property
    def state(self) -> State:
        """Progress of the latest complete checkpoint. Raises LumigraphError if there is none."""
        return self._checkpoints.state

    @property
    def has_state(self) -> bool:
        """True if it has a checkpoint, to render or to resume."""
        return bool(self._checkpoints)

    @property
    def compressed(self) -> bool:
        """True if it was made by `lumigraph compress`; training cannot continue then."""
        return self.has_state and self._checkpoints.weights.name == PACKED_FILE

    @property
    def version(self) -> str:
        return str(self._checkpoints.weights)

    @property
    def model_bytes(self) -> int:
        """Size of the trained weights, sufficient for rendering."""
        return self._checkpoints.weights.stat().st_size

    def save(
        self, state: State, method: Method, optimizers: Iterable[torch.optim.Optimizer], generator: torch.Generator
    ) -> None:
        """Write a complete state, then delete the one before it. Does nothing if this step is there already."""
        self._checkpoints.save(state, method, optimizers, generator)

    def restore_weights(self, method: Method) -> State:
        """Load the latest state's weights into a method; no change without a state."""
        if not self.has_state:
            return State()
        self._checkpoints.load_weights(method)
        return self.state

    def restore_training(self, optimizers: Iterable[torch.optim.Optimizer], generator: torch.Generator) -> None:
        """Load the latest state into optimizers and a random generator; no change without a state."""
        if self.has_state:
            self._checkpoints.load_training(optimizers, generator)

    # What was measured

    def log(self, row: dict[str, Any]) -> None:
        """Add a line to metrics.jsonl."""
        path = self.folder / "metrics.jsonl"
        with files.explained(path), open(path, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def metrics(self) -> list[dict[str, Any]]:
        """The lines of metrics.jsonl; damaged ones, such as a truncated last line, are left out."""
        return read_rows(self.folder / "metrics.jsonl")

    def forget_after(self, step: int) -> None:
        """Drop lines and previews of steps after the saved state: these steps will be repeated."""
        rows = [json.dumps(row) for row in self.metrics() if row["step"] <= step]
        files.write_bytes(self.folder / "metrics.jsonl", "".join(row + "\n" for row in rows).encode(), ours=True)
        for preview, path in self.previews().items():
            if preview > step:
                files.remove(path)

    def previews(self) -> dict[int, Path]:
        """Previews of one view by step."""
        found = sorted((self.folder / "previews").glob("*.png"))
        return {int(path.stem): path for path in found if re.fullmatch("[0-9]{6,12}", path.stem)}


def build(
    kind: type[Method], frame: Frame, config: Any, device: torch.device, seed: int, learning: bool = False
) -> Method:
    """Build a method whose initial weights depend on the seed alone.

    learning: for training, which takes more memory than rendering
    Raises LumigraphError for numbers out of range, and where memory is too small.
    """
    check(config, methods.name_of(kind))
    check_memory(kind, frame, config, device, learning)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        method = kind(frame, config)
    return method.to(device)


@contextlib.contextmanager
def taken_back(folder: Path, useless: Callable[[], bool]) -> Iterator[None]:
    """Block that removes the run on an exception, such as a full disk, if `useless()` holds."""
    try:
        yield
    except Exception:
        if useless():
            for preview in (folder / "previews").glob("*.png"):
                files.remove(preview)
            for name in ("config.json", "cameras.json", "metrics.jsonl", LOCK_FILE):
                files.remove(folder / name)
            if [path.name for path in folder.glob("*") if path.name not in ("previews", "checkpoints")] == [MARKS_FILE]:
                files.remove(folder / MARKS_FILE)
            for place in (folder / "previews", folder / "checkpoints", folder):
                with contextlib.suppress(OSError):  # somebody else's files are in it
                    place.rmdir()
        raise


def is_block_run(folder: Path) -> bool:
    """True if a folder contains a block run; see `large`."""
    return files.is_file(folder / "blocks.json")


def check_new(folder: Path) -> None:
    """Raise LumigraphError unless a run can begin in a folder, naming the command to continue an existing one."""
    if (folder / "config.json").exists():
        raise LumigraphError(
            f"{folder} already holds a run; go on with it by `lumigraph resume {folder}`, or choose another --output"
        )
    with files.explained(folder):
        if folder.exists() and not (folder.is_dir() and all(map(is_leftover, folder.iterdir()))):
            raise LumigraphError(f"{folder} is not an empty folder; choose another --output")
        files.check_room(Path(os.path.abspath(folder / "config.json")))
    check_place(folder)


def is_leftover(path: Path) -> bool:
    """True for files that a killed process left before its first step."""
    own = path.name in (LOCK_FILE, MARKS_FILE) or PARTIAL_NAME.fullmatch(path.name) is not None
    return own or marks.is_ours(path, "file")


def versions() -> dict[str, str]:
    """Versions of Python, the platform and the packages that affect results, by name."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in ("lumigraph", "torch", "numba", "triton"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """Commit of this code, short, where it lies in a checkout of its own; None for an installed package."""
    place = Path(__file__).parents[2] / ".git"
    try:
        head = (place / "HEAD").read_text("utf-8").strip()
        if head.startswith("ref: "):
            head = (place / head.removeprefix("ref: ")).read_text("utf-8").strip()
    except OSError:  # no checkout, or its references are packed
        return None
    return head[:8] if re.fullmatch("[0-9a-f]{40,64}", head) else None


def processor(device: torch.device) -> str:
    """Hardware name of a device."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    about = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*:\s*(.+)", about.read_text("utf-8", errors="replace")) if about.exists() else []
    return f"{names[0] if names else platform.machine()}, {torch.get_num_threads()} threads"
