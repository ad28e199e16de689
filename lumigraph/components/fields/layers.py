"""Network layers: wide ones in bfloat16 if the machine is fast at it, small perceptrons, activations."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from ... import kernels

# Samples that go through a network together. On a CPU a layer's inputs and outputs then stay in its caches: 262 144
# samples through eight layers of 256 took 2.5 times as long all at once. On a GPU it bounds the memory.
CHUNK_CPU, CHUNK_GPU = 1 << 13, 1 << 18
ROUND = 1 << 10  # the last chunk is filled up to a multiple of this: oneDNN compiles anew for every size that it meets


@cache
def product_type(device: torch.device) -> torch.dtype:
    """Type of matrix products: bfloat16 if the processor has instructions for it, else float32."""
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float32
    there = torch.cpu.get_capabilities() if hasattr(torch.cpu, "get_capabilities") else {}
    return torch.bfloat16 if there.get("amx_bf16") or there.get("avx512_bf16") else torch.float32


class Dense(nn.Linear):
    """y = W x + b, or max(0, W x + b), with Glorot initialisation (2010) and zero biases.

    exact: multiply in float32 even where bfloat16 is faster
    Output has the type of products, which the next layer accepts.
    """

    def __init__(self, inputs: int, outputs: int, relu: bool = False, exact: bool = False):
        super().__init__(inputs, outputs)
        self.relu, self.exact = relu, exact
        nn.init.xavier_uniform_(self.weight)
        nn.init.zeros_(self.bias)

    def forward(self, x: Float[Tensor, "sample input"]) -> Float[Tensor, "sample output"]:
        return _Layer.apply(x.to(self.type_of_products(x)), self.weight, self.bias, self.relu)

    def type_of_products(self, x: Tensor) -> torch.dtype:
        return torch.float32 if self.exact else product_type(x.device)


class _Layer(torch.autograd.Function):
    """One layer with its activation. Gradients of weights leave as float32, so that chunks add up in full precision."""

    @staticmethod
    def forward(ctx, x, weight, bias, relu):
        w = weight.to(x.dtype)
        y = _activated(x, w, bias.to(x.dtype)) if relu else F.linear(x, w, bias.to(x.dtype))
        ctx.save_for_backward(x, w, y if relu else None)
        return y

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        x, w, y = ctx.saved_tensors
        if y is not None:
            grad = torch.ops.aten.threshold_backward(grad, y, 0)
        to_x = grad @ w if ctx.needs_input_grad[0] else None
        return to_x, (grad.t() @ x).float(), grad.sum(0).float(), None


@cache
def _onednn_has_bfloat16() -> bool:
    """True if oneDNN multiplies in bfloat16 on this processor: it asks for AVX-512."""
    return torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()


def _activated(x: Tensor, w: Tensor, b: Tensor) -> Tensor:
    """max(0, x W^T + b), fused where oneDNN offers it, which halves the time."""
    if x.dtype == torch.bfloat16 and x.device.type == "cpu" and len(x) and _onednn_has_bfloat16():
        return torch.ops.mkldnn._linear_pointwise(x, w, b, "relu", [], "")
    return F.linear(x, w, b).relu_()


def in_chunks(
    network: Callable[..., tuple[Tensor, ...]], *inputs: Tensor, where: Bool[Tensor, " sample"] | None = None
) -> tuple[Tensor, ...]:
    """A network's outputs for many samples, in cache-sized chunks.

    where: mask of samples to evaluate; outputs are zero elsewhere
    """
    total, device = len(inputs[0]), inputs[0].device
    asked = torch.arange(total, device=device) if where is None else where.nonzero()[:, 0]
    index = asked if not total else F.pad(asked, (0, -len(asked) % ROUND))  # whole rounds; the padding is dropped below
    size = CHUNK_GPU if device.type == "cuda" else CHUNK_CPU
    parts = [network(*(x[chunk] for x in inputs)) for chunk in index.split(size)]
    answers = (torch.cat(part)[: len(asked)] for part in zip(*parts, strict=True))
    if where is None:
        return tuple(answers)
    return tuple(x.new_zeros(total, *x.shape[1:]).index_copy(0, asked, x) for x in answers)


class MLP(nn.Module):
    """`kernels.perceptron` with its own weights: MLP(inputs, hidden, ..., outputs)."""

    def __init__(self, *widths: int):
        super().__init__()
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(b, a)) for a, b in pairwise(widths))
        for weight in self.weights:
            nn.init.kaiming_uniform_(weight, nonlinearity="relu")

    def forward(self, x: Float[Tensor, "sample input"]) -> Float[Tensor, "sample output"]:
        return kernels.perceptron(x, *self.weights)


FIRST_DEVIATION = 1e-2  # of layers that begin as zero in published code, and so pass no gradient on at first


class ResNetLayers(nn.Module):
    """x' = S x + W_1 relu(W_0 relu(x)); S is the identity where the widths agree (Mescheder 2019, figure 2)."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.first, self.second = nn.Linear(inputs, outputs), nn.Linear(outputs, outputs)
        self.shortcut = nn.Identity() if inputs == outputs else nn.Linear(inputs, outputs, bias=False)
        nn.init.normal_(self.second.weight, std=FIRST_DEVIATION)

    def forward(self, x: Float[Tensor, "*batch input"]) -> Float[Tensor, "*batch output"]:
        return self.shortcut(x) + self.second(self.first(x.relu()).relu())


LIMIT = 15.0


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(y := x.clamp(max=2 * LIMIT).exp())
        return y

    @staticmethod
    def backward(ctx, grad):
        (y,) = ctx.saved_tensors
        return grad * y.clamp(max=2.718281828459045**LIMIT)


def truncated_exp(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """exp(x), with a gradient clamped at e^15, so that one dense sample cannot blow up a step (Müller 2022)."""
    return _TruncatedExp.apply(x)
