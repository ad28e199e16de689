"""Opened: whatever can be opened and looked at, a run, a splat file or a composition."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ..camera import Camera, dome
from ..datasets.dataset import Dataset
from ..datasets.scene import Frame, Scene
from ..exchange import size_of
from ..gaussians import Gaussians
from ..method import Method
from ..method.capabilities import HasGaussians, needs
from .checkpoint import State
from .measured import read_evaluation
from .settings import Settings, Source


class Opened(ABC):
    """Something to render, where it is, and cameras that see it: all that films, the viewer and exports ask for.

    path:  where it lies
    frame: of what it renders, and of its cameras
    """

    path: Path
    frame: Frame

    @property
    def title(self) -> str:
        """What a page of it is called."""
        return self.path.name.partition(".")[0]

    @property
    def renders(self) -> Path:
        """Where films of it go: not beside a file, which may lie where nobody may write."""
        return Path("renders") / self.title

    @property
    def paths(self) -> Path:
        """Where camera paths that somebody saves go."""
        return self.renders / "paths"

    @abstractmethod
    def method(self, device: torch.device | str = "cpu") -> Method:
        """What it shows, ready to render."""

    @abstractmethod
    def cameras(self) -> dict[str, Camera]:
        """Cameras by split, in `frame`; "train" is always among them."""

    @property
    def photographed(self) -> bool:
        """Whether these are cameras of photographs, rather than a ring around what nobody has photographed."""
        return False

    @property
    def open_scene(self) -> Callable[..., Scene] | None:
        """Function that opens the photographs again, told where they are now if they have moved; None where there are
        none."""
        return None

    @property
    def conversion_fault(self) -> str | None:
        """Reason why `convert` refuses it, and what to do instead; None for what can be converted."""
        return None

    @property
    def model_bytes(self) -> int:
        """Size of what rendering needs, as it is stored."""
        return size_of(self.path)

    def source_gaussians(self) -> Gaussians:
        """Cloud in the source's frame, in the order of the method's. Raises LumigraphError for what is no cloud."""
        return needs(self.method(), HasGaussians).gaussians().transformed(self.frame.to_source.matrix)

    def view_names(self) -> dict[str, list[str]]:
        """What the photographs are called, by split, in the order of `cameras`; nothing where there are none."""
        return {}

    def survey(self, cameras: Camera) -> Camera:
        """The cameras that surfaces are looked at with, for meshes and points: its own, or a dome above its ring."""
        return cameras if self.photographed else dome(cameras)

    def metrics(self) -> list[dict[str, Any]]:
        """What was measured while it was learnt, a row every few steps; none where that is not known."""
        return []


class Trained(Opened):
    """A folder in which something was learnt; films, camera paths and what was measured of it lie there too.

    folder:   where it lies
    settings: what was trained on what
    """

    folder: Path
    settings: Settings

    @property
    @abstractmethod
    def learnt_from(self) -> Source:
        """Where its photographs or shapes came from."""

    @property
    @abstractmethod
    def method_name(self) -> str:
        """The method that learnt, as the user types it."""

    @property
    @abstractmethod
    def state(self) -> State:
        """How far the latest complete state has come. Raises LumigraphError if there is none."""

    @abstractmethod
    def dataset(self, source: str | None = None) -> Dataset:
        """What it learnt from again. source: where that is now, if it has moved."""

    @property
    def title(self) -> str:
        """The scene's name."""
        source = self.learnt_from.source
        return Path(source.partition(":")[2]).name if source.startswith("procedural:") else Path(source).name

    @property
    def renders(self) -> Path:
        return self.folder / "renders"

    @property
    def paths(self) -> Path:
        return self.folder / "paths"

    def evaluation(self) -> dict[str, Any] | None:
        """What eval.json says, if it has been evaluated."""
        path = self.folder / "eval.json"
        return read_evaluation(path) if path.exists() else None
