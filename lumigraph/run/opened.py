"""Opened models: anything that can be opened and rendered, such as a run, a splat file or a composition."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch

from ..camera import Camera, dome, ring
from ..camera.rays import Rendering
from ..datasets.dataset import Dataset
from ..datasets.scene import Frame, Scene
from ..errors import LumigraphError, LumigraphWarning
from ..exchange import size_of
from ..figures import png
from ..files import refuse_link
from ..gaussians import Gaussians
from ..geometry import Similarity
from ..method import Method
from ..method.capabilities import HasGaussians, needs
from ..system.work import at_work
from .checkpoint import State
from .records import read_evaluation
from .settings import Settings, Source


class Opened(ABC):
    """An opened model with its path and cameras: the interface for films, the viewer and exports.

    path:  of the file or folder
    frame: of the method and of the cameras
    """

    path: Path
    frame: Frame
    _ready: tuple[Any, Method] | None = None  # version, device and unit of the method that renders

    @property
    def title(self) -> str:
        """Title of its pages."""
        return self.path.name.partition(".")[0]

    @property
    def renders(self) -> Path:
        """Folder of its films; for a file not beside it, since its folder may be read-only."""
        return Path("renders") / self.title

    @property
    def paths(self) -> Path:
        """Folder of saved camera paths."""
        return self.renders / "paths"

    def render(self, camera: Camera, device: str = "auto", **controls: Any) -> Rendering:
        """Picture of one camera, with leading axes (height, width). The method is loaded once.

        camera:   in `frame`, as those of `cameras()`
        controls: values of the method's controls, such as time=0.3
        """
        with at_work(), torch.no_grad():
            return self.ready(device).given(**controls).render(camera)

    def ready(self, device: torch.device | str = "auto") -> Method:
        """Method of the current version, loaded once."""
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        version = (self.version, str(device), self.frame.scale)
        if self._ready is None or self._ready[0] != version:
            self._ready = version, self.method(device)
        return self._ready[1]

    def __repr__(self) -> str:
        """One line of its facts."""
        (_, first), *rest = self.facts().items()
        return f"{type(self).__name__} {first}" + ": " * bool(rest) + ", ".join(f"{k} {v}" for k, v in rest)

    def facts(self) -> dict[str, object]:
        """Rows of the table below its picture in a notebook."""
        return {"file": self.path}

    def still(self, pixels: int) -> bytes:
        """Picture as PNG from the first camera. pixels: its longer side"""
        camera = self.cameras()["train"][0]
        return png(self.render(camera.resized(min(1.0, pixels / int(camera.size.max())))).rgb)

    @property
    def version(self) -> str:
        """Identifier of the state that is rendered; it changes with further training."""
        return ""

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
    def masked(self) -> bool:
        """True if its photographs may have masks that exclude pixels from training."""
        return self.photographed

    @property
    def open_scene(self) -> Callable[..., Scene] | None:
        """Function that opens the photographs again, given their present path; None without photographs."""
        return None

    def photographs(self, source: str | None, instead: str | None) -> Scene | None:
        """Photographs; None where there are none, and with a warning where they are gone.

        source:  their present path, if they have moved; Raises LumigraphError if they are not there
        instead: sentence on what is done without them; None for no warning
        """
        try:
            return self.open_scene and self.open_scene(source)
        except LumigraphError as error:
            if source is not None:
                raise
            if instead:
                warnings.warn(f"{instead}, for {error}", LumigraphWarning, stacklevel=3)
            return None

    @property
    def conversion_fault(self) -> str | None:
        """Reason why `convert` refuses it, and a way out; None if it can be converted."""
        return None

    @property
    def model_bytes(self) -> int:
        """Size of the stored model, sufficient for rendering."""
        return size_of(self.path)

    def source_gaussians(self) -> Gaussians:
        """Cloud in the source's frame, in the order of the method's. Raises LumigraphError for a model without
        Gaussians.
        """
        return needs(self.method(), HasGaussians).gaussians().transformed(self.frame.to_source.matrix, far=True)

    def view_names(self) -> dict[str, list[str]]:
        """Names of the photographs by split, in the order of `cameras`; empty without photographs."""
        return {}

    def find_view(self, split: str, view: str) -> tuple[str, Camera]:
        """Name and camera of a photograph, by its name or number in a split. Raises LumigraphError if there is none."""
        names = self.view_names().get(split, [])
        if not names:
            raise LumigraphError(f"{self.path} has no views in the split {split!r}; choose another --split")
        number = names.index(view) if view in names else int(view) if view.isdecimal() else len(names)
        if number >= len(names):
            raise LumigraphError(
                f"There is no view {view!r} in the split {split!r} of {self.path}; give --view a number from 0 to "
                f"{len(names) - 1}, or a name such as {names[0]}"
            )
        return names[number], self.cameras()[split][number]

    def survey(self, cameras: Camera) -> Camera:
        """Cameras for extracting meshes and points: its own, or a dome above its ring."""
        return cameras if self.photographed else dome(cameras)

    def set_scale(self, scale: float) -> None:
        """Set the scale of exports: see `Frame.scale`. Raises LumigraphError for a model that cannot store it."""
        raise LumigraphError(
            f"{self.path} remembers no scale, as a run does; export from the run, or scale the result in its program"
        )

    def set_world(self, world: Similarity) -> None:
        """Remember `Frame.world_from_source`, the frame of exports. Raises LumigraphError for what remembers none."""
        raise LumigraphError(f"{self.path} remembers no frame, as a run does; give the run that it was made of")

    def metrics(self) -> list[dict[str, Any]]:
        """Training metrics, one row every few steps; empty where unknown."""
        return []


class Trained(Opened):
    """A training folder; its films, camera paths and measurements are stored there too.

    folder:   of the run or block run
    settings: method, dataset and budget
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
        """Name of the method, as the user types it."""

    @property
    @abstractmethod
    def state(self) -> State:
        """Progress of the latest complete checkpoint. Raises LumigraphError if there is none."""

    @abstractmethod
    def dataset(self, source: str | None = None) -> Dataset:
        """Open the training dataset again. source: its present path, if it has moved"""

    def method_and_data(
        self, device: torch.device | str, settings: Iterable[str] = (), source: str | None = None, split: str = "test"
    ) -> tuple[Method, Any]:
        """Method with controls, NAME=VALUE, and the dataset with a split to compare it with. source: see `dataset`"""
        return controlled(self, self.ready(device), settings), self.dataset(source)

    @property
    def title(self) -> str:
        """Name of its folder: that of its pages and of files made from it."""
        return self.folder.resolve().name

    @property
    def renders(self) -> Path:
        refuse_link(self.folder / "renders")
        return self.folder / "renders"

    @property
    def paths(self) -> Path:
        return self.folder / "paths"

    def evaluation(self) -> dict[str, Any] | None:
        """Contents of eval.json, if it has been evaluated."""
        path = self.folder / "eval.json"
        return read_evaluation(path) if path.exists() else None


