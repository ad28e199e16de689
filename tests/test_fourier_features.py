"""Fourier features: the rows of B, the wall that rays meet, and the tangent kernel that explains the rest."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import listing
import numpy as np
import pytest
import torch
from budgets import budget
from PIL import Image

from lumigraph.camera.rays import Rays
from lumigraph.commands.cli import main
from lumigraph.components.fields.layers import Dense
from lumigraph.datasets.scene import Frame
from lumigraph.lab.explain.encodings import GRID_POINTS, compare, kernel_at_start, learn, spectrum, tangent_kernel
from lumigraph.lab.explain.encodings_page import write_page
from lumigraph.methods.fourier_features import Config, FourierFeatures, frequencies
from lumigraph.opening import open_scene
from lumigraph.run import build

pytestmark = budget("methods", 12)

CPU = torch.device("cpu")
SMALL = Config(hidden_width=64, frequencies=64, pixels_per_step=512, learning_rate=5e-3)


def painted(**numbers) -> FourierFeatures:
    return build(FourierFeatures, Frame(), Config(**numbers), CPU, 0)


# B


def test_basic_is_one_wave_along_each_axis():
    assert torch.equal(frequencies(Config(encoding="basic")), torch.eye(2))
    assert frequencies(Config(encoding="none")) is None


def test_positional_frequencies_rise_evenly_in_octaves_along_the_axes():
    rows = frequencies(Config(encoding="positional", scale=100.0, frequencies=8))
    rising = torch.tensor([1.0, 100**0.25, 10.0, 100**0.75])
    torch.testing.assert_close(
        rows, torch.cat([torch.stack([rising, 0 * rising], 1), torch.stack([0 * rising, rising], 1)])
    )


def test_gaussian_frequencies_have_the_scale_for_deviation():
    rows = frequencies(Config(scale=7.0, frequencies=4096))
    assert rows.shape == (4096, 2) and rows.std().item() == pytest.approx(7, rel=0.03)
    assert torch.equal(rows, frequencies(Config(scale=7.0, frequencies=4096)))
    assert not torch.equal(rows, frequencies(Config(scale=7.0, frequencies=4096, seed=1)))


def test_the_papers_network_has_its_shapes():
    method = painted()
    assert [tuple(layer.weight.shape) for layer in method.layers] == [(256, 512), (256, 256), (256, 256), (3, 256)]
    assert [tuple(layer.weight.shape)[1] for layer in painted(encoding="none").layers][0] == 2


@pytest.mark.parametrize("encoding", ["none", "basic", "positional", "gaussian"])
def test_neighbouring_pixels_are_told_apart(encoding):
    """Also where products are taken in bfloat16, which has three numbers between 3/4 and 3/4 + 1/100."""
    along = 0.75 + torch.arange(20) / 2000
    colours = painted(encoding=encoding).paint(torch.stack([along, along], 1))
    assert len(colours.unique(dim=0)) == 20


# The wall


def test_rays_meet_the_wall_or_the_background():
    method = painted(hidden_width=8, frequencies=4)
    origins = torch.tensor([[0.5, -2.0, 0.0], [0.5, 3.0, 0.0], [0.0, -2.0, 0.0], [0.0, -2.0, 0.0], [5.0, -2.0, 0.0]])
    directions = torch.tensor([[0.0, 1, 0], [0, -1, 0], [0, -1, 0], [1, 0, 0], [0, 1, 0]])
    background = torch.tensor([[0.1, 0.2, 0.3]])
    seen = method.render_rays(Rays(origins, directions, torch.full((5,), 1e-3)), background)
    assert seen.depth.tolist() == [2, 3, math.inf, math.inf, math.inf]
    assert seen.opacity.tolist() == [1, 1, 0, 0, 0]  # both sides; then behind, along it, beside it
    torch.testing.assert_close(seen.rgb[:2], method.paint(torch.tensor([[0.75, 0.5]])).expand(2, 3))
    torch.testing.assert_close(seen.rgb[2:], background.expand(3, 3))


# The tangent kernel


@pytest.mark.parametrize("widths", [(3, 2), (5, 8, 3), (4, 16, 16, 1)])
def test_the_tangent_kernel_is_made_of_gradients(widths, generator):
    """Against what autograd gives for every weight of every point's every output."""
    *hidden, (inputs, outputs) = list(zip(widths[:-1], widths[1:], strict=True))
    torch.manual_seed(0)
    layers = [Dense(a, b, relu=True, exact=True) for a, b in hidden] + [Dense(inputs, outputs, exact=True)]
    for layer in layers:
        torch.nn.init.normal_(layer.bias, std=0.3)
    network, points = torch.nn.Sequential(*layers), torch.randn(6, widths[0], generator=generator)
    kernel = torch.zeros(6, 6, dtype=torch.double)
    for k in range(outputs):
        rows = [torch.autograd.grad(network(p[None])[0, k], [*network.parameters()]) for p in points]
        jacobian = torch.stack([torch.cat([g.flatten() for g in row]) for row in rows]).double()
        kernel += jacobian @ jacobian.t() / outputs
    torch.testing.assert_close(tangent_kernel(network, points), kernel, rtol=1e-5, atol=1e-5)


