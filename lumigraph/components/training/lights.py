"""Whether photographs were taken in the same light, as far as the places that structure from motion found can tell."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...camera import Camera
from ...datasets.scene import Scene
from ...geometry import evenly
from ..clouds.flat_view import FlatView, flat_view

LOOKED_AT = 32  # photographs, each beside its neighbour
LONGEST = 200  # pixels along their longer side
POINTS = 1 << 14  # places at most
FEWEST = 30  # places that two photographs must share to be compared
DARKEST, BRIGHTEST = 0.05, 0.95  # colours between which a ratio says something
ENCODED = 2.2  # stops of light to one of sRGB-encoded colours


@torch.no_grad()
def spread_of_light(scene: Scene) -> float | None:
    """How much brighter or darker, redder or bluer neighbouring photographs show the same places, in stops: the root
    mean square over photographs and channels of the median log2 ratio. None where the scene has no points to tell by.

    Neighbours see about the same side of things and the same things before others, so that what is left is the light
    and the camera's reading of it.
    """
    if scene.points is None or len(train := scene.splits["train"]) < 2:
        return None
    points = scene.points[evenly(range(len(scene.points)), POINTS)]
    beside = neighbours(scene.cameras[train])
    chosen = evenly(range(len(train)), LOOKED_AT)
    views = {i: flat_view(scene.photograph(int(train[i])), LONGEST) for i in {*chosen, *beside[chosen].tolist()}}
    ratios = [ratio for i in chosen if (ratio := brighter(points, views[i], views[int(beside[i])])) is not None]
    return float(torch.stack(ratios).square().mean().sqrt()) if ratios else None


def spread_of_exposure(scene: Scene) -> float:
    """The same, and where no points tell, what photographs say of their exposures (`Scene.about`): their deviation, in
    stops of encoded colours. 0 where nothing is known. Those developed from raw files are as bright as `brightness`
    made them."""
    measured = spread_of_light(scene)
    if measured is not None:
        return measured
    exposure = scene.about.get("exposure")
    if exposure is None:
        return 0.0
    stops = (exposure * scene.about.get("brightness", torch.tensor(1.0))).log2()[scene.splits["train"]]
    known = stops[stops.isfinite()]
    return float(known.std()) / ENCODED if len(known) > 1 else 0.0


def neighbours(cameras: Camera) -> Int[Tensor, " camera"]:
    """For each camera the one that stands nearest and looks most alike: their distance, over how far all of them are
    apart, plus one minus the cosine between them."""
    position, forward = cameras.position, cameras.forward
    apart = torch.cdist(position, position)
    unlike = apart / apart.amax().clamp_min(1e-9) + 1 - forward @ forward.T
    return unlike.fill_diagonal_(torch.inf).argmin(-1)


def brighter(points: Float[Tensor, "point 3"], one: FlatView, other: FlatView) -> Float[Tensor, " 3"] | None:
    """Stops by which one picture shows points brighter than another, for each channel; None if they share too few."""
    colours, known = [], torch.ones(len(points), dtype=torch.bool)
    for view in (one, other):
        seen, row, column, _ = view.sees(points)
        rgb = view.rgb[row, column]
        colours.append(rgb)
        known &= seen & (view.trust[row, column] > 0.5) & (rgb > DARKEST).all(-1) & (rgb < BRIGHTEST).all(-1)
    if int(known.sum()) < FEWEST:
        return None
    return (colours[0][known] / colours[1][known]).log2().median(0).values
