"""Block-NeRF: what was seen, in which exposure and light, what moves; blocks in one picture, and one light for all."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from balls import BLUE, RED, WHITE, Marched, eye
from budgets import budget

from lumigraph.camera.rays import Rays, Samples
from lumigraph.components.fields.appearance import Appearance
from lumigraph.components.fields.spaces import space_of
from lumigraph.composition import Placed
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Frame, Scene
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.halves import judged_by_halves, left_half
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.files.ranges import changed
from lumigraph.geometry import Similarity
from lumigraph.large import InBlocks, Mixing, Nearby, align_appearance
from lumigraph.large.weights import inverse_distance, seeing, shares
from lumigraph.methods.block_nerf import BlockNeRF
from lumigraph.methods.block_nerf.parts import CELLS, Moving, Visibility, transmittance
from lumigraph.run import build
from lumigraph.training import fit
from lumigraph.volume import composite

pytestmark = budget("methods", 15)

HERE = Similarity.make(1.0)
STILL = {"residual_masks": False, "refine_cameras": False}
NETWORK = {
    "field": "network", "depth": 2, "skip_layer": 1, "coarse_samples": 8, "fine_samples": 8, "rays_per_step": 64,
    "position_frequencies": 4, "bfloat16": False,
}  # fmt: skip


def made(scene: Scene, **options) -> BlockNeRF:
    return build(BlockNeRF, scene.frame, changed(BlockNeRF.smallest(), **options), torch.device("cpu"), 0)


def stops(image: int) -> int:
    """Below the usual: 0, 1 or 2, held-out photographs among all of them."""
    return (0, 1, 2, 2, 1, 0, 1)[image % 7]


def dimmed(known: bool) -> Scene:
    """The ball before black, each photograph darker by its stops. known: whether it says so"""
    scene = tiny.scene()
    dark = [np.array([*[2.0 ** -stops(i)] * 3, 1]) for i in range(len(scene))]
    pictures = [(tiny.picture(pose) * by).astype(np.uint8) for pose, by in zip(scene.cameras.pose, dark, strict=True)]
    about = {"exposure": torch.tensor([0.1 * 2.0 ** -stops(i) for i in range(len(scene))])} if known else {}
    frame = replace(scene.frame, background=(0.0, 0.0, 0.0))
    return replace(scene, images=ImageStore.from_arrays(pictures), about=about, frame=frame)


@pytest.fixture(scope="module")
def exposed() -> tuple[BlockNeRF, Scene]:
    scene = dimmed(known=True)
    method = made(scene, appearance=False, visibility=False, samples_per_step=1 << 13, learning_rate=5e-2, **STILL)
    fit(method, scene, steps=120, show=False, rehearsal=False)
    return method.eval(), scene


@pytest.fixture(scope="module")
def lit() -> tuple[BlockNeRF, Scene]:
    scene = dimmed(known=False)
    fast = {"samples_per_step": 1 << 13, "learning_rate": 5e-2, "visibility_width": 32, "visibility_layers": 2}
    method = made(scene, **fast, **STILL)
    fit(method, scene, steps=120, show=False, rehearsal=False)
    return method.eval(), scene


# What was seen


def test_transmittance_is_that_of_what_lies_before():
    """Two rays through samples with a gap, and one through none."""
    samples = Samples(torch.tensor([1.0, 2.0, 0.5]), torch.tensor([1.5, 3.0, 1.0]), torch.tensor([0, 2, 3, 3]))
    density = torch.tensor([2.0, 4.0, 10.0])
    for t, thickness in ((0.5, 0), (1.25, 0.5), (1.75, 1), (2.5, 3), (9, 5)):
        light = transmittance(samples, density, torch.tensor([t, 0.75, t]))
        expected = torch.tensor([math.exp(-thickness), math.exp(-2.5), 1.0])
        torch.testing.assert_close(light, expected)


def test_visibility_agrees_with_the_transmittance_of_a_wall():
    """Rays along +x meet a wall at x = 0 from the left: before it all is seen, behind it nothing, and in haze before a
    second wall as much as the haze lets through."""
    torch.manual_seed(2)
    space = space_of(Frame(near=0.01))
    network = Visibility(space, 4, 2, 32)
    adam, random = torch.optim.Adam(network.parameters(), 2e-2), torch.Generator().manual_seed(2)
    wall = Samples(torch.full((128,), 1.0), torch.full((128,), 1.3), torch.arange(129))
    density = torch.where(torch.arange(128) < 64, 100.0, math.log(2) / 0.3)  # above z = 0 a wall, haze below it
    for _ in range(120):
        y, z = torch.rand(2, 128, generator=random)
        origins = torch.stack([-torch.ones(128), 2 * y - 1, torch.where(density > 50, z, -z)], -1)
        rays = Rays(origins, torch.tensor([[1.0, 0, 0]]).expand(128, 3), torch.zeros(128))
        error = network.error(rays, wall, density, random)
        adam.zero_grad()
        error.backward()
        adam.step()
    y = torch.linspace(-0.8, 0.8, 20)

    def seen(x: float, z: float) -> torch.Tensor:
        points = torch.stack([torch.full_like(y, x), y, torch.full_like(y, z)], -1)
        return network(points, torch.tensor([[1.0, 0, 0]]).expand(20, 3))

    torch.testing.assert_close(seen(-0.6, 0.5), torch.ones(20), atol=0.1, rtol=0)
    torch.testing.assert_close(seen(0.7, 0.5), torch.zeros(20), atol=0.1, rtol=0)
    torch.testing.assert_close(seen(0.7, -0.5), torch.full((20,), 0.5), atol=0.1, rtol=0)


def test_visibility_is_learnt_beside_the_field_and_changes_nothing_of_it(lit):
    method, scene = lit
    rays = scene.cameras[1].rays(scene.cameras[1].pixels())
    rays = rays[rays.directions @ scene.cameras[1].forward[0] > 0.999]  # the middle of the ball
    before, behind = (method.visibility(rays.at(torch.full_like(rays.radius, t)), rays.directions) for t in (2.1, 3.4))
    assert before.mean() > behind.mean() + 0.2
    other = made(scene, visibility=False, samples_per_step=1 << 13, **STILL)
    fit(other, scene, steps=5, show=False, rehearsal=False)
    again = made(scene, samples_per_step=1 << 13, **STILL)
    fit(again, scene, steps=5, show=False, rehearsal=False)
    assert torch.equal(other.network.table, again.network.table)
    assert torch.equal(other.visibility(rays.origins, rays.directions), torch.ones(len(rays)))


# Exposure and appearance


def test_more_exposure_is_brighter_by_about_as_much_as_it_was(exposed):
    """Each stop doubles what is encoded, as it did in the photographs, as far as a few steps teach that."""
    method, scene = exposed
    (control,) = method.controls
    assert control.name == "exposure" and control.range == pytest.approx((-1, 1))
    camera = scene.cameras[2]
    light = [float(method.given(exposure=x).render(camera).rgb.mean()) for x in (-1, -0.5, 0, 0.5, 1)]
    assert light == sorted(light)
    assert 1.4 < light[4] / light[2] < 2.5 and 1.4 < light[2] / light[0] < 2.5
    assert method.usual_exposure == pytest.approx(math.log2(0.05), abs=1e-4)


def test_a_photograph_is_compared_in_its_own_exposure(exposed):
    """Held-out photographs say how they were exposed; there is no appearance to be found in them."""
    method, scene = exposed
    assert judged_by_halves(method)
    known, usual = (evaluate(x, scene) for x in (method, method.given(exposure=0)))
    shot = left_half(scene.photograph(int(next(i for i in scene.splits["test"] if stops(int(i)) != 1))))
    assert not torch.equal(method.given(shot).render(shot.camera).rgb, method.render(shot.camera).rgb)
    assert known.psnr > usual.psnr
    told = method.given(shot).given(exposure=0)
    assert torch.equal(told.render(shot.camera).rgb, method.render(shot.camera).rgb)


def test_unknown_exposures_count_as_usual():
    scene = dimmed(known=True)
    exposure = scene.about["exposure"].clone()
    exposure[1] = torch.nan
    method = made(replace(scene, about={"exposure": exposure}), **STILL)
    method.begin(replace(scene, about={"exposure": exposure}))
    assert method.exposures.stops[1] == 0 and method.exposures.stops_of(1) is None
    other = made(dimmed(known=False), **STILL)
    other.begin(dimmed(known=False))
    assert [x.name for x in other.controls] == ["appearance"] and other.usual_exposure is None


def test_the_light_of_a_held_out_photograph_is_found_on_its_left_half(lit):
    method, scene = lit
    average, halves = (
        evaluate(x, scene, EvaluationOptions(right_halves=True)) for x in (method.given(appearance="average"), method)
    )
    assert halves.psnr > average.psnr + 1


def test_an_appearance_can_be_given(lit):
    method, scene = lit
    named = method.given(appearance=5)
    given = method.given(Appearance(torch.tensor(named.shown_in.code.tolist())))
    assert torch.equal(named.render(scene.cameras[0]).rgb, given.render(scene.cameras[0]).rgb)
    assert torch.equal(given.given(appearance="average").shown_in.code, method.shown_in.code)
    with pytest.raises(LumigraphError, match="3 numbers does not fit"):
        method.given(Appearance(torch.zeros(3)))


@pytest.mark.parametrize("options", [{}, NETWORK], ids=["hash", "network"])
@pytest.mark.parametrize("without", [(), ("appearance", "exposure", "visibility")])
def test_every_part_can_be_left_out(options, without):
    scene = dimmed(known=True)
    method = made(scene, **options, **dict.fromkeys(without, False))
    fit(method, scene, steps=2, show=False, rehearsal=False)
    assert method.eval().render(scene.cameras[0]).rgb.isfinite().all()
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    directions = torch.nn.functional.normalize(points, dim=-1)
    torch.testing.assert_close(method.field(points, directions)[0], method.density(points))
    if not without:  # what is told changes colours, and no geometry
        with torch.no_grad():
            method.appearance.codes[1].fill_(1.0)
        other = method.given(appearance=1)
        assert torch.equal(other.density(points), method.density(points))
        assert not torch.equal(other.field(points, directions)[1], method.field(points, directions)[1])


def test_refined_poses_are_held_near_the_given_ones():
    """The weight of the changes' squares falls linearly over the budget; without weights there is no such term."""
    scene = dimmed(known=True)
    method = made(scene, pose_penalty=100.0, final_pose_penalty=20.0)
    with torch.no_grad():
        method.poses.twist.normal_(generator=torch.Generator().manual_seed(0))
    batch = method.batch(scene, torch.Generator().manual_seed(0))
    squares = method.poses.moves[batch.rays.image_index].square()
    for progress, weight in (0.0, 100.0), (0.25, 80.0), (1.0, 20.0):
        method.progress = progress
        found = method.loss(batch, 0)["poses"]
        torch.testing.assert_close(found, weight * squares.sum() / len(batch))
    found.backward()
    assert method.poses.twist.grad.any()
    free = made(scene, pose_penalty=0.0, final_pose_penalty=0.0)
    assert "poses" not in free.loss(batch, 0)