def controlled(opened: Opened, method: Method, settings: Iterable[str]) -> Method:
    """The method with the controls of --set. Raises LumigraphError for controls that it does not have."""
    values = dict(parted("--set", "NAME=VALUE", text) for text in settings)
    return method.given(**{name: by_number(opened, method, name, value) for name, value in values.items()})


def stations_of(opened: Opened, method: Method, animations: Iterable[str]) -> dict[str, list[str]]:
    """Values of each control of --animate, NAME=A:B. Raises LumigraphError for controls that are set already."""
    stations = {}
    for name, text in (parted("--animate", "NAME=A:B", text) for text in animations):
        if name in method.settings:
            raise LumigraphError(f"{name} is both set and animated; leave out --set {name} or --animate {name}")
        if ":" not in text:
            raise LumigraphError(f"--animate {name}={text} goes nowhere; write where it goes, as in {name}=A:B")
        stations[name] = [by_number(opened, method, name, value) for value in text.split(":")]
    return stations


def parted(option: str, form: str, text: str) -> tuple[str, str]:
    """The two sides of NAME=VALUE."""
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise LumigraphError(f"{option} {text} gives no value for a control; write {option} {form}")
    return name.strip().replace("-", "_"), value.strip()


def by_number(opened: Opened, method: Method, name: str, value: str) -> str:
    """The value, or the number of the photograph that it names if the control takes one; in a blend, A:B:0.5, the
    numbers of both."""
    control = next((control for control in method.controls if control.name == name), None)
    if control is None or not control.of_photographs:
        return value
    by_name = numbers(opened)
    if value in by_name or not control.blends:
        return by_name.get(value, value)
    return ":".join(by_name.get(part, part) for part in value.split(":"))


def numbers(opened: Opened) -> dict[str, str]:
    """The number of each photograph, by its name."""
    cameras = opened.cameras()
    return {
        name: str(number)
        for split, names in opened.view_names().items()
        for name, number in zip(names, cameras[split].image_index.tolist(), strict=True)  # type: ignore[union-attr]
    }


def at_one_moment(method: Method) -> Method:
    """A method that moves, at the moment of --set or at its first one, for all cameras; any other as it is."""
    control = next((one for one in method.controls if one.name == "time"), None)
    return method if control is None else method.given(time=method.control("time"))
