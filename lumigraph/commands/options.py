"""Options of several commands: their format in --help; controls of the method (--set, --animate); crops and removal of
floaters (--box, --sphere, --clean)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Fixed, Positional, Suppress, UseAppendAction, arg

from ..errors import LumigraphError
from ..files.options import needed as needed
from ..files.options import option as option
from ..files.ranges import Coordinate, Positive, Seed, Share, Steps
from ..files.readers import LISTED, NAMES

if TYPE_CHECKING:
    Reader = str
else:
    Reader = Literal[NAMES]


DEVICE = "Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."
DeviceOption = Annotated[str, option("NAME", about=DEVICE)]
OVERWRITE = (
    "Replace existing files of other origin too. Unchanged files that Lumigraph wrote are replaced anyway; folders "
    "with other files in them never are."
)
Overwrite = Annotated[bool, arg(help=OVERWRITE)]
ORIGIN = "Write latitude and longitude of the frame's origin into the file, where they are known."
OriginOption = Annotated[bool, arg(help=ORIGIN)]
PHOTOGRAPHS = "Path of the photographs, if they were moved since training."
PhotographsOption = Annotated[str | None, option("SCENE", "the path used in training", PHOTOGRAPHS)]
ReaderOption = Annotated[Reader | None, option("NAME", "detected", f"Layout of the folder: {LISTED}.")]
RunOption = Annotated[Positional[Path], needed("RUN", "Folder of the run.")]
SeedOption = Annotated[Seed, option("N", about="Seed of all random choices.")]
SOURCE = "Folder of a run, a splat file (.ply, .spz ...), or a composition (.json)."
SourceOption = Annotated[Positional[Path], needed("RUN_OR_FILE", SOURCE)]
# Secret of a viewer, for requests alone: `ps` shows options.
ViewerToken = Annotated[str, Fixed, Suppress]
INSTEAD = "Train for this number of steps instead."
StepsOption = Annotated[Steps | None, option("N", "as long as --seconds", INSTEAD)]

SET = "Set a control of the method; `lumigraph info RUN` lists them. Can be given several times."
Set = UseAppendAction[Annotated[tuple[str, ...], needed("NAME=VALUE", SET, "set")]]
ANIMATE = "Change a control from A to B over the film, or on to C with A:B:C. Can be given several times."
Animate = UseAppendAction[Annotated[tuple[str, ...], needed("NAME=A:B", ANIMATE, "animate")]]


def open_method(
    source: Any, device: str, settings: Iterable[str] = (), scaling: Scaling | None = None
) -> tuple[Any, Any, Any]:
    """The opened run or file, its method with the controls of --set, and the cameras of its photographs by split, as
    the method has refined them. scaling: of --scale-by, which a run remembers"""
    from ..large import open_any
    from .common import choose_device

    opened = open_any(source)
    if scaling is not None:
        scaling.remember(opened)
    method = controlled(opened, opened.ready(choose_device(device)), settings)
    return opened, method, {split: method.refined(cameras) for split, cameras in opened.cameras().items()}


def photographers(opened: Any, method: Any) -> Any:
    """Cameras of the training photographs, as the method has refined them; None without photographs."""
    return method.refined(opened.cameras()["train"]) if opened.photographed else None


def controlled(opened: Any, method: Any, settings: Iterable[str]) -> Any:
    """The method with the controls of --set. Raises LumigraphError for unknown controls."""
    values = dict(parted("--set", "NAME=VALUE", text) for text in settings)
    return method.given(**{name: by_number(opened, method, name, value) for name, value in values.items()})


def at_one_moment(method: Any) -> Any:
    """A dynamic method fixed at the time of --set or at its first one, for all cameras; any other unchanged."""
    control = next((one for one in method.controls if one.name == "time"), None)
    return method if control is None else method.given(time=method.control("time"))


def animate(opened: Any, method: Any, settings: Iterable[str], frames: int) -> Any:
    """The method for each frame of a film by --animate; the method itself without --animate."""
    from ..export.film import animated

    stations = {}
    for name, text in (parted("--animate", "NAME=A:B", text) for text in settings):
        if name in method.settings:
            raise LumigraphError(f"{name} is both set and animated; leave out --set {name} or --animate {name}")
        if ":" not in text:
            raise LumigraphError(f"--animate {name}={text} goes nowhere; write where it goes, as in {name}=A:B")
        stations[name] = [by_number(opened, method, name, value) for value in text.split(":")]
    return animated(method, stations, frames) if stations else method


def parted(option: str, form: str, text: str) -> tuple[str, str]:
    """Name and value of NAME=VALUE."""
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise LumigraphError(f"{option} {text} gives no value for a control; write {option} {form}")
    return name.strip().replace("-", "_"), value.strip()


def by_number(opened: Any, method: Any, name: str, value: str) -> str:
    """The value, with a photograph's name replaced by its number if the control takes one; in a blend, A:B:0.5, both
    names."""
    control = next((control for control in method.controls if control.name == name), None)
    if control is None or not control.of_photographs:
        return value
    by_name = numbers(opened)
    if value in by_name or not control.blends:
        return by_name.get(value, value)
    return ":".join(by_name.get(part, part) for part in value.split(":"))


def numbers(opened: Any) -> dict[str, str]:
    """The number of each photograph, by its name."""
    cameras = opened.cameras()
    return {
        name: str(number)
        for split, names in opened.view_names().items()
        for name, number in zip(names, cameras[split].image_index.tolist(), strict=True)
    }


Six = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
Four = tuple[Coordinate, Coordinate, Coordinate, Positive]
Seven = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Positive]


@dataclass(frozen=True)
class Scaling:
    """The unit of exports, by one known length."""

    scale_by: Annotated[Seven | None, option("X0 Y0 Z0 X1 Y1 Z1 LENGTH", "the scale that the run remembers")] = None
    """Two points in the frame of the photographs, and their distance in the unit that exports shall have."""

    def check(self) -> None:
        """Raises LumigraphError for two points in one place."""
        if self.scale_by is not None and self.scale_by[:3] == self.scale_by[3:6]:
            raise LumigraphError("--scale-by names one point twice; give two points, and the distance between them")

    def remember(self, opened: Any) -> None:
        """Set the scale of an opened run, once and for all exports. Raises LumigraphError for files that cannot
        store it."""
        if self.scale_by is not None:
            opened.set_scale(self.scale_by[6] / math.dist(self.scale_by[:3], self.scale_by[3:6]))


@dataclass(frozen=True)
class Cropping:
    """Crop the scene to a box or a sphere."""

    box: Annotated[Six | None, option("X0 Y0 Z0 X1 Y1 Z1", "everything")] = None
    """Crop to the box between two corners."""
    sphere: Annotated[Four | None, option("X Y Z RADIUS", "everything")] = None
    """Crop to the inside of a sphere."""
    units: Literal["scene", "source"] = "scene"
    """Frame of --box and --sphere: scene, as in `lumigraph info` and the viewer, or source, as in the photographs and
    exports."""

    @property
    def crops(self) -> bool:
        return self.box is not None or self.sphere is not None

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.box is not None and self.sphere is not None:
            raise LumigraphError("--box and --sphere are two ways to crop; give one of them")
        if self.box is not None and not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise LumigraphError("The box holds nothing; give --box its lower corner first, then its upper one")

    def crop(self, frame: Any) -> Any:
        """The Crop, in the scene's frame; None where there is none."""
        from ..camera.crop import Crop, CropBox, Sphere

        crop: Crop
        if self.box is not None:
            crop = CropBox(self.box[:3], self.box[3:])
        elif self.sphere is not None:
            crop = Sphere(self.sphere[:3], self.sphere[3])
        else:
            return None
        return crop if self.units == "scene" else crop.transformed(frame.to_source.inverse)