def test_the_learning_rate_rises_for_as_many_steps_as_it_is_told():
    method = made(dimmed(known=True), warmup_steps=1024, learning_rate=2e-3, final_learning_rate=2e-5)
    rates = [method.learning_rate(step, progress) for step, progress in ((0, 0.0), (511, 0.0), (1023, 0.0), (9, 1.0))]
    assert rates == pytest.approx([2e-3 / 1024, 1e-3, 2e-3, 2e-5 * 10 / 1024])


def test_the_network_has_three_colour_layers_and_a_squared_loss():
    """Section 4.2 and figure 3: f_sigma of eight layers of 512, f_c of three of 128, code and exposure behind z."""
    scene = dimmed(known=True)
    paper = BlockNeRF(scene.frame, BlockNeRF.preset(torch.device("cuda")))
    shapes = [tuple(p.shape) for p in paper.network.network.colour.parameters() if p.ndim == 2]
    assert shapes == [(128, 512 + 27 + 32 + 9), (128, 128), (128, 128), (3, 128)]
    method = made(scene, visibility=False, **NETWORK | STILL)
    batch = method.batch(scene, torch.Generator().manual_seed(0))
    batch = replace(batch, alpha=None)
    terms, codes = method.loss(batch, 0), method.codes(batch.rays.image_index)
    for each in method.sampler.sample(batch.rays, method.network, codes, method.random(0)):
        look = each.look(method.network, codes)
        rgb = composite(look.samples, look.density, look.rgb, method.background).rgb
        weight = 0.1 if each.name == "coarse" else 1.0
        torch.testing.assert_close(terms[each.name], weight * (rgb - batch.rgb).square().mean())


