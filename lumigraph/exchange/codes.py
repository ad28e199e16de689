"""The numbers of Gaussians as few bits: what the compact formats have in common."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from ..gaussians import Gaussians

# The logit that a byte of opacity stands for. 0 and 1 have no finite one: the outer bytes mean half a step less.
_ALPHA = np.clip(np.arange(256) / 255, 0.5 / 255, 254.5 / 255)
LOGITS = np.log(_ALPHA / (1 - _ALPHA)).astype(np.float32)
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the components beside the i-th
MIN_SCALE, MAX_SCALE = np.finfo(np.float32).tiny, np.finfo(np.float32).max  # what a scale can be and have a logarithm


def array(tensor: Float[Tensor, "*shape"]) -> Float[np.ndarray, "*shape"]:
    return tensor.detach().cpu().float().contiguous().numpy()


def cloud(
    means: Float[np.ndarray, "gaussian 3"],
    quaternions: Float[np.ndarray, "gaussian 4"],
    log_scales: Float[np.ndarray, "gaussian 3"],
    opacities: Float[np.ndarray, " gaussian"],
    harmonics: Float[np.ndarray, "gaussian coefficient 3"],
    antialiased: bool = False,
) -> Gaussians:
    """Gaussians of arrays, in float32 and in memory of their own."""
    return Gaussians(
        _tensor(means), _tensor(quaternions), _tensor(log_scales), _tensor(opacities), _tensor(harmonics), antialiased
    )


def _tensor(values: Float[np.ndarray, "*shape"]) -> Float[Tensor, "*shape"]:
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is found by whoever checks
        return torch.from_numpy(np.array(values, np.float32, order="C"))


def to_byte(x: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """The nearest of 0 to 255."""
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)


def alpha_to_byte(logits: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """255 times the sigmoid, in a form that cannot overflow."""
    return to_byte(127.5 * (1 + np.tanh(logits / 2)))


def to_scales(log_scales: Float[np.ndarray, "gaussian 3"]) -> Float[np.ndarray, "gaussian 3"]:
    """Standard deviations, in double precision and within what float32 can say."""
    with np.errstate(over="ignore"):
        return np.exp(log_scales.astype(np.float64)).clip(MIN_SCALE, MAX_SCALE)


def from_scales(scales: Float[np.ndarray, "gaussian 3"]) -> Float[np.ndarray, "gaussian 3"]:
    """Their logarithms: of 0 that of the least, and of negative ones none, which is found later."""
    with np.errstate(invalid="ignore"):
        return np.log(np.where(scales == 0, MIN_SCALE, scales.astype(np.float64)))


def unit(quaternions: Float[np.ndarray, "gaussian 4"]) -> Float[np.ndarray, "gaussian 4"]:
    """Quaternions of length 1, in double precision, which does not overflow for float32 input."""
    quaternions = quaternions.astype(np.float64)
    return quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)


def without_largest(
    quaternions: Float[np.ndarray, "gaussian 4"],
) -> tuple[Int[np.ndarray, " gaussian"], Float[np.ndarray, "gaussian 3"]]:
    """Index of the largest component, and the other three, at most sqrt(1/2), signed to make the largest positive."""
    quaternions = unit(quaternions)
    largest = np.abs(quaternions).argmax(-1)
    sign = np.sign(np.take_along_axis(quaternions, largest[:, None], -1))
    return largest, sign * np.take_along_axis(quaternions, OTHERS[largest], -1)


def with_largest(
    largest: Int[np.ndarray, " gaussian"], rest: Float[np.ndarray, "gaussian 3"]
) -> Float[np.ndarray, "gaussian 4"]:
    """The inverse: the length of 1 gives the fourth component."""
    quaternions = np.empty((len(rest), 4))
    np.put_along_axis(quaternions, OTHERS[largest], rest, -1)
    missing = np.sqrt(np.maximum(0, 1 - (rest**2).sum(-1)))
    np.put_along_axis(quaternions, largest[:, None], missing[:, None], -1)
    return quaternions
