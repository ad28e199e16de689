"""LPIPS: perceptual distance of two pictures, by learnt features (Zhang et al. 2018).

The weights are not part of this package; they are read from files of the user:

    alexnet-owt-*.pth   AlexNet as torchvision publishes it: the backbone's convolutions
    alex.pth            of the authors' repository (PerceptualSimilarity, folder weights/v0.1): weights of channels

or from one safetensors file with both under the same names.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, relu

from ..errors import LumigraphError
from ..files.reading import reading

VARIABLE = "LUMIGRAPH_LPIPS"  # names the files where no option does
DEFINITION = "Zhang 2018: AlexNet, linear heads v0.1, pictures in [-1, 1]; 0 is equal"
# The convolutions of AlexNet (Krizhevsky 2014): number in torchvision's list, kernel, stride, padding, pooled before.
LAYERS = (
    (0, (64, 3, 11, 11), 4, 2, False),
    (3, (192, 64, 5, 5), 1, 2, True),
    (6, (384, 192, 3, 3), 1, 1, True),
    (8, (256, 384, 3, 3), 1, 1, False),
    (10, (256, 256, 3, 3), 1, 1, False),
)
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # ImageNet's mean and deviation, for values in [-1, 1]
MIN_PIXELS = 31  # pixels; below, AlexNet's second pooling finds nothing
EPSILON = 1e-10


class Lpips:
    """The distance of Zhang 2018, eq. 1, over the five rectified convolutions of AlexNet."""

    def __init__(self, weights: dict[str, Tensor]):
        """Load weights: `features.N.weight`, `features.N.bias` and `linK.model.1.weight`; others are ignored."""
        self.weights = {name: weights[name].detach().float() for name in SHAPES}

    def __call__(self, a: Float[Tensor, "height width 3"], b: Float[Tensor, "height width 3"]) -> float:
        """The distance between two pictures with values in [0, 1]. At least 0, and 0 for equal ones.

        Raises LumigraphError for pictures of less than 31 pixels.
        """
        if min(a.shape[:2]) < MIN_PIXELS:
            raise LumigraphError(
                f"LPIPS needs at least {MIN_PIXELS} x {MIN_PIXELS} pixels, not {a.shape[1]} x {a.shape[0]}; "
                "leave --lpips out"
            )
        distance = 0.0
        for layer, (x, y) in enumerate(zip(self.features(a), self.features(b), strict=True)):
            difference = (unit(x) - unit(y)).square()
            distance += float(conv2d(difference, self.weights[f"lin{layer}.model.1.weight"]).mean())
        return distance

    @torch.no_grad()
    def features(self, picture: Float[Tensor, "height width 3"]) -> list[Float[Tensor, "1 channel _ _"]]:
        """Features of a picture in each of the five layers."""
        x = (2 * picture.float().cpu() - 1 - torch.tensor(SHIFT)) / torch.tensor(SCALE)
        x = x.movedim(-1, 0)[None]
        found = []
        for number, _, stride, padding, pooled in LAYERS:
            x = max_pool2d(x, 3, 2) if pooled else x
            weight, bias = (self.weights[f"features.{number}.{name}"] for name in ("weight", "bias"))
            x = relu(conv2d(x, weight, bias, stride, padding))
            found.append(x)
        return found


SHAPES: dict[str, tuple[int, ...]] = {
    **{f"features.{number}.weight": shape for number, shape, *_ in LAYERS},
    **{f"features.{number}.bias": shape[:1] for number, shape, *_ in LAYERS},
    **{f"lin{layer}.model.1.weight": (1, shape[0], 1, 1) for layer, (_, shape, *_) in enumerate(LAYERS)},
}


def unit(x: Float[Tensor, "1 channel height width"]) -> Float[Tensor, "1 channel height width"]:
    """Features normalised to unit length at each pixel."""
    return x / (x.norm(dim=1, keepdim=True) + EPSILON)


def named_files(given: Sequence[Path]) -> list[Path]:
    """Files with weights: the given ones, otherwise those of LUMIGRAPH_LPIPS, separated as in PATH."""
    return list(given) or [Path(name) for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]


def load_lpips(paths: Sequence[Path]) -> Lpips:
    """The distance with the weights in one or several files.

    Raises LumigraphError for files that cannot be read, and for weights that are missing or of another network.
    """
    weights: dict[str, Tensor] = {}
    for path in paths:
        weights |= read_weights(path)
    there = " and ".join(map(str, paths))
    missing = [name for name in SHAPES if name not in weights]
    if missing:
        whose = "torchvision's AlexNet" if missing[0].startswith("features") else "the LPIPS repository (v0.1/alex.pth)"
        raise LumigraphError(
            f"{there} lacks {len(missing)} of the weights of LPIPS, such as {missing[0]}; add the file of {whose}"
        )
    for name, shape in SHAPES.items():
        if tuple(weights[name].shape) != shape:
            raise LumigraphError(
                f"{there}: {name} has the shape {tuple(weights[name].shape)}, and AlexNet's is {shape}; "
                "use the weights of AlexNet, not those of another network"
            )
    return Lpips(weights)


def read_weights(path: Path) -> dict[str, Tensor]:
    """Named tensors of a safetensors file or a PyTorch state dict, without executing code in it."""
    with reading(path, "is no file of weights", "give safetensors or a state dict"):
        if path.suffix == ".safetensors":
            return safetensors.torch.load(path.read_bytes())
        found = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(found, dict) or not all(isinstance(value, Tensor) for value in found.values()):
        raise LumigraphError(f"{path} holds no state dict of tensors; give safetensors or a state dict")
    return found