# What moves


def test_what_errs_in_one_photograph_alone_teaches_nothing():
    """Errors are even but for a patch of photograph 1, and for everything in photograph 2, which is hard to see."""
    moving, random = Moving(3), torch.Generator().manual_seed(0)
    image = torch.randint(3, (200_000,), generator=random)
    place = torch.rand(200_000, 2, generator=random)
    patch = (image == 1) & (place < 0.2).all(-1)
    error = 0.02 + 0.02 * torch.rand(200_000, generator=random) + 0.5 * patch + 0.05 * (image == 2)
    moving.note(image, place, error)
    assert moving.weights(image, place).all()  # not judged yet
    moving.before_step(None, 100, 0.1)
    assert moving.weights(image, place).all()
    moving.before_step(None, 100, 0.5)
    counted = moving.weights(image, place) > 0
    assert not counted[patch].any() and counted[image != 1].all()
    assert counted[(image == 1) & (place > 0.2 + 2 / CELLS).any(-1)].all()
    again = moving.error.clone()
    moving.note(image[:1], place[:1], torch.tensor([1.0]))
    assert ((moving.error != again).sum() == 1) and (moving.error >= again).all()


def test_rays_that_are_left_out_have_no_say_in_colours():
    scene = dimmed(known=False)
    method, random = made(scene, visibility=False), torch.Generator().manual_seed(0)
    batch = method.batch(scene, random)
    assert batch.extra["place"].min() >= 0 and batch.extra["place"].max() <= 1
    pixel = scene.cameras.project(batch.rays.at(torch.ones(len(batch))), batch.rays.image_index)[0]
    torch.testing.assert_close(batch.extra["place"] * tiny.SIZE, pixel, atol=1e-2, rtol=0)
    whole = method.loss(batch, 0)["samples"]
    method.moving.still.zero_()
    assert whole > 0 and method.loss(batch, 0)["samples"] == 0


