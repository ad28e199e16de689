"""Block worlds: region files, cubes of terrain, cameras, landscapes, and how steady a walk is."""

from __future__ import annotations

import io
import zlib

import numpy as np
import pytest
import tiny_world
import torch
from budgets import budget

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.camera.rays import Rendering
from lumigraph.datasets.terrain import terrain
from lumigraph.datasets.world import LABELS, BlockWorld
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.walks import colours_by_label, evaluate_walk, warped_difference
from lumigraph.method import Method
from lumigraph.methods.gancraft.landscapes import STYLES, landscape
from lumigraph.opening import kind_of, open_dataset
from lumigraph.readers import minecraft
from lumigraph.synthetic import block_stage
from lumigraph.synthetic.scenes.blocks import Options, blocks

pytestmark = budget("capture", 12)
anvil = pytest.importorskip("anvil")


def region(path, change=lambda chunk: chunk):
    """A region with a floor of stone 4 blocks thick at (16..31, 16..31), and above its corner (17, 18) blocks of sand
    with a torch. change: of the NBT of each chunk"""
    made, stone, sand = anvil.EmptyRegion(0, 0), anvil.Block("minecraft", "stone"), anvil.Block("minecraft", "sand")
    for x in range(16, 32):
        for z in range(16, 32):
            for y in range(4):
                made.set_block(stone, x, y, z)
    made.set_block(sand, 17, 4, 18)
    made.set_block(sand, 17, 5, 18)
    made.set_block(anvil.Block("minecraft", "torch"), 17, 6, 18)
    made.set_block(anvil.Block("minecraft", "chest"), 20, 4, 20)
    made.save(str(path))
    data = bytearray(path.read_bytes())
    offset = 4096 * int.from_bytes(data[4 * 33 : 4 * 33 + 3], "big")
    length = int.from_bytes(data[offset : offset + 4], "big")
    tag = anvil.Region(bytes(data)).chunk_data(1, 1)
    change(tag)
    buffer = io.BytesIO()
    tag.write_file(buffer=buffer)
    packed = zlib.compress(buffer.getvalue())
    assert len(packed) + 5 <= 4096 and length
    data[offset : offset + 5 + len(packed)] = (len(packed) + 1).to_bytes(4, "big") + b"\x02" + packed
    path.write_bytes(bytes(data))
    return path


def test_a_region_becomes_labels_with_north_ahead_and_height_up(tmp_path):
    labels, notes = minecraft.read(region(tmp_path / "r.0.0.mca"))
    assert labels.shape == (16, 16, 7)  # with a layer of air above the sand
    stone, sand = LABELS.index("stone"), LABELS.index("sand")
    assert (labels[:, :, :4] == stone).all()
    # z goes south in the game, so the block at z = 18, the third row from the north, is third from the end.
    assert (labels[1, 15 - 2, 4:6] == sand).all()
    assert (labels == sand).sum() == 2 and labels[4, 15 - 4, 4] == stone  # the chest; the torch is air
    assert len(notes) == 1 and "chest" in notes[0] and "torch" not in notes[0]


def test_a_region_opens_as_a_block_world_also_within_a_world(tmp_path):
    path = region(tmp_path / "r.0.0.mca")
    assert kind_of(path) is kind_of(tmp_path) is BlockWorld and not minecraft.recognises(tmp_path / "none.mca")
    (tmp_path / "world" / "region").mkdir(parents=True)
    path.rename(tmp_path / "world" / "region" / "r.0.0.mca")
    assert kind_of(tmp_path / "world") is BlockWorld


def forget_sections(chunk):
    """A layout of which nobody has heard."""
    chunk["DataVersion"].value = 99_999


def test_bad_regions_are_told_in_one_sentence(tmp_path):
    with pytest.raises(LumigraphError, match="unknown version .DataVersion 99999"):
        minecraft.read(region(tmp_path / "r.0.0.mca", forget_sections))
    (tmp_path / "r.0.1.mca").write_bytes(bytes(8192))
    with pytest.raises(LumigraphError, match="it has no chunks"):
        minecraft.read(tmp_path / "r.0.1.mca")
    damaged = bytearray(region(tmp_path / "r.0.2.mca").read_bytes())
    offset = 4096 * int.from_bytes(damaged[4 * 33 : 4 * 33 + 3], "big")
    damaged[offset + 5 : offset + 80] = bytes(75)
    (tmp_path / "r.0.2.mca").write_bytes(bytes(damaged))
    with pytest.raises(LumigraphError, match=r"its chunks \(1, 1\) are damaged"):
        minecraft.read(tmp_path / "r.0.2.mca")


def test_boxes_cover_what_can_be_seen_once():
    labels = blocks(Options(width=16, land=3)).labels
    seen, covered = block_stage.exposed(labels), np.zeros(labels.shape, int)
    for label in range(1, len(LABELS)):
        for low, high in block_stage.joined_boxes(seen & (labels == label)):
            covered[tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))] += 1
    assert np.array_equal(covered, seen.astype(int)) and seen.sum() < (labels > 0).sum()


