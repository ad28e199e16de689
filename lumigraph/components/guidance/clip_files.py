"""CLIP in a user's files: weights as safetensors, in the layouts of open_clip and of Hugging Face.

    open_clip_config.json · open_clip_model.safetensors · vocab.json · merges.txt    open_clip, and `train captions`
    config.json · model.safetensors · vocab.json · merges.txt                        Hugging Face's CLIPModel

The vocabulary may also be open_clip's own `bpe_simple_vocab_16e6.txt.gz`.
"""

from __future__ import annotations

import gzip
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import safetensors.torch
import torch
from torch import Tensor, nn

from ... import files
from ...errors import LumigraphError
from ...files.ranges import between
from ...files.reading import reading, reads
from .clip import (
    ACTIVATIONS,
    DEVIATION,
    EXPANSION,
    MEAN,
    REDUCTION,
    Clip,
    ClipSizes,
    ResnetSizes,
    TransformerSizes,
    VisionSizes,
)
from .tokenizer import BEGIN, END, WORD_END, Tokenizer, byte_names

CONFIG = "open_clip_config.json", "config.json"
WEIGHTS = "open_clip_model.safetensors", "model.safetensors"
VOCABULARY, MERGES, PUBLISHED = "vocab.json", "merges.txt", "bpe_simple_vocab_16e6.txt.gz"
MERGES_VERSION = "#version: 0.2"
MAX_MERGES = 49152 - 256 - 2  # of the published vocabulary
HEAD_WIDTH = 64  # of attention, where nothing says another
Heads = Annotated[int, between(1, 128)]


@dataclass(frozen=True)
class TowerRecord:
    """A tower in either layout's config."""

    num_attention_heads: Heads | None = None
    hidden_act: str | None = None
    heads: Heads | None = None
    head_width: Annotated[int, between(1, 1024)] | None = None


@dataclass(frozen=True)
class OpenClipRecord:
    vision_cfg: TowerRecord = field(default_factory=TowerRecord)
    text_cfg: TowerRecord = field(default_factory=TowerRecord)
    quick_gelu: bool = False


@dataclass(frozen=True)
class ConfigRecord:
    """config.json of Hugging Face, or open_clip_config.json."""

    model_type: str | None = None
    vision_config: TowerRecord | None = None
    text_config: TowerRecord | None = None
    model_cfg: OpenClipRecord | None = None


# Hugging Face's names of tensors, and those here.
NAMES = (
    (r"^vision_model\.embeddings\.patch_embedding\.", "visual.conv1."),
    (r"^vision_model\.embeddings\.class_embedding$", "visual.class_embedding"),
    (r"^vision_model\.embeddings\.position_embedding\.weight$", "visual.positional_embedding"),
    (r"^vision_model\.pre_layrnorm\.", "visual.ln_pre."),
    (r"^vision_model\.post_layernorm\.", "visual.ln_post."),
    (r"^vision_model\.encoder\.layers\.", "visual.transformer.resblocks."),
    (r"^text_model\.embeddings\.token_embedding\.", "token_embedding."),
    (r"^text_model\.embeddings\.position_embedding\.weight$", "positional_embedding"),
    (r"^text_model\.final_layer_norm\.", "ln_final."),
    (r"^text_model\.encoder\.layers\.", "transformer.resblocks."),
    (r"\.layer_norm([12])\.", r".ln_\1."),
    (r"\.self_attn\.", ".attn."),
    (r"\.mlp\.fc1\.", ".mlp.c_fc."),
    (r"\.mlp\.fc2\.", ".mlp.c_proj."),
    (r"^visual_projection\.weight$", "visual.proj"),
    (r"^text_projection\.weight$", "text_projection"),
    (r"^text\.", ""),  # open_clip's CustomTextCLIP
)
PROJECTIONS = "visual_projection.weight", "text_projection.weight"  # transposed in Hugging Face's layout