# Blocks in one picture


def test_weights_are_the_inverse_distance_that_ends_at_the_radius():
    radii = torch.tensor([4.0, 4.0, 8.0])
    distance = torch.tensor([[1.0, 2.0, 2.0], [5.0, 6.0, 9.0], [3.999, 1.0, 1.0], [1e-9, 1.0, 1.0]])
    weights = shares(inverse_distance(distance, radii, 2.0, 3))
    by_hand = torch.tensor([0.75**2, 0.25**2, 0.375**2])
    torch.testing.assert_close(weights[0], by_hand / by_hand.sum())
    assert weights[1].tolist() == [1, 0, 0]  # none in reach: the nearest
    assert weights[2, 0] < 1e-6 and weights[3, 0] > 0.999  # no jump at the radius, and none at the centre
    far = torch.full((3,), 1e5)
    plain = distance[0] ** -4
    torch.testing.assert_close(
        shares(inverse_distance(distance[0], far, 4.0, 3)), plain / plain.sum(), rtol=1e-3, atol=0
    )
    two = inverse_distance(torch.tensor([1.0, 2.0, 3.0]), far, 1.0, 2)
    torch.testing.assert_close(shares(two), torch.tensor([0.8, 0.2, 0]))  # of 1 / d - 1 / 3
    assert inverse_distance(distance, radii, 64.0, 3).isfinite().all()
    assert seeing(torch.tensor([0.05, 0.1, 0.15, 0.2, 0.9]), 0.1).tolist() == pytest.approx([0, 0, 0.5, 1, 1], abs=1e-5)


class Witness(Marched):
    """A ball that says how much of any place was seen."""

    def __init__(self, colour, seen: float = 1.0):
        super().__init__(colour)
        self.seen = seen

    def visibility(self, points, directions):
        return torch.full_like(points[:, 0], self.seen)


