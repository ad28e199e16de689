"""SNeRG's equations, what is baked, and the folder that its own viewer opens."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import tiny
import tiny_atlas
import torch
from budgets import budget
from PIL import Image
from tiny_atlas import DENSITY, RADIUS

from lumigraph import kernels
from lumigraph.camera.rays import Rays
from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.exchange import snerg
from lumigraph.files.ranges import changed
from lumigraph.kernels.block_march import ALPHA
from lumigraph.large import open_any
from lumigraph.method.capabilities import HasAtlas, can
from lumigraph.methods.snerg import ATLAS, FIELD, VOXELS, SNeRG
from lumigraph.methods.snerg.baked_voxels import VisibilityGrid
from lumigraph.methods.snerg.deferred_field import encoded
from lumigraph.metrics import psnr
from lumigraph.run import Run, State
from lumigraph.training import fit

pytestmark = budget("methods", 12)


@pytest.fixture(scope="module")
def ball():
    return tiny_atlas.baked()


@pytest.fixture(scope="module")
def room():
    """What reaches beyond the box of interest, contracted."""
    return tiny_atlas.baked(OPEN, field=tiny_atlas.room, resolution=120, whole=True)


@pytest.fixture
def folder(ball, tmp_path):
    snerg.write(tmp_path / "scene", ball.atlas())
    return tmp_path / "scene"


OPEN = replace(tiny.scene().frame, reach=4.0, has_alpha=False)


def through_the_middle(count: int) -> Rays:
    """Parallel rays along +z at growing distances from the axis."""
    origins = torch.stack([torch.linspace(0, 0.5, count), torch.zeros(count), torch.full((count,), -3.0)], -1)
    return Rays(origins, torch.tensor([0.0, 0.0, 1.0]).expand(count, 3), torch.full((count,), 0.01))


# The kernel's equation


def test_a_slab_dims_by_each_step():
    """Through n voxels of one alpha passes (1 - alpha)^n, and what is beyond the first is seen through it."""
    n, alpha = 8, 0.3
    places = torch.cartesian_prod(*[torch.arange(n)] * 3)
    values = torch.full((len(places), 8), 0.1)
    values[:, ALPHA] = alpha
    blocks = kernels.Blocks.of(places, (n, n, n), 3)
    ray = torch.tensor([[3.0, 4.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0]])
    totals, along = kernels.block_march(*ray, torch.tensor([5.0]), torch.tensor([5.0 + n]), blocks, values)
    light = (1 - alpha) ** torch.arange(n)
    assert float(totals[0, ALPHA]) == pytest.approx(1 - (1 - alpha) ** n, rel=1e-5)
    assert float(totals[0, 0]) == pytest.approx(float(0.1 * light.sum()), rel=1e-5)
    assert float(along) == pytest.approx(float((light * alpha * torch.arange(5, 5 + n)).sum()), rel=1e-5)


def test_blocks_hold_their_neighbours_beside_them():
    places = torch.cartesian_prod(*[torch.arange(3, 7)] * 3)
    blocks = kernels.Blocks.of(places, (12, 12, 12), 4)
    assert int((blocks.index >= 0).sum()) == 8  # of 27; the others touch nothing
    for a, b, c in (blocks.index >= 0).nonzero().tolist():
        rows = blocks.rows[blocks.index[a, b, c]]
        for x, y, z in (rows >= 0).nonzero().tolist():
            place = torch.tensor([a, b, c]) * 4 + torch.tensor([x, y, z]) - 1
            assert torch.equal(places[rows[x, y, z]], place)
    with pytest.raises(ValueError, match="two rows"):
        kernels.Blocks.of(torch.tensor([[1, 1, 1], [1, 1, 1]]), (4, 4, 4), 4)


def test_the_direction_is_encoded_as_the_viewer_does():
    d = torch.nn.functional.normalize(torch.tensor([[0.3, -0.5, 0.8]]), dim=-1)
    found = encoded(d)[0]
    for index in range(27):
        x = d[0, index % 3]
        octave, shift = (index - 3) % 12 // 3, math.pi / 2 * (index - 3 >= 12)
        expected = x if index < 3 else torch.sin(x * 2.0**octave + shift)
        assert float(found[index]) == pytest.approx(float(expected), abs=1e-6)


# Baking


def test_baked_values_are_those_of_the_field(ball):
    """alpha = 1 - exp(-density voxel), and the rest is multiplied by it (section 5.1)."""
    voxels = ball.voxels
    centres = voxels.low + (voxels.places + 0.5) * voxels.edge
    inside = centres.norm(dim=-1) < RADIUS
    assert inside.all() and len(centres) == pytest.approx(
        4 / 3 * math.pi * (RADIUS / float(voxels.edge)) ** 3, rel=0.05
    )
    alpha = 1 - math.exp(-DENSITY * float(voxels.edge))
    torch.testing.assert_close(ball.tuned.values[:, ALPHA], torch.full((len(centres),), alpha))
    torch.testing.assert_close(ball.tuned.values[:, :3], alpha * tiny_atlas.colour(centres))
    torch.testing.assert_close(ball.tuned.values[:, 4:], torch.full((len(centres), 4), 0.25 * alpha))
    torch.testing.assert_close(ball.density(centres[:50]), torch.full((50,), DENSITY), rtol=1e-3, atol=1e-3)


def test_a_ray_through_the_ball_is_dimmed_by_what_it_passes(ball):
    rays = through_the_middle(20)
    with torch.no_grad():
        seen = ball._marched(rays)
    length = 2 * (RADIUS**2 - rays.origins[:, 0] ** 2).sqrt()
    torch.testing.assert_close(seen.opacity, 1 - torch.exp(-DENSITY * length), atol=0.03, rtol=0)
    expected = ball.view(rays.directions, seen.diffuse, seen.features)
    with torch.no_grad():
        rgb = ball.render_rays(rays, torch.zeros(1, 3)).rgb
    torch.testing.assert_close(rgb, seen.diffuse + seen.opacity[:, None] * expected)


def test_looks_composite_to_the_picture(ball):
    rays = through_the_middle(7)
    with torch.no_grad():
        (look,) = ball.looks(rays)
        whole = ball.render_rays(rays, torch.zeros(1, 3))
    from lumigraph.volume import composite

    seen = composite(look.samples, look.density, look.rgb)
    torch.testing.assert_close(seen.rgb, whole.rgb, atol=2e-3, rtol=0)
    torch.testing.assert_close(seen.depth, whole.depth, atol=5e-3, rtol=0)


def test_straight_out_a_ray_meets_all_that_is_beyond_the_ball(room):
    """From the middle, from beyond the wall, and from beside it, which the wall's own density says."""
    out = torch.nn.functional.normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    wall = 1 - math.exp(-tiny_atlas.WALL * tiny_atlas.WIDE * math.sqrt(math.pi))
    rays = Rays(0.9 * out, out, torch.full((40,), 0.01))
    with torch.no_grad():
        seen, inwards = room._marched(rays), room._marched(replace(rays, origins=5 * out, directions=-out))
    torch.testing.assert_close(seen.opacity, torch.full((40,), wall), atol=0.02, rtol=0)
    through = 1 - (1 - wall) ** 2 * math.exp(-2 * RADIUS * DENSITY)
    torch.testing.assert_close(inwards.opacity, torch.full((40,), through), atol=0.02, rtol=0)
    assert float((seen.distance / seen.opacity).mean()) == pytest.approx(1.6, abs=0.1)
    points = torch.cat([2.2 * out, 2.8 * out, 0.3 * out])
    torch.testing.assert_close(room.density(points), tiny_atlas.room(points)[0], atol=0.02, rtol=0.05)


