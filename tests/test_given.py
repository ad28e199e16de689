"""What a trained method can be told: controls by name, on the command line, in films, a moment; and refined cameras."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph import synthetic as procedural
from lumigraph.camera import Camera
from lumigraph.camera.rays import Rays
from lumigraph.commands.cli import main
from lumigraph.components.training.development import decoded, encoded
from lumigraph.components.training.photometric import brighter, gain_between, spread_of_exposure
from lumigraph.datasets.images import ImageStore
from lumigraph.datasets.scene import Frame
from lumigraph.depth_maps.flat_view import FlatView
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.evaluation.halves import judged_by_halves, left_half
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.export.film import animated
from lumigraph.files.ranges import changed
from lumigraph.method.controls import Control, moment
from lumigraph.methods.instant_ngp import Config, InstantNGP
from lumigraph.opening import open_scene
from lumigraph.paths.keyframes import CameraPath, Keyframe
from lumigraph.run import Run, build
from lumigraph.synthetic.scenes import swing
from lumigraph.training import fit
from lumigraph.volume import composite

pytestmark = budget("capture", 10)

SMALL = changed(
    Config(),
    levels=4,
    log2_hashmap_size=10,
    base_resolution=4,
    max_resolution=24,
    hidden_width=16,
    sh_bands=2,
    samples_per_step=2048,
    steps_per_diagonal=96,
    occupancy_resolution=16,
)


def moving_scene():
    """The ball, taken from 2 to 5, in whatever unit."""
    scene = tiny.scene()
    time = torch.linspace(2, 5, len(scene))
    return replace(scene, cameras=replace(scene.cameras, time=time), frame=replace(scene.frame, times=(2.0, 5.0)))


def two_moments(frame: Frame | None = None):
    kind = methods.find("two-moments")
    return build(kind, frame or moving_scene().frame, kind.Config(), torch.device("cpu"), 0).eval()


def ngp(scene, **options) -> InstantNGP:
    return build(InstantNGP, scene.frame, changed(SMALL, **options), torch.device("cpu"), 0).eval()


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Run:
    """A run of the method with two moments, trained for a moment itself."""
    scene = moving_scene()
    run = Run.create(tmp_path_factory.mktemp("given") / "run", two_moments(scene.frame), scene)
    fit(run.new_method(), scene, run, steps=3, show=False)
    return run


# Given


def test_what_is_told_shares_all_weights_and_leaves_the_first_alone():
    method, camera = two_moments(), tiny.scene().cameras[0]
    before, state = method.render(camera).rgb, {name: x.clone() for name, x in method.state_dict().items()}
    told = method.given(brightness=0.5)
    again = told.given(ink="grey", brightness=0.25)
    assert told.settings == {"brightness": 0.5} and again.settings == {"brightness": 0.25, "ink": "grey"}
    assert method.settings == {} and told.grids is method.grids is again.grids
    assert method.state_dict().keys() == again.state_dict().keys() == state.keys()
    seen = again.render(camera)
    assert (seen.rgb.amax(-1) - seen.rgb.amin(-1)).max() < 1e-5 and not torch.equal(seen.rgb, before)
    assert torch.equal(method.render(camera).rgb, before)
    assert all(torch.equal(x, state[name]) for name, x in method.state_dict().items())
    with torch.no_grad():
        method.grids.add_(0.3)  # what is learnt later is seen through both
    assert torch.equal(method.given().render(camera).rgb, method.render(camera).rgb)
    assert not torch.equal(told.render(camera).rgb, method.given(brightness=0.5).render(camera).rgb * 0.9)


def test_what_is_set_on_a_told_method_stays_its_own():
    method = two_moments()
    told = method.given()
    told.grids = torch.nn.Parameter(torch.zeros(1))
    told.register_buffer("code", torch.zeros(2))
    told.figures["mse"] = 1.0
    assert method.grids.numel() > 1 and not hasattr(method, "code") and method.figures == {}


def test_what_a_method_cannot_be_told():
    method = two_moments()
    for fault, given in (
        ("no control 'contrast'; there are: brightness, ink, time", {"contrast": 1}),
        ("brightness=3 cannot be; give a number from 0 to 2", {"brightness": 3}),
        ("brightness=bright cannot be", {"brightness": "bright"}),
        ("brightness=nan cannot be", {"brightness": "nan"}),
        ("ink=blue is no choice; there are: colour, grey", {"ink": "blue"}),
        ("time=6 cannot be; give a number from 2 to 5", {"time": 6}),
    ):
        with pytest.raises(LumigraphError, match=fault):
            method.given(**given)
    with pytest.raises(LumigraphError, match="VoxelGrid has no control 'brightness'; it has none"):
        tiny.method().given(brightness=1)
    with pytest.raises(LumigraphError, match="cannot be given a Camera; it takes nothing but its controls"):
        method.given(tiny.scene().cameras[0])


def test_values_between_stations():
    number, choice = Control("x", 0.0, (0.0, 10.0)), Control("y", "a", choices=("a", "b", "c"))
    assert number.over(["0", "10"], 5) == [0, 2.5, 5, 7.5, 10]
    assert number.over([0, 10, 0], 5) == [0, 5, 10, 5, 0]
    assert number.over([3, 7], 1) == [3] and number.over([4], 3) == [4, 4, 4]
    assert choice.over(["a", "c", "b"], 7) == ["a", "a", "a", "c", "c", "b", "b"]
    with pytest.raises(LumigraphError, match="x=11 cannot be"):
        number.over([0, 11], 2)
    many = Control("z", "0", choices=tuple(map(str, range(100))))
    assert many.domain == "0, 1, 2, 3, 4, 5, 6, ..., 99" and many.checked(7) == "7"


# Time


def test_a_moment_is_told_else_the_cameras_else_the_first():
    scene = moving_scene()
    method, camera = two_moments(), scene.cameras[-1:]
    timeless = replace(camera, time=None)
    assert camera.rays(camera.pixels()).time.unique().tolist() == [5.0]
    first, last = (method.given(time=t).render(timeless).rgb for t in (2, 5))
    assert not torch.allclose(first, last, atol=0.01)
    assert torch.equal(method.render(timeless).rgb, first)  # by default
    assert torch.equal(method.render(camera).rgb, last)  # as the camera says
    assert torch.equal(method.given(time=2).render(camera).rgb, first)  # as told, whatever the camera says
    ngp_method = ngp(scene)  # a method for still scenes sees the same at any time
    assert torch.equal(ngp_method.render(camera).rgb, ngp_method.render(timeless).rgb)


def test_times_of_a_frame_survive_and_older_frames_have_none():
    frame = moving_scene().frame
    plain = json.loads(json.dumps(frame.to_json()))
    assert Frame.from_json(plain) == frame and frame.times == (2.0, 5.0)
    del plain["times"]
    assert Frame.from_json(plain).times is None


def test_the_pendulum_stays_within_its_bounds_and_away_from_cameras():
    stage = procedural.scenes.stage("swing", size=16, views=20)
    positions = torch.cat([cameras.position for cameras in stage.cameras.values()])
    for time in np.linspace(0, 1, 5).tolist():
        low, high = stage.moving(time).bounds()
        assert (low >= stage.bounds[0]).all() and (high <= stage.bounds[1]).all()
        assert procedural.signed_distance(stage.moving(time), positions).min() > stage.near


def ball_centre(time: float) -> tuple[float, float, float]:
    """Centre of the swing's ball, by the pendulum's angle."""
    x, y, z = swing.PIVOT
    swung = math.radians(swing.angle(time))
    return x + swing.ROD_LENGTH * math.sin(swung), y, z - swing.ROD_LENGTH * math.cos(swung)


def test_a_moving_scene_is_photographed_at_its_times(tmp_path):
    scene = open_scene("procedural:swing,size=32,views=6")
    assert scene.frame.times == (0.0, 1.0)
    assert sorted(scene.cameras.time[scene.splits["train"]].tolist()) == pytest.approx(np.linspace(0, 1, 6))
    stage = procedural.scenes.stage("swing", size=32, views=6)
    camera = stage.cameras["test"]
    for time in (0.0, 0.5, 1.0):  # the ball is where the pendulum's angle says
        seen = procedural.render(stage.world_of(replace(camera[0], time=torch.tensor([time]))), camera[0])
        ball = seen.extra["ids"] == stage.world.names.index("ball")
        found = camera[0].rays(camera[0].pixels()).at(seen.depth.flatten())[ball.flatten()]
        away = (found - torch.tensor(ball_centre(time))).norm(dim=-1)
        assert len(away) > 8 and (away - 0.2).abs().max() < 1e-3
    for index in scene.splits["test"].tolist():  # and so is the layer of labels, of each photograph at its own moment
        shot = scene.photograph(index, layers=["labels", "depth"])
        ball = (shot.extra["labels"] == stage.world.names.index("ball")).flatten()
        found = shot.camera.rays(shot.camera.pixels()).at(shot.extra["depth"].flatten())[ball]
        centre = torch.tensor(ball_centre(float(shot.camera.time)))
        assert len(found) > 8 and ((found - centre).norm(dim=-1) - 0.2).abs().max() < 1e-3
    procedural.write_blender(stage, tmp_path / "swing", truth=False)
    again = open_scene(tmp_path / "swing")
    assert again.frame.times == (0.0, 1.0)
    for split in ("train", "test"):
        assert torch.equal(again.cameras.time[again.splits[split]], scene.cameras.time[scene.splits[split]])
    assert open_scene("procedural:still-life,size=16,views=2").frame.times is None


def test_keyframes_carry_times(tmp_path):
    pose = tuple(map(tuple, torch.eye(3, 4).tolist()))
    keys = [Keyframe(pose, 50.0, seconds, time) for seconds, time in ((0.0, 2.0), (1.0, 5.0), (3.0, 4.0))]
    path = CameraPath(tuple(keys), fps=2.0)
    path.save(tmp_path / "path.json")
    assert CameraPath.load(tmp_path / "path.json") == path
    assert path.cameras(Frame(), (8, 8)).time.tolist() == [2.0, 3.5, 5.0, 4.75, 4.5, 4.25, 4.0]
    assert replace(path, loop=True).times_at(torch.tensor([0.0, 3.75, 4.5])).tolist() == [2.0, 3.0, 2.0]
    with pytest.raises(LumigraphError, match="Some keyframes have a time"):
        CameraPath((keys[0], replace(keys[1], time=None)))
    still = CameraPath(tuple(replace(key, time=None) for key in keys))
    still.save(tmp_path / "still.json")
    assert "time" not in (tmp_path / "still.json").read_text() and still.cameras(Frame(), (8, 8)).time is None


# Exposure and refined cameras


def two_exposures():
    """The ball, cut out, each picture taken twice, the second time half as bright."""
    scene = tiny.scene(6)
    pictures = [tiny.picture(pose) for pose in scene.cameras.pose]
    half = [np.concatenate([picture[..., :3] // 2, picture[..., 3:]], -1) for picture in pictures]
    index = torch.arange(12)
    return replace(
        scene,
        cameras=replace(Camera.cat([scene.cameras, scene.cameras]), image_index=index),
        images=ImageStore.from_arrays([*pictures, *half]),
        frame=replace(scene.frame, background=(0.0, 0.0, 0.0), image_count=12),
        splits={"train": index},
        names=[f"ball_{i}" for i in range(12)],
    )


class QuickGains(InstantNGP):
    """Gains learn 100 times as fast as they do, so that few steps are enough."""

    def optimizers(self):
        *others, gains = super().optimizers()
        gains.param_groups[0]["scale"] *= 100
        return [*others, gains]


def test_gains_are_learnt_and_an_exposure_multiplies_light():
    """Gains are of encoded colours, as photographs have them; a stop doubles the light."""
    scene = two_exposures()
    config = changed(SMALL, learning_rate=2e-2, samples_per_step=1024, steps_per_diagonal=24, exposure_correction="yes")
    method = build(QuickGains, scene.frame, config, torch.device("cpu"), 0)
    assert [control.name for control in method.controls] == ["exposure", "exposed_as"]
    fit(method, scene, steps=80, show=False)
    log_gain = method.exposure.log_gain.detach()
    doublings = log_gain.mean(-1) / math.log(2)
    apart = doublings[:6] - doublings[6:]
    assert float(apart.mean()) == pytest.approx(1, abs=0.25) and apart.min() > 0.5
    camera = scene.cameras[0]
    plain, bright, dark, average = (
        method.given(**given).render(camera).rgb
        for given in ({}, {"exposed_as": 0}, {"exposed_as": "6"}, {"exposed_as": "average"})
    )
    assert torch.equal(plain, method.render(camera).rgb)
    rays = camera.rays(camera.pixels())
    points = rays.at(torch.full_like(rays.radius, tiny.DISTANCE - 0.6))
    light, darker = (decoded(x.field(points, rays.directions)[1]) for x in (method, method.given(exposure=-1)))
    torch.testing.assert_close(darker, light / 2)
    assert torch.allclose(dark, plain * log_gain[6].exp(), atol=1e-6)
    assert float(dark.mean() / bright.mean()) == pytest.approx(0.5, abs=0.12)
    assert torch.allclose(average, plain * log_gain.mean(0).exp(), atol=1e-6)
    assert torch.equal(method.given(exposure=0, exposed_as="scene").render(camera).rgb, plain)


def test_exposures_are_told_apart_where_they_differ(generator):
    """By points that neighbours show, else by what photographs say of themselves; a photograph's gain is then found on
    its left half."""
    one, scene = tiny.scene(), two_exposures()
    points = 0.6 * torch.nn.functional.normalize(torch.randn(1000, 3, generator=generator), dim=-1)
    auto = {"exposure_correction": "auto"}
    alike, apart = ngp(one, **auto), ngp(scene, **auto)
    alike.begin(replace(one, points=points))
    assert not bool(alike.exposure.differ) and not alike.controls and not judged_by_halves(alike)
    with pytest.warns(LumigraphWarning, match="an exposure of its own"):
        apart.begin(replace(scene, points=points))
    assert bool(apart.exposure.differ) and judged_by_halves(apart)
    assert ngp(scene, exposure_correction="no").exposure is None
    stops = torch.tensor([0.0, 1.0]).repeat_interleave(6)
    assert spread_of_exposure(scene) == 0
    assert spread_of_exposure(replace(scene, about={"exposure": 2**stops})) == pytest.approx(stops.std())
    developed = {"exposure": 2**stops, "brightness": 2**-stops}
    assert spread_of_exposure(replace(scene, about=developed)) == pytest.approx(0, abs=1e-6)


def test_a_photographs_gain_is_found(generator):
    rgb = 0.1 + 0.5 * torch.rand(100, 3, generator=generator)
    target = rgb * torch.tensor([1.2, 1.0, 0.8])
    target[:20] = 0.9  # somebody passes
    torch.testing.assert_close(gain_between(rgb, target), torch.tensor([1.2, 1.0, 0.8]))
    assert torch.equal(gain_between(rgb, torch.ones_like(rgb)), torch.ones(3))
    scene = tiny.scene()
    method = ngp(scene, exposure_correction="yes")
    camera, shot = scene.cameras[0], scene.photograph(0)
    plain, given = method.render(camera), method.given(left_half(shot))
    assert torch.allclose(given.given(exposed_as="scene").render(camera).rgb, plain.rgb)
    behind = (1 - plain.opacity)[..., None]
    found = (plain.rgb - behind) * given.exposure.found + behind
    assert torch.allclose(given.render(camera).rgb, found, atol=1e-5)
    assert torch.equal(method.given(exposure=1).given(shot).exposure.found, method.given(shot).exposure.found)


def test_the_background_is_not_exposed():
    scene = tiny.scene()  # before white
    method = ngp(scene, exposure_correction="yes")
    rays = scene.cameras[0].rays(scene.cameras[0].pixels())
    told = method.given(exposure=1)
    with torch.no_grad():
        (plain,), (look,) = (x.looks(rays) for x in (method, told))
        seen, expected = (
            told.render_rays(rays, method.background),
            composite(plain.samples, plain.density, look.rgb, method.background),
        )
    torch.testing.assert_close(decoded(look.rgb), 2 * decoded(plain.rgb))
    torch.testing.assert_close(seen.rgb, expected.rgb)
    torch.testing.assert_close(seen.depth, expected.depth)


def test_stops_are_of_light(generator):
    """Photographs whose light differs by a factor of two, encoded as sRGB, are found to differ by one stop."""
    rgb = 0.2 + 0.3 * torch.rand(64, 64, 3, generator=generator)
    pose, intrinsics = torch.eye(4)[:3], torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]])
    one, other = (FlatView(pose, intrinsics, encoded(light * decoded(rgb)), torch.ones(64, 64)) for light in (1.0, 2.0))
    points = torch.cat([torch.rand(500, 2, generator=generator) - 0.5, torch.full((500, 1), 1.5)], -1)
    torch.testing.assert_close(brighter(points, other, one), torch.ones(3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", ["instant-ngp", "plenoxels", "rawnerf"])
def test_an_exposure_is_the_same_control_in_all_methods(name):
    """A stop doubles the light of every colour of the field. Block-NeRF's, which is learnt, counts the same stops."""
    kind = methods.find(name)
    method = build(kind, tiny.scene().frame, kind.smallest(), torch.device("cpu"), 0).eval()
    (control,) = [x for x in method.controls if x.name == "exposure"]
    assert (control.unit, control.default, control.about) == ("stops", 0.0, "Each stop doubles the light.")
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    directions = torch.nn.functional.normalize(points, dim=-1)
    light, less = (decoded(x.field(points, directions)[1]) for x in (method, method.given(exposure=-1)))
    assert light.max() < 1 and light.min() > 0
    torch.testing.assert_close(less, light / 2, atol=1e-6, rtol=1e-4)


