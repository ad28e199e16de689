"""Results of commands as values: the file that was written, its figures, and the rows that the terminal shows."""

import base64
import html
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .common import choose_device, show

MAX_SHOWN_BYTES = 8_000_000  # of a film within a notebook


@dataclass(frozen=True)
class Result:
    """A file or folder that a command wrote. It is an os.PathLike.

    path: the file or folder
    rows: text by name, as the terminal shows it
    """

    path: Path
    rows: Mapping[str, Any] = field(repr=False, compare=False, kw_only=True)

    def __fspath__(self) -> str:
        return str(self.path)

    def __str__(self) -> str:
        return str(self.path)


@dataclass(frozen=True)
class Film(Result):
    """A film that was rendered.

    size:     width and height, pixels
    seconds:  rendering time of all frames
    cameras:  JSON file of the cameras
    depth:    the film of depth
    pictures: folder of the frames as pictures
    """

    frames: int
    fps: float
    size: tuple[int, int]
    seconds: float
    cameras: Path
    depth: Path | None = None
    pictures: Path | None = None

    def __repr__(self) -> str:
        """Path, frames, size and time in one line."""
        width, height = self.size
        return (
            f"Film {self.path}: {self.frames} frames of {width}x{height} at {self.fps:g} per second, "
            f"{self.seconds_per_frame:.3g} s each to render"
        )

    def _repr_html_(self) -> str:
        """Player of the film in a notebook; its path where it is too large."""
        kind = {".mp4": "video/mp4", ".gif": "image/gif", ".webp": "image/webp"}.get(self.path.suffix.lower())
        if kind is None or self.path.stat().st_size > MAX_SHOWN_BYTES:
            return html.escape(repr(self))
        data = f"data:{kind};base64,{base64.b64encode(self.path.read_bytes()).decode()}"
        shown = f'<video controls loop src="{data}"></video>' if kind == "video/mp4" else f'<img src="{data}">'
        return f"{shown}<br>{html.escape(repr(self))}"

    @property
    def seconds_per_frame(self) -> float:
        """Rendering time of one frame."""
        return self.seconds / self.frames


@dataclass(frozen=True)
class Exported(Result):
    """Files that an export wrote.

    counts: numbers of what they hold, by name: triangles, vertices, gaussians, points ...
    files:  all files, `path` first; for a folder, the folder
    """

    counts: Mapping[str, int]
    files: tuple[Path, ...] = ()

    @property
    def bytes(self) -> int:
        """Size of all files."""
        from ..exchange import size_of

        return sum(map(size_of, self.files or (self.path,)))


@dataclass(frozen=True)
class Evaluation(Result, Mapping[str, Any]):
    """Contents of eval.json: `evaluation["psnr"]`, and as attributes: `evaluation.psnr`."""

    contents: Mapping[str, Any] = field(repr=False)

    def __getattr__(self, name: str) -> Any:
        if name == "contents" or name not in self.contents:
            raise AttributeError(f"This evaluation has no {name!r}")
        return self.contents[name]

    def __getitem__(self, name: str) -> Any:
        return self.contents[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.contents)

    def __len__(self) -> int:
        return len(self.contents)

    def __str__(self) -> str:
        return "\n".join(f"{name}  {value}" for name, value in self.rows.items())


@dataclass(frozen=True, kw_only=True)
class Output:
    """Output of a command, ahead of its options; the command says what it is."""

    output: Any


class Reports(ABC):
    """A command on something that opens: `of` works on it and returns a result, `made` opens it, `run` prints."""

    @abstractmethod
    def of(self, opened: Any) -> Any:
        """Do the work on what was opened, and return a Result."""

    def made(self) -> Any:
        """Open the source, do the work, and return a Result."""
        from ..large import open_any

        return self.of(open_any(getattr(self, "source", None) or self.run_folder))  # type: ignore[attr-defined]

    def loaded(self, opened: Any) -> Any:
        """Opened source with its method, as the options of the command have it."""
        from ..export.loaded import Loaded

        options = {name: getattr(self, name) for name in ("settings", "part", "scaling") if hasattr(self, name)}
        return Loaded.of(opened, choose_device(getattr(self, "device", "cpu")), **options)

    def run(self) -> int:
        """Do the work, and print the result. Returns the exit code."""
        show(self.made().rows)
        return 0
