"""Neural scene graphs: boxes over time against geometry, files of tracks, edits, compositions, unseen instances."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from captures import Tiny, write_ngp
from PIL import Image

from lumigraph import methods, synthetic
from lumigraph.camera.rays import Rays
from lumigraph.commands.cli import main
from lumigraph.components.fields.coordinate_field import NetworkNumbers
from lumigraph.components.sampling.hierarchical_sampler import RayNumbers
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.tracks import BoxTrack, TrackEdit, TrackEdits, nodes_of
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.files.ranges import changed
from lumigraph.geometry import Similarity, rotated, to_matrix
from lumigraph.large import open_any
from lumigraph.method.field_method import FieldMethod
from lumigraph.methods import neural_scene_graph
from lumigraph.methods.neural_scene_graph import NeuralSceneGraph, found_in, prior_of
from lumigraph.methods.neural_scene_graph.nodes import PoseTable, crossings, exponential
from lumigraph.opening import open_scene, read_capture
from lumigraph.readers.tracks import read_tracks, write_tracks
from lumigraph.run import Run, build
from lumigraph.synthetic import scenes
from lumigraph.synthetic.scenes import traffic
from lumigraph.training import fit

pytestmark = budget("methods", 8)
STILL = (1.0, 0.0, 0.0, 0.0)


def about_z(degrees: float) -> tuple[float, float, float, float]:
    half = math.radians(degrees) / 2
    return math.cos(half), 0.0, 0.0, math.sin(half)


def drive(name: str = "car", turn: float = 90.0) -> BoxTrack:
    """A box that goes along x from time 1 to 3 and turns, with one rotation's quaternion negated."""
    last = tuple(-x for x in about_z(turn))
    return BoxTrack(name, "car", (4.0, 2.0, 1.0), (1.0, 3.0), ((0.0, 0.0, 0.5), (8.0, 0.0, 0.5)), (STILL, last))  # type: ignore[arg-type]


# Boxes over time


def test_a_pose_between_two_moments():
    pose = drive().pose(2.0)
    torch.testing.assert_close(pose[:, 3], torch.tensor([4.0, 0.0, 0.5]).double())
    torch.testing.assert_close(pose[:, :3], to_matrix(torch.tensor([about_z(45.0)]).double())[0], atol=1e-6, rtol=0)
    assert drive().pose(0.5) is None and drive().pose(3.5) is None and drive().pose(3.0) is not None


def test_a_table_has_the_poses_of_its_tracks():
    still = BoxTrack("post", "post", (1.0, 1.0, 2.0), (0.0,), ((1.0, 2.0, 3.0),), (about_z(30.0),))
    tracks = (drive(), still)
    times = torch.tensor([0.0, 1.0, 1.7, 3.0, 4.0])
    poses = PoseTable(nodes_of(tracks), tracks).at(times)
    for number, track in enumerate(tracks):
        for place, time in enumerate(times.tolist()):
            pose = track.pose(time)
            assert bool(poses.present[number, place]) == (pose is not None)
            if pose is not None:
                torch.testing.assert_close(poses.rotation[number, place], pose[:, :3].float(), atol=1e-5, rtol=0)
                torch.testing.assert_close(poses.position[number, place], pose[:, 3].float(), atol=1e-5, rtol=0)


def test_corrections_turn_and_shift_a_box_at_their_moments():
    tracks = (drive(turn=0.0),)
    twist = torch.zeros(1, 2, 6)
    twist[0, 1] = torch.tensor([0.0, 0.0, 0.2, 0.0, 0.25, 0.0])
    poses = PoseTable(nodes_of(tracks), tracks).at(torch.tensor([1.0, 2.0, 3.0]), twist)
    torch.testing.assert_close(poses.position[0, :, 1], torch.tensor([0.0, 0.5, 1.0]))  # lengths of the box, which is 4
    vectors = torch.eye(3)
    turned = rotated(vectors, twist[0, 1, :3].expand(3, 3))
    torch.testing.assert_close(exponential(twist[0, 1, :3]) @ vectors, turned.T)
    torch.testing.assert_close(poses.rotation[0, 2], turned.T)


