"""Selecting by strokes: what is distilled onto points, how a part grows, what is cut, and what comes of it."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import tiny
import torch
from balls import BLUE, RED, WHITE, Dense, Splatted, eye
from budgets import budget
from PIL import Image
from scipy.sparse import csr_matrix, diags_array

from lumigraph import selection
from lumigraph.commands.cli import main
from lumigraph.composition import Placed, VoxelMask, compose, cropped, mask_of, read_mask
from lumigraph.datasets.scene import Photograph
from lumigraph.errors import LumigraphError
from lumigraph.gaussians import Gaussians
from lumigraph.gaussians.cloud import BAND_0
from lumigraph.geometry import Similarity
from lumigraph.large import open_any
from lumigraph.opening import open_scene
from lumigraph.run import Run
from lumigraph.selection import Selection, Strokes, describe, distil_features, feature_network, read_strokes
from lumigraph.selection.cutting import UNKNOWN_COLOUR, closed, cut, motion, tinted
from lumigraph.selection.distilled import SelectionGrid, weigher_of
from lumigraph.selection.growth import clusters, walked
from lumigraph.training import fit

pytestmark = budget("capture", 8)

EYES = (-3.0, 0.3, 0.8), (0.2, -3.0, 0.5), (3.0, 0.2, 0.3), (-0.3, 3.0, 0.9)


def two_balls(kind):
    """A red and a blue ball that touch."""
    one = Similarity.make(1.0)
    balls = kind(RED, 0.35, (0.0, -0.34, 0.0)), kind(BLUE, 0.35, (0.0, 0.34, 0.0))
    return compose(WHITE, [Placed(balls[0], one, leads=True), Placed(balls[1], one)])


@pytest.fixture(scope="module", params=[Splatted, Dense], ids=["cloud", "field"])
def balls(request):
    """The method, and points with the features of its own pictures."""
    method = two_balls(request.param)
    cameras = [eye(place) for place in EYES]
    photographs = [Photograph(camera, method.render(camera).rgb) for camera in cameras]
    return method, distil_features(method, photographs, describe), cameras


def strokes(camera, place, radius=5, wanted=True):
    """A dab around a point of the scene."""
    (row, column), _ = (x[0] for x in camera.locate(torch.tensor([place])))
    pixels = torch.zeros(int(camera.size[0, 1]), int(camera.size[0, 0]), dtype=torch.bool)
    pixels[int(row) - radius : int(row) + radius + 1, int(column) - radius : int(column) + radius + 1] = True
    none = torch.zeros_like(pixels)
    return Strokes(camera, pixels, none) if wanted else Strokes(camera, none, pixels)


def test_weights_of_points_sum_to_opacity(balls):
    method, _, cameras = balls
    weigher = weigher_of(method)
    ones = torch.ones(*cameras[0].size[0].flip(0).tolist(), 1)
    opacity = method.render(cameras[0]).opacity
    assert weigher.sums(cameras[0], ones).sum() == pytest.approx(float(opacity.sum()), rel=1e-3)
    count = len(weigher.sums(cameras[0], ones))
    assert torch.allclose(weigher.shown(cameras[0], torch.ones(count)), opacity, atol=2e-3)


def test_distilled_features_are_weighted_means(balls):
    method, _, cameras = balls
    pictures = [Photograph(c, torch.full((*c.size[0].flip(0).tolist(), 3), 0.1 * i)) for i, c in enumerate(cameras)]
    found = distil_features(method, pictures, lambda rgb: rgb[..., :1])
    assert found.features[found.is_seen].min() >= -1e-5 and found.features.max() <= 0.3 + 1e-5
    weigher = weigher_of(method)
    weights = torch.stack([weigher.sums(x.camera, torch.ones_like(x.rgb[..., :1]))[:, 0] for x in pictures])
    weights = weights if found.voxels is None else weights[:, found.voxels]
    expected = (weights * 0.1 * torch.arange(4)[:, None]).sum(0) / weights.sum(0).clamp_min(0.05)
    assert torch.allclose(found.features[found.is_seen, 0], expected[found.is_seen], atol=1e-4)


def test_a_stroke_selects_one_of_two_balls_and_undo_takes_it_back(balls):
    method, points, cameras = balls
    chosen = Selection(method, points)
    assert len(chosen) == 0 and not chosen.chosen().any()
    chosen.add(strokes(cameras[0], (-0.3, -0.4, 0.0)))
    part = chosen.chosen()
    alone = two_balls(type(method.pieces[0].method)).pieces[0]
    for camera in cameras:
        blue = (alone.method.render(camera).opacity > 0.5) & (method.render(camera).rgb[..., 0] > 0.5)
        found = (chosen.mask(camera, part) > 0.5) | (method.render(camera).opacity < 0.5)
        truth = blue | (method.render(camera).opacity < 0.5)
        assert (found != truth).float().mean() < 0.03
    chosen.add(strokes(cameras[0], (-0.3, 0.4, 0.0)))
    assert chosen.chosen().sum() > 1.5 * part.sum()
    chosen.undo()
    assert torch.equal(chosen.chosen(), part)


def test_unwanted_strokes_hold_the_part_back(balls):
    method, points, cameras = balls
    chosen = Selection(method, points)
    for place in ((-0.3, -0.4, 0.0), (-0.3, 0.4, 0.0)):
        chosen.add(strokes(cameras[0], place))
    both = chosen.chosen().sum()
    chosen.add(strokes(cameras[2], (0.3, 0.4, 0.0), wanted=False))
    assert chosen.chosen().sum() < both


def test_strokes_on_nothing_are_refused(balls):
    method, points, cameras = balls
    none = torch.zeros(*cameras[0].size[0].flip(0).tolist(), dtype=torch.bool)
    corner = none.clone()
    corner[:3, :3] = True
    with pytest.raises(LumigraphError, match="strokes are on nothing"):
        Selection(method, points).add(Strokes(cameras[0], corner, none))


def test_a_random_walk_between_two_seeds_is_linear():
    """The harmonic function on a chain, where no match speaks; with a match alone it is the match."""
    chain = csr_matrix(diags_array([np.ones(10), np.ones(10)], offsets=[-1, 1]))
    found = walked(chain, np.full(11, 0.5), np.array([0]), np.array([10]), 0.0)
    assert np.allclose(found, np.linspace(1, 0, 11), atol=1e-3)
    prior = np.random.default_rng(0).uniform(size=11)
    strong = walked(chain, prior, np.array([], int), np.array([], int), 1e6)
    assert np.allclose(strong, prior, atol=1e-4)


def test_clusters_are_those_of_the_strokes():
    features = np.array([[0.0, 0.0]] * 20 + [[5.0, 0.0]] * 20 + [[9.0, 9.0]] * 5)
    found = clusters(features, np.arange(40))
    assert np.allclose(np.unique(found, axis=0), [[0, 0], [5, 0]])


def test_descriptors_tell_colour_from_shade_and_texture():
    picture = torch.full((32, 32, 3), 0.5)
    picture[:, 16:, 2] = 0.9
    colour = (describe(picture)[16, 4] - describe(picture)[16, 28]).norm()
    shaded = picture.clone()
    shaded[:, 16:] = 0.6
    shade = (describe(shaded)[16, 4] - describe(shaded)[16, 28]).norm()
    checks = torch.full((32, 32, 3), 0.5)
    checks[::2, ::2] = checks[1::2, 1::2] = 0.8
    plain = torch.full((32, 32, 3), 0.65)
    texture = (describe(checks) - describe(plain))[16, 16, 9:].norm()
    assert colour > 2 * shade and texture > 0.2


# Strokes of a file


def drawn(path, size, pixels):
    picture = np.zeros((size[1], size[0], 4), np.uint8)
    for (row, column), colour in pixels.items():
        picture[row, column] = (*colour, 255)
    Image.fromarray(picture).save(path)
    return path


def test_strokes_are_read_by_colour(tmp_path):
    camera = eye(EYES[0])
    size = tuple(camera.size[0].tolist())
    path = drawn(tmp_path / "s.png", size, {(2, 3): (0, 255, 0), (4, 5): (255, 0, 0), (6, 7): (0, 0, 255)})
    found = read_strokes(path, camera, "a")
    assert found.wanted.nonzero().tolist() == [[2, 3]] and found.unwanted.nonzero().tolist() == [[4, 5]]
    segments = torch.zeros(size[1], size[0], dtype=torch.int64)
    segments[:, 3], segments[:, 5] = 1, 2
    over = found.over(segments)
    assert over.wanted.sum() == over.unwanted.sum() == size[1] and over.wanted[:, 3].all()


@pytest.mark.parametrize(
    ("size", "pixels", "sentence"),
    [((9, 9), {(1, 1): (0, 255, 0)}, "is 9x9 pixels, and the view a is"), (None, {}, "has no strokes")],
)
def test_strokes_that_cannot_be_are_refused(tmp_path, size, pixels, sentence):
    camera = eye(EYES[0])
    path = drawn(tmp_path / "s.png", size or tuple(camera.size[0].tolist()), pixels)
    with pytest.raises(LumigraphError, match=sentence):
        read_strokes(path, camera, "a")


def test_segments_that_match_no_photograph_are_refused(tmp_path):
    with pytest.raises(LumigraphError, match="named after photo.jpg"):
        selection.read_segments(tmp_path, "photo.jpg", eye(EYES[0]))
    Image.fromarray(np.zeros((5, 5), np.uint8)).save(tmp_path / "photo.png")
    with pytest.raises(LumigraphError, match="is 5x5 pixels"):
        selection.read_segments(tmp_path, "photo.jpg", eye(EYES[0]))


# Feature networks of files


def weights():
    chance = torch.Generator().manual_seed(0)
    shapes = {"0": (6, 3, 3, 3), "2": (14, 6, 3, 3)}
    made = {f"{n}.weight": torch.randn(shape, generator=chance) for n, shape in shapes.items()}
    return made | {f"{n}.bias": torch.randn(shape[0], generator=chance) for n, shape in shapes.items()}


def onnx_file(path, tensors):
    """The two convolutions as an ONNX file of open size."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    helper = onnx.helper
    constants = [onnx.numpy_helper.from_array(x.numpy(), name) for name, x in tensors.items()]
    padded = {"pads": [1, 1, 1, 1], "kernel_shape": [3, 3]}
    nodes = [
        helper.make_node("Conv", ["x", "0.weight", "0.bias"], ["a"], **padded),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Conv", ["b", "2.weight", "2.bias"], ["y"], **padded),
    ]
    kind = onnx.TensorProto.FLOAT
    taken = helper.make_tensor_value_info("x", kind, [1, 3, "h", "w"])
    given = helper.make_tensor_value_info("y", kind, [1, 14, "h", "w"])
    graph = helper.make_graph(nodes, "g", [taken], [given], constants)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)
    return path