def test_layers_agree_with_the_blocks():
    world = open_dataset("procedural:blocks,size=16,views=2,width=16,land=3")
    assert isinstance(world, BlockWorld) and set(LABELS) > set(world.layer("labels").names)
    matrix = world.blocks_from_scene
    for number in range(len(world)):
        shot = world.photograph(number, ("labels", "depth"))
        rays, depth = shot.camera.rays(shot.camera.pixels()), shot.extra["depth"].flatten()
        hit = depth.isfinite()
        inside = rays.at(depth.nan_to_num(posinf=0.0) + 1e-4).double() @ matrix[:3, :3].T + matrix[:3, 3]
        blocks = torch.from_numpy(world.blocks.labels)[tuple(inside[hit].floor().long().T)]
        labels = world.label_numbers[shot.extra["labels"]].flatten()
        assert hit.any() and (labels[hit] == blocks).float().mean() > 0.98
        assert (labels[~hit] == LABELS.index("sky")).all()


def test_cameras_are_above_the_ground_and_the_walk_is_closed():
    labels = blocks(Options(width=24, land=1)).labels
    unit, height = 12.0, block_stage.tops(labels)
    poses = block_stage.walk(labels, 50, unit)
    places = poses[:, :, 3] * unit + np.array(labels.shape) / 2
    for x, y, z in places:
        assert z > block_stage.clear_height(height, x, y) + 1
    steps = np.linalg.norm(np.diff(places, axis=0, append=places[:1]), axis=1)
    assert steps.max() < 3 * np.median(steps)


def test_finer_terrain_is_the_same_land():
    coarse, fine = terrain(24, 5), terrain(24, 5, fine=3)
    np.testing.assert_allclose(fine.ground[1::3, 1::3], coarse.ground, atol=1e-9)
    height, label = fine.surface
    assert (height >= fine.ground - 1e-9).all() and (label == LABELS.index("tree")).any() == bool(len(fine.trees))


def test_a_landscape_depends_on_its_style_and_its_labels_do_not():
    pictures = {style: landscape(3, style, 24, land=2) for style in STYLES}
    summer, labels = pictures["summer"]
    assert summer.min() >= 0 and summer.max() <= 1 and len(np.unique(labels)) > 2
    for rgb, own in pictures.values():
        assert np.array_equal(own, labels)
        assert rgb is summer or np.abs(rgb - summer).mean() > 0.05
    sky = labels == LABELS.index("sky")
    assert sky[0].mean() > sky[-1].mean()


def painted(camera: Camera, depth: torch.Tensor) -> torch.Tensor:
    """Colours that depend on the place alone."""
    points = camera.rays(camera.pixels()).at(depth.flatten())
    return (0.5 + 0.3 * torch.sin(2 * points)).view(*depth.shape, 3)


def test_a_place_that_keeps_its_colour_is_steady_and_a_flicker_is_not():
    """Two cameras before a wall at z = 3."""
    lens = Pinhole(torch.full((1, 2), 40.0), torch.full((1, 2), 20.0))
    poses = [torch.cat([torch.eye(3), torch.tensor([[x], [0.0], [0.0]])], 1)[None] for x in (0.0, 0.2)]
    a, b = (Camera(pose, lens, torch.tensor([[40, 40]])) for pose in poses)
    depths = [3 / c.rays(c.pixels()).directions[:, 2].view(40, 40) for c in (a, b)]
    first, second = (painted(c, d) for c, d in zip((a, b), depths, strict=True))
    change, shared = warped_difference(second, b, depths[1], first, a, depths[0])
    assert change < 2e-3 and 0.85 < shared < 1
    change, _ = warped_difference(second + 0.1, b, depths[1], first, a, depths[0])
    assert change == pytest.approx(0.1, abs=2e-3)
    hidden, _ = warped_difference(second, b, depths[1], first, a, 0.5 * depths[0])
    assert hidden is None


def test_colours_that_labels_explain():
    labels = torch.arange(40 * 40).view(1, 40, 40) % 2 + 1
    exact = torch.stack([labels.float()] * 3, -1) / 4
    separation, colours = colours_by_label(exact, labels)
    assert separation == pytest.approx(1) and colours["grass"] == (0.25, 0.25, 0.25)
    noise = torch.rand(1, 40, 40, 3, generator=torch.Generator().manual_seed(0))
    assert colours_by_label(noise, labels)[0] < 0.01


def test_a_walk_is_evaluated_without_photographs():
    world = tiny_world.world()

    class Grey(Method):
        """Renders everything in one colour."""

        def batch(self, data, generator):
            raise NotImplementedError

        def render(self, camera):
            depth = torch.full((24, 24), 2.0)
            return Rendering(torch.full((24, 24, 3), 0.5), depth, torch.ones(24, 24))

    found = evaluate_walk(Grey(world.frame, None), world)
    assert len(found.frames) == 3 and found.change == 0 and found.frames[0].change is None
    assert [score.name for score in found.scores] == ["warped difference", "colours by label"]
    with pytest.raises(LumigraphError, match="no frames in the split 'val'"):
        evaluate_walk(Grey(world.frame, None), world, EvaluationOptions("val"))
