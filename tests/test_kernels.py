"""Every operation, every engine, every case: the same outputs and gradients as the float64 reference."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch
from agreement import ENGINES, OPERATIONS, assert_agrees, cases, module, outputs_and_gradients

from lumigraph import kernels, metrics

DIFFERENTIABLE = {"spherical_harmonics": [0], "composite": [0, 1], "hash_encode": [0, 1], "perceptron": [0, 1, 2]}
DIFFERENTIABLE |= {"project": [0, 1, 2, 3, 4], "rasterize": [0, 1, 2, 3, 4], "ssim": [0, 1]}
TYPICAL = {"spherical_harmonics": 4, "composite": 13, "hash_encode": 2, "march": 2, "perceptron": 4}  # a case of each
TYPICAL |= {"project": 5, "tile": 2, "rasterize": 3, "ssim": 1}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("name", "case"), [(name, i) for name in OPERATIONS for i in range(len(cases(name)))])
def test_engine_agrees_with_reference(name, engine, case):
    assert_agrees(name, engine, cases(name)[case])


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("name", "wanted"), [(name, i) for name, all_ in DIFFERENTIABLE.items() for i in all_])
def test_one_gradient_alone(name, engine, wanted):
    assert_agrees(name, engine, cases(name)[TYPICAL[name]], wanted=[wanted])


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("name", "used"), [(name, i) for name, n in [("composite", 3), ("project", 5), ("rasterize", 3)] for i in range(n)]
)
def test_one_output_is_used_alone(name, engine, used):
    assert_agrees(name, engine, cases(name)[TYPICAL[name]], used=[used])


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", OPERATIONS)
def test_inputs_need_not_be_contiguous(name, engine):
    inputs = cases(name)[TYPICAL[name]]
    strided = tuple(torch.stack([x, x], -1)[..., 0] if torch.is_tensor(x) else x for x in inputs)
    assert_agrees(name, engine, strided)


def first(found):
    return found[0] if isinstance(found, tuple) else found


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradient_of_a_plain_sum(name, engine):
    """Its cotangent has no memory of its own: every stride is zero."""
    inputs = [x.clone() if torch.is_tensor(x) else x for x in cases(name)[TYPICAL[name]]]
    wanted = [inputs[i].requires_grad_() for i in DIFFERENTIABLE[name]]
    gradients = []
    for engine_ in ("reference", engine):
        with kernels.using(engine_):
            total = first(getattr(module(name), name)(*inputs)).sum()
            gradients.append(torch.autograd.grad(total, wanted, materialize_grads=True))
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("engine", ENGINES)
def test_marching_ends_where_rays_never_enter(engine):
    """Parallel to a face and outside it, towards infinity: no samples, and no endless loop."""
    origins = torch.tensor([[2.0, 0.1, 0.1], [-3.0, 0.1, 0.1], [0.1, 0.1, 1.0]])
    directions = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    far = torch.full((3,), torch.inf)
    with kernels.using(engine):
        grid = torch.ones(1, 2, 2, 2, dtype=torch.bool)
        samples = kernels.march(origins, directions, torch.zeros(3), far, grid, grid.float(), step=0.1)
    assert samples.ray_starts.tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
def test_an_image_is_like_itself(engine, generator):
    image = torch.rand(13, 29, 3, generator=generator)
    with kernels.using(engine):
        assert kernels.ssim(image, image.clone()).item() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
def test_similarity_is_the_score_of_images_with_a_black_margin(engine, generator):
    """Around an image's own pixels the score's windows then lie inside the picture."""
    a, b = torch.rand(2, 17, 90, 3, generator=generator)
    margins = (torch.nn.functional.pad(image, (0, 0, 5, 5, 5, 5)) for image in (a, b))
    with kernels.using(engine):
        assert kernels.ssim(a, b).item() == pytest.approx(metrics.ssim(*margins), abs=1e-6)


def test_similarity_does_not_depend_on_the_number_of_threads(generator):
    a, b = torch.rand(2, 70, 50, 3, generator=generator)
    a.requires_grad_()
    found, threads = [], numba.get_num_threads()
    for number in (1, threads):
        numba.set_num_threads(number)
        with kernels.using("cpu"):
            value = kernels.ssim(a, b)
        found.append((value, *torch.autograd.grad(value, a)))
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))


# The references themselves, asked for mathematics


@pytest.mark.parametrize(("name", "case"), [*((name, TYPICAL[name]) for name in DIFFERENTIABLE), ("project", 6)])
def test_reference_gradient_is_the_slope(name, case):
    inputs = list(cases(name)[case])
    if name == "hash_encode":  # away from the planes where the slope jumps
        levels = kernels.HashLevels(levels=2, features=1, log2_entries=5, coarsest=2, finest=5)
        inputs = [
            torch.tensor([[0.1, 0.3, 0.9], [0.7, 1.2, -0.1]]),
            torch.arange(float(levels.offsets[-1])).sin()[:, None],
            levels,
        ]
    if name == "composite":
        inputs = list(cases(name)[15])  # with early termination
    if name == "ssim":
        inputs = [image[:3, :4, :2] for image in inputs]
    wanted = DIFFERENTIABLE[name]
    inputs = [x.double() if torch.is_tensor(x) and x.is_floating_point() else x for x in inputs]

    def function(*real):
        return outputs(*[real[wanted.index(i)] if i in wanted else x for i, x in enumerate(inputs)])

    def outputs(*inputs):
        with kernels.using("reference"):
            return getattr(module(name), name)(*inputs)

    many = name in ("project", "rasterize")  # numbers: one random direction among them has to do
    assert torch.autograd.gradcheck(function, [inputs[i].requires_grad_() for i in wanted], fast_mode=many)


def test_harmonics_are_orthonormal():
    """Their products integrate to the identity over the sphere: exact quadrature in z, equal angles around it."""
    z, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(8))
    angle = torch.arange(16, dtype=torch.float64) / 16 * 2 * torch.pi
    rim = (1 - z**2).sqrt()[:, None]
    directions = torch.stack([rim * angle.cos(), rim * angle.sin(), z[:, None].expand(-1, 16)], -1).reshape(-1, 3)
    with kernels.using("reference"):
        Y = kernels.spherical_harmonics(directions, 4)
    area = (weight[:, None] * 2 * torch.pi / 16).expand(-1, 16).reshape(-1, 1)
    torch.testing.assert_close(Y.T @ (area * Y), torch.eye(16, dtype=torch.float64))


def test_a_slab_of_fog_dims_exponentially():
    lengths = torch.rand(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    with kernels.using("reference"):
        _, opacity, _ = kernels.composite(0.7 * lengths, lengths[:, None], torch.tensor([0, 50]))
    torch.testing.assert_close(opacity, 1 - torch.exp(-0.7 * lengths.sum())[None])


def test_hash_levels_follow_the_paper():
    levels = kernels.HashLevels(levels=16, features=2, log2_entries=19, coarsest=16, finest=2048)
    assert levels.resolutions[0] == 16 and levels.resolutions[-1] == 2048
    assert levels.sizes[0] == 17**3 and levels.sizes[-1] == 2**19
    assert levels.offsets[-1] == sum(levels.sizes)


def test_case_list_covers_what_it_claims():
    """No case was lost where rays that hang on rounding are left out."""
    for origins, _, _, _, occupied, *_ in cases("march")[1:]:
        assert len(origins), tuple(occupied.shape)
    longest = max(
        outputs_and_gradients("march", "reference", inputs)[2].diff().max().item() for inputs in cases("march")[1:]
    )
    assert longest > 64