def test_methods_without_corrections_offer_nothing_and_leave_cameras():
    scene = tiny.scene()
    method = ngp(scene)
    assert method.controls == () and method.refined(scene.cameras) is scene.cameras


def test_refined_cameras_have_the_rays_that_were_learnt_from():
    scene = tiny.scene()
    method = ngp(scene, refine_cameras=True)
    train, held_out = scene.splits["train"], scene.splits["test"]
    with torch.no_grad():
        method.poses.twist[train] = 0.1 * torch.randn(len(train), 6, generator=torch.Generator().manual_seed(0))
    refined = method.refined(scene.cameras)
    xy, index = torch.rand(50, 2) * tiny.SIZE, train[torch.arange(50) % len(train)]
    learnt, seen = method.poses(scene.cameras.rays(xy, index)), refined.rays(xy, index)
    assert torch.allclose(learnt.origins, seen.origins, atol=1e-6)
    assert torch.allclose(learnt.directions, seen.directions, atol=1e-5)
    rotation = refined.pose[:, :, :3]
    assert torch.allclose(rotation @ rotation.mT, torch.eye(3).expand(len(scene), 3, 3), atol=1e-5)
    assert torch.equal(refined.pose[held_out], scene.cameras.pose[held_out])
    assert not torch.equal(refined.pose[train], scene.cameras.pose[train])
    protocols = [evaluate(method, scene, EvaluationOptions(split, 1)).protocol["poses"] for split in ("test", "train")]
    assert all(said.startswith("as the method refined them; held-out ones") for said in protocols)
    plain = ngp(scene)
    assert evaluate(plain, scene, EvaluationOptions(views=1)).protocol["poses"] == "as captured"


