"""Opened: whatever can be opened and looked at, a run, a splat file or a composition."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ..camera import Camera, dome, ring
from ..datasets.dataset import Dataset
from ..datasets.scene import Frame, Scene
from ..errors import LumigraphError
from ..exchange import size_of
from ..gaussians import Gaussians
from ..method import Method
from ..method.capabilities import HasGaussians, needs
from .checkpoint import State
from .records import read_evaluation
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
        """Title of its pages."""
        return self.path.name.partition(".")[0]

    @property
    def renders(self) -> Path:
        """Folder of its films: not beside a file, whose folder may be read-only."""
        return Path("renders") / self.title

    @property
    def paths(self) -> Path:
        """Folder of saved camera paths."""
        return self.renders / "paths"

    @abstractmethod
    def method(self, device: torch.device | str = "cpu") -> Method:
        """Method, ready to render."""

    def cameras(self) -> dict[str, Camera]:
        """Cameras by split, in `frame`; "train" is always among them. A ring around the bounds without photographs."""
        return {"train": ring(self.frame.bounds)}

    @property
    def photographed(self) -> bool:
        """True for cameras of photographs, False for a synthetic ring of cameras."""
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
        """Names of the photographs by split, in the order of `cameras`; empty without photographs."""
        return {}

    def survey(self, cameras: Camera) -> Camera:
        """The cameras that surfaces are looked at with, for meshes and points: its own, or a dome above its ring."""
        return cameras if self.photographed else dome(cameras)

    def set_scale(self, scale: float) -> None:
        """Remember the scale of exports: see `Frame.scale`. Raises LumigraphError for what remembers none."""
        raise LumigraphError(
            f"{self.path} remembers no scale, as a run does; export from the run, or scale the result in its program"
        )

    def metrics(self) -> list[dict[str, Any]]:
        """Training metrics, one row every few steps; empty where unknown."""
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
        """Source of its photographs or shapes."""

    @property
    @abstractmethod
    def method_name(self) -> str:
        """The method that learnt, as the user types it."""

    @property
    @abstractmethod
    def state(self) -> State:
        """Progress of the latest complete checkpoint. Raises LumigraphError if there is none."""

    @abstractmethod
    def dataset(self, source: str | None = None) -> Dataset:
        """Open its dataset again. source: its present path, if it has moved."""

    @property
    def title(self) -> str:
        """Name of its folder: that of its pages and of files made from it."""
        return self.folder.resolve().name

    @property
    def renders(self) -> Path:
        return self.folder / "renders"

    @property
    def paths(self) -> Path:
        return self.folder / "paths"

    def evaluation(self) -> dict[str, Any] | None:
        """Contents of eval.json, if it has been evaluated."""
        path = self.folder / "eval.json"
        return read_evaluation(path) if path.exists() else None
