"""LPIPS beside a slow formula that shares no code with it, on weights made up here."""

from __future__ import annotations

import os

import pytest
import safetensors.torch
import tiny
import torch

from lumigraph.datasets.scene import Photograph
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.views import compare
from lumigraph.metrics.lpips import SHAPES, Lpips, load_lpips, named_files


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    made = {name: torch.randn(shape, generator=generator) for name, shape in SHAPES.items()}
    return {name: x.abs() if name.startswith("lin") else x / max(1, x[0].numel()) ** 0.5 for name, x in made.items()}


def pictures(height: int = 39, width: int = 33) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    a = torch.rand(height, width, 3, generator=generator)
    return a, (a + 0.2 * torch.randn(a.shape, generator=generator)).clamp(0, 1)


def convolved(x, weight, bias, stride, padding):
    """Window by window, in float64."""
    size = weight.shape[-1]
    padded = torch.zeros(x.shape[0], x.shape[1] + 2 * padding, x.shape[2] + 2 * padding, dtype=torch.float64)
    padded[:, padding : padding + x.shape[1], padding : padding + x.shape[2]] = x
    windows = padded.unfold(1, size, stride).unfold(2, size, stride)  # channel, row, column, y, x
    return torch.einsum("crsyx,ocyx->ors", windows, weight.double()) + bias.double()[:, None, None]


def pooled(x):
    return x.unfold(1, 3, 2).unfold(2, 3, 2).amax((-1, -2))


def slow(weights, a, b) -> float:
    """The paper's equation: a mean over places of a weighted sum over channels, summed over layers."""
    stacks = []
    for picture in (a, b):
        x = (picture.double() * 2 - 1).permute(2, 0, 1)
        for channel, (mean, deviation) in enumerate(((0.485, 0.229), (0.456, 0.224), (0.406, 0.225))):
            x[channel] = (picture[..., channel].double() - mean) / deviation
        stack = []
        for number, stride, padding, pool in ((0, 4, 2, 0), (3, 1, 2, 1), (6, 1, 1, 1), (8, 1, 1, 0), (10, 1, 1, 0)):
            x = pooled(x) if pool else x
            x = convolved(x, weights[f"features.{number}.weight"], weights[f"features.{number}.bias"], stride, padding)
            x = x.clamp_min(0)
            stack.append(x)
        stacks.append(stack)
    total = 0.0
    for layer, (x, y) in enumerate(zip(*stacks, strict=True)):
        weight = weights[f"lin{layer}.model.1.weight"].double().flatten()
        for row in range(x.shape[1]):
            for column in range(x.shape[2]):
                p, q = x[:, row, column], y[:, row, column]
                p, q = p / (p.norm() + 1e-10), q / (q.norm() + 1e-10)
                total += float((weight * (p - q) ** 2).sum()) / (x.shape[1] * x.shape[2])
    return total


def test_it_is_the_equation(weights):
    a, b = pictures()
    # the published shift and scale are ImageNet's mean and deviation, rounded to three digits
    assert Lpips(weights)(a, b) == pytest.approx(slow(weights, a, b), rel=2e-3)


def test_equal_pictures_have_no_distance(weights):
    a, b = pictures()
    distance = Lpips(weights)
    assert distance(a, a) == 0
    assert distance(a, b) == pytest.approx(distance(b, a))
    assert distance(a, (a + b) / 2) < distance(a, b)


@pytest.mark.parametrize("kind", ["one file", "two files"])
def test_weights_come_from_files(tmp_path, weights, kind):
    a, b = pictures()
    if kind == "one file":
        paths = [tmp_path / "both.safetensors"]
        safetensors.torch.save_file(weights, paths[0])
    else:
        paths = [tmp_path / "alexnet.pth", tmp_path / "alex.pth"]
        other = {"classifier.6.bias": torch.zeros(1000)}
        torch.save({n: x for n, x in weights.items() if n.startswith("features")} | other, paths[0])
        torch.save({n: x for n, x in weights.items() if n.startswith("lin")}, paths[1])
    assert load_lpips(paths)(a, b) == Lpips(weights)(a, b)


def test_the_environment_names_files(tmp_path, monkeypatch):
    monkeypatch.setenv("LUMIGRAPH_LPIPS", os.pathsep.join(["a.pth", "b.pth"]))
    assert [path.name for path in named_files([])] == ["a.pth", "b.pth"]
    assert named_files([tmp_path]) == [tmp_path]
    monkeypatch.delenv("LUMIGRAPH_LPIPS")
    assert named_files([]) == []


def test_missing_weights_are_named(tmp_path, weights):
    for left_out, whose in (("features", "torchvision"), ("lin", "LPIPS repository")):
        path = tmp_path / f"{left_out}.safetensors"
        safetensors.torch.save_file({n: x for n, x in weights.items() if not n.startswith(left_out)}, path)
        with pytest.raises(LumigraphError, match=whose):
            load_lpips([path])


def test_other_networks_are_refused(tmp_path, weights):
    path = tmp_path / "other.safetensors"
    safetensors.torch.save_file(weights | {"features.0.weight": torch.zeros(64, 3, 3, 3)}, path)
    with pytest.raises(LumigraphError, match="not those of another network"):
        load_lpips([path])


class Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('ran')",))


def test_no_code_runs_and_rubbish_is_refused(tmp_path):
    torch.save({"features.0.weight": Evil()}, tmp_path / "evil.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    for name in ("rubbish.safetensors", "rubbish.pth"):
        (tmp_path / name).write_bytes(b"rubbish")
    for path in sorted(tmp_path.iterdir()):
        with pytest.raises(LumigraphError, match="give safetensors or a state dict"):
            load_lpips([path])
    with pytest.raises(LumigraphError, match="does not exist"):
        load_lpips([tmp_path / "none.pth"])


def test_pictures_may_be_too_small(weights):
    a = torch.zeros(31, 31, 3)
    assert Lpips(weights)(a, a) == 0
    with pytest.raises(LumigraphError, match="31 x 31"):
        Lpips(weights)(a[:30], a[:30])


def test_what_a_mask_rules_out_does_not_count(weights):
    a, b = pictures()
    mask = torch.ones(a.shape[:2], dtype=torch.bool)
    mask[:, 16:] = False
    distance = Lpips(weights)
    spoilt = torch.where(mask[..., None], b, 1 - b)
    camera = tiny.scene().cameras[0]
    masked, whole = Photograph(camera, a, mask=mask), Photograph(camera, a)
    scores = [compare("one", rgb, masked, a, slice(None), 0.0, distance) for rgb in (b, spoilt)]
    assert scores[0].lpips == scores[1].lpips
    assert 0 < scores[0].lpips < compare("one", b, whole, a, slice(None), 0.0, distance).lpips