def test_rays_cross_boxes_in_order_of_distance():
    near = BoxTrack("near", "a", (2.0, 2.0, 2.0), (0.0,), ((3.0, 0.0, 0.0),), (about_z(45.0),))
    far = BoxTrack("far", "a", (2.0, 2.0, 2.0), (0.0,), ((9.0, 0.0, 0.0),), (STILL,))
    tracks = (far, near)
    rays = Rays(torch.zeros(3, 3), torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [-1.0, 0, 0]]), torch.zeros(3))
    found = crossings(rays, torch.zeros(3), PoseTable(nodes_of(tracks), tracks), None, 1.0, 0.1)
    assert found.ray.tolist() == [0, 0] and found.node.tolist() == [1, 0] and found.rank.tolist() == [0, 1]
    root = math.sqrt(2)
    torch.testing.assert_close(found.enter, torch.tensor([3 - root, 8.0]))
    torch.testing.assert_close(found.leave, torch.tensor([3 + root, 10.0]))
    torch.testing.assert_close(found.origins[0], torch.tensor([-3 / root, 3 / root, 0.0]))  # in the box's axes
    wider = crossings(rays, torch.zeros(3), PoseTable(nodes_of(tracks), tracks), None, 1.5, 0.1)
    torch.testing.assert_close(wider.enter[1], torch.tensor(7.5))


# Edits


def test_edits_move_turn_add_swap_and_remove():
    small = replace(drive("small"), size=(2.0, 1.0, 0.5))
    tracks = drive("big"), small
    changes = (
        TrackEdit("big", shift=(0.0, 1.0, 0.0), turn=90.0),
        TrackEdit("small", like="big"),
        TrackEdit("new", like="small", shift=(0.0, 0.0, 2.0)),
    )
    nodes = {node.name: node for node in nodes_of(tracks, TrackEdits(changes))}
    assert nodes["big"].track.positions[0] == (0.0, 1.0, 0.5)
    quarter = to_matrix(torch.tensor([nodes["big"].track.rotations[0]]).double())[0]
    torch.testing.assert_close(quarter, to_matrix(torch.tensor([about_z(90.0)]).double())[0])
    swapped = nodes["small"].track
    assert nodes["small"].like == "big" and swapped.size == (4.0, 2.0, 1.0)
    assert swapped.positions[0][2] - 0.5 * swapped.size[2] == pytest.approx(0.5 - 0.25)  # its lower side stays
    assert nodes["new"].track.size == small.size and nodes["new"].own == "small"
    gone = nodes_of(tracks, TrackEdits((TrackEdit("big", remove=True),)))
    assert [node.name for node in gone] == ["small"]
    with pytest.raises(LumigraphError, match="no 'nobody'; there are big, small"):
        nodes_of(tracks, TrackEdits((TrackEdit("big", like="nobody"),)))
    with pytest.raises(LumigraphError, match="one category"):
        nodes_of((drive("car"), replace(drive("tree"), category="tree")), TrackEdits((TrackEdit("car", like="tree"),)))


def graph(tracks: tuple[BoxTrack, ...] = tiny.TRACKS, **config) -> NeuralSceneGraph:
    kind = methods.find("neural-scene-graph")
    frame = replace(tiny.scene().frame, tracks=tracks)
    return build(kind, frame, changed(kind.smallest(), **config), torch.device("cpu"), 0).eval()


def test_without_its_things_a_graph_is_its_background():
    method, camera = graph(), tiny.scene().cameras[1]
    rays = camera.rays(camera.pixels())
    with torch.no_grad():
        alone = FieldMethod._look(method, method.sampler.sample(rays, method.network)[-1], rays)
        (look,) = method.given(half="removed", quarter="removed").looks(rays)
        (whole,) = method.looks(rays)
    assert torch.equal(look.density, alone.density) and len(whole.samples) > len(look.samples)