CENTRES, RADII = torch.tensor([[-3.0, 0, 0], [3.0, 0, 0]]), torch.tensor([9.0, 9.0])


def blocks(*seen: float, **mixing) -> InBlocks:
    """A red ball as one block has it, and the same in blue as the other."""
    parts = [Placed(Witness(c, s), HERE) for c, s in zip((RED, BLUE), seen, strict=True)]
    return InBlocks(WHITE, parts, CENTRES, RADII, Mixing(**mixing))


def in_the_middle(method, camera) -> torch.Tensor:
    return method.render(camera).rgb[16, 16]


def test_pictures_are_mixed_by_the_distance_from_the_camera():
    red, blue = torch.tensor(RED), torch.tensor(BLUE)
    for x in (-4.0, -2.0, 2.0):
        camera = eye((x, 0.0, 0.0))
        a, b = ((1 / abs(x - centre) - 1 / 9) ** 4 for centre in (-3, 3))
        expected = (a * red + b * blue) / (a + b)
        both = blocks(1, 1, power=4.0)
        torch.testing.assert_close(in_the_middle(both, camera), expected, atol=1e-3, rtol=0)
        seen, alone = both.render(camera), Witness(RED).render(camera)
        torch.testing.assert_close(seen.opacity, alone.opacity, atol=1e-4, rtol=0)
        torch.testing.assert_close(seen.depth, alone.depth, atol=1e-3, rtol=0)
        nearest = in_the_middle(blocks(1, 1, by="nearest"), camera)
        torch.testing.assert_close(nearest, red if x < 0 else blue, atol=1e-3, rtol=0)
    camera = eye((-1.0, 0.0, 0.0))  # it sees the near side of the ball, at x = -0.5
    a, b = 2.5**-2, 3.5**-2
    by_points = in_the_middle(blocks(1, 1, by="points", power=2.0), camera)
    torch.testing.assert_close(by_points, (a * red + b * blue) / (a + b), atol=5e-3, rtol=0)
    by_sight = in_the_middle(blocks(0.9, 0.3, by="visibility", power=2.0), camera)
    torch.testing.assert_close(by_sight, 0.75 * red + 0.25 * blue, atol=2e-3, rtol=0)


def test_a_block_that_does_not_see_is_not_shown():
    camera = eye((-2.0, 0.0, 0.0))
    colours = [in_the_middle(blocks(*seen), camera) for seen in ((0.05, 1), (1, 0.05), (0, 0), (1, 1))]
    torch.testing.assert_close(colours[0], torch.tensor(BLUE), atol=1e-3, rtol=0)
    torch.testing.assert_close(colours[1], torch.tensor(RED), atol=1e-3, rtol=0)
    torch.testing.assert_close(colours[2], colours[3])  # where none sees, distance alone tells
    half = blocks(0.15, 1).weights(camera)  # halfway between the threshold and twice that
    whole = blocks(1, 1).weights(camera)
    assert half[0] / half[1] == pytest.approx(0.5 * float(whole[0] / whole[1]), rel=1e-4)


def test_density_is_mixed_where_blocks_overlap():
    class Filled(Witness):
        def density(self, points):
            return torch.full_like(points[:, 0], self.seen)

    parts = [Placed(Filled(RED, s), Similarity.make(scale)) for s, scale in ((10.0, 1.0), (80.0, 2.0))]
    both = InBlocks(WHITE, parts, CENTRES, torch.tensor([6.0, 6.0]))
    found = both.density(torch.tensor([[-4.0, 0, 0], [0.0, 0, 0], [4.0, 0, 0], [0.0, 50, 0]]))
    assert found.tolist() == pytest.approx([10, 25, 40, 10], rel=1e-4)