@reads("cannot be read as a CLIP")
def read_clip(path: Path) -> tuple[Clip, Tokenizer]:
    """A model and its tokenizer from a folder, or from a file of weights beside their config and vocabulary.

    Raises LumigraphError for what is missing, and for weights of another architecture.
    """
    folder = path if path.is_dir() else path.parent
    weights = path if path.is_file() else first(folder, WEIGHTS)
    if weights is None:
        raise LumigraphError(f"{folder} holds no weights of CLIP; looked for {' or '.join(WEIGHTS)}")
    config = first(folder, CONFIG)
    if config is None:
        raise LumigraphError(f"{weights} has no {' or '.join(CONFIG)} beside it; put the one of these weights there")
    tensors, record = named_as_here(read_tensors(weights)), files.read_json(config, ConfigRecord)
    tokenizer = read_tokenizer(folder)
    network = Clip(sizes_of(tensors, record, weights))
    load(network, tensors, weights)
    if len(tokenizer.vocabulary) > network.sizes.vocabulary:
        raise LumigraphError(
            f"{folder} has a vocabulary of {len(tokenizer.vocabulary):,} tokens for weights of "
            f"{network.sizes.vocabulary:,}; put the vocabulary of these weights there"
        )
    tokenizer.context = network.sizes.context
    return network, tokenizer