def test_networks_of_both_kinds_of_files_agree(tmp_path):
    made, chance = weights(), torch.Generator().manual_seed(1)
    pictures = [torch.rand(112, 112, 3, generator=chance) for _ in range(2)]
    safetensors.torch.save_file(made, tmp_path / "n.safetensors")
    one = feature_network(tmp_path / "n.safetensors", pictures)(pictures[0])
    other = feature_network(onnx_file(tmp_path / "n.onnx", made), pictures)(pictures[0])
    assert one.shape[:2] == (112, 112) and one.isfinite().all()
    assert torch.allclose(one.abs(), other.abs(), atol=2e-2)  # axes have a sign of their own
    assert one[..., :12].std() > 0.3


def test_files_that_are_no_networks_are_refused(tmp_path, monkeypatch):
    (tmp_path / "n.safetensors").write_text("no")
    with pytest.raises(LumigraphError, match="is no safetensors file"):
        feature_network(tmp_path / "n.safetensors", [])
    safetensors.torch.save_file({"0.weight": torch.zeros(4, 5, 3, 3)}, tmp_path / "m.safetensors")
    with pytest.raises(LumigraphError, match="does not follow on 3 channels"):
        feature_network(tmp_path / "m.safetensors", [])
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(LumigraphError, match=r"lumigraph\[onnx\]"):
        feature_network(tmp_path / "n.onnx", [])