def test_steps_of_curved_rays_are_as_long_as_voxels(room):
    """In the coordinates of the grid, between where their samples begin and end."""
    rays = tiny.scene().cameras[4].rays(tiny.scene().cameras[4].pixels())[::7]
    with torch.no_grad():
        samples, _ = room.voxels.samples(rays, room._values, 0.1)
    ray = samples.ray_index
    ends = [
        2 * room.voxel_space.warp(rays.origins[ray] + t[:, None] * rays.directions[ray])
        for t in (samples.t_start, samples.t_end)
    ]
    torch.testing.assert_close((ends[1] - ends[0]).norm(dim=-1), room.voxels.edge.expand(len(ray)), rtol=0.1, atol=0)
    assert float(samples.t_end.max()) > 4


def test_looks_of_an_open_capture_composite_to_the_picture(room):
    test_looks_composite_to_the_picture(room)


def test_what_no_ray_sees_is_left_out():
    method = SNeRG(tiny.scene().frame, SNeRG.smallest())
    with pytest.raises(LumigraphError, match="no ray sees"):
        method._bake(tiny_atlas.ball)
    n = method.visibility.resolution
    method.visibility.record(torch.tensor([[-0.9, 0.0, 0.0], [5.0, 0.0, 0.0]]), torch.tensor([0.5, 0.5]))
    cells = method.visibility.visible.nonzero()
    assert len(cells) == 2 * 3 * 3 or cells[:, 0].max() <= 2 < n
    method.visibility.record(torch.tensor([[-0.5, 0.0, 0.0]]), torch.tensor([0.5]))
    method._bake(tiny_atlas.ball)
    centres = method.voxels.low + (method.voxels.places + 0.5) * method.voxels.edge
    assert len(centres) and (centres[:, 0] < 0).all()