def test_evaluation_sees_photographs_from_where_they_were_refined_to(monkeypatch):
    scene, seen = tiny.scene(), []
    method = ngp(scene, refine_cameras=True)
    with torch.no_grad():
        method.poses.twist.fill_(0.05)
    render = InstantNGP.render
    monkeypatch.setattr(InstantNGP, "render", lambda self, camera: seen.append(camera.pose) or render(self, camera))
    evaluate(method, scene, EvaluationOptions("train", 1))
    assert torch.equal(seen[-1], method.refined(scene.cameras[1:2]).pose)


def test_a_missing_index_moves_nothing():
    cameras = replace(tiny.scene().cameras, image_index=None)
    assert ngp(tiny.scene(), refine_cameras=True).refined(cameras) is cameras


# Films and the command line


def test_a_film_turns_controls_from_frame_to_frame():
    method = two_moments()
    made = animated(method, {"brightness": [0, 2], "ink": ["colour", "grey"]}, 4)
    assert [m.settings["brightness"] for m in made] == pytest.approx([0, 2 / 3, 4 / 3, 2])
    assert [m.settings["ink"] for m in made] == ["colour", "colour", "grey", "grey"]
    assert all(m.grids is method.grids for m in made)


def test_render_sets_and_animates(trained, tmp_path):
    output = tmp_path / "film.webp"
    arguments = ["--frames", "3", "--output", str(output), "--set", "ink=grey", "--animate", "brightness=0:2"]
    arguments += ["--animate", "time=2:5", "--pictures", "png"]
    assert main(["render", str(trained.folder), *arguments]) == 0
    about = json.loads(output.with_suffix(".json").read_text())
    assert about["controls"] == {"ink": "grey", "brightness": [0, 1, 2], "time": [2, 3.5, 5]}
    from PIL import Image

    pictures = [np.asarray(Image.open(output.with_suffix("") / f"{i:04d}.png")).astype(float) for i in range(3)]
    assert all(np.ptp(picture, axis=-1).max() == 0 for picture in pictures)  # grey
    assert pictures[0].mean() < pictures[1].mean() < pictures[2].mean()


