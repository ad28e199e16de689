"""Words with guidance that has learnt nothing: a tiny CLIP, and a tiny diffusion model, written here."""

from __future__ import annotations

import json
import shutil
import tempfile
from functools import cache
from pathlib import Path

import safetensors.torch
import torch

from lumigraph.components.guidance.clip import Clip, ClipSizes, ResnetSizes, TransformerSizes, VisionSizes
from lumigraph.components.guidance.clip_files import write_clip
from lumigraph.components.guidance.tokenizer import Tokenizer
from lumigraph.datasets.words import Words

PROMPT = "a red ball"
WORDS = ("a", "red", "ball", "blue", "front", "side", "back", "overhead", "view", ",")
TEXT = TransformerSizes(16, 1, 2, 32)
_folder = tempfile.TemporaryDirectory(prefix="tiny_words")


def words() -> Words:
    """Dataset for a method that learns from Words."""
    return Words(PROMPT, clip_folder())


@cache
def clip_folder() -> Path:
    folder = Path(_folder.name) / "clip"
    folder.mkdir()
    write_clip(folder, *clip())
    return folder


def clip(vision: ResnetSizes | VisionSizes = ResnetSizes(4, (1, 1, 1, 1), 2)) -> tuple[Clip, Tokenizer]:
    """A CLIP for pictures of 32 pixels with random weights, which are the same each time."""
    tokenizer = Tokenizer.of_words(WORDS, 8)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = Clip(ClipSizes(vision, TEXT, 32, len(tokenizer.vocabulary), 8, 8))
    return network.eval().requires_grad_(False), tokenizer


@cache
def diffusion_folder() -> Path:
    """A diffusion model with random weights in the layout of diffusers, by diffusers itself."""
    from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel

    folder = Path(_folder.name) / "diffusion"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        blocks = {"block_out_channels": (8, 16), "norm_num_groups": 4, "layers_per_block": 1}
        unet = UNet2DConditionModel(
            sample_size=8,
            in_channels=4,
            out_channels=4,
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
            up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
            cross_attention_dim=16,
            attention_head_dim=8,
            **blocks,
        )
        down, up = ("DownEncoderBlock2D",) * 2, ("UpDecoderBlock2D",) * 2
        vae = AutoencoderKL(down_block_types=down, up_block_types=up, latent_channels=4, **blocks)
    unet.save_pretrained(folder / "unet")
    vae.save_pretrained(folder / "vae")
    DDPMScheduler(beta_schedule="scaled_linear").save_pretrained(folder / "scheduler")
    network, _ = clip()
    (folder / "text_encoder").mkdir()
    text = hugging_face({name: x for name, x in network.state_dict().items() if not name.startswith("visual.")})
    safetensors.torch.save_file(text, folder / "text_encoder/model.safetensors")
    (folder / "text_encoder/config.json").write_text('{"num_attention_heads": 2, "hidden_act": "quick_gelu"}')
    (folder / "tokenizer").mkdir()
    for name in ("vocab.json", "merges.txt"):
        shutil.copy(clip_folder() / name, folder / "tokenizer")
    parts = {"unet": ["diffusers", "UNet2DConditionModel"], "vae": ["diffusers", "AutoencoderKL"]}
    parts |= {"text_encoder": ["transformers", "CLIPTextModel"], "scheduler": ["diffusers", "DDPMScheduler"]}
    (folder / "model_index.json").write_text(json.dumps({"_class_name": "StableDiffusionPipeline", **parts}))
    return folder


def hugging_face(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Tensors of a CLIP with a vision transformer, under the names of Hugging Face's CLIPModel."""
    found = {}
    for name, x in tensors.items():
        if name in PROJECTIONS:
            found[PROJECTIONS[name]] = x.T.contiguous()
            continue
        for own, other in NAMES.items():
            name = name.replace(own, other) if name.startswith(own) or own.startswith(".") else name
        if "in_proj_" in name:
            found |= {
                name.replace("in_proj_", f"{p}_proj."): y.contiguous() for p, y in zip("qkv", x.chunk(3), strict=True)
            }
        else:
            found[name] = x.contiguous()
    return found


PROJECTIONS = {"visual.proj": "visual_projection.weight", "text_projection": "text_projection.weight"}
NAMES = {  # here: in Hugging Face's layout
    "visual.conv1.": "vision_model.embeddings.patch_embedding.",
    "visual.class_embedding": "vision_model.embeddings.class_embedding",
    "visual.positional_embedding": "vision_model.embeddings.position_embedding.weight",
    "visual.ln_pre.": "vision_model.pre_layrnorm.",
    "visual.ln_post.": "vision_model.post_layernorm.",
    "visual.transformer.resblocks.": "vision_model.encoder.layers.",
    "token_embedding.": "text_model.embeddings.token_embedding.",
    "positional_embedding": "text_model.embeddings.position_embedding.weight",
    "ln_final.": "text_model.final_layer_norm.",
    "transformer.resblocks.": "text_model.encoder.layers.",
    ".ln_1.": ".layer_norm1.",
    ".ln_2.": ".layer_norm2.",
    ".attn.": ".self_attn.",
    ".mlp.c_fc.": ".mlp.fc1.",
    ".mlp.c_proj.": ".mlp.fc2.",
}
