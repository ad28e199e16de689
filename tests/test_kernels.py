"""Every operation, every engine, every case: the same outputs and gradients as the float64 reference."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from agreement import (
    DEVICES,
    ENGINES,
    GRADIENT_BOUND,
    OPERATIONS,
    assert_agrees,
    assert_near,
    call,
    cases,
    depends,
    exact,
    facts,
    in_bfloat16,
    module,
    moved,
    truth,
)
from budgets import budget
from proofs import kept

from lumigraph import kernels, metrics

pytestmark = budget("kernels", 80)

DIFFERENTIABLE = [name for name in OPERATIONS if facts(name).differentiable]


def interpreted(name: str, engine: str) -> set[Path] | None:
    """What a comparison rests on that Triton's interpreter makes, slowly. Numba's code and a GPU's run each time."""
    return depends(name) if engine == "gpu" and DEVICES[engine] == "cpu" else None


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", OPERATIONS)
@kept(interpreted)
def test_engine_agrees_with_reference(name, engine):
    """In all cases, which are made here and not when tests are collected."""
    for case in range(len(cases(name))):
        assert_agrees(name, engine, case)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("name", "wanted"), [(name, i) for name in OPERATIONS for i in facts(name).differentiable])
@kept(interpreted)
def test_one_gradient_alone(name, engine, wanted):
    assert_agrees(name, engine, facts(name).typical, wanted=wanted)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    ("name", "used"),
    [(name, i) for name in DIFFERENTIABLE if facts(name).outputs > 1 for i in range(facts(name).outputs)],
)
@kept(interpreted)
def test_one_output_is_used_alone(name, engine, used):
    assert_agrees(name, engine, facts(name).typical, used=used)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", OPERATIONS)
@kept(interpreted)
def test_inputs_need_not_be_contiguous(name, engine):
    assert_agrees(name, engine, facts(name).typical, laid_out=lambda x: torch.stack([x, x], -1)[..., 0])


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", DIFFERENTIABLE)
@kept(interpreted)
def test_gradient_of_a_plain_sum(name, engine):
    """Its cotangent has no memory of its own: every stride is zero."""
    gradients = []
    for engine_ in ("reference", engine):
        inputs = moved(cases(name)[facts(name).typical], engine_)
        wanted = [inputs[i].requires_grad_() for i in facts(name).differentiable]
        total = call(name, engine_, inputs)[0].sum()
        gradients.append([x.cpu() for x in torch.autograd.grad(total, wanted, materialize_grads=True)])
    for actual, expected in zip(gradients[1], gradients[0], strict=True):
        if in_bfloat16(name, engine):
            assert_near(actual, expected, GRADIENT_BOUND)
        else:
            torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", OPERATIONS)
def test_what_an_operation_says_of_itself_is_true(name):
    said, inputs = facts(name), list(exact(cases(name)[facts(name).typical]))
    real = [i for i, x in enumerate(inputs) if torch.is_tensor(x) and x.is_floating_point()]
    leaves = [inputs[i].requires_grad_() for i in real]
    outputs = call(name, "reference", inputs)
    assert len(outputs) == said.outputs
    reached: tuple[int, ...] = ()
    if differentiated := [x.sum() for x in outputs if x.requires_grad]:
        gradients = torch.autograd.grad(sum(differentiated), leaves, allow_unused=True)
        reached = tuple(i for i, g in zip(real, gradients, strict=True) if g is not None)
    assert reached == said.differentiable
    assert bool(said.smooth) == bool(reached)
    assert all(0 <= case < len(cases(name)) for case in (said.typical, said.compiled, *said.smooth))
    assert said.unit_axes <= inputs[0].ndim


@pytest.mark.parametrize("engine", ENGINES)
@kept(lambda engine: interpreted("march", engine))
def test_marching_ends_where_rays_never_enter(engine):
    """Parallel to a face and outside it, towards infinity: no samples, and no endless loop."""
    origins = torch.tensor([[2.0, 0.1, 0.1], [-3.0, 0.1, 0.1], [0.1, 0.1, 1.0]])
    directions = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    near, far = torch.zeros(3), torch.full((3,), torch.inf)
    grid = torch.ones(1, 2, 2, 2, dtype=torch.bool)
    inputs = moved([origins, directions, near, far, grid, grid.float()], engine)
    with kernels.using(engine):
        samples = kernels.march(*inputs, step=0.1)
    assert samples.ray_starts.tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
@kept(lambda engine: interpreted("photometric", engine))
def test_an_image_is_like_itself(engine, generator):
    (image,) = moved([torch.rand(13, 29, 3, generator=generator)], engine)
    with kernels.using(engine):
        ssim, gap = kernels.photometric(image, image.clone())
    assert ssim.item() == pytest.approx(1, abs=1e-6) and gap.item() == 0


@pytest.mark.parametrize("engine", ["reference", *ENGINES])
@kept(lambda engine: interpreted("photometric", engine))
def test_similarity_is_the_score_of_images_with_a_black_margin(engine, generator):
    """Around an image's own pixels the score's windows then lie inside the picture."""
    a, b = torch.rand(2, 12, 90, 3, generator=generator)
    margins = (torch.nn.functional.pad(image, (0, 0, 5, 5, 5, 5)) for image in (a, b))
    with kernels.using(engine):
        assert kernels.photometric(*moved([a, b], engine))[0].item() == pytest.approx(metrics.ssim(*margins), abs=1e-6)


def test_similarity_does_not_depend_on_the_number_of_threads(generator):
    a, b = torch.rand(2, 70, 50, 3, generator=generator)
    a.requires_grad_()
    found, threads = [], numba.get_num_threads()
    for number in (1, threads):
        numba.set_num_threads(number)
        with kernels.using("cpu"):
            ssim, gap = kernels.photometric(a, b)
        found.append((ssim, gap, *torch.autograd.grad(gap - ssim, a)))
    assert all(torch.equal(*pair) for pair in zip(*found, strict=True))


# The references themselves, asked for mathematics


@pytest.mark.parametrize(("name", "case"), [(name, case) for name in OPERATIONS for case in facts(name).smooth])
def test_reference_gradient_is_the_slope(name, case):
    inputs = exact(cases(name)[case])
    wanted = [i for i in facts(name).differentiable if i < len(inputs)]
    leaves = [inputs[i].requires_grad_() for i in wanted]

    def function(*real):
        given = dict(zip(wanted, real, strict=True))
        with kernels.using("reference"):
            return getattr(module(name), name)(*(given.get(i, x) for i, x in enumerate(inputs)))

    slopes = sum(x.numel() for x in leaves) * sum(x.numel() for x in truth(name, case)[: facts(name).outputs])
    # Of more than so many slopes, those along one random direction have to do: they take seconds.
    assert torch.autograd.gradcheck(function, leaves, fast_mode=slopes > 20_000)


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


def test_marching_has_the_cases_it_claims():
    """No case of marching was lost where rays that hang on rounding are left out."""
    for origins, _, _, _, occupied, *_ in cases("march")[1:]:
        assert len(origins), tuple(occupied.shape)
    longest = max(truth("march", case)[2].diff().max().item() for case in range(1, len(cases("march"))))
    assert longest > 64
