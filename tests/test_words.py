"""Guidance by words: tokens, files of CLIP, random views, the transmittance prior, and captions to learn from."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import safetensors.torch
import tiny_words
import torch
from budgets import budget

from lumigraph.commands.cli import main
from lumigraph.components.guidance.clip import VisionSizes
from lumigraph.components.guidance.clip_files import read_clip
from lumigraph.components.guidance.guides import ClipGuide, DistillationNumbers
from lumigraph.components.guidance.opening import open_guide
from lumigraph.components.guidance.part import Guidance, GuidanceNumbers
from lumigraph.components.guidance.tokenizer import BEGIN, END, Tokenizer
from lumigraph.components.guidance.views import (
    backgrounds,
    before_backgrounds,
    camera_around,
    cropped,
    named_view,
    opacity_target,
)
from lumigraph.datasets.words import Words
from lumigraph.errors import LumigraphError
from lumigraph.lab.benchmark.cell import CellSettings, evaluated
from lumigraph.run import Run
from lumigraph.synthetic import captions
from lumigraph.training.captions import (
    CaptionNumbers,
    contrast,
    different,
    distorted,
    learn_captions,
    new_model,
    perturbed,
    thing_loss,
)

pytestmark = budget("methods", 20)
CPU = torch.device("cpu")


def chance(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# Tokens


def test_pairs_are_merged_in_the_order_of_the_vocabulary():
    names = ["l", "o", "w", "lo", "low</w>", "w</w>", "e", "r</w>", "ow", BEGIN, END]
    merges = [("l", "o"), ("lo", "w</w>"), ("o", "w")]
    tokenizer = Tokenizer({x: i for i, x in enumerate(names)}, merges, context=8)
    assert tokenizer.merged("low") == ["low</w>"]
    assert tokenizer.merged("lower") == ["lo", "w", "e", "r</w>"]  # the first merge wins over the third
    assert tokenizer(["Low  LOWER"]).tolist() == [[9, 4, 3, 2, 6, 7, 10, 10]]


def test_a_long_caption_is_cut_before_its_end():
    tokenizer = Tokenizer.of_words(["red", "ball"], 4)
    row = tokenizer(["red ball red ball"])[0].tolist()
    assert len(row) == 4 and row[0] == tokenizer.vocabulary[BEGIN] and row[-1] == tokenizer.vocabulary[END]


@pytest.mark.parametrize("prompt", ["красный шар", "赤い球", "a crimson ball"])
def test_words_without_tokens_are_refused(prompt):
    tokenizer = Tokenizer.of_words(["a", "red", "ball"], 8)
    with pytest.raises(LumigraphError, match="has no tokens for"):
        tokenizer([prompt])


def test_a_script_known_by_its_bytes_alone_is_refused():
    """The published vocabulary has every byte, of which a script that it has not seen would become noise."""
    from lumigraph.components.guidance.tokenizer import WORD_END, byte_names

    names = [*byte_names(), *(x + WORD_END for x in byte_names()), BEGIN, END]
    tokenizer = Tokenizer({x: i for i, x in enumerate(names)}, [], 32)
    assert tokenizer(["a ball"]).shape == (1, 32)
    with pytest.raises(LumigraphError, match="has no tokens for 'шар'"):
        tokenizer(["a шар"])


# Files


def test_both_layouts_hold_the_same_model(tmp_path):
    network, tokenizer = tiny_words.clip(VisionSizes(16, 2, 2, 32, patch=8))
    pictures = torch.rand(2, 3, 32, 32, generator=chance())
    for layout in ("open_clip", "hugging_face"):
        folder = tmp_path / layout
        shutil.copytree(tiny_words.clip_folder(), folder)
        (folder / "open_clip_model.safetensors").unlink()
        (folder / "open_clip_config.json").unlink()
        towers = {"num_attention_heads": 2, "hidden_act": "quick_gelu"}
        if layout == "open_clip":
            tower = {"heads": 2, "head_width": 8}
            config = {"model_cfg": {"quick_gelu": True, "vision_cfg": tower, "text_cfg": tower}}
            tensors, names = network.state_dict(), ("open_clip_config.json", "open_clip_model.safetensors")
        else:
            config = {"model_type": "clip", "vision_config": towers, "text_config": towers}
            tensors, names = tiny_words.hugging_face(network.state_dict()), ("config.json", "model.safetensors")
        (folder / names[0]).write_text(json.dumps(config))
        safetensors.torch.save_file(tensors, folder / names[1])
        for path in (folder, folder / names[1]):
            read, words = read_clip(path)
            assert read.sizes == network.sizes
            torch.testing.assert_close(read.of_pictures(pictures), network.of_pictures(pictures))
            tokens = words(["a red ball", "a blue ball"])
            assert torch.equal(tokens, tokenizer(["a red ball", "a blue ball"]))
            torch.testing.assert_close(read.of_captions(tokens), network.of_captions(tokens))


def test_a_residual_network_comes_back():
    network, _ = tiny_words.clip()
    read, _ = read_clip(tiny_words.clip_folder())
    pictures = torch.rand(2, 3, 32, 32, generator=chance())
    assert read.sizes == network.sizes
    torch.testing.assert_close(read.of_pictures(pictures), network.of_pictures(pictures))
    torch.testing.assert_close(read.of_pictures(pictures).norm(dim=-1), torch.ones(2))


@pytest.mark.parametrize(
    ("tensors", "fault"),
    [
        ({"features.0.weight": torch.zeros(4, 3, 3, 3)}, "another architecture than CLIP's"),
        ({"transformer.resblocks.0.mlp.c_fc.weight": torch.zeros(8, 4)}, "another architecture than CLIP's"),
    ],
)
def test_other_weights_are_refused_in_a_sentence(tmp_path, tensors, fault):
    shutil.copytree(tiny_words.clip_folder(), folder := tmp_path / "clip")
    safetensors.torch.save_file(tensors, folder / "open_clip_model.safetensors")
    with pytest.raises(LumigraphError, match=fault):
        read_clip(folder)
    (folder / "open_clip_model.safetensors").write_bytes(b"nothing of that kind")
    with pytest.raises(LumigraphError, match="no safetensors file"):
        read_clip(folder)
    (folder / "merges.txt").unlink()
    shutil.copy(tiny_words.clip_folder() / "open_clip_model.safetensors", folder)
    with pytest.raises(LumigraphError, match="holds no vocabulary"):
        read_clip(folder)


def test_a_picture_with_another_shape_of_weights_is_refused(tmp_path):
    shutil.copytree(tiny_words.clip_folder(), folder := tmp_path / "clip")
    tensors = tiny_words.clip()[0].state_dict()
    tensors["visual.layer2.0.conv2.weight"] = torch.zeros(2, 2, 3, 3)
    safetensors.torch.save_file(tensors, folder / "open_clip_model.safetensors")
    with pytest.raises(LumigraphError, match=r"visual\.layer2\.0\.conv2\.weight should be"):
        read_clip(folder)


# Views


def test_cameras_look_at_the_origin_from_their_angles():
    origin = torch.tensor([0.1, -0.2, 0.3])
    camera = camera_around(torch.tensor([0.0, 90.0]), torch.tensor([30.0, -10.0]), 4.0, 1.2, 64, origin)
    outward = (camera.position - origin) / 4
    torch.testing.assert_close(outward[:, 2], torch.tensor([30.0, -10.0]).deg2rad().sin())
    torch.testing.assert_close(outward.norm(dim=-1), torch.ones(2))
    pixels, _ = camera.project(origin.expand(2, 3), torch.arange(2))
    torch.testing.assert_close(pixels, torch.full((2, 2), 32.0))
    assert camera.lens.focal[0, 0] == pytest.approx(1.2 * 64)


@pytest.mark.parametrize(
    ("azimuth", "elevation", "name"),
    [
        (10, 0, "front view"),
        (350, 20, "front view"),
        (90, 0, "side view"),
        (180, 10, "back view"),
        (0, 80, "overhead view"),
    ],
)
def test_views_have_names(azimuth, elevation, name):
    assert named_view(azimuth, elevation) == name


def test_opaque_crops_hide_the_background_and_clear_ones_show_it():
    rgba = torch.zeros(4, 12, 12)
    rgba[:, :, 6:] = torch.tensor([0.5, 0.25, 1.0, 1.0])[:, None, None]  # the right half is opaque
    crops = cropped(rgba, 5, 1.0, 12, chance())
    seen = before_backgrounds(crops, chance(1))
    torch.testing.assert_close(seen[:, :, :, 6:], rgba[:3, :, 6:].expand(5, 3, 12, 6))
    torch.testing.assert_close(seen[:, :, :, :6], backgrounds(5, 12, chance(1))[:, :, :, :6])


def test_backgrounds_are_colours_that_differ():
    found = backgrounds(12, 32, chance())
    assert found.shape == (12, 3, 32, 32) and found.min() >= 0 and found.max() <= 1
    assert (found.flatten(1)[:, None] - found.flatten(1)).abs().mean(-1).add(torch.eye(12)).min() > 0.05


def test_the_allowed_opacity_falls_as_published():
    """From a half to a tenth over 500 steps, for the paper's camera (released code, config_base.py)."""
    assert opacity_target(0.5, 0.1, 500, 0, 1.2, 4.0) == pytest.approx(0.5 * 1.2)
    assert opacity_target(0.5, 0.1, 500, 250, 1.2, 4.0) == pytest.approx(math.sqrt(0.05) * 1.2)
    assert opacity_target(0.5, 0.1, 500, 9000, 1.2, 4.0) == pytest.approx(0.1 * 1.2)
    assert opacity_target(0.5, 0.1, 500, 9000, 2.4, 8.0) == pytest.approx(0.1 * 1.2)