def test_visibility_fades():
    grid = VisibilityGrid(8, 1)
    grid.record(torch.zeros(1, 3), torch.tensor([0.02]))
    assert grid.visible.any()
    for step in range(20):
        grid.before_step(None, step, 0.0)
    assert not grid.visible.any()


# Learning


def test_it_goes_through_its_stages_by_the_share_of_the_budget():
    method, stages = SNeRG(tiny.scene().frame, SNeRG.smallest()), []
    before = method.before_step
    method.before_step = lambda step, progress: (before(step, progress), stages.append(int(method.stage)))  # type: ignore
    with pytest.raises(LumigraphError, match="not baked yet"):
        method.atlas()
    fit(method, tiny.scene(), steps=20, show=False, rehearsal=False)
    assert stages == [FIELD] * 12 + [VOXELS] * 5 + [ATLAS] * 3
    assert not len(method.network.table) and not len(method.tuned.values) and can(method, HasAtlas)
    atlas = method.atlas()
    assert torch.equal(
        atlas.values.unique(), torch.cat([torch.zeros(1), method.voxels.levels.unique()]).unique().byte()
    )


def test_the_papers_network_is_baked_as_well():
    """And its layers are let go of, all of them."""
    config = changed(SNeRG.smallest(), field="network", hidden_layers=3, learning_rate=5e-3)
    method = SNeRG(tiny.scene().frame, config)
    fit(method, tiny.scene(), steps=8, show=False, rehearsal=False)
    assert method.stage == ATLAS and not sum(x.numel() for x in method.network.parameters())


@pytest.mark.parametrize("frame", [tiny.scene().frame, OPEN])
def test_voxels_are_no_finer_than_half_a_pixel(frame):
    """However many are asked for: a field that has learnt little is dense all over, and so would be the voxels."""
    method = SNeRG(frame, changed(SNeRG.smallest(), resolution=1000))
    fit(method, replace(tiny.scene(), frame=frame), steps=16, show=False, rehearsal=False)
    assert method.stage > FIELD and int(method.voxels.size.max()) <= 2 * tiny.SIZE + method.voxels.block
    again = SNeRG(frame, method.config)
    again.load_state_dict({name: x for name, x in method.state_dict().items() if name == "longest_side"}, strict=False)
    assert int(again.longest_side) == tiny.SIZE  # a resumed run bakes the same