def test_a_thing_moves_with_its_box():
    """Rays that are moved and turned as the box is see the same, but for colour, which knows the box's heading."""
    method = graph(pose_input="location").given(quarter="removed")
    camera = tiny.scene().cameras[2]
    rays = camera.rays(camera.pixels())
    edits = TrackEdits((TrackEdit("half", turn=30.0),))
    turn = to_matrix(torch.tensor([about_z(30.0)]))[0]
    centre = torch.tensor(tiny.TRACKS[0].positions[0])
    moved = replace(rays, origins=(rays.origins - centre) @ turn.T + centre, directions=rays.directions @ turn.T)
    with torch.no_grad():
        (first,), (second,) = method.instance_looks(rays), method.given(edits).instance_looks(moved)
    assert len(first.samples) > 100
    torch.testing.assert_close(first.samples.t_start, second.samples.t_start, atol=1e-4, rtol=0)
    torch.testing.assert_close(first.density, second.density, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(first.rgb, second.rgb, atol=1e-3, rtol=0)


def test_density_at_points_is_that_along_rays():
    method, camera = graph().given(quarter="removed"), tiny.scene().cameras[2]
    rays = camera.rays(camera.pixels())
    with torch.no_grad():
        (first, *_) = method.instance_looks(rays)
        points, directions = first.samples.along(rays)
        background = method.network.density(points)
        density, _ = method.field(points, directions)
    torch.testing.assert_close(density - background, first.density, atol=2e-2, rtol=2e-2)


def test_a_code_between_two():
    method = graph()
    half = method.given(half="half:quarter:0.25").shown_codes()[0]
    torch.testing.assert_close(half, torch.lerp(method.codes[0], method.codes[1], 0.25))
    with pytest.raises(LumigraphError, match="half=third is no choice"):
        method.given(half="third")


def test_the_papers_networks_learn():
    """One step of the preset's fields, tiny: every parameter gets a gradient."""
    network = NetworkNumbers(depth=3, skip_layer=2, position_frequencies=4)
    method = graph(field="network", network=network, rays=RayNumbers(8, 8, 128), pose_input="location").train()
    batch = method.batch(tiny.scene(), torch.Generator().manual_seed(0))
    sum(method.loss(batch, 0).values()).backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in method.parameters())
    assert method.eval().render(tiny.scene().cameras[0]).rgb.isfinite().all()


def test_a_graph_of_a_scene_without_tracks_is_refused():
    with pytest.raises(LumigraphError, match="The scene has no tracks.*put tracks.json"):
        graph(tracks=())


# Compositions


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    scene, method = tiny.scene(), graph()
    made = Run.create(tmp_path_factory.mktemp("graph") / "run", method, scene)
    fit(method, scene, made, steps=12, show=False, rehearsal=False)
    return made


def test_a_composition_holds_edits(run, tmp_path, capsys):
    file, camera = tmp_path / "edited.json", tiny.scene().cameras[3]
    command = ["compose", str(run.folder), "--remove", "quarter", "--shift", "half", "0", "0.2", "0"]
    command += ["--rotate", "half", "25", "--add", "third", "half", "0", "0", "0.4", "--output", str(file)]
    assert main(command) == 0
    edits = (
        TrackEdit("third", like="half", shift=(0.0, 0.0, 0.4)),
        TrackEdit("half", shift=(0.0, 0.2, 0.0)),
        TrackEdit("half", turn=25.0),
        TrackEdit("quarter", remove=True),
    )
    expected = run.method().given(TrackEdits(edits)).render(camera)
    seen = open_any(file).method().render(camera)
    torch.testing.assert_close(seen.rgb, expected.rgb, atol=1e-5, rtol=0)
    assert (seen.rgb - run.method().render(camera).rgb).abs().max() > 0.02
    capsys.readouterr()
    assert main(["compose", str(run.folder), "--remove", "fifth", "--output", str(tmp_path / "no.json")]) == 2
    assert "no 'fifth'; there are half, quarter" in capsys.readouterr().err


