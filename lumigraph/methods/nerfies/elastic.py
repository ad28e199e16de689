"""Elastic loss: distance of a deformation from a rigid motion, by singular values of its Jacobian (Park 2021, 3.3)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

MIN_EIGENVALUE = 1e-12  # of J^T J; smaller ones count as this
APART = 0.02  # relative difference of eigenvalues below which a divided difference is a derivative

Matrix = Float[Tensor, "point 3 3"]
Values = Float[Tensor, " point"]


def elastic_loss(jacobian: Matrix, scale: float) -> Values:
    """rho(|log S|), S the singular values of the Jacobian (eqs. 9 and 10); 0 for a rigid motion, below 2."""
    return geman_mcclure(log_singular_square(jacobian), scale)


def geman_mcclure(square: Float[Tensor, "*n"], scale: float) -> Float[Tensor, "*n"]:
    """2 (x / c)^2 / ((x / c)^2 + 4), of squares x^2 (Geman and McClure 1985): bounded for outliers."""
    relative = square / scale**2
    return 2 * relative / (relative + 4)


def log_singular_square(jacobian: Matrix) -> Values:
    """|log S|^2 = sum_i log(s_i)^2 for the singular values s_i of 3x3 matrices."""
    return _LogSquare.apply((jacobian.mT @ jacobian).double()).to(jacobian)


class _LogSquare(torch.autograd.Function):
    """sum_i f(l_i) with f(l) = (log l)^2 / 4, for the eigenvalues l_i of A = J^T J.

    Its gradient in A is the matrix function f'(A), a polynomial through f' at the eigenvalues (Newton's form):

        f'(A) = g_1 1 + g_12 (A - l_1 1) + g_123 (A - l_1 1) (A - l_2 1)

    No eigenvectors are needed, and where eigenvalues coincide, as they all do at a rigid motion, the divided
    differences g_12 and g_123 become derivatives.
    """

    @staticmethod
    def forward(ctx, a):
        values = symmetric_eigenvalues(a).clamp_min(MIN_EIGENVALUE)
        ctx.save_for_backward(a, values)
        return 0.25 * values.log().square().sum(-1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        a, values = ctx.saved_tensors
        l1, l2, l3 = values.unbind(-1)
        first, outer, inner = slope(l1), divided(l1, l2), divided(l2, l3)
        spread = l1 - l3  # the largest difference: eigenvalues descend
        near = spread <= APART * l1
        second = torch.where(near, 0.5 * bend(values.mean(-1)), (outer - inner) / torch.where(near, 1.0, spread))
        one = torch.eye(3, dtype=a.dtype, device=a.device)
        from_first, from_second = (a - x[:, None, None] * one for x in (l1, l2))
        terms = first[:, None, None] * one + outer[:, None, None] * from_first
        return grad[:, None, None] * (terms + second[:, None, None] * from_first @ from_second)


def slope(x: Values) -> Values:
    """f'(x) = log x / (2 x)."""
    return x.log() / (2 * x)


def divided(x: Values, y: Values) -> Values:
    """(f'(x) - f'(y)) / (x - y), or f'' between the two where they are close."""
    middle, apart = 0.5 * (x + y), x - y
    near = apart.abs() <= APART * x
    return torch.where(
        near, (1 - middle.log()) / (2 * middle**2), (slope(x) - slope(y)) / torch.where(near, 1.0, apart)
    )


def bend(x: Values) -> Values:
    """f'''(x) = (2 log x - 3) / (2 x^3)."""
    return (2 * x.log() - 3) / (2 * x**3)


def symmetric_eigenvalues(a: Matrix) -> Float[Tensor, "point 3"]:
    """Eigenvalues of symmetric matrices in closed form, descending (Smith 1961)."""
    mean = a.diagonal(dim1=-2, dim2=-1).mean(-1)
    rest = a - mean[:, None, None] * torch.eye(3, dtype=a.dtype, device=a.device)
    size = (rest.square().sum((-2, -1)) / 6).sqrt()
    half = torch.linalg.det(rest / size.clamp_min(1e-30)[:, None, None]) / 2
    angle = half.clamp(-1, 1).acos() / 3
    turns = angle[:, None] + torch.arange(3, device=a.device) * (2 * torch.pi / 3)
    return (mean[:, None] + 2 * size[:, None] * turns.cos()).sort(-1, descending=True).values