@pytest.mark.parametrize("whole", [True, False])
def test_an_open_capture_is_baked_whole_or_within_its_box(whole):
    scene = replace(tiny.scene(), frame=OPEN)
    method = SNeRG(OPEN, changed(SNeRG.smallest(), whole=whole, sweep_weight=0.0))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fit(method, scene, steps=20, show=False, rehearsal=False)
    assert method.stage == ATLAS and method.atlas().contracted == whole
    assert any("box of interest" in str(x.message) for x in told) != whole
    places = method.voxels.low + (method.voxels.places + 0.5) * method.voxels.edge
    assert (float(places.abs().max()) > 1) == whole


def test_voxels_that_no_ray_meets_are_dropped_and_nobody_sees_it():
    """Of an opaque ball its inside; of a haze, that rays pass through, nothing."""
    for density, hidden in ((100.0, True), (1.0, False)):
        method = tiny_atlas.baked(diffuse=True, density=density, rays_per_step=1 << 16)
        camera = tiny.scene().photograph(0).camera
        rays = camera.rays(camera.pixels())
        optimizer = method.optimizers()[0]
        for group in optimizer.param_groups:
            group["lr"] = 0.0
        before, count = method.render_rays(rays, method.background), len(method.voxels)
        before.rgb.sum().backward()
        optimizer.step()
        method._drop_hidden()
        after = method.render_rays(rays, method.background)
        assert torch.equal(before.rgb, after.rgb)
        assert len(method.voxels) == len(method.tuned.values)
        assert (len(method.voxels) < 0.8 * count) if hidden else (len(method.voxels) > 0)


class OnlySeen:
    """A teacher that shows pictures, and knows nothing of points."""

    def __init__(self, method):
        self.render, self.frame, self.device = method.render, method.frame, method.device


@pytest.mark.parametrize(("teacher", "like"), [("field", 27), ("pictures", 20)])
def test_a_teacher_is_taken_over_as_far_as_cameras_see_it(teacher, like):
    """It looks like a diffuse one at once, and is to learn features that nobody has told."""
    scene, solid = tiny.scene(), tiny_atlas.baked(diffuse=True, density=10.0)
    method = SNeRG(scene.frame, SNeRG.smallest())
    method.from_field(solid if teacher == "field" else OnlySeen(solid), scene.cameras[::2])
    assert method.stage == VOXELS and method.of_another
    assert not method.tuned.values[:, ALPHA + 1 :].any()
    seen = [each.eval().render(scene.cameras[4]) for each in (method, solid)]
    assert psnr(seen[0].rgb, seen[1].rgb) > like
    if teacher == "field":
        fit(method, scene, steps=6, show=False, rehearsal=False)
        assert method.stage == ATLAS and method.voxels.levels[:, ALPHA + 1 :].any()


# The viewer's folder


def test_the_folder_holds_what_the_atlas_does(ball, folder):
    atlas, back = ball.atlas(), snerg.read(folder)
    assert torch.equal(atlas.index >= 0, back.index >= 0)
    there = tuple((atlas.index >= 0).nonzero().unbind(-1))
    assert torch.equal(atlas.values[atlas.index[there]], back.values[back.index[there]])
    torch.testing.assert_close(back.low, atlas.low)
    assert back.voxel == pytest.approx(atlas.voxel) and back.block == atlas.block
    for name in ("weights", "biases"):
        for a, b in zip(getattr(atlas.network, name), getattr(back.network, name), strict=True):
            torch.testing.assert_close(a, b)
    said = json.loads((folder / "scene_params.json").read_text())
    slices = sorted(path.name for path in folder.glob("rgba_*.png"))
    assert slices[-1] == f"rgba_{said['num_slices'] - 1:03d}.png" and said["atlas_depth"] == 4 * said["num_slices"]