def test_edits_of_what_is_no_graph_are_refused(ball_run, tmp_path):
    said = {"format": "lumigraph composition 1", "parts": [{"source": str(ball_run.path), "edits": [{"node": "a"}]}]}
    (tmp_path / "no.json").write_text(json.dumps(said))
    with pytest.raises(LumigraphError, match="is no scene graph; train neural-scene-graph"):
        open_any(tmp_path / "no.json").method()


# Unseen instances


def test_the_code_of_an_unseen_thing_is_found_from_views(monkeypatch):
    """Pictures of a graph with a thing of a known code: the code that is found shows them again."""
    monkeypatch.setattr(neural_scene_graph, "CODE_STEPS", 50)
    monkeypatch.setattr(neural_scene_graph, "CODE_RAYS", 64)
    scene, method = tiny.scene(), graph(tracks=tiny.TRACKS[:1], symmetric=False)
    with torch.no_grad():  # a class whose looks depend on the code
        method.classes[0].table.uniform_(-1, 1, generator=torch.Generator().manual_seed(0))
        for weight in method.classes[0].density_network.weights:
            weight.mul_(2)
    mean = method.codes.detach().mean(0, keepdim=True)
    true, average = method.given(), method.given()
    true.found = tiny.TRACKS[1:], mean + torch.tensor([[0.6, -0.5, 0.4, -0.6]])
    average.found = tiny.TRACKS[1:], mean
    for told in (true, average):
        told.arrange()
    pictures = [true.render(camera).rgb for camera in (scene.cameras[i] for i in range(len(scene)))]
    images = ImageStore.from_arrays([(255 * picture.clamp(0, 1)).round().byte().numpy() for picture in pictures])
    before = {name: value.clone() for name, value in method.state_dict().items()}
    found = method.given(replace(scene, images=images, layers={}))
    assert [track.name for track in found.tracks] == ["half", "quarter"]
    assert all(torch.equal(value, before[name]) for name, value in method.state_dict().items())

    def error(graph: NeuralSceneGraph) -> float:
        return float((graph.render(scene.cameras[5]).rgb - pictures[5]).square().mean())

    assert error(found) < 0.3 * error(average)
    with pytest.raises(LumigraphError, match="has no track of piece besides half, quarter"):
        found_in(found, scene)


# Files


def test_tracks_beside_photographs(tmp_path):
    frames = Tiny()
    write_ngp(tmp_path, frames)
    path = tmp_path / "transforms.json"
    said = json.loads(path.read_text())
    for i, frame in enumerate(said["frames"]):
        frame["time"] = float(i)
    path.write_text(json.dumps(said))
    last = float(len(said["frames"]) - 1)
    seen = BoxTrack("seen", "car", (0.2, 0.1, 0.1), (0.0, last), ((0.0, 0, 0), (0.1, 0, 0)), (STILL, about_z(20.0)))
    away = replace(seen, name="away", positions=((0.0, 0, 5000.0), (0.0, 0, 5000.0)))
    write_tracks(tmp_path / "tracks.json", (seen, away))
    assert read_tracks(tmp_path / "tracks.json") == (seen, away)
    with pytest.warns(LumigraphWarning, match="the box of away is outside all photographs"):
        scene = open_scene(tmp_path)
    (track,) = scene.frame.tracks
    back = track.transformed(scene.frame.to_source)
    np.testing.assert_allclose(back.positions, seen.positions, atol=1e-5)
    np.testing.assert_allclose(back.size, seen.size, rtol=1e-5)
    assert type(scene.frame).from_json(json.loads(json.dumps(scene.frame.to_json()))) == scene.frame


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"times": [3.0, 1.0]}, "ends before it begins: its times go from 3 to 1"),
        ({"name": "a:b"}, "has a colon in its name"),
        ({"times": [3.0]}, "1 times, 2 positions and 2 rotations"),
        ({"rotations": [[0, 0, 0, 0], [1, 0, 0, 0]]}, "rotation of four zeros"),
        ({"size": [1, 1, 0]}, "size"),
    ],
)
def test_tracks_that_are_none(tmp_path, change, sentence):
    said = {"format": "lumigraph tracks 1", "tracks": [json.loads(json.dumps(asdict(drive()))) | change]}
    (tmp_path / "tracks.json").write_text(json.dumps(said))
    with pytest.raises(LumigraphError, match=sentence):
        read_tracks(tmp_path / "tracks.json")


