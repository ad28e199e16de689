"""PSNR and SSIM against values worked out by hand and by scikit-image."""

from __future__ import annotations

import math

import pytest
import torch

from lumigraph.metrics import normal_consistency, psnr, ssim, ssim_map
from lumigraph.metrics.detail import detail


def pictures(height=40, width=53):
    """Two smooth pictures and noise between them, the same numbers on every machine."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    a = torch.stack([(0.11 * x + 0.07 * y).sin(), (0.05 * x - 0.13 * y).cos(), ((x * y) % 17) / 8.5 - 1], -1)
    noise = (12.9898 * x + 78.233 * y).sin()[..., None] * torch.tensor([0.05, 0.1, 0.2])
    a = (0.5 + 0.4 * a).float()
    return a, (a + noise).clamp(0, 1).float()


def test_psnr_is_minus_ten_log_of_the_error():
    a = torch.zeros(8, 8, 3)
    assert psnr(a, a + 0.1) == pytest.approx(20.0, abs=1e-5)
    assert psnr(a, a + torch.tensor([0.1, 0.2, 0.4])) == pytest.approx(-10 * math.log10(0.21 / 3), abs=1e-5)
    assert psnr(a, a) == pytest.approx(100.0)


def test_ssim_agrees_with_scikit_image():
    # skimage.metrics.structural_similarity(a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    # data_range=1.0, channel_axis=-1)
    a, b = pictures()
    assert ssim(a, b) == pytest.approx(EXPECTED_MEAN, abs=1e-5)
    for channel, expected in enumerate(EXPECTED_CHANNELS):
        assert ssim(a[..., channel : channel + 1], b[..., channel : channel + 1]) == pytest.approx(expected, abs=1e-5)


def test_ssim_of_constant_pictures_is_the_luminance_term():
    a, b = torch.full((16, 16, 1), 0.4), torch.full((16, 16, 1), 0.6)
    assert ssim(a, b) == pytest.approx((2 * 0.24 + 1e-4) / (0.16 + 0.36 + 1e-4), abs=1e-6)


def test_ssim_counts_windows_inside_the_picture_only():
    a, b = pictures()
    assert ssim_map(a, b).shape == (30, 43, 3)
    assert ssim(a, a) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="11 x 11"):
        ssim(a[:10], b[:10])


EXPECTED_MEAN = 0.7233971789332362
EXPECTED_CHANNELS = (0.7929736251070538, 0.5331190620284164, 0.8440988496642385)


def test_detail_tells_a_shift_from_blur(generator):
    noise = torch.rand(130, 130, 3, generator=generator)
    texture = torch.nn.functional.avg_pool2d(noise.permute(2, 0, 1), 3, 1).permute(1, 2, 0)
    photograph, shifted = texture[:-1, :-1], texture[1:, 1:]
    blurred = torch.nn.functional.avg_pool2d(texture.permute(2, 0, 1), 11, 1).permute(1, 2, 0)
    inner = texture[5:-5, 5:-5]
    assert abs(psnr(shifted, photograph) - psnr(blurred, inner)) < 3  # PSNR has no word for the difference
    assert "shifted by a pixel" in str(detail(shifted, photograph))
    assert str(detail(blurred, inner)).startswith("blurred")
    assert str(detail(photograph + 0.02 * noise[:127, :127], photograph)) == "as sharp as the photographs"
    half = torch.zeros(118, 118, dtype=torch.bool)
    half[:, :60] = True
    seen = torch.where(half[..., None], inner, blurred)
    assert detail(seen, inner, half).sharpness == pytest.approx(1, abs=0.05)
    assert detail(texture[:9, :9], texture[:9, :9]) is None and detail(0 * texture, 0 * texture) is None


def test_normals_are_compared_with_those_of_the_nearest_point():
    """Two points in the other order, the normal of one turned by 30 degrees: the mean of cosines 1 and cos 30."""
    points, up, side = torch.tensor([[0.0, 0, 0], [1, 0, 0]]), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
    turned = (0.0, 0.5, 0.75**0.5)
    found = normal_consistency(points, torch.tensor([up, side]), points.flip(0), torch.tensor([side, turned]))
    assert found == pytest.approx((1 + 0.75**0.5) / 2)
