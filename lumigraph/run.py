"""A run is a folder that explains itself: what was trained on what, its latest state, and what was measured.

    config.json     method and its numbers, frame, scene, seed, budget, versions
    cameras.json    where the photographs were taken from, so that films need no photographs
    checkpoints/    the latest complete state, in a folder named after its step
        000800/     weights.safetensors · optimizer.safetensors · state.json
    metrics.jsonl   one line every few steps
    previews/       one view as it came to be
    eval.json, eval.png, renders/, report.html: what the commands made of it

Nothing in it runs code when opened. A checkpoint is written beside the old one and renamed once it is whole, so the
folder holds a complete state whenever it held one before, however the writer ended.
"""

from __future__ import annotations

import json
import platform
import re
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from torch import Tensor

from . import files, methods
from .camera import Camera
from .errors import LumigraphError
from .lens import Lens
from .method import Method
from .plain import alike, flatten, from_plain, understood, unflatten
from .scene import Frame, Scene

FORMAT, CHECKPOINT = "lumigraph run 1", "lumigraph checkpoint 1"


@dataclass(frozen=True)
class State:
    """How far training has come: completed steps, and seconds that they took; compilation is counted apart.

    peak_memory: bytes at most, see `memory.peak_memory`; 0 if unknown
    """

    step: int = 0
    seconds: float = 0.0
    compile_seconds: float = 0.0
    peak_memory: int = 0