def write_kitti(folder: Path, frames: int = 9) -> None:
    """A car 10 m ahead of a camera that drives north, one of whose wheels' middle line is 1.6 m below the camera."""
    for name in ("image_02/0006", "label_02", "calib", "oxts"):
        (folder / name).mkdir(parents=True)
    random = np.random.default_rng(0)
    for i in range(frames):
        Image.fromarray(random.integers(0, 255, (24, 80, 3), np.uint8)).save(folder / f"image_02/0006/{i:06d}.png")
    labels = [f"{i} 2 Car 0 0 -1.5 20 8 40 20 1.5 1.7 4.0 1.0 1.6 10.0 {-math.pi / 2}" for i in range(frames)]
    labels += ["0 -1 DontCare -1 -1 -10 0 0 5 5 -1 -1 -1 -1000 -1000 -1000 -10"]
    (folder / "label_02/0006.txt").write_text("\n".join(labels))
    projection = "60 0 40 -3.0 0 60 12 0 0 0 1 0"  # camera 2 is 0.05 m to the right of camera 0
    axes = "0 -1 0 0 0 0 -1 0 1 0 0 0"  # the laser's x is forward, y to the left, z up
    lines = [
        f"P2: {projection}",
        "R_rect 1 0 0 0 1 0 0 0 1",
        f"Tr_velo_cam {axes}",
        "Tr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0",
    ]
    (folder / "calib/0006.txt").write_text("\n".join(lines))
    step = math.degrees(1.0 / 6378137.0)  # a metre to the north
    rows = [f"{i * step:.12f} 8.0 100.0 0 0 {math.pi / 2}" + " 0" * 24 for i in range(frames)]
    (folder / "oxts/0006.txt").write_text("\n".join(rows))


@pytest.mark.filterwarnings("ignore:.*one and the same pose")
def test_a_drive_of_kitti(tmp_path):
    write_kitti(tmp_path)
    capture = read_capture(tmp_path / "image_02" / "0006")
    assert len(capture.shots) == 9 and capture.shots[4].time == 4.0
    pose = capture.shots[4].pose
    np.testing.assert_allclose(pose[:, 2], (0, 1, 0), atol=1e-6)  # it looks north
    np.testing.assert_allclose(pose[:, 1], (0, 0, -1), atol=1e-6)
    np.testing.assert_allclose(pose[:, 3], (0.05, 4.0, 0), atol=1e-3)
    (car,) = capture.tracks
    assert (car.name, car.category, car.size) == ("Car 2", "Car", (4.0, 1.7, 1.5))
    np.testing.assert_allclose(car.positions[4], (1.0, 14.0, 0.75 - 1.6), atol=1e-3)
    box = car.pose(4.0)
    np.testing.assert_allclose(box[:, 0], (0, 1, 0), atol=1e-6)  # it drives north as well
    np.testing.assert_allclose(box[:, 2], (0, 0, 1), atol=1e-6)
    (tmp_path / "oxts/0006.txt").unlink()
    still = read_capture(tmp_path)
    np.testing.assert_allclose(still.shots[3].pose[:, 3], (0.05, 0, 0), atol=1e-6)
    np.testing.assert_allclose(still.tracks[0].positions[3], (1.0, 1.6 - 0.75, 10.0), atol=1e-6)
    scene = open_scene(tmp_path)
    assert len(scene.frame.tracks) == 1 and scene.frame.is_open


