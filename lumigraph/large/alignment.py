"""Alignment of blocks: the appearance code of each is fitted to the pictures of its neighbours (Tancik 2022, 4.3.3),
and all are rendered with one exposure. Stops count from the median of its photographs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..components.fields.appearance import Appearance, Patches
from ..composition import Placed
from ..datasets.scene import Batch, Photograph
from ..geometry import evenly
from ..method.capabilities import HasAppearance, HasExposure, RefinesPoses, can, needs
from ..method.controls import Control
from ..system.progress import track
from .block_cache import Nearby
from .weights import saw

MAX_CAMERAS, COMPARED_CAMERAS = 8, 6  # candidate cameras between two blocks, and those whose pictures are compared
PICTURE_SIDE = 48  # pixels along the longer side of these pictures
PATCH_SIDE = 4  # pixels
MIN_RELATIVE_VISIBILITY = 0.5  # of the best seen patch's visibility, from which on patches are compared
EXPOSURE = "exposure"  # the control's name


def align_appearance(
    parts: Sequence[Placed] | Nearby,
    centres: Float[Tensor, "block 3"],
    radii: Float[Tensor, " block"],
    cameras: Camera,
    kept: Iterable[int] | None = None,
) -> list[Float[Tensor, " code"]]:
    """The appearance code of each block, in which it looks like its neighbours.

    Some blocks keep the appearance that they show: those of `kept`, or where it is None the one nearest to the middle
    of all, in the average of its photographs. Outward from there, nearest first, each block's code is optimised so that
    rays of cameras which it and blocks that are aligned already see well show the same colours, with all weights as
    they are. All neighbours that are aligned are compared with. A block with none in reach is aligned to the nearest.

    parts, centres, radii: as `InBlocks` takes them, in one common frame
    cameras: from which places to compare are chosen: the capture's photographs, in the common frame

    A code is stored as a plain list of numbers; `method.given(Appearance(torch.tensor(numbers)))` restores it. A block
    that learnt no appearance has an empty code. To align a block that was trained again, give the others their codes
    first and name them in `kept`.
    """
    parts = Nearby.of(parts)
    exposure, order = Asked.of(parts).usual, []
    found = dict[int, Appearance]()

    def lit(number: int) -> Placed:
        """A part in its light, as far as that is found."""
        part = exposed(parts[number], exposure)
        return replace(part, method=part.method.given(found[number])) if number in found else part

    if kept is None:
        middle = centres.mean(0)
        kept = [int((centres - middle).norm(dim=-1).argmin())]
    distance = torch.cdist(centres.double(), centres.double())
    done = sorted(set(kept))
    while waiting := [i for i in range(len(parts)) if i not in done]:
        i, j = min(((i, j) for i in waiting for j in done), key=lambda pair: float(distance[pair]))
        reached = [k for k in done if distance[i, k] < radii[i] + radii[k]] or [j]
        order.append((i, reached))
        done.append(i)
    for i, neighbours in track(order, "Aligning blocks", len(order)):
        own = lit(i)
        if not appearance_of(own).numel():
            continue
        alike = [x for k in neighbours if (x := patch(lit(k), own, centres[[k, i]], radii[[k, i]], cameras))]
        if alike:
            seen = Patches(joined(alike), PATCH_SIDE * PATCH_SIDE)
            found[i] = Appearance(appearance_of(replace(own, method=own.method.given(seen))))
    return [appearance_of(lit(i)) for i in range(len(parts))]


def appearance_of(part: Placed) -> Float[Tensor, " code"]:
    """The code that a part is shown in; empty where it has none."""
    if not can(part.method, HasAppearance):
        return torch.zeros(0)
    return needs(part.method, HasAppearance).shown_in.code.detach().cpu()


def patch(
    known: Placed, other: Placed, centres: Float[Tensor, "2 3"], radii: Float[Tensor, 2], cameras: Camera
) -> Batch | None:
    """Rays in the frame of one block, with the colours that another shows along them: those of some cameras between the
    two, of pixels that both saw well (section 4.3.3). None where there are no cameras."""
    views = [looked(known, other, camera) for camera in between(centres, radii, cameras)]
    views = sorted(views, key=lambda view: float(view.visibility.mean()), reverse=True)[:COMPARED_CAMERAS]
    return joined([view.well_seen() for view in views]) if views else None


@dataclass(frozen=True)
class BlockView:
    """Colours that one block shows a camera, the camera in the frame of another, and how well both saw each pixel."""

    rgb: Float[Tensor, "height width 3"]
    camera: Camera
    visibility: Float[Tensor, "height width"]

    def well_seen(self) -> Batch:
        """Patches of SIDE by SIDE pixels that both saw well, one after the other, as rays of the other block."""
        height, width = (n // PATCH_SIDE * PATCH_SIDE for n in self.visibility.shape)
        pixel = torch.arange(self.visibility.numel(), device=self.visibility.device).view_as(self.visibility)
        rows = pixel[:height, :width].unfold(0, PATCH_SIDE, PATCH_SIDE)
        patches = rows.unfold(1, PATCH_SIDE, PATCH_SIDE).reshape(-1, PATCH_SIDE * PATCH_SIDE)
        visibility = self.visibility.flatten()[patches].mean(-1)
        chosen = patches[visibility >= MIN_RELATIVE_VISIBILITY * visibility.max()].flatten()
        rays = self.camera.rays(self.camera.pixels()[chosen])
        return Batch(rays, self.rgb.flatten(0, 1)[chosen].clamp(0, 1))


def looked(known: Placed, other: Placed, camera: Camera) -> BlockView:
    """One block looked at through a small picture, and by how much the less seeing of both saw each pixel."""
    small = camera.resized(min(1.0, PICTURE_SIDE / int(camera.size.max())))
    seen, theirs = known.rendering(small), other.rendering(small)
    both = torch.minimum(saw(known, small, seen), saw(other, small, theirs))
    background = torch.tensor(other.method.frame.background, device=seen.rgb.device)
    return BlockView(seen.rgb + (1 - seen.opacity)[..., None] * background, other.camera(small), both)


def between(centres: Float[Tensor, "2 3"], radii: Float[Tensor, 2], cameras: Camera) -> list[Camera]:
    """Some of the cameras that are about as near to one block as to the other, by their radii, the nearest of them."""
    farther = ((cameras.position[:, None] - centres) / radii[:, None]).norm(dim=-1).amax(-1)
    near = farther.argsort()[: 3 * MAX_CAMERAS]
    return [cameras[int(i)] for i in evenly(near.tolist(), MAX_CAMERAS)]


def joined(batches: Sequence[Batch]) -> Batch:
    """One batch of several, none of them with alpha."""
    columns = {
        name: torch.cat([getattr(x.rays, name) for x in batches]) for name in ("origins", "directions", "radius")
    }
    rays = replace(batches[0].rays, **columns, time=None, image_index=None)
    return Batch(rays, torch.cat([x.rgb for x in batches]))


def own_exposure(part: Placed) -> float | None:
    """log2 of the exposure that is usual in one part; None where it knows of none."""
    return needs(part.method, HasExposure).usual_exposure if can(part.method, HasExposure) else None


def exposed(part: Placed, exposure: float | None) -> Placed:
    """The same part as if photographed with an exposure, log2 of it, or as near to it as it learnt from."""
    usual, reach = own_exposure(part), own_range(part)
    if usual is None or reach is None or exposure is None:
        return part
    stops = min(max(exposure, reach[0]), reach[1]) - usual
    return replace(part, method=part.method.given(**{EXPOSURE: stops}))


def own_range(part: Placed) -> tuple[float, float] | None:
    """The least and the most exposure, log2 of it, that one part learnt from; None where it has no choice."""
    control = next((x for x in part.method.controls if x.name == EXPOSURE), None)
    own = own_exposure(part)
    if control is None or control.range is None or own is None:
        return None
    return own + control.range[0], own + control.range[1]


@dataclass(frozen=True)
class Asked:
    """Controls and exposures of many parts, each of which is asked once.

    photographs: whether each finds its own appearance in a photograph
    refined:     whether any was learnt with poses
    controls:    that any of them has, the first of each name, but for exposure and those that name photographs
    usual:       log2 of the exposure that is usual among them, the median of theirs; None where none of them knows
    exposures:   the least and the most that any learnt from, log2 of them; None where none has a choice
    """

    photographs: bool
    refined: bool
    controls: tuple[Control, ...]
    usual: float | None
    exposures: tuple[float, float] | None

    @classmethod
    def of(cls, parts: Iterable[Placed]) -> Asked:
        """One part after the other is asked, and none is held."""
        photographs, refined, controls = True, False, dict[str, Control]()
        usual, ranges = list[float](), list[tuple[float, float]]()
        for part in parts:
            photographs &= Photograph in part.method.takes
            refined |= can(part.method, RefinesPoses)
            for control in part.method.controls:
                if not control.of_photographs and control.name != EXPOSURE:
                    controls.setdefault(control.name, control)
            if (own := own_exposure(part)) is not None:
                usual.append(own)
            if (reach := own_range(part)) is not None:
                ranges.append(reach)
        return cls(
            photographs,
            refined,
            tuple(controls.values()),
            median(usual) if usual else None,
            (min(least for least, _ in ranges), max(most for _, most in ranges)) if ranges else None,
        )
