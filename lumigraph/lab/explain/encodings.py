"""Encodings of a picture's pixels with one network, and a range of scales (Tancik 2020, section 6)."""

import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...components.fields.layers import Dense
from ...datasets.scene import Scene
from ...methods.fourier_features import Config, Encoding, FourierFeatures
from ...metrics import psnr
from ...run import build
from ...system.progress import track
from ...system.signals import go_on_unless
from ...training.loop import fit

UNSCALED_ENCODINGS: tuple[Encoding, ...] = ("none", "basic")
SCALED_ENCODINGS: tuple[Encoding, ...] = ("positional", "gaussian")
GRID_POINTS = 24  # points along each side, at which the tangent kernel is taken


@dataclass(frozen=True)
class EncodingFit:
    """One trained network.

    scale:       cycles across the picture; None for encodings without one
    learnt:      PSNR of its training pixels, in dB; held_out of the others
    eigenvalues: of the tangent kernel before training, as shares of their sum
    """

    encoding: Encoding
    scale: float | None
    learnt: float
    held_out: float
    seconds: float
    rgb: Float[Tensor, "height width 3"]
    eigenvalues: Float[Tensor, " point"]

    @property
    def name(self) -> str:
        return self.encoding if self.scale is None else f"{self.encoding} {self.scale:g}"


@dataclass(frozen=True)
class EncodingComparison:
    """All fits, and their settings."""

    source: str
    picture: Float[Tensor, "height width 3"]
    steps: int
    config: Config
    fits: list[EncodingFit]

    def of(self, encoding: Encoding) -> list[EncodingFit]:
        """Fits of one encoding, by scale."""
        return [one for one in self.fits if one.encoding == encoding]

    def best(self, encoding: Encoding) -> EncodingFit:
        """Fit with the highest held-out PSNR."""
        return max(self.of(encoding), key=lambda one: one.held_out)

    @property
    def leading(self) -> list[EncodingFit]:
        """Best fit of each encoding."""
        return [self.best(encoding) for encoding in UNSCALED_ENCODINGS + SCALED_ENCODINGS]

    @property
    def gain(self) -> float:
        """Held-out PSNR gain of Gaussian features over no encoding, in dB."""
        return self.best("gaussian").held_out - self.best("none").held_out

    @property
    def peak_inside(self) -> bool:
        """True if the best scale of Gaussian features is neither the smallest nor the largest one."""
        return self.best("gaussian") not in (self.of("gaussian")[0], self.of("gaussian")[-1])

    def to_json(self) -> dict[str, Any]:
        height, width = self.picture.shape[:2]
        return {
            "picture": self.source,
            "resolution": f"{width}x{height}",
            "held_out": "half of the pixels, at random",
            "steps": self.steps,
            "pixels_per_step": self.config.pixels_per_step,
            "seed": self.config.seed,
            "gain_over_none": self.gain,
            "peak_inside": self.peak_inside,
            "fits": [
                {
                    "encoding": one.encoding,
                    "scale": one.scale,
                    "psnr_held_out": one.held_out,
                    "psnr_learnt": one.learnt,
                    "seconds": one.seconds,
                    "eigenvalues": one.eigenvalues.tolist(),
                }
                for one in self.fits
            ],
        }


def compare(
    scene: Scene, scales: tuple[float, ...], steps: int, device: torch.device, config: Config | None = None
) -> EncodingComparison:
    """Train one network for every encoding, and for every scale of those with one.

    scene:  of a single picture (`capture.picture`)
    scales: rising
    config: the network's other numbers
    """
    config = config or FourierFeatures.preset(device)
    todo = [replace(config, encoding=encoding) for encoding in UNSCALED_ENCODINGS]
    todo += [replace(config, encoding=encoding, scale=scale) for encoding in SCALED_ENCODINGS for scale in scales]
    fits = [learn(scene, one, steps, device) for one in track(todo, "Fitting the picture", len(todo))]
    return EncodingComparison(scene.source, truth(scene), steps, config, fits)


def learn(scene: Scene, config: Config, steps: int, device: torch.device) -> EncodingFit:
    """Train one network and score it."""
    method = build(FourierFeatures, scene.frame, config, device, config.seed)
    assert isinstance(method, FourierFeatures)
    eigenvalues = spectrum(kernel_at_start(method))
    begin = time.perf_counter()
    go_on_unless(fit(method, scene, steps=steps, seed=config.seed, show=False).signal)
    seconds = time.perf_counter() - begin
    rgb, picture = method.render(scene.cameras[0]).rgb.cpu(), truth(scene)
    masks = [scene.images.mask(int(scene.splits[split][0])) for split in ("train", "test")]
    learnt, held_out = (psnr(rgb[mask], picture[mask]) for mask in masks)
    scale = None if config.encoding in UNSCALED_ENCODINGS else config.scale
    return EncodingFit(config.encoding, scale, learnt, held_out, seconds, rgb, eigenvalues)


def truth(scene: Scene) -> Float[Tensor, "height width 3"]:
    """The picture itself, common to both of the scene's shots."""
    return scene.photograph(0).before(scene.frame.background)


def kernel_at_start(method: FourierFeatures) -> Float[Tensor, "point point"]:
    """Tangent kernel of a network between grid points, before its sigmoid."""
    side = (torch.arange(GRID_POINTS, device=method.device) + 0.5) / GRID_POINTS
    places = torch.cartesian_prod(side, side)
    return tangent_kernel(method.layers, method.encoding(places)).cpu()


@torch.no_grad()
def tangent_kernel(network: nn.Sequential, features: Float[Tensor, "point feature"]) -> Float[Tensor, "point point"]:
    """Neural tangent kernel Theta(x, x') = df(x)/dtheta . df(x')/dtheta, exact for these weights, averaged over the
    outputs of f.

    network:  f, layers that are all Dense
    features: input at each point

    With h_l the input of layer l, z_l = W_l h_l + b_l, and delta_l = df/dz_l, the gradient of W_l is delta_l h_l^T and
    that of b_l is delta_l, so that all of them together give

        Theta(x, x') = sum_l (delta_l . delta_l') (h_l . h_l' + 1)

    In float64: eigenvalues span more than single precision can.
    """
    layers = [layer for layer in network if isinstance(layer, Dense)]
    given = [features.double()]
    for layer in layers:
        z = given[-1] @ layer.weight.double().t() + layer.bias.double()
        given.append(z.relu() if layer.relu else z)
    answers = given.pop()
    alike = [h @ h.t() + 1 for h in given]
    kernel = torch.zeros_like(alike[0])
    for unit in torch.eye(answers.shape[1]).to(answers):
        delta = unit.expand_as(answers)
        for layer, h, products in reversed(list(zip(layers, given, alike, strict=True))):
            kernel += delta @ delta.t() * products
            delta = delta @ layer.weight.double() * (h > 0)
    return kernel / answers.shape[1]


def spectrum(kernel: Float[Tensor, "point point"]) -> Float[Tensor, " point"]:
    """Eigenvalues of the kernel, largest first, as shares of its trace.

    Gradient descent on squared error reduces the error along the i-th eigenvector as exp(-eta lambda_i t): components
    with small eigenvalues are not learnt in any practical time.
    """
    values = torch.linalg.eigvalsh(kernel).flip(0)
    return values / values.sum()