def first(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Tensors of a safetensors file as float32."""
    with reading(path, "is no safetensors file", "give the weights of CLIP as .safetensors"):
        found = safetensors.torch.load_file(path)
    if broken := next((name for name, x in found.items() if x.is_floating_point() and not x.isfinite().all()), None):
        raise LumigraphError(f"{path}: {broken[:80]} has numbers that are not finite; download the weights again")
    return {name: x.float() if x.is_floating_point() else x for name, x in found.items()}


def named_as_here(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors renamed from either layout to the names of open_clip."""
    found = dict[str, Tensor]()
    for name, x in tensors.items():
        x = x.T if name in PROJECTIONS else x
        for pattern, replacement in NAMES:
            name = re.sub(pattern, replacement, name)
        found[name] = x
    for name in [x for x in found if ".attn.q_proj." in x]:  # three matrices in one
        parts = [found.pop(name.replace("q_proj", f"{part}_proj")) for part in "qkv"]
        found[name.replace("q_proj.", "in_proj_")] = torch.cat(parts)
    return found


def sizes_of(tensors: dict[str, Tensor], record: ConfigRecord, path: Path) -> ClipSizes:
    """Sizes from the tensors' shapes and the config. Raises LumigraphError for any other architecture."""
    remedy = "give a CLIP with a vision transformer or a residual network, such as ViT-B/32"
    with reading(path, "holds the weights of another architecture than CLIP's", remedy):
        text = tower_of(tensors, "transformer.", record, "text")
        vocabulary, context = tensors["token_embedding.weight"], tensors["positional_embedding"]
        embedding = tensors["text_projection"].shape[1]
        if "visual.attnpool.positional_embedding" in tensors:
            places, width = tensors["visual.attnpool.positional_embedding"].shape
            stages = [count(tensors, f"visual.layer{number}.") for number in range(1, 5)]
            blocks = (stages[0], stages[1], stages[2], stages[3])
            vision: Any = ResnetSizes(width // (8 * EXPANSION), blocks, max(1, width // HEAD_WIDTH))
            patch = REDUCTION
        else:
            plain = tower_of(tensors, "visual.transformer.", record, "vision")
            patch = tensors["visual.conv1.weight"].shape[-1]
            vision, places = VisionSizes(**vars(plain), patch=patch), len(tensors["visual.positional_embedding"])
    return ClipSizes(vision, text, round((places - 1) ** 0.5) * patch, len(vocabulary), len(context), embedding)


def count(tensors: dict[str, Tensor], place: str) -> int:
    """Number of blocks whose tensors have a prefix."""
    return len({name.removeprefix(place).split(".")[0] for name in tensors if name.startswith(place)})


def tower_of(tensors: dict[str, Tensor], place: str, record: ConfigRecord, name: str) -> TransformerSizes:
    """Sizes of one transformer."""
    blocks = f"{place}resblocks."
    hidden, width = tensors[f"{blocks}0.mlp.c_fc.weight"].shape
    openclip = record.model_cfg
    own: TowerRecord = getattr(openclip, f"{name}_cfg") if openclip else getattr(record, f"{name}_config")
    own = own or TowerRecord()
    heads = own.num_attention_heads or own.heads or width // (own.head_width or HEAD_WIDTH)
    activation = own.hidden_act or ("gelu" if openclip and not openclip.quick_gelu else "quick_gelu")
    if activation not in ACTIVATIONS:
        raise ValueError(f"the activation {activation!r}")
    return TransformerSizes(width, count(tensors, blocks), max(heads, 1), hidden, activation)


def load(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load tensors into a network. Raises LumigraphError for missing ones and for other shapes."""
    own = network.state_dict()
    for name, x in own.items():
        if name not in tensors or tensors[name].shape != x.shape:
            there = tuple(tensors[name].shape) if name in tensors else "missing"
            raise LumigraphError(
                f"{path} holds the weights of another architecture than CLIP's: {name} should be {tuple(x.shape)} and "
                f"is {there}; give one such as ViT-B/32"
            )
    network.load_state_dict({name: tensors[name] for name in own})
    network.eval().requires_grad_(False)


def read_tokenizer(folder: Path) -> Tokenizer:
    """Tokenizer in the folder of the weights. Raises LumigraphError without one."""
    if (folder / VOCABULARY).is_file() and (folder / MERGES).is_file():
        vocabulary = files.read_json(folder / VOCABULARY, dict[str, int])
        lines = files.read_bytes(folder / MERGES).decode("utf-8", "replace").splitlines()
        pairs = [tuple(line.split(" ")) for line in lines if line != MERGES_VERSION]
        merges = [(pair[0], pair[1]) for pair in pairs if len(pair) == 2]
    elif (folder / PUBLISHED).is_file():
        with reading(folder / PUBLISHED, "is no vocabulary"):
            lines = gzip.decompress(files.read_bytes(folder / PUBLISHED)).decode("utf-8").split("\n")
        pairs = [tuple(line.split()) for line in lines[1 : MAX_MERGES + 1]]
        merges = [(pair[0], pair[1]) for pair in pairs if len(pair) == 2]
        letters = sorted(byte_names(), key=lambda letter: (ord(letter) > 255, ord(letter)))
        names = [*letters, *(x + WORD_END for x in letters), *map("".join, merges), BEGIN, END]
        vocabulary = {name: number for number, name in enumerate(names)}
    else:
        raise LumigraphError(f"{folder} holds no vocabulary; put {VOCABULARY} and {MERGES}, or {PUBLISHED}, there")
    if BEGIN not in vocabulary or END not in vocabulary:
        raise LumigraphError(f"{folder / VOCABULARY} has no {BEGIN} and {END}; it is not the vocabulary of a CLIP")
    return Tokenizer(vocabulary, merges)


def write_clip(folder: Path, network: Clip, tokenizer: Tokenizer) -> None:
    """Write a model with a residual network in open_clip's layout into a folder."""
    s, vision = network.sizes, network.sizes.vision
    assert isinstance(vision, ResnetSizes)
    text = {"context_length": s.context, "vocab_size": s.vocabulary, "width": s.text.width}
    text |= {"heads": s.text.heads, "layers": s.text.layers}
    picture = {"image_size": s.picture, "layers": vision.blocks, "width": vision.width, "patch_size": None}
    model = {"embed_dim": s.embedding, "quick_gelu": True, "vision_cfg": picture, "text_cfg": text}
    config = {"model_cfg": model, "preprocess_cfg": {"mean": MEAN, "std": DEVIATION}}
    tensors = {name: x.detach().cpu().contiguous().clone() for name, x in network.state_dict().items()}
    (folder / CONFIG[0]).write_text(json.dumps(config, indent=2), "utf-8")
    (folder / WEIGHTS[0]).write_bytes(safetensors.torch.save(tensors, {"format": "pt"}))
    (folder / VOCABULARY).write_text(json.dumps(tokenizer.vocabulary, ensure_ascii=False), "utf-8")
    lines = [MERGES_VERSION, *(" ".join(pair) for pair in tokenizer.merges)]
    (folder / MERGES).write_text("\n".join(lines) + "\n", "utf-8")
