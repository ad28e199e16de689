"""A small multilayer perceptron for very many inputs."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from .._operation import Facts, door, implementation, require

FACTS = Facts(unit="samples", outputs=1, differentiable=(0, 1, 2, 3), typical=4, compiled=4, smooth=(2, 4))


@door
def perceptron(x: Float[Tensor, "sample input"], *weights: Float[Tensor, "_ _"]) -> Float[Tensor, "sample last"]:
    """Linear layers without biases, ReLU between them (Müller 2021, the fully fused network).

        h_0 = x,  h_l = max(0, W_l h_{l-1}),  y = W_L h_{L-1}

    weights: W_1 to W_L, each (outputs, inputs)
    The fast layout is feature-major: a (sample, feature) tensor that is the transpose of a contiguous one, as
    `hash_encode` returns it, is not copied, and the result is such a tensor.
    On a GPU products are taken in bfloat16 and sums in float32. Differentiable in x and the weights.
    """
    widths = [x.shape[1], *(weight.shape[0] for weight in weights)]
    chained = all(weight.shape[1] == width for weight, width in zip(weights, widths, strict=False))
    require(len(weights) > 0 and chained, f"layers do not fit: {widths[0]} inputs, {[tuple(w.shape) for w in weights]}")
    return implementation("perceptron", x)(x, weights)


def cases(generator: torch.Generator):
    """Test inputs for all engines: widths and counts that are and are not multiples of registers and blocks."""
    for samples, widths in [
        (0, (4, 3)),
        (1, (3, 2)),
        (31, (5, 7, 2)),
        (64, (32, 32, 16)),
        (70, (32, 32, 32, 3)),
        (129, (40, 9, 33, 1)),
    ]:
        yield _inputs(samples, widths, generator)


def benchmark_case(generator: torch.Generator, size: int = 2**18):
    """Instant-NGP's colour network on a CPU."""
    x, *weights = _inputs(size, (32, 32, 32, 3), generator)
    return x.t().contiguous().t().requires_grad_(), *(w.requires_grad_() for w in weights)


def _inputs(samples: int, widths: Sequence[int], generator: torch.Generator):
    x = torch.randn(samples, widths[0], generator=generator)
    pairs = zip(widths[:-1], widths[1:], strict=True)
    return x, *(torch.randn(b, a, generator=generator) * (2 / a) ** 0.5 for a, b in pairs)
