"""Scenes from words: of held-out captions with two things, how many renderings are recognised, with the transmittance
prior and without.

    lumigraph train captions --output runs/captions
    python benchmarks/words.py runs/captions --captions 20 --output words.png

Two judges look at rings of views of each scene: the model that guided training, which must give the caption the best
mean cosine among the captions of all pairs, and a plain convolutional network trained here on other renderings, whose
mean logits must be largest for the caption's pair. The model that guides saw none of these pairs in training. The
classifier, a measuring instrument, saw renderings of all pairs: without the held-out ones it learns that they never
occur.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, interpolate

from lumigraph import methods
from lumigraph.components.guidance import open_guide
from lumigraph.components.guidance.guides import ClipGuide
from lumigraph.components.guidance.part import CAMERA_DISTANCE
from lumigraph.components.guidance.views import camera_around
from lumigraph.datasets.words import Words
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.files import write_json
from lumigraph.method import Method, seeded
from lumigraph.run import build
from lumigraph.synthetic import captions
from lumigraph.system.progress import track
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit
from lumigraph.training.captions import TRACED_PIXELS, augmented

CPU = torch.device("cpu")
VIEWS, ELEVATION, SHOWN = 8, 25.0, 4  # on a ring that training does not draw, degrees
CLASSIFIER_SEED = 1000  # of renderings that no model of `train captions` has seen
PIXELS = 32  # a side of the classifier's pictures


@dataclass(frozen=True)
class Options:
    guidance: tyro.conf.Positional[Path]
    method: str = "dream-fields"
    captions: int = 20
    steps: int = 300
    without_prior: bool = True  # also without the transmittance prior
    classifier_pictures: int = 2400
    classifier_steps: int = 800
    size: int = 128  # pixels of the sheet's pictures
    seed: int = 0
    output: Path = Path("words.png")


def classifier(o: Options) -> nn.Module:
    """Logits of the things in a picture: four convolutions, learnt from renderings of its own."""
    pairs = captions.pairs()
    groups = [pairs[i % len(pairs)] for i in range(o.classifier_pictures)]
    traced = torch.from_numpy(captions.pictures(groups, TRACED_PIXELS, CLASSIFIER_SEED))
    there = torch.tensor([[float(thing in group) for thing in captions.THINGS] for group in groups])
    with seeded(CLASSIFIER_SEED):
        layers: list[nn.Module] = []
        for inputs, outputs in ((3, 16), (16, 32), (32, 64), (64, 96)):
            layers += [nn.Conv2d(inputs, outputs, 3, 2 if inputs > 3 else 1, 1, bias=False), nn.BatchNorm2d(outputs)]
            layers += [nn.ReLU()]
        network = nn.Sequential(*layers, nn.AdaptiveMaxPool2d(1), nn.Flatten(), nn.Linear(96, len(captions.THINGS)))
    generator = torch.Generator().manual_seed(CLASSIFIER_SEED)
    optimizer = torch.optim.AdamW(network.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, o.classifier_steps)
    for _ in track(range(o.classifier_steps), "Learning to classify", o.classifier_steps):
        chosen = torch.randint(len(groups), (64,), generator=generator)
        logits = network(augmented(traced[chosen], PIXELS, generator, textured=0.1))
        optimizer.zero_grad()
        binary_cross_entropy_with_logits(logits, there[chosen]).backward()
        optimizer.step()
        schedule.step()
    return network.eval()


def named(pictures: Tensor, network: nn.Module) -> str:
    """Caption by the classifier: the pair with the largest mean logits over views."""
    pairs = captions.pairs()
    members = torch.tensor([[captions.THINGS.index(thing) for thing in pair] for pair in pairs])
    with torch.no_grad():
        logits = network(sized(pictures, PIXELS)).mean(0)
    return captions.caption(pairs[int(logits[members].sum(-1).argmax())])


def retrieved(pictures: Tensor, guide: ClipGuide) -> str:
    """Caption of the best mean cosine among those of all pairs (R-precision, Jain 2022, section 5.1)."""
    said = tuple(captions.caption(pair) for pair in captions.pairs())
    with torch.no_grad():
        return said[int(guide.cosines(sized(pictures, guide.pixels), said).mean(0).argmax())]


def sized(pictures: Tensor, pixels: int) -> Tensor:
    return interpolate(pictures, (pixels, pixels), mode="bilinear", antialias=True, align_corners=False)


def dreamt(o: Options, caption: str, prior: bool) -> tuple[Method, float]:
    """A scene of a caption, and the processor seconds that it took."""
    kind, words = methods.find(o.method), Words(caption, o.guidance.resolve())
    config = replace(kind.preset(CPU), seed=o.seed)
    if not prior:
        config = replace(config, guidance=replace(config.guidance, transmittance_weight=0.0))
    method = build(kind, words.frame, config, CPU, o.seed, learning=True)
    begin = time.process_time()
    go_on_unless(fit(method, words, None, steps=o.steps, seed=o.seed, show=False, rehearsal=False).signal)
    return method, time.process_time() - begin


def views(method: Any, size: int) -> Tensor:
    """Pictures from all around before white, (view, 3, size, size)."""
    azimuth = torch.arange(VIEWS) * (360 / VIEWS) + 11.0
    n = method.config.guidance
    around = torch.full((VIEWS,), ELEVATION)
    cameras = camera_around(azimuth, around, CAMERA_DISTANCE, n.focal, size, method.guidance.origin)
    return torch.stack([method.render(cameras[i]).rgb.clamp(0, 1).movedim(-1, 0) for i in range(VIEWS)])


def held_out_accuracy(network: nn.Module, pairs: Sequence[captions.Group]) -> float:
    """Share of traced pictures of held-out pairs that the classifier names."""
    traced = torch.from_numpy(captions.pictures([x for x in pairs for _ in range(4)], PIXELS, CLASSIFIER_SEED + 1))
    rgba = traced.float().movedim(-1, 1) / 255
    pictures = rgba[:, :3] * rgba[:, 3:] + 1 - rgba[:, 3:]
    right = [named(pictures[i : i + 1], network) == captions.caption(pairs[i // 4]) for i in range(len(pictures))]
    return sum(right) / len(right)


def main(o: Options) -> None:
    guide = open_guide(o.guidance.resolve(), CPU)
    assert isinstance(guide, ClipGuide)
    network, pairs = classifier(o), captions.held_out()
    accuracy = held_out_accuracy(network, pairs)
    print(f"classifier: {100 * accuracy:.0f} % of single traced pictures of held-out pairs", flush=True)
    results: list[dict[str, Any]] = []
    rows: list[Row] = []
    for pair in pairs[: o.captions]:
        caption, pictures = captions.caption(pair), []
        for prior in (True, False)[: 1 + o.without_prior]:
            method, seconds = dreamt(o, caption, prior)
            seen = views(method, o.size)
            own, other = retrieved(seen, guide), named(seen, network)
            result = {"caption": caption, "prior": prior, "model": own, "classifier": other, "seconds": seconds}
            results.append(result)
            print(result, flush=True)
            pictures += [x.movedim(0, -1) for x in seen[:: VIEWS // SHOWN]]
        rows.append(Row(caption, pictures))
        kinds = ["with the prior", "without"][: 1 + o.without_prior]
        sheet = contact_sheet(f"{o.method}, {o.steps} steps", [x for x in kinds for _ in range(SHOWN)], rows)
        save_picture(o.output, sheet, "benchmark")
        write_json(o.output.with_suffix(".json"), {"classifier": accuracy, "scenes": results}, "benchmark")
    for prior in (True, False)[: 1 + o.without_prior]:
        own = [x for x in results if x["prior"] == prior]
        model, other = (sum(x[judge] == x["caption"] for x in own) for judge in ("model", "classifier"))
        both = sum(x["caption"] == x["model"] == x["classifier"] for x in own)
        seconds = sum(x["seconds"] for x in own) / len(own)
        name = "with the prior" if prior else "without"
        print(f"{name}: of {len(own)}: model {model}, classifier {other}, both {both}; {seconds:.0f} s each")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