class Run:
    """A run's folder. `Run.create` makes one, `Run(folder)` opens one; LumigraphError if it is not one of ours."""

    def __init__(self, folder: Path | str):
        self.folder = Path(folder)
        file = self.folder / "config.json"
        if not file.exists():
            raise LumigraphError(f"{self.folder} is not a run: it holds no config.json; `lumigraph train` makes runs")
        self.config: dict[str, Any] = files.read_json(file)
        if not isinstance(self.config, dict) or self.config.get("format") != FORMAT:
            raise LumigraphError(f"{file} was not written by this version of Lumigraph; open it with the one that did")

    @classmethod
    def create(
        cls,
        folder: Path | str,
        method: Method,
        scene: Scene,
        *,
        seed: int = 0,
        options: dict[str, Any] | None = None,
        budget: dict[str, Any] | None = None,
    ) -> Run:
        """Begin a run in a new or empty folder.

        options: what open_scene was told besides the source, to open the same scene again
        budget:  {"steps": n} or {"seconds": s}
        """
        folder = Path(folder)
        check_new(folder)
        place = Path(scene.source)
        config = {
            "format": FORMAT,
            "method": methods.name_of(method),
            "config": asdict(method.config),
            "frame": method.frame.to_json(),
            "scene": {"source": str(place.resolve()) if place.exists() else scene.source, "options": options or {}},
            "splits": {name: len(index) for name, index in scene.splits.items()},
            "seed": seed,
            "budget": budget or {},
            "device": str(method.device),
            "processor": processor(method.device),
            "versions": versions(),
        }
        with files.explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
        files.write_json(folder / "cameras.json", cameras_to_json(scene))
        files.write_json(folder / "config.json", config)  # last: a folder with it is a run
        return cls(folder)

    def set_budget(self, **budget: float) -> None:
        """Remember another total of steps or seconds."""
        self.config["budget"] = budget
        files.write_json(self.folder / "config.json", self.config)

    @property
    def renders(self) -> Path:
        """Where films go."""
        return self.folder / "renders"

    # What was trained on what

    @property
    def method_name(self) -> str:
        return self.config["method"]

    @property
    def frame(self) -> Frame:
        with understood(self.folder / "config.json"):
            return Frame.from_json(self.config["frame"])

    def new_method(self, device: torch.device | str = "cpu") -> Method:
        """The run's method as it was before the first step."""
        if self.method_name not in methods.available():
            raise LumigraphError(
                f"{self.folder} is a run of {self.method_name}, a method that is not installed; "
                f"there are: {', '.join(methods.available())}"
            )
        kind = methods.find(self.method_name)
        with understood(self.folder / "config.json"):
            config = from_plain(kind.Config, self.config["config"])
        return build(kind, self.frame, config, torch.device(device), self.config["seed"])

    def method(self, device: torch.device | str = "cpu") -> Method:
        """The trained method, ready to render."""
        method = self.new_method(device)
        self._load_weights(method, self._checkpoint())
        return method.eval()

    def scene(self, source: str | None = None) -> Scene:
        """The photographs again. source: where they are now, if they have moved.

        Raises LumigraphError if they give another frame than the run was trained in.
        """
        from .capture import open_scene

        source = source or self.config["scene"]["source"]
        scene = open_scene(source, **self.config["scene"]["options"])
        frame, known = scene.frame.to_json(), self.config["frame"]
        if not alike({name: frame.get(name) for name in known}, known):  # older runs know fewer numbers of a frame
            raise LumigraphError(
                f"{source} is not what {self.folder} was trained on: cameras or bounds differ; train a new run on it"
            )
        return scene

    def cameras(self) -> dict[str, Camera]:
        """The photographs' cameras by split, in the run's frame."""
        with understood(self.folder / "cameras.json"):
            return cameras_from_json(files.read_json(self.folder / "cameras.json"))

    def view_names(self) -> dict[str, list[str]]:
        """What the photographs are called, by split, in the order of `cameras`."""
        with understood(self.folder / "cameras.json"):
            data = files.read_json(self.folder / "cameras.json")
            return {split: [data["names"][i] for i in index] for split, index in data["splits"].items()}

    # Its state

    @property
    def state(self) -> State:
        """How far the latest complete state has come. Raises LumigraphError if there is none."""
        return self._state(self._checkpoint())

    @property
    def has_state(self) -> bool:
        return bool(self._checkpoints())

    def save(
        self, state: State, method: Method, optimizers: Iterable[torch.optim.Optimizer], generator: torch.Generator
    ) -> None:
        """Write a complete state, then delete the one before it. Does nothing if this step is there already."""
        folder = self.folder / "checkpoints" / f"{state.step:06d}"
        if folder.exists():
            return
        tensors: dict[str, Tensor] = {"generator": generator.get_state()}
        structure = flatten([optimizer.state_dict() for optimizer in optimizers], tensors)
        with files.replacing(folder) as partial:
            partial.mkdir()
            sums = {
                name: write_tensors(partial / name, content)
                for name, content in (("weights.safetensors", method.state_dict()), ("optimizer.safetensors", tensors))
            }
            about = {"format": CHECKPOINT, "method": self.method_name, **asdict(state), "files": sums}
            (partial / "state.json").write_text(json.dumps({**about, "optimizers": structure}), "utf-8")
        for path in folder.parent.iterdir():
            if path != folder:
                retire(path)

    def restore_weights(self, method: Method) -> State:
        """Give a method the latest state's weights. Without any state, leaves it as it is."""
        if not self.has_state:
            return State()
        checkpoint = self._checkpoint()
        self._load_weights(method, checkpoint)
        return self._state(checkpoint)

    def restore_training(self, optimizers: Iterable[torch.optim.Optimizer], generator: torch.Generator) -> None:
        """Give optimizers and random numbers the latest state. Without any state, leaves them as they are."""
        if not self.has_state:
            return
        checkpoint = self._checkpoint()
        tensors = self._read_tensors(checkpoint, "optimizer.safetensors")
        structure = self._about(checkpoint)["optimizers"]
        with understood(self.folder / f"checkpoints/{checkpoint.name}"):
            generator.set_state(tensors["generator"])
            for optimizer, saved in zip(optimizers, unflatten(structure, tensors), strict=True):
                optimizer.load_state_dict(saved)

    def _checkpoints(self) -> list[Path]:
        folder = self.folder / "checkpoints"
        found = [x for x in folder.iterdir() if re.fullmatch(r"\d+", x.name)] if folder.is_dir() else []
        return sorted(found, key=lambda x: int(x.name))

    def _checkpoint(self) -> Path:
        if not self.has_state:
            raise LumigraphError(
                f"{self.folder} has no saved state yet; `lumigraph resume {self.folder}` trains it from the start"
            )
        return self._checkpoints()[-1]

    def _about(self, checkpoint: Path) -> dict[str, Any]:
        about = files.read_json(checkpoint / "state.json")
        if not isinstance(about, dict) or about.get("format") != CHECKPOINT:
            raise LumigraphError(f"{checkpoint} is not a checkpoint that Lumigraph wrote; restore it from a copy")
        if about["method"] != self.method_name:
            raise LumigraphError(
                f"{checkpoint} belongs to a run of {about['method']}, not of {self.method_name}; restore it from a copy"
            )
        return about

    def _state(self, checkpoint: Path) -> State:
        about = {"peak_memory": 0} | self._about(checkpoint)  # older runs do not tell it
        with understood(self.folder / f"checkpoints/{checkpoint.name}"):
            return State(**{field.name: about[field.name] for field in fields(State)})

    def _read_tensors(self, checkpoint: Path, name: str) -> dict[str, Tensor]:
        path = checkpoint / name
        expected = self._about(checkpoint)["files"].get(name)
        with files.explained(path):
            data = path.read_bytes()
        if checksum(data) != expected:
            raise LumigraphError(f"{path} is damaged: its checksum is not the one it was saved with; restore a copy")
        return safetensors.torch.load(data)

    def _load_weights(self, method: Method, checkpoint: Path) -> None:
        tensors = self._read_tensors(checkpoint, "weights.safetensors")
        try:
            method.load_state_dict(tensors)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise LumigraphError(f"{checkpoint} does not fit the method {self.method_name}: {reason}") from error

    # What was measured

    def log(self, row: dict[str, Any]) -> None:
        """Add a line to metrics.jsonl."""
        path = self.folder / "metrics.jsonl"
        with files.explained(path), open(path, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def metrics(self) -> list[dict[str, Any]]:
        """The lines of metrics.jsonl; one that a kill cut short is left out."""
        path = self.folder / "metrics.jsonl"
        rows = []
        for line in path.read_text("utf-8", errors="replace").splitlines() if path.exists() else []:
            try:
                rows.append(json.loads(line))
            except json.JSONDecodeError:
                continue
        return rows

    def forget_after(self, step: int) -> None:
        """Drop lines and previews of steps after the saved state: they will be taken again."""
        rows = [json.dumps(row) for row in self.metrics() if row["step"] <= step]
        files.write_bytes(self.folder / "metrics.jsonl", "".join(row + "\n" for row in rows).encode())
        for preview, path in self.previews().items():
            if preview > step:
                files.remove(path)

    def previews(self) -> dict[int, Path]:
        """One view at the steps at which it was taken."""
        return {int(path.stem): path for path in sorted((self.folder / "previews").glob("[0-9]*.png"))}

    def evaluation(self) -> dict[str, Any] | None:
        """What eval.json says, if the run has been evaluated."""
        path = self.folder / "eval.json"
        return files.read_json(path) if path.exists() else None


def build(kind: type[Method], frame: Frame, config: Any, device: torch.device, seed: int) -> Method:
    """A fresh method whose initial weights depend on the seed alone."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        method = kind(frame, config)
    return method.to(device)


def check_new(folder: Path) -> None:
    """Raise LumigraphError unless a run may begin here, saying how to go on with one that lies here."""
    if (folder / "config.json").exists():
        raise LumigraphError(
            f"{folder} already holds a run; go on with it by `lumigraph resume {folder}`, or choose another --output"
        )
    with files.explained(folder):
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise LumigraphError(f"{folder} is not an empty folder; choose another --output")


def write_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, int]:
    """Write a safetensors file; gives its checksum."""
    data = safetensors.torch.save({name: x.detach().cpu().contiguous().clone() for name, x in tensors.items()})
    path.write_bytes(data)
    return checksum(data)


def checksum(data: bytes) -> dict[str, int]:
    return {"bytes": len(data), "crc32": zlib.crc32(data)}


def retire(path: Path) -> None:
    """Delete a checkpoint so that a half-deleted one cannot be taken for a whole one."""
    with files.explained(path):
        if not path.name.endswith(files.PARTIAL):
            path = path.rename(path.with_name(path.name + files.PARTIAL))
        files.remove(path)


def cameras_to_json(scene: Scene) -> dict[str, Any]:
    camera = scene.cameras.to("cpu")
    return {
        "names": list(scene.names),
        "splits": {name: index.tolist() for name, index in scene.splits.items()},
        "pose": camera.pose.tolist(),
        "lens": camera.lens.to_json(),
        "size": camera.size.tolist(),
        "time": None if camera.time is None else camera.time.tolist(),
    }


def cameras_from_json(data: dict[str, Any]) -> dict[str, Camera]:
    time = None if data["time"] is None else torch.tensor(data["time"])
    image_index = torch.arange(len(data["pose"]))
    camera = Camera(
        torch.tensor(data["pose"]), Lens.from_json(data["lens"]), torch.tensor(data["size"]), time, image_index
    )
    return {name: camera[torch.tensor(index, dtype=torch.int64)] for name, index in data["splits"].items()}


def versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in ("lumigraph", "torch", "numba", "triton"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def processor(device: torch.device) -> str:
    """What kind of machine a device is."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    about = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*:\s*(.+)", about.read_text("utf-8", errors="replace")) if about.exists() else []
    return f"{names[0] if names else platform.machine()}, {torch.get_num_threads()} threads"
