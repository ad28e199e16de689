"""`--box`, `--sphere`, `--clean` and related options: crop a trained scene and remove floaters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from tyro.conf import arg

from ..errors import LumigraphError
from ..files.ranges import Coordinate, Positive, Share
from .common import option

Six = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
Four = tuple[Coordinate, Coordinate, Coordinate, Positive]


@dataclass(frozen=True)
class Keeping:
    """Crop the scene, and remove floaters from Gaussians."""

    box: Annotated[Six | None, arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="(default: everything)")] = None
    """Crop to the box between two corners."""
    sphere: Annotated[Four | None, arg(metavar="X Y Z RADIUS", help_behavior_hint="(default: everything)")] = None
    """Crop to the inside of a sphere."""
    units: Literal["scene", "source"] = "scene"
    """Frame of --box and --sphere: scene, as in `lumigraph info` and the viewer, or source, as in the photographs and
    exports."""
    clean: bool = False
    """Remove floaters from Gaussians: faint, huge or isolated ones, with limits that suit most scenes."""
    min_opacity: Annotated[Share | None, option("SHARE", "0, with --clean 0.02")] = None
    """Remove Gaussians with a lower opacity; a larger value removes more."""
    max_scale: Annotated[Positive | None, option("SHARE", "any, with --clean 1")] = None
    """Remove Gaussians with a larger standard deviation, in extents of the cloud; a smaller value removes more."""
    isolation: Annotated[Positive | None, option("DEVIATIONS", "any, with --clean 3")] = None
    """Remove Gaussians farther from neighbours than most, in standard deviations; a smaller value removes more."""

    @property
    def crops(self) -> bool:
        return self.box is not None or self.sphere is not None

    @property
    def floaters(self) -> Mapping[str, float]:
        """Arguments of `cleaned` for floaters: the given numbers, with --clean the defaults of the rest."""
        from ..gaussians.cloud import ISOLATION, MAX_SCALE, MIN_OPACITY

        usual = {"min_opacity": MIN_OPACITY, "max_scale": MAX_SCALE, "isolation": ISOLATION}
        given = {name: value for name in usual if (value := getattr(self, name)) is not None}
        return usual | given if self.clean else given

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.box is not None and self.sphere is not None:
            raise LumigraphError("--box and --sphere are two ways to crop; give one of them")
        if self.box is not None and not all(a < b for a, b in zip(self.box[:3], self.box[3:], strict=True)):
            raise LumigraphError("The box holds nothing; give --box its lower corner first, then its upper one")

    def crop(self, frame: Any) -> Any:
        """The Crop, in the scene's frame; None where there is none."""
        from ..camera.crop import Box, Crop, Sphere

        crop: Crop
        if self.box is not None:
            crop = Box(self.box[:3], self.box[3:])
        elif self.sphere is not None:
            crop = Sphere(self.sphere[:3], self.sphere[3])
        else:
            return None
        return crop if self.units == "scene" else crop.moved(frame.to_source.inverse)

    def unwanted(self, gaussians: Any, crop: Any) -> Any:
        """Masks of the Gaussians to remove, by reason. Raises LumigraphError if that is all of them."""
        from ..gaussians.cloud import gone, unwanted

        reasons = unwanted(gaussians, crop, **self.floaters)
        if len(gaussians) and gone(reasons).all():
            raise LumigraphError(
                "No Gaussian is left; give --box or --sphere where the scene is (`lumigraph info` tells its bounds), "
                "or clean less"
            )
        return reasons

    def of_gaussians(self, gaussians: Any, crop: Any) -> Any:
        """The Gaussians that are wanted. Raises LumigraphError if that is none."""
        from ..gaussians.cloud import gone

        return gaussians[~gone(self.unwanted(gaussians, crop))]

    def of_method(self, method: Any) -> Any:
        """The part of a method that is wanted, ready to render. Raises LumigraphError where it can have no floaters."""
        from ..composition import PickedCloud, cropped
        from ..method.capabilities import HasGaussians, can, needs

        crop = self.crop(method.frame)
        if self.floaters or (crop is not None and can(method, HasGaussians)):
            return PickedCloud(method.frame, self.of_gaussians(needs(method, HasGaussians).gaussians(), crop))
        return method if crop is None else cropped(method, crop)

    def without_floaters(self, method: Any) -> Any:
        """All of a method but its floaters, for what crops by itself."""
        return replace(self, box=None, sphere=None).of_method(method)