def as_its_viewer(folder, origin, direction):
    """One ray's diffuse colour, features and opacity as the published shader finds them, in its own axes."""
    said = json.loads((folder / "scene_params.json").read_text())
    size, block = said["voxel_size"], said["block_size"]
    low = np.array([said[f"min_{axis}"] for axis in "xyz"])
    grid = np.array([said[f"grid_{name}"] for name in ("width", "height", "depth")])
    planes = {}
    for kind in ("rgba", "feature"):
        pictures = [np.asarray(Image.open(folder / f"{kind}_{i:03d}.png")) for i in range(said["num_slices"])]
        height = said["atlas_height"]
        planes[kind] = np.concatenate([p.reshape(4, height, -1, 4) for p in pictures]) / 255  # (z, y, x, channel)
    blocks = -(-grid // block)
    index = np.asarray(Image.open(folder / "atlas_indices.png")).reshape(blocks[2], blocks[1], blocks[0], 3)
    o = (origin - low) / size
    with np.errstate(divide="ignore"):
        a, b = (0 - o) / direction, (grid - o) / direction
    t, end = np.minimum(a, b).max() + 0.5, np.maximum(a, b).min()
    total, light = np.zeros(8), 1.0
    while t < end:
        place = o + t * direction
        own = np.floor(place / block).astype(int)
        at = index[own[2], own[1], own[0]].astype(int)
        if at[0] != 255:
            corner = place - own * block + at * (block + 2) + 1 - 0.5  # texels' centres lie at halves
            first = np.floor(corner).astype(int)
            seen = np.zeros(8)
            for i in np.ndindex(2, 2, 2):
                x, y, z = first + i
                weight = np.prod(np.where(np.array(i) == 1, corner - first, 1 - (corner - first)))
                seen += weight * np.concatenate([planes["rgba"][z, y, x], planes["feature"][z, y, x]])
            total += light * seen
            light *= 1 - seen[3]
        t += 1
    return total


def test_the_published_viewer_finds_the_same_along_rays(ball, folder):
    generator = torch.Generator().manual_seed(0)
    out = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator), dim=-1)
    rays = Rays(2.5 * out + 0.2, -out, torch.full((6,), 0.01))
    shown = open_any(folder).method()
    with torch.no_grad():
        seen = shown._marched(rays)
    turn = np.array(json.loads((folder / "scene_params.json").read_text())["worldspace_T_opengl"])[:3, :3]
    for i in range(6):
        origin, direction = (x[i].double().numpy() @ turn for x in (rays.origins, rays.directions))
        total = as_its_viewer(folder, origin, direction)
        assert total[3] == pytest.approx(float(seen.opacity[i]), abs=0.01)
        np.testing.assert_allclose(total[:3], seen.diffuse[i], atol=0.01)
        np.testing.assert_allclose(total[4:], seen.features[i], atol=0.01)


def test_a_folder_opens_like_a_run(ball, folder):
    opened = open_any(folder)
    camera = tiny.scene().cameras[4]
    seen, expected = opened.method().render(camera), ball.render(camera)
    assert psnr(seen.rgb, expected.rgb) > 40
    assert len(opened.cameras()["train"]) and not opened.photographed


def test_an_open_capture_comes_back_from_its_folder(room, tmp_path, capsys):
    snerg.write(tmp_path / "room", room.atlas())
    opened, camera = open_any(tmp_path / "room"), tiny.scene().cameras[4]
    shown = opened.method()
    assert shown.atlas().contracted and opened.frame.reach > 1
    assert psnr(shown.render(camera).rgb, room.render(camera).rgb) > 40
    assert main(["export", "snerg", str(tmp_path / "room"), str(tmp_path / "again")]) == 0
    assert "out of shape" in capsys.readouterr().err