def test_a_film_of_held_out_views_keeps_their_times(trained, tmp_path):
    output = tmp_path / "film.webp"
    assert main(["render", str(trained.folder), "--path", "held-out", "--output", str(output)]) == 0
    about = json.loads(output.with_suffix(".json").read_text())
    assert about["times"] == pytest.approx(trained.cameras()["test"].time.tolist()) and "controls" not in about
    assert CameraPath.load(output.with_suffix(".json")).keyframes[1].time == pytest.approx(about["times"][1])


def test_info_lists_controls(trained, capsys):
    assert main(["info", str(trained.folder)]) == 0
    told = capsys.readouterr().out
    assert "brightness  0 to 2 (default: 1.0)" in told and "colour, grey (default: colour)" in told
    assert "time        2 to 5 (default: 2.0)" in told and "from 2 to 5" in told


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        (["eval", "--set", "contrast=1"], "no control 'contrast'; there are: brightness, ink, time"),
        (["render", "--set", "brightness"], "--set brightness gives no value for a control"),
        (["render", "--set", "brightness=9"], "brightness=9 cannot be; give a number from 0 to 2"),
        (["render", "--animate", "time=3"], "--animate time=3 goes nowhere"),
        (["render", "--animate", "time=3:9"], "time=9 cannot be"),
        (["render", "--animate", "ink=grey:blue"], "ink=blue is no choice"),
        (["render", "--set", "time=3", "--animate", "time=3:4"], "time is both set and animated"),
        (["view", "--set", "ink=blue"], "ink=blue is no choice"),
        (["export", "mesh", "--set", "ink=blue"], "ink=blue is no choice"),
        (["export", "points", "--set", "ink=blue"], "ink=blue is no choice"),
        (["export", "panorama", "--set", "ink=blue"], "ink=blue is no choice"),
        (["export", "stereo", "--set", "ink=blue"], "ink=blue is no choice"),
        (["export", "web", "--set", "ink=blue"], "ink=blue is no choice"),
        (["export", "splats", "--set", "ink=blue"], "ink=blue is no choice"),
        (["explain", "ray", "--set", "ink=blue"], "ink=blue is no choice"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_every_command_that_renders_can_be_told(trained, tmp_path, capsys, command, fault):
    files = {"mesh": "x.ply", "points": "x.ply", "panorama": "x.png", "stereo": "x.png", "web": "x.html"}
    words = [word for word in command if not word.startswith("--") and "=" not in word and word != "brightness"]
    output = [str(tmp_path / files.get(words[-1], "x.ply"))] if words[0] == "export" else []
    assert main([*words, str(trained.folder), *output, *command[len(words) :]]) == 2
    assert fault in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_an_export_shows_what_was_told(trained, tmp_path):
    from PIL import Image

    arguments = ["export", "panorama", str(trained.folder), str(tmp_path / "x.png"), "--size", "64"]
    assert main([*arguments, "--set", "ink=grey", "--set", "brightness=0.5"]) == 0
    assert np.ptp(np.asarray(Image.open(tmp_path / "x.png")), axis=-1).max() == 0


def test_photographs_are_named(tmp_path):
    """A control that wants a photograph takes its name as well as its number."""
    from lumigraph.export.loaded import Loaded

    scene = tiny.scene()
    made = ngp(scene, exposure_correction="yes", refine_cameras=True)
    run = Run.create(tmp_path / "run", made, scene)
    fit(run.new_method(), scene, run, steps=1, show=False)
    with_name, with_number = (Loaded.of(run, "cpu", [f"exposed-as={which}"]).method for which in ("ball_5", "5"))
    assert with_name.settings == with_number.settings == {"exposed_as": "5"}
    loaded = Loaded.of(run, "cpu")
    method, cameras = loaded.method, loaded.cameras
    assert torch.equal(cameras["train"].pose, method.refined(scene.cameras[scene.splits["train"]]).pose)
    assert not torch.equal(cameras["train"].pose, run.cameras()["train"].pose)
    with pytest.raises(LumigraphError, match="exposed_as=ball_99 is no choice"):
        Loaded.of(run, "cpu", ["exposed_as=ball_99"])


def test_a_moment_is_a_control_of_the_frames_times():
    control = moment((2.0, 5.0))
    assert control.default == 2.0 and control.range == (2.0, 5.0) and math.isclose(float(control.checked("3.5")), 3.5)
    rays = Rays(torch.zeros(2, 3), torch.eye(3)[:2], torch.ones(2))
    assert two_moments().moments(rays).tolist() == [2.0, 2.0]