# Guidance


@pytest.fixture
def guidance() -> Guidance:
    n = GuidanceNumbers(render_width=16, views_per_step=2, crops_per_view=2, opacity_steps=10)
    return Guidance(n)


def test_the_prior_has_the_papers_gradient(guidance):
    """-lambda min(tau, mean(T)) of eq. 6: lambda / pixels for each opacity while the picture is too full, else 0."""
    views = guidance.views(tiny_words.words(), chance())
    for opacity, slope in ((0.9, 0.5), (0.01, 0.0)):
        rgba = torch.full((2, 4, 16, 16), opacity, requires_grad=True)
        term = guidance.terms(rgba, views, 100, chance())["transmittance"]
        (gradient,) = torch.autograd.grad(term, rgba)
        torch.testing.assert_close(gradient[:, 3], torch.full((2, 16, 16), slope / 512))
        assert not gradient[:, :3].any()


def test_guidance_is_one_minus_the_cosine():
    network, tokenizer = read_clip(tiny_words.clip_folder())
    guide, pictures = ClipGuide(network, tokenizer), torch.rand(3, 3, 32, 32, generator=chance())
    prompts = ("a red ball",) * 3
    loss = guide.loss(pictures, prompts, chance(), DistillationNumbers())
    assert float(loss) == pytest.approx(1 - guide.score(pictures, "a red ball").value, abs=1e-6)