@pytest.mark.parametrize(
    ("file", "text", "sentence"),
    [
        ("label_02/0006.txt", "0 2 Car 0 0", "17 columns were looked for"),
        ("calib/0006.txt", "P0: 1", "no P2"),
        ("oxts/0006.txt", "49 8 100 0 0 0", "1 lines, and none for 000001.png"),
    ],
)
def test_a_drive_with_a_fault(tmp_path, file, text, sentence):
    write_kitti(tmp_path, 2)
    (tmp_path / file).write_text(text)
    with pytest.raises(LumigraphError, match=sentence):
        read_capture(tmp_path)


# Procedural traffic


def test_boxes_of_traffic_hold_their_cars_alone():
    stage = scenes.stage("traffic", size=32, views=5, seed=3)
    camera = stage.cameras["test"][0]
    world, rays = stage.world_of(camera), camera.rays(camera.pixels())
    seen = synthetic.trace(world, rays, shaded=False)
    points = rays.origins.double().numpy() + np.nan_to_num(seen.depth, posinf=9.0)[:, None] * rays.directions.numpy()
    found = 0
    for track in stage.tracks:
        pose = track.pose(float(camera.time)).numpy()
        own = seen.identity == world.names.index(track.name)
        shares = np.abs((points - pose[:, 3]) @ pose[:, :3]) / (0.5 * np.array(track.size))
        assert shares[own].max(initial=0) < 1 + 1e-4
        found += own.sum()
        others = (seen.identity >= 0) & ~own
        assert (shares[others].max(-1) > 1 - 1e-2).all()
    assert found > 50


def test_the_truth_of_an_edited_scene():
    stage = scenes.stage("traffic", size=16, views=5)
    time = 0.25
    same = {(o.name, o.shape, o.material) for o in traffic.with_edits(stage, TrackEdits(()), time).objects}
    assert same == {(o.name, o.shape, o.material) for o in stage.moving(time).objects}
    edits = TrackEdits((TrackEdit("car 1", shift=(0.1, 0, 0)), TrackEdit("car 2", remove=True)))
    moved = traffic.with_edits(stage, edits, time)
    assert "car 2" not in moved.names
    parts = ([o for o in world.objects if o.name == "car 1"] for world in (moved, stage.moving(time)))
    for after, before in zip(*parts, strict=True):
        np.testing.assert_allclose(after.pose.position, np.array(before.pose.position) + (0.1, 0, 0), atol=1e-3)


def test_tracks_follow_a_change_of_frame():
    turn = to_matrix(torch.tensor([about_z(90.0)]).double())[0]
    moved = drive().transformed(Similarity.make(2.0, turn, torch.tensor([1.0, 0, 0]).double()))
    assert moved.size == pytest.approx((8.0, 4.0, 2.0))
    np.testing.assert_allclose(moved.positions[1], (1.0, 16.0, 1.0), atol=1e-9)
    np.testing.assert_allclose(moved.pose(1.0)[:, 0], (0, 1, 0), atol=1e-6)


def test_the_prior_of_codes_is_the_releases():
    """latentReg: 1e-4 times the sum of norms, 5 and 13; the mean square with tables is ours."""
    codes = torch.tensor([[3.0, 4.0], [5.0, 12.0]])
    assert float(prior_of(codes, NeuralSceneGraph.Config())) == pytest.approx(1e-4 * (5 + 13))
    small = NeuralSceneGraph.cpu_preset()
    assert float(prior_of(codes, small)) == pytest.approx(1e-3 * (9 + 16 + 25 + 144) / 4)
