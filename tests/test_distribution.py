"""FID and KID: distances of Gaussians, what the shipped network notices, Inception's architecture and its files."""

from __future__ import annotations

import pytest
import safetensors.torch
import torch
from budgets import budget
from torch.nn.functional import avg_pool2d, interpolate

from lumigraph.errors import LumigraphError
from lumigraph.metrics import distribution
from lumigraph.metrics.distribution import (
    Inception,
    RandomFeatures,
    distances,
    frechet_distance,
    kernel_distance,
    load_inception,
)

pytestmark = budget("methods", 5)


def drawn(count: int, mean: float, deviation: float, seed: int) -> torch.Tensor:
    return mean + deviation * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))


def test_the_distance_of_gaussians_is_known():
    """Distance of N(m, s^2) in each of three features: 3 ((m - m')^2 + (s - s')^2)."""
    a, b = drawn(200_000, 0.0, 1.0, 0), drawn(200_000, 0.5, 2.0, 1)
    assert frechet_distance(a, b) == pytest.approx(3 * (0.25 + 1.0), rel=0.02)
    assert frechet_distance(a, a) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(a, b) == pytest.approx(frechet_distance(b, a), rel=1e-6)


def test_the_distance_sees_correlations():
    """Two features, correlated by +r and by -r: 2 tr(C) - 2 tr((C C')^(1/2)) in closed form."""
    x = torch.randn(100_000, 2, generator=torch.Generator().manual_seed(0)).double()
    mixed = [x @ torch.linalg.cholesky(torch.tensor([[1.0, r], [r, 1.0]]).double()).T for r in (0.6, -0.6)]
    # C C' = (1 - r^2) I for these two
    assert frechet_distance(*mixed) == pytest.approx(4 - 4 * (1 - 0.36) ** 0.5, rel=0.05)


def test_the_kernel_distance_is_unbiased():
    """About zero for sets of one distribution, by its definition for three numbers."""
    a, b = torch.tensor([[0.0], [1.0]]), torch.tensor([[2.0], [3.0]])
    kernel = lambda x, y: (x * y + 1.0) ** 3  # noqa: E731
    expected = kernel(0, 1) + kernel(2, 3) - 2 * (kernel(0, 2) + kernel(0, 3) + kernel(1, 2) + kernel(1, 3)) / 4
    assert kernel_distance(a, b) == pytest.approx(expected)
    found = [kernel_distance(drawn(100, 0, 1, 2 * i), drawn(100, 0, 1, 2 * i + 1)) for i in range(40)]
    mean, error = torch.tensor(found).mean(), torch.tensor(found).std() / 40**0.5
    assert mean.abs() < 3 * error


def blobs(count: int, seed: int) -> torch.Tensor:
    """Pictures of random smooth colours."""
    coarse = torch.rand(count, 3, 6, 6, generator=torch.Generator().manual_seed(seed))
    return interpolate(coarse, (32, 32), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)


def test_the_shipped_network_notices_what_is_wrong():
    """Blur, noise, paler colours and fewer modes each cost more the stronger they are, and another draw costs least."""
    network, real = RandomFeatures(), blobs(200, 0)

    def fid(made: torch.Tensor) -> float:
        return distances(real, made, network)[0].value

    another = blobs(200, 1)
    floor = fid(another)

    def blur(x: torch.Tensor, n: int) -> torch.Tensor:
        small = avg_pool2d(x.permute(0, 3, 1, 2), n)
        return interpolate(small, (32, 32), mode="bilinear").permute(0, 2, 3, 1)

    noise = torch.randn(another.shape, generator=torch.Generator().manual_seed(2))
    for worse in (
        [blur(another, 8), blur(another, 16)],
        [another + 0.1 * noise, another + 0.2 * noise],
        [0.5 + 0.8 * (another - 0.5), 0.5 + 0.5 * (another - 0.5)],
        [another[:20].repeat(10, 1, 1, 1), another[:4].repeat(50, 1, 1, 1)],
    ):
        mild, strong = (fid(x.clamp(0, 1)) for x in worse)
        assert floor < mild < strong


def test_the_shipped_network_never_changes():
    """Its weights are frozen, so that figures of different years can be compared."""
    assert RandomFeatures().weights[0][0, 0].flatten().tolist()[:3] == pytest.approx(FIRST_WEIGHTS, abs=1e-5)
    assert RandomFeatures().features(torch.full((1, 3, 64, 64), 0.25)).shape == (1, 240)


