"""Score distillation: a text-to-image diffusion model as a guide (Poole et al. 2022, arXiv 2209.14988).

    model_index.json · unet/ · scheduler/ · text_encoder/ · tokenizer/ · vae/    diffusers' folder; safetensors alone

The text encoder is CLIP's, as in Stable Diffusion 1 and 2. Without vae/ it is a pixel-space model.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ... import files
from ...errors import LumigraphError
from ...files.reading import reading
from ...metrics import Score
from .clip import TextTransformer
from .clip_files import ConfigRecord, TowerRecord, load, named_as_here, read_tensors, read_tokenizer, tower_of
from .guides import MAX_TIME, MIN_TIME, DistillationNumbers, Pictures

DIFFUSION_INDEX = "model_index.json"
CLASSES = {"unet": "UNet2DConditionModel", "text_encoder": "CLIPTextModel"}  # that are understood
TEXT_WEIGHTS = "model.safetensors"
SCORE_SHARES = (0.2, 0.5, 0.8)  # of the noise schedule, at which agreement is measured


@dataclass(frozen=True)
class IndexRecord:
    """model_index.json: library and class of each part."""

    unet: list[str | None]
    text_encoder: list[str | None]
    vae: list[str | None] | None = None


class DiffusionGuide:
    """Agreement of pictures and prompts by the score of a diffusion model."""

    named_views = True

    def __init__(self, path: Path, device: torch.device):
        index = files.read_json(path / DIFFUSION_INDEX, IndexRecord)
        for part, wanted in CLASSES.items():
            if (found := getattr(index, part)[-1]) != wanted:
                raise LumigraphError(
                    f"{path} has a {found} as its {part}, and score distillation here needs a {wanted}; give a model "
                    "such as Stable Diffusion 1 or 2"
                )
        with_vae = index.vae is not None and index.vae[-1] is not None
        self.unet = part_of(path, "unet", CLASSES["unet"]).to(device)
        self.vae = part_of(path, "vae", "AutoencoderKL").to(device) if with_vae else None
        schedule = part_of(path, "scheduler", "DDPMScheduler")
        self.kept = schedule.alphas_cumprod.to(device)  # share of a picture's variance that is left at each time
        self.velocity = schedule.config.prediction_type == "v_prediction"
        self.encoder = read_text_encoder(path / "text_encoder").to(device)
        self.tokenizer = read_tokenizer(path / "tokenizer")
        self.tokenizer.context = len(self.encoder.positional_embedding)
        scale = 2 ** (len(self.vae.config.block_out_channels) - 1) if self.vae else 1
        self.pixels = int(self.unet.config.sample_size) * scale
        self.states = cache(self._states)

    @torch.no_grad()
    def _states(self, prompt: str) -> Float[Tensor, "1 token width"]:
        return self.encoder.states(self.tokenizer([prompt]).to(self.kept.device))

    def latents(self, pictures: Pictures, generator: torch.Generator) -> Float[Tensor, "picture channel h w"]:
        """Latents of pictures: scaled to [-1, 1], encoded if the model has an encoder."""
        x = 2 * pictures - 1
        if self.vae is None:
            return x
        found = self.vae.encode(x).latent_dist
        noise = torch.randn(found.mean.shape, generator=generator).to(x)
        return self.vae.config.scaling_factor * (found.mean + found.std * noise)

    def predicted(
        self, noisy: Float[Tensor, "picture channel h w"], time: Int[Tensor, " picture"], states: Tensor
    ) -> Float[Tensor, "picture channel h w"]:
        """Predicted noise of noisy pictures."""
        out = self.unet(noisy, time, encoder_hidden_states=states).sample
        if not self.velocity:
            return out
        kept = self.kept[time][:, None, None, None]
        return kept.sqrt() * out + (1 - kept).sqrt() * noisy

    @torch.no_grad()
    def gradient(
        self, latents: Tensor, prompts: tuple[str, ...], generator: torch.Generator, n: DistillationNumbers
    ) -> Float[Tensor, "picture channel h w"]:
        """w(t) (e(z_t; y, t) - noise) with classifier-free guidance (Poole 2022, eq. 3 and 4); w(t) = 1 - kept(t)."""
        last = len(self.kept) - 1
        share = MIN_TIME + (MAX_TIME - MIN_TIME) * torch.rand(len(latents), generator=generator)
        time = (share * last).round().long().to(latents.device)
        noise = torch.randn(latents.shape, generator=generator).to(latents)
        kept = self.kept[time][:, None, None, None]
        noisy = kept.sqrt() * latents + (1 - kept).sqrt() * noise
        said = torch.cat([self.states(prompt) for prompt in prompts])
        unsaid = self.states("").expand_as(said)
        with_words, without = self.predicted(
            torch.cat([noisy, noisy]), torch.cat([time, time]), torch.cat([said, unsaid])
        ).chunk(2)
        found = (1 + n.guidance_scale) * with_words - n.guidance_scale * without
        return (1 - kept) * (found - noise)

    def loss(
        self, pictures: Pictures, prompts: tuple[str, ...], generator: torch.Generator, numbers: DistillationNumbers
    ) -> Tensor:
        """Half the squared distance to the latents after one gradient step: its gradient is that of eq. 3."""
        latents = self.latents(pictures, generator)
        goal = latents.detach() - self.gradient(latents.detach(), prompts, generator, numbers)
        return 0.5 * (latents - goal).square().sum() / len(latents)

    @torch.no_grad()
    def score(self, pictures: Pictures, prompt: str) -> Score:
        """Mean squared error of the noise found in the pictures under the prompt."""
        generator, errors = torch.Generator().manual_seed(0), []
        latents = self.latents(pictures, generator)
        states = self.states(prompt).expand(len(latents), -1, -1)
        for share in SCORE_SHARES:
            time = torch.full((len(latents),), round(share * (len(self.kept) - 1)), device=latents.device)
            noise, kept = torch.randn(latents.shape, generator=generator).to(latents), self.kept[time[0]]
            found = self.predicted(kept.sqrt() * latents + (1 - kept).sqrt() * noise, time, states)
            errors.append((found - noise).square().mean())
        return Score("denoising error", float(torch.stack(errors).mean()), "", "lower")


def part_of(path: Path, name: str, kind: str) -> Any:
    """A part of a diffusers folder. Raises LumigraphError if it is missing or of another kind."""
    try:
        library = importlib.import_module("diffusers")
    except ImportError as error:
        raise LumigraphError(
            f"{path} is a diffusion model and needs diffusers; pip install 'lumigraph[words]'"
        ) from error
    weights = {} if name == "scheduler" else {"use_safetensors": True}
    with reading(path / name, f"holds no {kind} that can be read", "download it again"):
        found = getattr(library, kind).from_pretrained(path, subfolder=name, local_files_only=True, **weights)
    return found if name == "scheduler" else found.eval().requires_grad_(False)


def read_text_encoder(folder: Path) -> TextTransformer:
    """The text encoder of a diffusion model."""
    weights = folder / TEXT_WEIGHTS
    if not weights.is_file():
        raise LumigraphError(f"{folder} holds no {TEXT_WEIGHTS}; download the model as safetensors")
    tensors = named_as_here(read_tensors(weights))
    record = ConfigRecord(text_config=files.read_json(folder / "config.json", TowerRecord))
    with reading(weights, "holds no text encoder of CLIP", "give such a model"):
        sizes = tower_of(tensors, "transformer.", record, "text")
        vocabulary, context = len(tensors["token_embedding.weight"]), len(tensors["positional_embedding"])
    encoder = TextTransformer(sizes, vocabulary, context)
    load(encoder, tensors, weights)
    return encoder