@dataclass(frozen=True)
class Keeping(Cropping):
    """Crop the scene, and remove floaters from Gaussians."""

    clean: bool = False
    """Remove floaters from Gaussians, as `lumigraph clean` does."""
    strength: Annotated[Share | None, option("SHARE", "0, with --clean 0.4")] = None
    """Remove Gaussians with a floater score above 1 - strength; a larger value removes more."""
    max_scale: Annotated[Positive | None, option("SHARE", "any")] = None
    """Remove Gaussians with a larger standard deviation, in extents of the cloud; a smaller value removes more."""

    @property
    def removes(self) -> bool:
        """True if Gaussians are removed for reasons other than a crop."""
        return self.clean or bool(self.strength) or self.max_scale is not None

    def of_gaussians(self, gaussians: Any, crop: Any, frame: Any, cameras: Any) -> Any:
        """Gaussians to keep. Raises LumigraphError if there is none."""
        return gaussians[self.kept(gaussians, crop, frame, cameras)]

    def kept(self, gaussians: Any, crop: Any, frame: Any, cameras: Any) -> Any:
        """Mask of the Gaussians to keep. Raises LumigraphError if there is none.

        cameras: of the photographs, in the cloud's frame; None without photographs
        """
        from ..composition.floaters import STRENGTH, floaters
        from ..gaussians.cloud import gone, unwanted

        strength = (STRENGTH if self.clean else 0.0) if self.strength is None else self.strength
        lost = gone(unwanted(gaussians, crop, self.max_scale, floaters(gaussians, cameras, frame, strength)))
        if len(gaussians) and lost.all():
            raise LumigraphError(
                "No Gaussian is left; give --box or --sphere where the scene is (`lumigraph info` shows its bounds), "
                "or clean less"
            )
        return ~lost

    def of_method(self, method: Any, opened: Any) -> Any:
        """The method, cropped and without floaters. Raises LumigraphError for floaters of a method without Gaussians.

        opened: the method's run or file
        """
        from ..composition import FilteredCloud, PickedCloud, cropped
        from ..method.capabilities import HasGaussians, can, needs

        crop = self.crop(method.frame)
        moves = any(control.name == "time" for control in method.controls)
        if self.removes and moves:
            gaussians = needs(method, HasGaussians).gaussians()
            method = FilteredCloud(method, self.kept(gaussians, None, method.frame, photographers(opened, method)))
            return method if crop is None else cropped(method, crop)
        if self.removes or (crop is not None and can(method, HasGaussians) and not moves):
            gaussians = needs(method, HasGaussians).gaussians()
            kept = self.of_gaussians(gaussians, crop, method.frame, photographers(opened, method))
            return PickedCloud(method.frame, kept)
        return method if crop is None else cropped(method, crop)

    def without_floaters(self, method: Any, opened: Any) -> Any:
        """A method without its floaters but not cropped, for exports with their own crop."""
        return replace(self, box=None, sphere=None).of_method(method, opened)


def told_origin(frame: Any, wanted: bool) -> tuple[Any, dict[str, str]]:
    """Origin on Earth for a file, and its row to print; neither if unknown or unwanted."""
    if not wanted or frame.origin is None:
        return None, {}
    place = f"latitude {frame.origin.latitude:.6f}, longitude {frame.origin.longitude:.6f}"
    return frame.origin, {"place": f"the file holds {place} of its origin; --no-origin leaves them out"}
