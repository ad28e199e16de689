"""The neural tangent kernel: how learning one point moves a network's answer at another (Jacot 2018)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..components.fields.layers import Dense


@torch.no_grad()
def tangent_kernel(network: nn.Sequential, features: Float[Tensor, "point feature"]) -> Float[Tensor, "point point"]:
    """Theta(x, x') = df(x)/dtheta . df(x')/dtheta, exact for these very weights, averaged over the outputs of f.

    network:  f, layers that are all Dense
    features: what it is given at each point

    With h_l what layer l is given, z_l = W_l h_l + b_l, and delta_l = df/dz_l, the gradient of W_l is delta_l h_l^T and
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

    Gradient descent on squared error shrinks what is wrong along the i-th eigenvector as exp(-eta lambda_i t): what
    lies along small eigenvalues is not learnt in any time that one would wait.
    """
    values = torch.linalg.eigvalsh(kernel).flip(0)
    return values / values.sum()
