"""Points as waves: columns and widths, float32 beside exact sums, gradients, and kernels that know only differences."""

from __future__ import annotations

import math

import pytest
import torch
from budgets import budget

from lumigraph.components.fields.encodings import FourierEncoding, FrequencyEncoding, IntegratedEncoding

pytestmark = budget("methods")


def points(generator, count: int = 500, inputs: int = 3) -> torch.Tensor:
    return 2 * torch.rand(count, inputs, generator=generator) - 1


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize(("inputs", "bands"), [(3, 10), (3, 4), (2, 1), (1, 6)])
def test_columns_are_octaves_of_all_coordinates_together(inputs, bands, keep, generator):
    encoding, p = FrequencyEncoding(inputs, bands, keep), points(generator, 7, inputs)
    columns = [p] if keep else []
    for k in range(bands):
        angle = 2**k * math.pi * p.double()
        columns += [angle.sin(), angle.cos()]
    expected = torch.cat(columns, 1)
    assert expected.shape[1] == encoding.width
    torch.testing.assert_close(encoding(p).double(), expected.double(), rtol=0, atol=1.5e-4)


def test_the_nerf_paper_has_sixty_and_twenty_four_numbers():
    assert FrequencyEncoding(3, 10, keep_input=False).width == 60  # section 5.1
    assert FrequencyEncoding(3, 4, keep_input=False).width == 24
    assert FrequencyEncoding(3, 0).width == 3


def test_the_base_is_the_angle_of_the_first_octave():
    encoding = FrequencyEncoding(1, 2, keep_input=False, base=1.0)
    p = torch.tensor([[0.3]])
    expected = torch.tensor([[0.3, 0.6]])
    torch.testing.assert_close(encoding(p)[:, 0::2], expected.sin())
    torch.testing.assert_close(encoding(p)[:, 1::2], expected.cos())


def test_float32_stays_near_the_truth_at_ten_bands(generator):
    p = points(generator, 20_000)
    exact = FrequencyEncoding(3, 10).double()(p.double())
    octaves = math.pi * 2.0 ** torch.arange(10, dtype=torch.float64)
    assert torch.equal(octaves.float().double(), FrequencyEncoding(3, 10).octaves.double())
    assert (FrequencyEncoding(3, 10)(p) - exact).abs().max() < 3e-4


@pytest.mark.parametrize("keep", [False, True])
def test_gradients_of_frequencies(keep, generator):
    p = points(generator, 5).double().requires_grad_()
    assert torch.autograd.gradcheck(FrequencyEncoding(3, 5, keep).double(), p)


def test_gradients_of_fourier_features(generator):
    encoding = FourierEncoding(torch.randn(6, 2, generator=generator)).double()
    assert torch.autograd.gradcheck(encoding, points(generator, 5, 2).double().requires_grad_())


def test_inner_products_of_fourier_features_know_only_differences(generator):
    """gamma(p) . gamma(q) = sum_j cos(2 pi b_j . (p - q)): the kernel is stationary (Tancik 2020, section 4)."""
    frequencies = 3 * torch.randn(64, 2, generator=generator)
    encoding = FourierEncoding(frequencies).double()
    p, q = points(generator, 20, 2).double(), points(generator, 20, 2).double()
    product = (encoding(p) * encoding(q)).sum(1)
    expected = (2 * math.pi * (p - q) @ frequencies.double().t()).cos().sum(1)
    torch.testing.assert_close(product, expected)
    shifted = (encoding(p + 0.37) * encoding(q + 0.37)).sum(1)
    torch.testing.assert_close(shifted, product)


def test_frequencies_survive_saving_and_octaves_need_none(generator):
    encoding = FourierEncoding(torch.randn(4, 2, generator=generator))
    other = FourierEncoding(torch.zeros(4, 2))
    other.load_state_dict(encoding.state_dict())
    p = points(generator, 9, 2)
    assert torch.equal(other(p), encoding(p))
    assert not FrequencyEncoding(3, 10).state_dict() and encoding.width == 8


def test_an_integrated_encoding_is_the_mean_over_a_gaussian(generator):
    """Barron 2021, eqs. 11 to 14, against the mean of the plain encoding over samples."""
    mean, deviation = torch.tensor([0.3, -0.7, 0.1]), torch.tensor([0.05, 0.3, 0.01])
    samples = mean + deviation * torch.randn(400_000, 3, generator=generator)
    plain = FrequencyEncoding(3, 6, keep_input=False, base=1.0)
    seen = IntegratedEncoding(3, 6)(mean[None], deviation.square()[None])
    torch.testing.assert_close(seen[0], plain(samples).double().mean(0).float(), rtol=0, atol=5e-3)


def test_without_width_it_is_the_plain_encoding(generator):
    p = points(generator)
    plain = FrequencyEncoding(3, 8, keep_input=False, base=1.0)
    torch.testing.assert_close(IntegratedEncoding(3, 8)(p, torch.zeros_like(p)), plain(p), rtol=0, atol=1e-5)