# Cutting


def test_a_part_and_the_rest_are_the_cloud_and_hidden_gaussians_are_grey():
    method = two_balls(Splatted)
    cloud = method.gaussians()
    inner = replace(cloud[:5], means=torch.tensor([[0.0, -0.34, 0.0]]).repeat(5, 1))
    names = ("means", "quaternions", "log_scales", "opacities", "harmonics")
    whole = Gaussians(**{name: torch.cat([getattr(x, name) for x in (cloud, inner)]) for name in names})
    seen = torch.ones(len(whole))
    seen[-5:] = 0
    points = selection.Distilled(whole.means, torch.zeros(len(whole), 1), seen)
    chosen = whole.harmonics[:, 0, 0] > 0
    pieces = cut(whole, chosen, points)
    counts = int(chosen.sum()), int((~chosen).sum())
    assert len(pieces.part) >= counts[0] and len(pieces.rest) >= counts[1]
    grey = 0.5 + BAND_0 * pieces.part.harmonics[: counts[0], 0]
    assert torch.allclose(grey[-5:], torch.tensor(UNKNOWN_COLOUR).expand(5, -1), atol=1e-5)
    assert (grey[:-5] - torch.tensor(RED)).abs().max() < 1e-4


def test_what_lay_under_an_object_is_closed_in_grey():
    """A floor with a round hole in it: discs fill the hole and nothing else."""
    axis = np.arange(-1, 1.01, 0.05)
    floor = np.stack(np.meshgrid(axis, axis, [0.0]), -1).reshape(-1, 3)
    own = floor[np.linalg.norm(floor, axis=1) > 0.4]
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    perimeter = 0.4 * np.stack([np.cos(angle), np.sin(angle), 0.001 * np.cos(9 * angle)], -1)
    discs = closed(perimeter, own, Splatted(RED).cloud)
    assert discs is not None and len(discs) > 50
    assert discs.means.norm(dim=-1).max() < 0.41 and discs.means[:, 2].abs().max() < 0.01
    assert torch.allclose(0.5 + BAND_0 * discs.harmonics[:, 0], torch.tensor(UNKNOWN_COLOUR), atol=1e-5)
    bent = perimeter + np.stack([0 * angle, 0 * angle, 0.3 * np.cos(3 * angle)], -1)
    assert closed(bent, own, Splatted(RED).cloud) is None
    assert closed(perimeter, floor, Splatted(RED).cloud) is None