def test_controls_are_passed_on_and_exposures_are_made_one(exposed):
    """One block usually saw twice the light of the other; both are shown as halfway between."""
    method, scene = exposed
    brighter = copy.deepcopy(method)
    brighter.exposures.usual += 1
    parts = [Placed(x.eval(), HERE) for x in (method, brighter)]
    both = InBlocks(scene.frame, parts, 10 * CENTRES, 10 * RADII, exposures=scene.about["exposure"])
    (control,) = both.controls
    assert control.range == pytest.approx((-1.5, 1.5))
    camera = scene.cameras[2]
    near = [InBlocks(scene.frame, parts, x, torch.tensor([9.0, 9.0])) for x in (CENTRES, CENTRES.flip(0))]
    for block, told in ((method, 0.5), (brighter, -0.5)):
        expected = Placed(block.given(exposure=told), HERE).rendering(camera)
        index = int(block is brighter)
        torch.testing.assert_close(both.blocks[index].rendering(camera).rgb, expected.rgb)
    assert all(x.render(camera).rgb.isfinite().all() for x in near)
    more, most = (both.given(exposure=x) for x in (0.5, 1.5))
    assert more.blocks[0].method.settings["exposure"] == pytest.approx(1)
    assert most.blocks[0].method.settings["exposure"] == pytest.approx(1)  # no more than it learnt from
    shot = scene.photograph(0)
    taken = both.given(shot)
    assert taken.blocks[0].method.settings["exposure"] == pytest.approx(1 - stops(0), abs=1e-4)
    with pytest.raises(LumigraphError, match="does not learn"):
        both.batch(scene, torch.Generator())
    with pytest.raises(LumigraphError, match="as many centres"):
        InBlocks(scene.frame, parts, CENTRES[:1], RADII[:1])


def test_blocks_are_opened_as_a_camera_comes_near():
    opened = []

    def part(number: int) -> Placed:
        opened.append(number)
        return Placed(Witness((number / 20, 0.0, 0.0), 1.0), HERE)

    nearby = Nearby(part, 20, most=3)
    centres = torch.tensor([[4.0 * i, 0, 0] for i in range(20)])
    row = InBlocks(WHITE, nearby, centres, torch.full((20,), 5.0))
    assert opened == list(range(20))  # asked once what they can be told
    for number in (2, 15, 16):
        opened.clear()
        row.weights(eye((4.0 * number, 0.0, 0.0)))
        assert set(opened) <= {number - 1, number, number + 1}
    everywhere = row.given().weights(eye((4.0 * 15.5, 0.0, 0.0)))
    assert everywhere.nonzero()[:, 0].tolist() == [15, 16]
    opened.clear()
    assert [nearby[i].method for i in (3, 4, 5, 3)][0] is nearby[3].method and opened == [3, 4, 5]
    assert nearby[6] is not None and nearby[4] is not None and opened == [3, 4, 5, 6, 4]  # 4 was closed for 6


# One light for all


def test_alignment_recovers_a_known_change_of_light(lit):
    """Three copies of one block in a row, in frames of their own: one shows a bright photograph's light and keeps it,
    and the others come to show it, one from the other."""
    method, scene = lit
    place = Similarity.make(2.0, translation=torch.tensor([1.0, 0.0, 0.0]))
    bright, dim = (next(i for i in scene.splits["train"].tolist() if stops(i) == n) for n in (0, 2))
    parts = [Placed(method.given(appearance=name), place) for name in (bright, dim, dim)]
    cameras = scene.cameras.transformed(place.matrix)
    centres, radii = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0]]), torch.tensor([1.5, 1.5, 1.5])
    codes = align_appearance(parts, centres, radii, cameras, kept=[0])
    assert torch.equal(codes[0], method.given(appearance=bright).shown_in.code)
    camera = scene.cameras[0]
    wanted = method.given(appearance=bright).render(camera).rgb
    before = (method.given(appearance=dim).render(camera).rgb - wanted).square().mean()
    for code in codes[1:]:
        after = (method.given(Appearance(code)).render(camera).rgb - wanted).square().mean()
        assert after < 0.1 * before
    middle = align_appearance(parts, centres, radii, cameras)
    assert torch.equal(middle[1], method.given(appearance=dim).shown_in.code)


def test_blocks_without_appearance_are_aligned_to_nothing(exposed):
    method, scene = exposed
    parts = [Placed(method, HERE)] * 2
    codes = align_appearance(parts, CENTRES, RADII, scene.cameras)
    assert [len(code) for code in codes] == [0, 0]