def test_a_scene_of_another_size_is_brought_within_reach(ball, tmp_path):
    atlas = ball.atlas()
    snerg.write(tmp_path / "large", replace(atlas, low=atlas.low * 30 + 5, voxel=atlas.voxel * 30, network=None))
    assert not list((tmp_path / "large").glob("feature_*.png"))
    opened = open_any(tmp_path / "large")
    to_source, (low, high) = opened.frame.to_source, opened.frame.bounds
    assert max(map(abs, (*low, *high))) <= 1 and max(b - a for a, b in zip(low, high, strict=True)) > 1.9
    corner = opened.method().voxels.low * to_source.scale + to_source.matrix[:3, 3].float()
    torch.testing.assert_close(corner, atlas.low * 30 + 5, atol=1e-3, rtol=1e-4)
    with torch.no_grad():
        added = opened.method().view(torch.eye(3), torch.rand(3, 3), torch.rand(3, 4))
    assert float(added.max()) < 1e-6


def test_the_command_writes_the_folder(ball, tmp_path, capsys):
    scene = tiny.scene()
    run = Run.create(tmp_path / "run", ball, scene)
    run.save(State(), ball, ball.optimizers(), torch.Generator())
    output = tmp_path / "out"
    assert main(["export", "snerg", str(run.folder), str(output)]) == 0
    assert "MB" in capsys.readouterr().out
    assert torch.equal(snerg.read(output).index >= 0, ball.atlas().index >= 0)
    assert main(["export", "snerg", str(output), str(tmp_path / "again")]) == 0
    assert main(["info", str(output)]) == 0 and "SNeRG's viewer" in capsys.readouterr().out
    assert (tmp_path / "again" / "rgba_000.png").is_file()


def test_a_run_that_is_not_baked_is_refused(tmp_path, capsys):
    scene = tiny.scene()
    method = SNeRG(scene.frame, SNeRG.smallest())
    run = Run.create(tmp_path / "run", method, scene)
    run.save(State(), method, method.optimizers(), torch.Generator())
    assert main(["export", "snerg", str(run.folder), str(tmp_path / "out")]) == 2
    assert "not baked yet" in capsys.readouterr().err and not (tmp_path / "out").exists()


def said(folder, **changes):
    path = folder / "scene_params.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


FAULTS = {
    "a slice is missing": (lambda f: (f / "rgba_001.png").unlink(), "lacks the file 'rgba_001.png'"),
    "a slice is cut": (lambda f: cut(f / "feature_000.png"), "feature_000.png is damaged"),
    "a slice is no picture": (lambda f: (f / "rgba_000.png").write_bytes(b"no"), "rgba_000.png is damaged"),
    "a slice is of another size": (lambda f: Image.new("RGBA", (4, 4)).save(f / "rgba_000.png"), "should be"),
    "no indices": (lambda f: (f / "atlas_indices.png").unlink(), "atlas_indices.png"),
    "no parameters": (lambda f: (f / "scene_params.json").unlink(), "scene_params.json"),
    "absurd counts": (
        lambda f: said(f, atlas_blocks_x=250, atlas_width=2000, atlas_blocks_y=250, atlas_height=2000),
        "to read|should be",
    ),
    "counts that disagree": (lambda f: said(f, num_slices=3), "does not hold"),
    "normalised coordinates": (lambda f: said(f, ndc=True), "normalised device"),
    "another format": (lambda f: said(f, format="webp"), "only png"),
    "contracted, and no cube": (lambda f: said(f, contracted=True), "fills the cube"),
    "a layer too narrow": (lambda f: said(f, **{"1_bias": [0.0]}), "Layer 1|layer 1"),
}


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("name", FAULTS)
def test_bad_input_is_told_in_a_sentence(name, folder, tmp_path, capsys):
    spoil, sentence = FAULTS[name]
    spoil(folder)
    if name == "no parameters":
        assert snerg.recognises(folder)
    with pytest.raises(LumigraphError, match=sentence):
        snerg.read(folder)
    assert main(["export", "snerg", str(folder), str(tmp_path / "copy")]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "copy").exists()