def test_waves_make_the_kernel_stationary():
    """Section 4: with B the kernel knows only where points differ, up to the chance in a finite width."""
    spread = {}
    for encoding in ("none", "gaussian"):
        diagonal = kernel_at_start(painted(encoding=encoding, scale=4.0, hidden_width=1536)).diagonal()
        spread[encoding] = (diagonal.std() / diagonal.mean()).item()
    assert spread["gaussian"] < 0.09 and spread["none"] > 0.14


def test_scale_makes_the_spectrum_level():
    """Section 5: the share of the smaller half of the eigenvalues, which detail needs."""
    half, networks = (
        GRID_POINTS * GRID_POINTS // 2,
        [{"encoding": "none"}, *({"scale": scale} for scale in (1.0, 4.0, 16.0))],
    )
    shares = [float(spectrum(kernel_at_start(painted(**numbers)))[half:].sum()) for numbers in networks]
    assert shares == sorted(shares) and shares[0] < 1e-4 < 0.02 < shares[1] and shares[3] > 0.2


def test_shares_of_a_spectrum_add_up(generator):
    root = torch.randn(9, 9, generator=generator, dtype=torch.double)
    shares = spectrum(root @ root.t())
    assert shares.sum().item() == pytest.approx(1) and (shares.diff() <= 0).all() and (shares > 0).all()


# The comparison


@pytest.fixture(scope="module")
def photograph(tmp_path_factory) -> Path:
    """Waves of many lengths, shorter to the right: detail that a smooth network cannot draw, and nothing random."""
    y, x = np.mgrid[:64, :64] / 64
    waves = [np.sin(2 * np.pi * (f * x**1.5 + g * y)) for f, g in ((3, 1), (6, 2), (9, -4))]
    pixels = 127.5 + 120 * np.stack(waves, -1)
    path = tmp_path_factory.mktemp("picture") / "waves.png"
    Image.fromarray(pixels.astype(np.uint8)).save(path)
    return path


@pytest.fixture(scope="module")
def comparison(photograph):
    return compare(open_scene(photograph), (0.5, 4.0, 60.0), 120, CPU, SMALL)


def test_gaussian_features_win_and_their_best_scale_lies_inside(comparison):
    assert comparison.gain > 5 and comparison.peak_inside and comparison.best("gaussian").scale == 4
    small, best, large = comparison.of("gaussian")
    assert large.learnt - large.held_out > 5 > abs(small.learnt - small.held_out)  # too large memorises
    assert len(comparison.fits) == 2 + 2 * 3 and [fit.encoding for fit in comparison.leading][0] == "none"


def test_a_seed_gives_the_same_figures(photograph):
    scene = open_scene(photograph)
    first, again, other = (learn(scene, replace(SMALL, seed=seed), 10, CPU).held_out for seed in (0, 0, 1))
    assert first == again != other


def test_the_page_holds_everything(comparison, tmp_path):
    write_page(tmp_path, comparison)
    names = ("index.html", "scales.svg", "spectrum.svg", "comparison.png", "figures.json")
    assert listing.names(tmp_path) == sorted(names)
    page = (tmp_path / "index.html").read_text("utf-8")
    assert page.count("<svg") == 2 and "data:image/jpeg" in page and "waves.png" in page
    assert f"{comparison.gain:.2f} dB over no encoding" in page and "src='http" not in page
    figures = json.loads((tmp_path / "figures.json").read_text())
    assert [fit["psnr_held_out"] for fit in figures["fits"]] == [fit.held_out for fit in comparison.fits]
    assert figures["resolution"] == "64x64" and len(figures["fits"][0]["eigenvalues"]) == GRID_POINTS * GRID_POINTS


def test_the_command(photograph, tmp_path, capsys):
    folder = tmp_path / "page"
    options = ["--output", str(folder), "--steps", "2", "--scales", "8", "2", "--device", "cpu"]
    assert main(["explain", "encodings", str(photograph), *options]) == 0
    assert "index.html" in capsys.readouterr().out
    assert [f["scale"] for f in json.loads((folder / "figures.json").read_text())["fits"]] == [None, None, 2, 8, 2, 8]
    for arguments, words in (
        ([str(tmp_path)], "is no image file"),
        ([str(photograph), "--steps", "0"], "--steps"),
        ([str(photograph), "--scales", "3", "3"], "--scales"),
        ([str(photograph), "--scales", "0", "3"], "--scales"),
    ):
        assert main(["explain", "encodings", *arguments]) == 2
        assert words in capsys.readouterr().err