def test_cameras_follow_the_centre_of_mass(guidance):
    guidance.numbers = replace(guidance.numbers, origin_decay=0.75)
    guidance.follow(torch.tensor([[0.4, 0.0, 0.0], [0.0, 0.2, 0.0]]), torch.tensor([1.0, 1.0]))
    torch.testing.assert_close(guidance.origin, 0.25 * torch.tensor([0.2, 0.1, 0.0]))


def test_a_view_is_named_where_that_is_asked(guidance, monkeypatch):
    guidance.numbers = replace(guidance.numbers, view_prompts="yes")
    views = guidance.views(tiny_words.words(), chance())
    assert all(x.startswith("a red ball, ") and x.endswith(" view") for x in views.prompts)
    guidance.numbers = replace(guidance.numbers, view_prompts="auto")
    assert guidance.views(tiny_words.words(), chance()).prompts == ("a red ball",) * 2


# Words


def test_prompts_are_checked():
    assert Words.read("words:  a   red ball ").prompt == "a red ball"
    for wrong in ("words:", "words:" + "a" * 2000):
        with pytest.raises(LumigraphError, match="The prompt"):
            Words.read(wrong)
    with pytest.raises(LumigraphError, match="does not exist"):
        Words.read("words:a ball", "nowhere")


def test_a_scene_is_trained_from_words_and_judged(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    guidance, numbers = str(tiny_words.clip_folder()), ["--render-width", "16", "--views-per-step", "1"]
    words = ["train", "dream-fields", "words:a red ball", "--steps", "2", *numbers]
    assert main(words) == 2 and "--guidance FOLDER" in capsys.readouterr().err
    assert main([*words, "--guidance", guidance, "--output", "run"]) == 0
    run = Run(tmp_path / "run")
    assert run.settings.scene.source == "words:a red ball" and run.settings.scene.options["guidance"] == guidance
    assert run.dataset() == Words("a red ball", tiny_words.clip_folder())
    assert main(["eval", "run", "--views", "2"]) == 0
    assert evaluated(run.folder, CellSettings(eval_views=2))
    judged = json.loads((tmp_path / "run/eval.json").read_text())
    (score,) = judged["scores"]
    assert -1 <= judged["baselines"]["empty view"] <= 1
    assert score["name"] == "similarity to the prompt" and -1 <= score["value"] <= 1
    assert main(["train", "dream-fields", "words:a шар", "--steps", "1", "--guidance", guidance, "--output", "b"]) == 2
    assert "no tokens for 'шар'" in capsys.readouterr().err
    assert main(["train", "instant-ngp", "words:a ball"]) == 2 and "holds words" in capsys.readouterr().err


# Captions


def test_held_out_pairs_are_never_learnt():
    never = {frozenset(pair) for pair in captions.held_out()}
    assert len(never) == 20
    groups = list(captions.training_groups(np.random.default_rng(0), 2000))
    assert len(groups) == 2000
    for group in groups:
        assert not any(pair <= frozenset(group) for pair in never)
    learnt = {thing for group in groups for thing in group}
    assert learnt == set(captions.THINGS)
    assert captions.caption(captions.held_out()[0]).count(" beside ") == 1


def test_a_picture_shows_its_colours():
    group = captions.Thing("red", "cube"), captions.Thing("blue", "ball")
    picture = captions.picture(group, 32, np.random.default_rng(0)).astype(float)
    solid = picture[picture[..., 3] > 200][:, :3]
    assert 0.05 < len(solid) / 1024 < 0.6
    assert {int(x) for x in solid.argmax(-1)} == {0, 2}


def test_captions_are_learnt_and_open_as_guidance(tmp_path, capsys):
    numbers = "--pictures 60 --steps 3 --batch 8 --width 4 --embedding 8 --perturbed-from 0.5"
    assert main(["train", "captions", "--output", str(tmp_path / "small"), *numbers.split()]) == 0
    assert "held-out pairs" in capsys.readouterr().out
    guide = open_guide(tmp_path / "small", CPU)
    assert isinstance(guide, ClipGuide) and guide.pixels == 32
    assert main(["train", "captions", "--output", str(tmp_path / "small"), *numbers.split()]) == 0  # its own
    (tmp_path / "small" / "mine.txt").write_text("precious")
    assert main(["train", "captions", "--output", str(tmp_path / "small"), *numbers.split()]) == 2


def test_a_perturbation_stays_small_and_misleads():
    n = CaptionNumbers(pictures=40, steps=1, batch=8, width=4, embedding=8)
    learned = learn_captions(n)
    pictures, said = torch.rand(4, 3, 32, 32, generator=chance()), torch.eye(4, 8)
    changed = perturbed(learned.network, pictures, said, 0.05, chance())
    assert (changed - pictures).abs().max() <= 0.05 + 1e-6
    before, after = (contrast(learned.network, learned.network.of_pictures(x), said, 4) for x in (pictures, changed))
    assert after > before


def test_captions_are_told_from_distorted_pictures():
    """A distorted picture that looks like a caption costs what another's picture would."""
    network, _ = new_model(CaptionNumbers(width=4, embedding=8))
    seen = said = torch.eye(3, 8)
    plain = contrast(network, seen, said, 3)
    assert contrast(network, torch.cat([seen, torch.eye(4, 8)[3:]]), said, 3) > plain
    assert contrast(network, torch.cat([seen, seen[:1]]), said, 3) > plain + 0.05
    picture = torch.rand(1, 3, 8, 8, generator=chance())
    wrong = distorted(picture.repeat(64, 1, 1, 1), chance())
    assert ((wrong - picture).abs().amax((1, 2, 3)) > 0.1).all() and wrong.min() >= 0 and wrong.max() <= 1
    whole = (wrong.flatten(2).sort(-1).values - picture.flatten(2).sort(-1).values).abs().amax((1, 2)) < 1e-6
    assert 0.3 < whole.float().mean() < 0.7  # in pieces or on a side: each channel has its values still


def test_batches_follow_the_pictures_and_repeat_no_group():
    """Half of the pictures are of two groups, and half of fifty: a batch holds both of the two."""
    same = torch.cat([torch.arange(2).repeat(25), torch.arange(2, 52)])
    for seed in range(5):
        groups = same[different(same, 8, chance(seed))].tolist()
        assert len(set(groups)) == len(groups) == 8
    many = [same[different(same, 8, chance(seed))] for seed in range(200)]
    assert torch.stack([(x < 2).sum() for x in many]).float().mean() > 0.9  # 0.3 if each group were as likely


def test_no_thing_is_learnt_to_be_wrong_beside_its_held_out_neighbour():
    things, never = captions.THINGS, [set(pair) for pair in captions.held_out()]
    first, second = next(
        (i, j) for i in range(15) for j in range(i) if things[i].colour == things[j].colour
    )  # no held-out pair has one colour twice
    there = torch.zeros(1, 15, dtype=torch.bool)
    there[0, [first, second]] = True
    logits = torch.zeros(1, 15, requires_grad=True)
    (gradient,) = torch.autograd.grad(thing_loss(logits, there), logits)
    assert gradient[0, first] < 0 and gradient[0, second] < 0
    for other in set(range(15)) - {first, second}:
        allowed = [{things[other], things[beside]} not in never for beside in (first, second)]
        assert bool(gradient[0, other] > 0) == any(allowed)