def test_a_tint_keeps_light_and_shade():
    cloud = Splatted(RED, degree=1).cloud
    cloud.harmonics[::2, 0] *= 0.5
    made = tinted(cloud, (0.2, 0.4, 0.8))
    colours = (0.5 + BAND_0 * made.harmonics[:, 0]).clamp(0, 1)
    assert torch.allclose(colours.mean(0), torch.tensor([0.2, 0.4, 0.8]), atol=0.02)
    before = (0.5 + BAND_0 * cloud.harmonics[:, 0]) @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert np.corrcoef(before.numpy(), colours[:, 2].numpy())[0, 1] > 0.999


def test_a_motion_turns_about_the_part():
    points = torch.tensor([[1.0, 2.0, 0.0], [1.0, 2.0, 1.0], [1.0, 2.0, 3.0]])
    moved = motion(points, (0.0, 0.0, 0.5), 90).points(torch.tensor([[2.0, 2.0, 0.0]]))
    assert torch.allclose(moved.float(), torch.tensor([[1.0, 3.0, 0.5]]), atol=1e-6)


# Parts of fields


def halves() -> VoxelMask:
    grid = SelectionGrid.over(WHITE, 20)
    chosen = torch.zeros(grid.count, dtype=torch.bool)
    index = torch.arange(grid.count)
    chosen[grid.middles(index)[:, 1] < 0] = True
    seen = np.ones(grid.size, bool)
    return mask_of(chosen.view(grid.size).numpy(), seen, grid.lower, grid.edge)


