"""One photograph as segmentation sees it: small, in patches of like colour."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from skimage.color import rgb2lab
from skimage.segmentation import slic

from ...camera import Camera

MAX_SIDE = 400  # pixels of the longer side
SUPERPIXELS = 1500  # of a picture (SLIC, Achanta 2012)
COMPACTNESS = 8.0


@dataclass
class ObjectView:
    """A small photograph.

    lab:     colours in CIELAB
    patches: the number of each pixel's superpixel
    colours: mean colour of each superpixel
    edges:   pairs of superpixels that touch
    lengths: of each pair's common border, in pixels
    """

    name: str
    camera: Camera
    lab: Float[np.ndarray, "height width 3"]
    patches: Int[np.ndarray, "height width"] = field(init=False)
    colours: Float[np.ndarray, "patch 3"] = field(init=False)
    sizes: Float[np.ndarray, " patch"] = field(init=False)
    edges: Int[np.ndarray, "edge 2"] = field(init=False)
    lengths: Float[np.ndarray, " edge"] = field(init=False)

    def __post_init__(self) -> None:
        # SLIC scales what it is given to [0, 1]; compactness is meant for CIELAB's own units.
        compact = COMPACTNESS / float(np.ptp(self.lab))
        self.patches = slic(
            self.lab, SUPERPIXELS, compact, max_num_iter=5, start_label=0, convert2lab=False, channel_axis=2
        )
        count = int(self.patches.max()) + 1
        self.sizes = np.bincount(self.patches.ravel(), minlength=count).astype(np.float64)
        self.colours = np.stack([self.mean(self.lab[..., k]) for k in range(3)], -1)
        across = np.stack([self.patches[:, :-1].ravel(), self.patches[:, 1:].ravel()], -1)
        down = np.stack([self.patches[:-1].ravel(), self.patches[1:].ravel()], -1)
        pairs = np.sort(np.concatenate([across, down]), -1)
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        self.edges, lengths = np.unique(pairs, axis=0, return_counts=True)
        self.lengths = lengths.astype(np.float64)

    @staticmethod
    def of(name: str, camera: Camera, rgb: Float[torch.Tensor, "height width 3"]) -> ObjectView:
        """A view of a photograph of any size."""
        share = min(1.0, MAX_SIDE / max(rgb.shape[:2]))
        small = camera.resized(share)
        width, height = small.size[0].tolist()
        shrunk = torch.nn.functional.interpolate(rgb.permute(2, 0, 1)[None].float(), (height, width), mode="area")[
            0
        ].permute(1, 2, 0)
        return ObjectView(name, small, rgb2lab(shrunk.clamp(0, 1).numpy()))

    def mean(self, values: Float[np.ndarray, "height width"]) -> Float[np.ndarray, " patch"]:
        """The mean of pixels' values in each superpixel."""
        return np.bincount(self.patches.ravel(), values.ravel(), len(self.sizes)) / self.sizes

    def at(
        self, points: Float[torch.Tensor, "point 3"]
    ) -> tuple[Int[np.ndarray, "point 2"], Bool[np.ndarray, " point"]]:
        """The (row, column) at which points are seen, clamped to the picture, and whether they are in it."""
        places, inside = self.camera.locate(points)
        return places.numpy(), inside.numpy()

    def shadow(self, points: Float[torch.Tensor, "point 3"], size: float) -> Float[np.ndarray, "height width"]:
        """Coverage of each pixel by cubes of side `size` at points: about 1 inside, 0 outside."""
        places, inside = self.at(points)
        hit = np.zeros(self.lab.shape[:2])
        hit[tuple(places[inside].T)] = 1.0
        radius = self.pixels(points, size)
        grown = ndimage.maximum_filter(hit, size=2 * int(np.ceil(radius)) + 1)
        closed = ndimage.minimum_filter(grown, size=2 * int(np.floor(0.5 * radius)) + 1)
        return ndimage.gaussian_filter(closed, 0.5 * radius)

    def pixels(self, points: Float[torch.Tensor, "point 3"], size: float) -> float:
        """Size of a length at the mean of points, in pixels."""
        middle = points.mean(0)
        ends, _ = self.camera.project(torch.stack([middle, middle + size * self.camera.pose[0, :, 0]]))
        return max(1.0, float((ends[1] - ends[0]).norm()))
