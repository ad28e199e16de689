"""Score distillation by a tiny diffusion model in the layout of diffusers (Poole 2022)."""

from __future__ import annotations

import importlib.util
import json
import shutil

import pytest
import tiny_words
import torch
from budgets import budget

from lumigraph.components.guidance import diffusion
from lumigraph.components.guidance.diffusion import DiffusionGuide
from lumigraph.components.guidance.guides import DistillationNumbers
from lumigraph.components.guidance.opening import open_guide
from lumigraph.datasets.words import Words
from lumigraph.errors import LumigraphError
from lumigraph.methods.dream_fields import DreamFields
from lumigraph.training import fit

pytestmark = [  # importing it takes 3 s, of each worker
    budget("methods", 4),
    pytest.mark.skipif(importlib.util.find_spec("diffusers") is None, reason="no diffusers"),
]
CPU, PROMPTS = torch.device("cpu"), ("a red ball, front view", "a red ball, side view")


@pytest.fixture(scope="module")
def guide() -> DiffusionGuide:
    found = open_guide(tiny_words.diffusion_folder(), CPU)
    assert isinstance(found, DiffusionGuide) and found.pixels == 16
    return found


def chance(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_the_loss_has_the_gradient_of_the_paper(guide):
    """w(t) (e - noise) dz/dx, eq. 3: without the Jacobian of the denoiser."""
    n, pictures = DistillationNumbers(guidance_scale=7.0), torch.rand(2, 3, 16, 16, generator=chance(3))
    latents = guide.latents(pictures.requires_grad_(), generator := chance(5))
    score = guide.gradient(latents.detach(), PROMPTS, generator, n)
    (expected,) = torch.autograd.grad(latents, pictures, score / 2)  # a mean over two pictures
    (found,) = torch.autograd.grad(guide.loss(pictures, PROMPTS, chance(5), n), pictures)
    torch.testing.assert_close(found, expected)
    assert score.abs().mean() > 1e-3


def test_guidance_extrapolates_from_no_words(guide, monkeypatch):
    """e = (1 + w) e(y) - w e(), eq. 4, at one time for all pictures."""
    monkeypatch.setattr(diffusion, "MIN_TIME", 0.5)
    monkeypatch.setattr(diffusion, "MAX_TIME", 0.5)
    latents = torch.randn(2, 4, 8, 8, generator=chance(3))

    def at(scale: float, prompts: tuple[str, str] = PROMPTS) -> torch.Tensor:
        return guide.gradient(latents, prompts, chance(5), DistillationNumbers(scale))

    words, none = at(0.0), at(0.0, ("", ""))
    torch.testing.assert_close(at(4.0), 5 * words - 4 * none, rtol=1e-3, atol=1e-4)
    assert (words - none).abs().max() > 1e-6


def test_the_noise_is_weighted_by_what_is_lost(guide, monkeypatch):
    """With a denoiser that finds nothing the gradient is -w(t) noise, w(t) = 1 - kept(t)."""
    monkeypatch.setattr(diffusion, "MIN_TIME", 0.3)
    monkeypatch.setattr(diffusion, "MAX_TIME", 0.3)
    plain = object.__new__(DiffusionGuide)
    plain.__dict__ = guide.__dict__ | {"predicted": lambda noisy, time, states: torch.zeros_like(noisy)}
    latents, n = torch.zeros(1, 4, 8, 8), DistillationNumbers(0.0)
    generator = chance(1)
    torch.rand(1, generator=generator)
    noise = torch.randn(latents.shape, generator=generator)
    lost = 1 - guide.kept[round(0.3 * (len(guide.kept) - 1))]
    torch.testing.assert_close(plain.gradient(latents, PROMPTS[:1], chance(1), n), -lost * noise)


def test_gradients_reach_the_picture(guide):
    pictures = torch.rand(2, 3, 16, 16, generator=chance()).requires_grad_()
    (gradient,) = torch.autograd.grad(guide.loss(pictures, PROMPTS, chance(), DistillationNumbers()), pictures)
    assert gradient.isfinite().all() and gradient.abs().mean() > 0
    assert guide.score(pictures.detach(), "a red ball").value > 0


def test_a_field_is_led_by_diffusion():
    words = Words("a red ball", tiny_words.diffusion_folder())
    method = DreamFields(words.frame, DreamFields.smallest())
    before = method.network.table.detach().clone()
    fit(method, words, None, steps=3, show=False, rehearsal=False)
    assert (method.network.table != before).any() and method.network.table.isfinite().all()


@pytest.mark.parametrize("part", ["unet", "text_encoder"])
def test_models_of_another_kind_are_refused(tmp_path, part):
    shutil.copytree(tiny_words.diffusion_folder(), folder := tmp_path / "other")
    index = json.loads((folder / "model_index.json").read_text())
    index[part] = ["diffusers", "T5EncoderModel"]
    (folder / "model_index.json").write_text(json.dumps(index))
    with pytest.raises(LumigraphError, match=f"has a T5EncoderModel as its {part}"):
        DiffusionGuide(folder, CPU)


def test_missing_weights_are_named(tmp_path):
    shutil.copytree(tiny_words.diffusion_folder(), folder := tmp_path / "other")
    shutil.rmtree(folder / "vae")
    with pytest.raises(LumigraphError, match="holds no AutoencoderKL"):
        DiffusionGuide(folder, CPU)