def test_the_inside_and_the_outside_of_a_mask_are_the_field(tmp_path):
    halves().write(tmp_path / "m.safetensors")
    mask, whole, camera = read_mask(tmp_path / "m.safetensors"), two_balls(Dense), eye((-3.0, 0.0, 0.0))
    inside, outside = (cropped(whole, replace(mask, outside=x)).render(camera) for x in (False, True))
    seen = whole.render(camera)
    assert torch.allclose(inside.opacity + outside.opacity, seen.opacity, atol=0.05)
    assert (inside.rgb[inside.opacity > 0.99][:, 0] > 0.8).float().mean() > 0.97
    assert (outside.rgb[outside.opacity > 0.99][:, 0] < 0.2).float().mean() > 0.9  # but for the seam
    place = Similarity.make(1.0, None, torch.tensor([0.0, 0.5, 0.0]))
    moved = mask.transformed(place)
    assert (
        moved.holds(torch.tensor([[0.0, 0.4, 0.0]])).item() and not moved.holds(torch.tensor([[0.0, 0.6, 0.0]])).item()
    )


def test_voxels_that_nobody_saw_are_grey():
    mask = halves()
    unseen = replace(mask, observed=torch.zeros_like(mask.observed))
    seen = cropped(two_balls(Dense), unseen).render(eye((-3.0, 0.0, 0.0)))
    assert torch.allclose(seen.rgb[seen.opacity > 0.99], torch.tensor(UNKNOWN_COLOUR), atol=0.02)


def test_hidden_voxels_go_with_the_nearest_seen_ones():
    seen, chosen = np.zeros((5, 1, 1), bool), np.zeros((5, 1, 1), bool)
    seen[0] = seen[4] = chosen[4] = True
    assert mask_of(chosen, seen, (0, 0, 0), 1.0).part.flatten().tolist() == [0, 0, 0, 1, 1]


@pytest.mark.parametrize("content", [b"no", safetensors.torch.save({"object": torch.zeros(2, 2)})])
def test_a_damaged_mask_is_refused(tmp_path, content):
    (tmp_path / "m.safetensors").write_bytes(content)
    with pytest.raises(LumigraphError, match="no mask of voxels"):
        read_mask(tmp_path / "m.safetensors")


# The command


@pytest.fixture
def trained(ball_folder, tmp_path, monkeypatch):
    """The run of the tiny scene with its photographs, and a stroke on the middle of one of them."""
    monkeypatch.chdir(tmp_path)
    scene = open_scene(ball_folder)
    method = tiny.method(scene.frame)
    run = Run.create(tmp_path / "ball", method, scene)
    fit(method, scene, run, steps=40, show=False, rehearsal=False)
    camera = scene.cameras[1]
    size = tuple(camera.size[0].tolist())
    drawn(tmp_path / "s.png", size, {(r, c): (0, 255, 0) for r in range(10, 15) for c in range(10, 15)})
    return run, scene


def test_segment_cuts_a_field_into_a_composition(trained, capsys):
    run, scene = trained
    name, said = scene.names[1], ["segment", "ball", "--strokes", "s.png"]
    assert main([*said, "--view", name, "--output", "rest.json", "--action", "delete"]) == 0
    part = json.loads(Path("rest.json").read_text())["parts"][0]
    assert part["keep"] == "outside" and part["mask"] == "rest.mask.safetensors"
    whole, rest = run.method(), open_any("rest.json").method()
    seen, left = (x.render(scene.cameras[1]) for x in (whole, rest))
    assert left.opacity[12, 12] < seen.opacity[12, 12]
    assert Image.open("rest.json.png").size[0] > 100
    for given, sentence in (
        (["--view", "nothing", "--output", "a.json"], "has no photograph 'nothing'"),
        (["--view", name, "--output", "a.ply"], "should end in .json"),
        (["--view", name, "--output", "a.json", "--action", "recolour"], "convert the run"),
        (["--view", name, "--output", "a.json", "--masks", "."], "None of the masks"),
    ):
        capsys.readouterr()
        assert main([*said, *given]) == 2
        assert sentence in capsys.readouterr().err
    assert main([*said, "--view", name, "--output", "labels", "--action", "masks"]) == 0
    stems = {name.rsplit("/")[-1].removesuffix(".png") for name in scene.names}
    assert {p.stem for p in Path("labels").rglob("*.png")} == stems
