"""Feature networks from a user's own file: ONNX, or the weights of a plain convolutional network as safetensors.

ONNX         one input (1, 3, height, width), normalised as ImageNet's pictures; its first output is a map
             (1, channel, h, w) or tokens (1, h w (+ class tokens), channel), as DINO's backbones export them.
             Fixed sizes of the input are kept.
safetensors  weights `NAME.weight` (out, in, k, k) and `NAME.bias`, in the order of the numbers in their names:
             convolutions with rectification between them, each of its own stride; `strides` in the metadata, as
             "1,2,1", is 1 for all where it is missing.

The features of all photographs are reduced to their first principal components, which the strokes are matched in.
"""

import importlib
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from safetensors import safe_open
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, normalize, relu

from ..errors import LumigraphError
from ..files.reading import reading
from .descriptors import describe

COMPONENTS = 12  # of the features, in which points are matched
COMPONENT_UNIT = 4.0  # standard deviations of all components together, in units of descriptors
OWN_WEIGHT = 0.3  # of the house's descriptors beside a network's, for edges that its coarse maps blur
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet's
PATCH = 14  # pixels; sides that ONNX files leave open are multiples of it and of 16, as backbones of patches need
SIDES = (16, PATCH)
MAX_CLASS_TOKENS = 8  # tokens of a backbone that belong to no patch, in front of the others

Maps = Callable[[Float[Tensor, "1 3 height width"]], Float[Tensor, "1 channel h w"]]


def feature_network(path: Path, pictures: Sequence[Float[Tensor, "height width 3"]]) -> Any:
    """Function from a picture to features of each pixel, by a network in a file.

    pictures: for the principal components
    Raises LumigraphError for an invalid file, and for missing packages.
    """
    maps = onnx_maps(path) if path.suffix.lower() == ".onnx" else convolution_maps(path)
    some = torch.cat([raw_features(maps, picture).flatten(2)[0].T for picture in pictures])
    mean = some.mean(0)
    _, _, axes = torch.linalg.svd(some[:: max(1, len(some) // 20_000)] - mean, full_matrices=False)
    axes = axes[:COMPONENTS]
    scale = COMPONENT_UNIT / float(((some - mean) @ axes.T).square().sum(-1).mean().sqrt().clamp_min(1e-9))

    def features(rgb: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width feature"]:
        found = raw_features(maps, rgb)[0]
        reduced = torch.einsum("chw,kc->khw", found - mean[:, None, None], axes) * scale
        full = interpolate(reduced[None], rgb.shape[:2], mode="bilinear", align_corners=False)[0]
        return torch.cat([full.movedim(0, -1), OWN_WEIGHT * describe(rgb)], -1)

    return features


def raw_features(maps: Maps, rgb: Float[Tensor, "height width 3"]) -> Float[Tensor, "1 channel h w"]:
    """Features of a picture, normalised to unit length at each pixel."""
    picture = (rgb.cpu() - torch.tensor(MEAN)) / torch.tensor(DEVIATION)
    with torch.no_grad():
        return normalize(maps(picture.movedim(-1, 0)[None]).float(), dim=1)


def convolution_maps(path: Path) -> Maps:
    """Maps of a plain convolutional network whose weights a safetensors file holds."""
    if not path.exists():
        raise LumigraphError(f"{path} does not exist; name a file of weights, .safetensors or .onnx")
    with reading(path, "is no safetensors file", "give one, or a network as .onnx"), safe_open(path, "pt") as held:
        weights = {name: held.get_tensor(name) for name in held.keys()}  # no dictionary
        said = (held.metadata() or {}).get("strides", "")
    names = sorted((x[: -len(".weight")] for x in weights if x.endswith(".weight")), key=numbers_in)
    layers = [(weights[f"{name}.weight"].float(), weights.get(f"{name}.bias")) for name in names]
    channels = 3
    for name, (weight, bias) in zip(names, layers, strict=True):
        if weight.ndim != 4 or weight.shape[1] != channels or (bias is not None and bias.shape != weight.shape[:1]):
            raise LumigraphError(
                f"{path}: {name} of shape {tuple(weight.shape)} does not follow on {channels} channels; give the "
                "weights of a plain convolutional network, or any network as .onnx"
            )
        channels = weight.shape[0]
    if not layers:
        raise LumigraphError(f"{path} holds no convolutions; give the weights of some, or any network as .onnx")
    strides = [int(x) for x in said.split(",")] if re.fullmatch(r"[1-8](,[1-8])*", said) else [1] * len(layers)
    if len(strides) != len(layers):
        raise LumigraphError(f"{path} has {len(layers)} convolutions and {len(strides)} strides; correct its metadata")

    def maps(picture: Float[Tensor, "1 3 height width"]) -> Float[Tensor, "1 channel h w"]:
        x = picture
        for number, ((weight, bias), stride) in enumerate(zip(layers, strides, strict=True)):
            x = conv2d(relu(x) if number else x, weight, bias, stride, weight.shape[-1] // 2)
        return x

    return maps


def numbers_in(name: str) -> list[int]:
    return [int(x) for x in re.findall(r"\d+", name)]


def onnx_maps(path: Path) -> Maps:
    """Maps of an ONNX network. Raises LumigraphError without onnxruntime."""
    try:
        runtime = importlib.import_module("onnxruntime")
    except ImportError as error:
        raise LumigraphError(f"{path} needs onnxruntime; pip install 'lumigraph[onnx]'") from error
    with reading(path, "is no ONNX network that runs here", "export it anew"):
        session = runtime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    (taken, *others), given = session.get_inputs(), session.get_outputs()[0]
    if others or len(taken.shape) != 4 or taken.shape[1] != 3:
        raise LumigraphError(f"{path} should take one input of shape (1, 3, height, width); export it so")
    fixed = [side if isinstance(side, int) else None for side in taken.shape[2:]]

    def maps(picture: Float[Tensor, "1 3 height width"]) -> Float[Tensor, "1 channel h w"]:
        unit = math.lcm(*SIDES)
        size = [f or max(unit, round(n / unit) * unit) for f, n in zip(fixed, picture.shape[2:], strict=True)]
        sized = interpolate(picture, size, mode="bilinear", align_corners=False, antialias=True)
        found = torch.from_numpy(np.asarray(session.run([given.name], {taken.name: sized.numpy()})[0]))
        if found.ndim == 4:
            return found
        shape = None if found.ndim != 3 else patches(found.shape[1], size)
        if shape is None:
            raise LumigraphError(
                f"{path} gives {tuple(found.shape)}, neither a map nor tokens of patches; export it so"
            )
        tokens = found[:, -shape[0] * shape[1] :]
        return tokens.movedim(-1, 1).reshape(1, -1, *shape)

    return maps


def patches(tokens: int, size: Sequence[int]) -> tuple[int, int] | None:
    """Rows and columns of square patches of a picture for a number of tokens, without class tokens."""
    for side in range(4, min(size) + 1):
        rows, columns = size[0] // side, size[1] // side
        if size[0] % side == 0 and size[1] % side == 0 and 0 <= tokens - rows * columns <= MAX_CLASS_TOKENS:
            return rows, columns
    return None