FIRST_WEIGHTS = [-0.00014368, -0.07481869, -0.03790873]


def test_sets_of_one_are_refused():
    with pytest.raises(LumigraphError, match="give two or more"):
        distances(blobs(1, 0), blobs(4, 1), RandomFeatures())


# Inception


class Every(dict):
    """Weights of any name and shape that are asked for, kept, so that a file can be made of them."""

    shapes: dict[str, tuple[int, ...]]


def small_inception(share: int, classes: int = 1008) -> dict[str, torch.Tensor]:
    """Random weights of an Inception with so many times fewer channels, by its architecture itself."""
    made: dict[str, torch.Tensor] = {"fc.weight": torch.zeros(classes, 2048 // share)}
    generator = torch.Generator().manual_seed(0)

    class Recording(Inception):
        def _weight(self, name, shape):
            shape = tuple(shape)
            if name not in made:
                fan = max(1, shape[1] * shape[2] * shape[3]) if len(shape) == 4 else 1
                made[name] = (
                    (2 / fan) ** 0.5 * torch.randn(shape, generator=generator)
                    if len(shape) == 4
                    else (torch.ones(shape) if name.endswith(("bn.weight", "running_var")) else torch.zeros(shape))
                )
            return torch.empty(shape, device="meta")

    Recording(made, share=share)
    return made


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    return small_inception(16)


def test_the_architecture_is_the_published_one():
    """94 convolutions, 21.8 million numbers ahead of the last layer, by torchvision's names."""
    shapes: dict[str, tuple[int, ...]] = {}

    class Shapes(Inception):
        def _weight(self, name, shape):
            shapes[name] = tuple(shape)
            return torch.empty(tuple(shape), device="meta")

    definition = Shapes({}).definition
    kernels = [name for name in shapes if name.endswith("conv.weight")]
    assert len(kernels) == 94 and "2048 features" in definition
    assert sum(torch.Size(shapes[name]).numel() for name in kernels) == 21_751_136
    assert shapes["Mixed_5b.branch5x5_2.conv.weight"] == (64, 48, 5, 5)
    assert shapes["Mixed_6c.branch7x7dbl_3.conv.weight"] == (160, 160, 1, 7)
    assert shapes["Mixed_6e.branch_pool.conv.weight"] == (192, 768, 1, 1)
    assert shapes["Mixed_7a.branch7x7x3_4.conv.weight"] == (192, 192, 3, 3)
    assert shapes["Mixed_7c.branch3x3dbl_3b.conv.weight"] == (384, 384, 3, 1)


def test_a_file_of_weights_is_read(weights, tmp_path, monkeypatch):
    """By both kinds of file, with the same features; full size is a matter of `share` alone."""
    torch.save(weights, tmp_path / "w.pth")
    safetensors.torch.save_file(weights, tmp_path / "w.safetensors")
    real = Inception.__init__
    monkeypatch.setattr(Inception, "__init__", lambda self, w, where: real(self, w, where, share=16))
    one, other = (load_inception(tmp_path / name) for name in ("w.pth", "w.safetensors"))
    picture = torch.rand(1, 3, 40, 40, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        a, b = one.features(picture), other.features(picture)
    assert torch.equal(a, b) and a.shape == (1, 128) and a.std() > 0 and "128 features" in one.definition


def test_other_networks_are_refused(weights, tmp_path):
    torch.save({"features.0.weight": torch.zeros(64, 3, 11, 11)}, tmp_path / "alexnet.pth")
    with pytest.raises(LumigraphError, match=r"alexnet\.pth lacks Conv2d_1a_3x3\.conv\.weight"):
        load_inception(tmp_path / "alexnet.pth")
    torch.save(weights, tmp_path / "slim.pth")
    with pytest.raises(LumigraphError, match=r"shape \(2, 3, 3, 3\), where FID's Inception has \(32, 3, 3, 3\)"):
        load_inception(tmp_path / "slim.pth")
    torch.save(weights | {"fc.weight": torch.zeros(1000, 128)}, tmp_path / "torchvision.pth")
    with pytest.raises(LumigraphError, match="1000 classes"):
        load_inception(tmp_path / "torchvision.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(LumigraphError, match="no file of weights"):
        load_inception(tmp_path / "text.pth")


def test_averages_leave_the_border_out():
    x = torch.arange(9.0).view(1, 1, 3, 3)
    assert distribution.averaged(x)[0, 0, 0, 0] == pytest.approx((0 + 1 + 3 + 4) / 4)
