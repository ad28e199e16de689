"""A small multilayer perceptron, quick for very many inputs."""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .precision import product_dtype

CHUNK = 8192  # samples whose activations stay in cache from one layer to the next


class Perceptron(nn.Module):
    """Linear layers without biases, ReLU between them (Müller 2021, the fully fused network).

    Works on features in planes: a (sample, feature) tensor whose memory is (feature, sample), which is what
    `hash_encode` gives, costs no copy. Samples go through all layers in chunks that fit the cache.
    Products run in bfloat16 where the device multiplies that faster; weights and sums of gradients stay float32.
    """

    def __init__(self, *widths: int):
        super().__init__()
        self.weights = nn.ParameterList(nn.Parameter(torch.empty(b, a)) for a, b in pairwise(widths))
        for weight in self.weights:
            nn.init.kaiming_uniform_(weight, nonlinearity="relu")

    def forward(self, x: Float[Tensor, "sample feature"]) -> Float[Tensor, "sample output"]:
        if not x.is_cuda:
            from ..kernels.perceptron import cpu
            return cpu.run(x, list(self.weights))
        return _Layers.apply(x.t().contiguous(), product_dtype(x.device), *self.weights).t()


class _Layers(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, dtype, *weights):
        outputs = [x.new_empty(len(w), x.shape[1], dtype=dtype) for w in weights[:-1]]
        outputs.append(x.new_empty(len(weights[-1]), x.shape[1]))
        low = [w.to(dtype) for w in weights]
        for chunk in _chunks(x):
            h = x[:, chunk].to(dtype)
            for w, out in zip(low[:-1], outputs[:-1], strict=True):
                h = torch.relu_(torch.mm(w, h, out=out[:, chunk]) if dtype == x.dtype else out[:, chunk].copy_(w @ h))
            outputs[-1][:, chunk] = low[-1] @ h
        ctx.save_for_backward(x, *weights, *outputs[:-1])
        ctx.dtype, ctx.layers = dtype, len(weights)
        return outputs[-1]

    @staticmethod
    def backward(ctx, grad):
        x, *saved = ctx.saved_tensors
        weights, hidden = saved[: ctx.layers], saved[ctx.layers :]
        low = [w.to(ctx.dtype) for w in weights]
        to_weights = [torch.zeros_like(w) for w in weights]
        to_x = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        for chunk in _chunks(x):
            g = grad[:, chunk].to(ctx.dtype)
            for i in reversed(range(ctx.layers)):
                h = (hidden[i - 1] if i else x)[:, chunk]
                to_weights[i] += g @ h.to(ctx.dtype).t()
                if i:
                    g = torch.ops.aten.threshold_backward(low[i].t() @ g, h, 0)
                elif to_x is not None:
                    to_x[:, chunk] = low[0].t() @ g
        return to_x, None, *to_weights


def _chunks(x):
    """One chunk on a GPU, whose caches are not ours to mind."""
    size = CHUNK if x.device.type == "cpu" else max(x.shape[1], 1)
    return [slice(i, i + size) for i in range(0, x.shape[1], size)]
