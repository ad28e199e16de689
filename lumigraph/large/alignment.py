"""Alignment of blocks: the appearance code of each is fitted to the pictures of its neighbours (Tancik 2022, 4.3.3),
and all are rendered with one exposure, relative to the median of their photographs."""

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
    """Appearance code of each block, fitted to match its neighbours.

    Some blocks keep their appearance: those of `kept`, or if None the block nearest to the centre of all, in the
    average appearance of its photographs. Outward from there, nearest first, each block's code is optimised, with fixed
    weights, to match the colours of all aligned neighbours along rays that both see well. A block without neighbours in
    reach is aligned to the nearest.

    parts, centres, radii: as for `InBlocks`, in one common frame
    cameras: of the photographs, in the common frame; comparisons use some of them

    A code is stored as a plain list of numbers; `method.given(Appearance(torch.tensor(numbers)))` restores it. A block
    without appearance codes has an empty one. To align a block that was trained again, give the others their codes
    first and name them in `kept`.
    """
    parts = Nearby.of(parts)
    exposure, order = Asked.of(parts).usual, []
    found = dict[int, Appearance]()

    def lit(number: int) -> Placed:
        """A part in its appearance, if already fitted."""
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
    """A part's current appearance code; empty without one."""
    if not can(part.method, HasAppearance):
        return torch.zeros(0)
    return needs(part.method, HasAppearance).shown_in.code.detach().cpu()


def patch(
    known: Placed, other: Placed, centres: Float[Tensor, "2 3"], radii: Float[Tensor, 2], cameras: Camera
) -> Batch | None:
    """Rays in the frame of one block with another block's colours along them, from some cameras between the two, at
    pixels that both see well (section 4.3.3). None without such cameras."""
    views = [looked(known, other, camera) for camera in between(centres, radii, cameras)]
    views = sorted(views, key=lambda view: float(view.visibility.mean()), reverse=True)[:COMPARED_CAMERAS]
    return joined([view.well_seen() for view in views]) if views else None


@dataclass(frozen=True)
class BlockView:
    """One block's rendering for a camera in another block's frame, and the visibility of each pixel in both."""

    rgb: Float[Tensor, "height width 3"]
    camera: Camera
    visibility: Float[Tensor, "height width"]

    def well_seen(self) -> Batch:
        """Patches of SIDE by SIDE pixels of high visibility in both, concatenated, as rays of the other block."""
        height, width = (n // PATCH_SIDE * PATCH_SIDE for n in self.visibility.shape)
        pixel = torch.arange(self.visibility.numel(), device=self.visibility.device).view_as(self.visibility)
        rows = pixel[:height, :width].unfold(0, PATCH_SIDE, PATCH_SIDE)
        patches = rows.unfold(1, PATCH_SIDE, PATCH_SIDE).reshape(-1, PATCH_SIDE * PATCH_SIDE)
        visibility = self.visibility.flatten()[patches].mean(-1)
        chosen = patches[visibility >= MIN_RELATIVE_VISIBILITY * visibility.max()].flatten()
        rays = self.camera.rays(self.camera.pixels()[chosen])
        return Batch(rays, self.rgb.flatten(0, 1)[chosen].clamp(0, 1))


def looked(known: Placed, other: Placed, camera: Camera) -> BlockView:
    """Render one block in a small picture, with each pixel's lesser visibility of both."""
    small = camera.resized(min(1.0, PICTURE_SIDE / int(camera.size.max())))
    seen, theirs = known.rendering(small), other.rendering(small)
    both = torch.minimum(saw(known, small, seen), saw(other, small, theirs))
    background = torch.tensor(other.method.frame.background, device=seen.rgb.device)
    return BlockView(seen.rgb + (1 - seen.opacity)[..., None] * background, other.camera(small), both)


def between(centres: Float[Tensor, "2 3"], radii: Float[Tensor, 2], cameras: Camera) -> list[Camera]:
    """Cameras about as near to one block as to the other, relative to their radii; some of the nearest."""
    farther = ((cameras.position[:, None] - centres) / radii[:, None]).norm(dim=-1).amax(-1)
    near = farther.argsort()[: 3 * MAX_CAMERAS]
    return [cameras[int(i)] for i in evenly(near.tolist(), MAX_CAMERAS)]


def joined(batches: Sequence[Batch]) -> Batch:
    """Concatenate batches without alpha."""
    columns = {
        name: torch.cat([getattr(x.rays, name) for x in batches]) for name in ("origins", "directions", "radius")
    }
    rays = replace(batches[0].rays, **columns, time=None, image_index=None)
    return Batch(rays, torch.cat([x.rgb for x in batches]))


def own_exposure(part: Placed) -> float | None:
    """Usual exposure of one part, log2; None if unknown."""
    return needs(part.method, HasExposure).usual_exposure if can(part.method, HasExposure) else None


def exposed(part: Placed, exposure: float | None) -> Placed:
    """The same part at an exposure, log2, clamped to its training range."""
    usual, reach = own_exposure(part), own_range(part)
    if usual is None or reach is None or exposure is None:
        return part
    stops = min(max(exposure, reach[0]), reach[1]) - usual
    return replace(part, method=part.method.given(**{EXPOSURE: stops}))


def own_range(part: Placed) -> tuple[float, float] | None:
    """Least and largest training exposure of one part, log2; None without exposure control."""
    control = next((x for x in part.method.controls if x.name == EXPOSURE), None)
    own = own_exposure(part)
    if control is None or control.range is None or own is None:
        return None
    return own + control.range[0], own + control.range[1]


@dataclass(frozen=True)
class Asked:
    """Controls and exposures of all blocks.

    photographs: whether each can fit its appearance to a photograph
    refined:     whether any was trained with pose optimisation
    controls:    of any block, the first of each name, except for exposure and those that name photographs
    usual:       median of the blocks' usual exposures, log2; None if all are unknown
    exposures:   least and largest training exposure of all, log2; None without exposure control
    """

    photographs: bool
    refined: bool
    controls: tuple[Control, ...]
    usual: float | None
    exposures: tuple[float, float] | None

    @classmethod
    def of(cls, parts: Iterable[Placed]) -> Asked:
        """Evaluate blocks one by one; load none permanently."""
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
