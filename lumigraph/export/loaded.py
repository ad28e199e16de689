"""Loaded: an opened run or file with its method, as exports take it: controls set, at a moment, cropped, cleaned."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from ..camera import Camera
from ..camera.crop import Crop
from ..composition import FilteredCloud, PickedCloud, cropped
from ..composition.floaters import STRENGTH, floaters
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..exchange import write_gaussians
from ..exchange.fourdgs import write_moving
from ..exchange.streamed_sog import Detail
from ..gaussians import Gaussians
from ..gaussians.cloud import gone, unwanted
from ..gaussians.moving import MovingGaussians
from ..method import Method
from ..method.capabilities import HasGaussians, HasMovingGaussians, can, needs
from ..paths import Surroundings
from ..run import Opened
from ..run.files import MovingFile, SplatFile
from ..run.opened import at_one_moment, controlled
from .options import DURATION, Keeping, Scaling, SplatsOptions


@dataclass(frozen=True)
class Loaded:
    """An opened run or file, and its method as it is exported.

    method:  with the controls that were set
    cameras: of the photographs by split, as the method has refined them
    part:    the part of it to keep
    """

    opened: Opened
    method: Method
    cameras: dict[str, Camera]
    part: Keeping = Keeping()

    @classmethod
    def of(
        cls,
        opened: Opened,
        device: torch.device | str = "auto",
        settings: Iterable[str] = (),
        part: Keeping = Keeping(),
        scaling: Scaling = Scaling(),
    ) -> Loaded:
        """Load an opened run or file. settings: controls, NAME=VALUE; scaling: scale that the run remembers"""
        scaling.remember(opened)
        method = controlled(opened, opened.ready(device), settings)
        return cls(opened, method, {name: method.refined(some) for name, some in opened.cameras().items()}, part)

    @property
    def frame(self) -> Frame:
        """Frame of the scene."""
        return self.opened.frame

    @property
    def still(self) -> Loaded:
        """The same at the moment that was set, or at the first one of a scene that moves."""
        return replace(self, method=at_one_moment(self.method))

    @property
    def moves(self) -> bool:
        """True for a scene that moves, unless a moment was set."""
        return can(self.method, HasMovingGaussians) and "time" not in self.method.settings and bool(self.frame.times)

    def moments(self, count: int) -> Iterator[Loaded]:
        """The same at so many moments, evenly spread. Raises LumigraphError for a scene that does not move."""
        if (times := self.frame.times) is None:
            raise LumigraphError(f"{self.opened.path} does not move, so it has one mesh; leave out --moments")
        for i in range(count):
            time = times[0] + (times[1] - times[0]) * i / (count - 1)
            yield replace(self, method=self.method.given(time=f"{time:.9g}"))

    @property
    def photographers(self) -> Camera | None:
        """Cameras of the training photographs; None without photographs."""
        return self.cameras["train"] if self.opened.photographed else None

    @property
    def crop(self) -> Crop | None:
        """The crop in the scene's frame; None where there is none."""
        return self.part.crop(self.frame)

    def camera(self, view: str | None) -> Camera:
        """Camera of a training photograph by name or number; None for the one in the middle of all."""
        if view is None:
            return self.cameras["train"][Surroundings(self.cameras["train"], self.frame).middle]
        return self.method.refined(self.opened.find_view("train", view)[1])

    def unwanted(self, gaussians: Gaussians, crop: Crop | None) -> dict[str, Bool[Tensor, " gaussian"]]:
        """Masks of the Gaussians to remove, by reason. Raises LumigraphError if none is left."""
        part = self.part
        strength = (STRENGTH if part.clean else 0.0) if part.strength is None else part.strength
        floating = floaters(gaussians, self.photographers, self.frame, strength)
        reasons = unwanted(gaussians, crop, part.max_scale, floating)
        if len(gaussians) and gone(reasons).all():
            raise LumigraphError(
                "No Gaussian is left; give --box or --sphere where the scene is (`lumigraph info` shows its bounds), "
                "or a smaller --strength"
            )
        return reasons

    def kept(self, gaussians: Gaussians, crop: Crop | None) -> Bool[Tensor, " gaussian"]:
        """Mask of the Gaussians to keep. Raises LumigraphError if that is none."""
        return ~gone(self.unwanted(gaussians, crop))

    def gaussians(self) -> Gaussians:
        """Gaussians to keep, in the scene's frame. Raises LumigraphError if that is none."""
        gaussians = needs(self.method, HasGaussians).gaussians()
        return gaussians[self.kept(gaussians, self.crop)]

    def moving(self, duration: float | None) -> MovingGaussians:
        """Moving Gaussians to keep, in the scene's frame. duration: seconds of the whole capture when played; None
        keeps those of a file, and gives others DURATION"""
        duration = duration or (self.opened.moving.duration if isinstance(self.opened, MovingFile) else DURATION)
        if can(self.method, HasMovingGaussians):
            moving = needs(self.method, HasMovingGaussians).moving(duration)
        else:
            moving = MovingGaussians.still(needs(self.method, HasGaussians).gaussians(), duration)
        return moving[self.kept(moving.cloud, self.crop)]

    def kept_method(self) -> Method:
        """The cropped method without floaters, ready to render. Raises LumigraphError where it can have no floaters."""
        method, crop = self.method, self.crop
        moves = any(control.name == "time" for control in method.controls)
        if self.part.removes and moves:
            method = FilteredCloud(method, self.kept(needs(method, HasGaussians).gaussians(), None))
        elif self.part.removes or (crop is not None and can(method, HasGaussians) and not moves):
            return PickedCloud(method.frame, self.gaussians())
        return method if crop is None else cropped(method, crop)

    def without_floaters(self) -> Method:
        """All of the method but its floaters, for what crops by itself."""
        return replace(self, part=replace(self.part, box=None, sphere=None)).kept_method()


def export_splats(
    opened: Opened,
    path: Path,
    options: SplatsOptions = SplatsOptions(),
    settings: Sequence[str] = (),
    part: Keeping = Keeping(),
    scaling: Scaling = Scaling(),
) -> Gaussians:
    """Write a cloud as it is at one moment, and return it; a splat file's numbers stay. settings: NAME=VALUE"""
    if isinstance(opened, SplatFile):
        if settings:
            raise LumigraphError(f"{opened.path} is a file of Gaussians, which has no controls; leave out --set")
        scaling.remember(opened)
        cloud = opened.source_gaussians()
        if part.crops or part.removes:
            loaded = Loaded(opened, opened.ready("cpu"), {}, part)
            cloud = cloud[loaded.kept(cloud, loaded.crop and loaded.crop.transformed(opened.frame.to_source))]
    else:
        loaded = Loaded.of(opened, "cpu", settings, part, scaling)
        cloud = loaded.gaussians().transformed(opened.frame.to_export.matrix, far=True)
    write_gaussians(path, cloud, Detail(**options.detail.given), int(options.spz_version))
    return cloud


def export_moving(loaded: Loaded, path: Path, options: SplatsOptions = SplatsOptions()) -> MovingGaussians:
    """Write every moment of a scene that moves, as .4dgs, and return it. Raises LumigraphError for levels of detail."""
    if options.detail.given or options.detail.lod:
        raise LumigraphError("A .4dgs has no levels of detail; leave out --lod and its options")
    if "time" in loaded.method.settings:
        raise LumigraphError("A .4dgs holds every moment; leave out --set time, or name a .spz for one of them")
    moving = loaded.moving(options.duration)
    write_moving(path, moving.transformed(loaded.frame.to_export.matrix, far=True))
    return moving
