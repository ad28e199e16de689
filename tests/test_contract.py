"""What every method promises to the trainer, the run, the viewer, the exports and the command line, whatever it is.

A method is trained twice for all of it, in its `smallest()` configuration on the smallest dataset of its kind: 24 steps
in one sitting, and the same in three with looks between steps. A new method needs no new test here; parameters that
shall not learn have `requires_grad` False.
"""

from __future__ import annotations

import dataclasses
import math
import re
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from budgets import PER_METHOD, budget

import lumigraph
from lumigraph import methods
from lumigraph.camera import Camera
from lumigraph.camera.lens import (
    Division,
    EnhancedUnified,
    Equirectangular,
    FieldOfView,
    Fisheye,
    Lens,
    OmnidirectionalStereo,
    OpenCV,
    Pinhole,
    RadialThinPrism,
    ThinPrism,
)
from lumigraph.camera.rays import Rays, Rendering
from lumigraph.commands.cli import main
from lumigraph.commands.eval import compared
from lumigraph.commands.main_options import MAX_SHOWN, option_names
from lumigraph.components.fields import appearance
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.scene import Scene
from lumigraph.datasets.shapes import Shapes
from lumigraph.depth_maps import depth_map
from lumigraph.derive.compression import LADDER
from lumigraph.derive.compression.model import CompressedModel
from lumigraph.errors import LumigraphError
from lumigraph.evaluation import held_out_poses
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.run import evaluate_run
from lumigraph.evaluation.views import evaluate
from lumigraph.exchange import read_gaussians, write_gaussians
from lumigraph.export import points as export_points
from lumigraph.export.film import film
from lumigraph.export.mesh import extract_mesh
from lumigraph.export.options import FilmOptions, MeshOptions, PageOptions, PointsOptions
from lumigraph.export.page import splats_page, views_page
from lumigraph.lab.benchmark.cell import CellSettings, evaluated
from lumigraph.lab.explain.ray import along_ray
from lumigraph.method import Method, RayMethod
from lumigraph.method.capabilities import (
    CanCompress,
    HasDensity,
    HasDistance,
    HasField,
    HasGaussians,
    HasLooks,
    HasMesh,
    can,
)
from lumigraph.metrics import psnr, scores_of
from lumigraph.paths import camera_path
from lumigraph.paths.opening import opening_of_scene
from lumigraph.run import Run, build
from lumigraph.run.checkpoint import Checkpoints
from lumigraph.training import fit
from lumigraph.training.loop import rehearse

STEPS, PAUSES, LATER = 24, (5, 18), 48
UNLIKE_STEPS = 6
SHOWN = 4  # the camera whose picture is looked at, a held-out one
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
NAMES = methods.available()  # tiny adds the tests' own
METHODS = {path.stem for path in Path(lumigraph.methods.__file__).parent.iterdir()}  # files and folders
OWN = [name for name in NAMES if name.replace("-", "_") in METHODS]
# Of lenses: the house's, not those of other tests; a batch of several kinds is of no kind of its own.
KINDS = sorted(name for name, kind in Lens.kinds.items() if kind.__module__ == Lens.__module__ and name != "mixed")
DOCS = Path(__file__).parent.parent / "docs" / "methods"
# A few steps leave a scene half transparent: what counts as solid there, and how well cameras must agree on it. Tests
# with the constants that are shipped are in test_solid_exports.
HALF_SOLID, HALF_AGREED = 0.5, 0.3

pytestmark = [
    budget("methods", PER_METHOD * len(NAMES)),
    pytest.mark.filterwarnings("ignore:The cloud stops growing"),
]


@dataclass(frozen=True)
class Taught:
    """A trained method: `straight` in one sitting, `broken` in several with looks between steps, on the same data."""

    name: str
    kind: type[Method]
    device: str
    data: Any
    straight: Run
    broken: Run
    left: dict[str, torch.Tensor]  # what the method itself held at the end of the one sitting
    looks: int  # renderings between the steps of `broken`

    @cached_property
    def method(self) -> Method:
        return self.straight.method(self.device)

    @cached_property
    def cameras(self) -> Camera:
        return tiny.scene().cameras

    @cached_property
    def seen(self) -> Rendering:
        return self.method.render(self.cameras[SHOWN]).cpu()


def begin(name: str, data: Any, folder: Path, device: str) -> Run:
    kind = methods.find(name)
    assert hasattr(kind, "smallest"), (
        f"{kind.__name__} has no smallest(): give it a classmethod that returns a Config with every schedule inside "
        f"{STEPS} steps of less than 20 ms on the tiny scene"
    )
    return Run.create(folder, build(kind, data.frame, kind.smallest(), torch.device(device), 0), data)


SITTING = {"steps": STEPS, "show": False, "rehearsal": False, "log_every": 1}


def train(run: Run, data: Any, device: str, **options) -> Method:
    method = run.new_method(device)
    if not run.has_state:
        rehearse(method, data, 0)  # which a budget of seconds begins with, and which changes nothing
    fit(method, data, run, **SITTING | options)
    return method


class Looker:
    """Renders a small picture between any two steps of a sitting, as viewers do."""

    def __init__(self, method: Method):
        self.method, self.camera = method, tiny.scene().cameras[3].resized(0.5)
        self.asked, self.looks = False, 0

    def give_way(self, stopping) -> None:
        self.method.render(self.camera)
        self.asked, self.looks = False, self.looks + 1

    def note(self, step: int, progress: float, row: dict[str, Any]) -> None:
        self.asked = True


@pytest.fixture(scope="session", params=[f"{name}-{device}" for name in NAMES for device in DEVICES])
def taught(request, tmp_path_factory) -> Taught:
    name, _, device = request.param.rpartition("-")
    folder, data = tmp_path_factory.mktemp(name), tiny.dataset(methods.find(name).learns_from)
    straight, broken = (begin(name, data, folder / sittings, device) for sittings in ("straight", "broken"))
    method, looks = train(straight, data, device), 0
    for pause_at in (*PAUSES, None):
        run = Run(broken.folder)
        fit(other := run.new_method(device), data, run, pause_at=pause_at, watch=(looker := Looker(other)), **SITTING)
        looks += looker.looks
    return Taught(name, type(method), device, data, straight, Run(broken.folder), method.state_dict(), looks)


def same(expected: dict[str, torch.Tensor], actual: dict[str, torch.Tensor]) -> None:
    """To the bit."""
    assert expected.keys() == actual.keys()
    for name, value in expected.items():
        assert torch.equal(value.cpu(), actual[name].cpu()), name


def in_any_order(device: str) -> bool:
    """True where sums are taken in any order, as a GPU's atomic ones are, so that no run repeats another to the bit."""
    return device == "cuda"


# What it says of itself


@pytest.mark.parametrize("name", NAMES)
def test_it_says_what_it_is(name):
    kind = methods.find(name)
    assert len(methods.summary(name)) > 20
    assert dataclasses.is_dataclass(kind.Config) and kind.Config.__dataclass_params__.frozen  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", OWN)
def test_a_page_describes_it(name):
    page = DOCS / f"{name.replace('-', '_')}.md"
    assert page.is_file(), f"{page.name} is missing in docs/methods"
    assert f"lumigraph train {name}" in page.read_text("utf-8")


@pytest.mark.parametrize("name", NAMES)
def test_help_shows_what_people_set_and_all_on_request(name, capsys):
    told = {}
    for asked in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as done:
            main(["train", name, asked])
        assert done.value.code == 0
        told[asked] = capsys.readouterr().out.partition(f"{name} options")[2]
    flags = [f"--{number.replace('_', '-')}" for number in option_names(methods.find(name).Config())]
    assert all(re.search(rf"{flag}\b", told["--help-all"]) for flag in flags)
    shown = [flag for flag in flags if re.search(rf"{flag}(?![\w-])", told["--help"])]
    assert min(len(flags), 4) <= len(shown) <= MAX_SHOWN and "Config" not in told["--help-all"], shown


# Learning


def fall(losses: list[float]) -> bool:
    return sum(losses[-8:]) < 0.95 * sum(losses[:8])


def test_it_learns(taught, monkeypatch):
    """Its loss falls, where it has one. A method of photographs shows held-out ones better than one that has learnt
    nothing."""
    monkeypatch.setattr(held_out_poses, "STEPS", 5)  # for each photograph, of methods that refine poses; 200 otherwise
    monkeypatch.setattr(appearance, "FIT_STEPS", 10)  # for each photograph, of methods with appearance; 100 otherwise
    losses = [row["loss"] for row in taught.straight.metrics() if "loss" in row]
    if losses and not fall(losses):  # as yet
        run = begin(taught.name, taught.data, taught.straight.folder.with_name("later"), taught.device)
        train(run, taught.data, taught.device, steps=LATER)
        losses = [row["loss"] for row in run.metrics()]
    if losses:
        assert fall(losses), losses
    else:
        assert taught.method.complete or taught.straight.state.step == STEPS
    if taught.kind.learns_from is Scene:
        fresh = taught.straight.new_method(taught.device).eval()
        assert evaluate(taught.method, taught.data).psnr > evaluate(fresh, taught.data).psnr + 0.5


@pytest.mark.parametrize("name", [name for name in NAMES if methods.find(name).learns_from is Scene])
@pytest.mark.parametrize("device", DEVICES)
def test_an_unlike_scene_is_learnt_or_refused_in_a_sentence(name, device, tmp_path):
    data = tiny.stranger()
    try:
        run = begin(name, data, tmp_path / "run", device)
        fit(method := run.new_method(device), data, run, steps=UNLIKE_STEPS, show=False)
        method.eval()
        sound(method.render(data.cameras[SHOWN]).cpu(), (tiny.SIZE, tiny.SIZE))
    except LumigraphError as refusal:
        assert len(str(refusal)) > 40
    else:
        assert all(value.isfinite().all() for value in method.parameters())


def test_every_parameter_gets_a_finite_gradient(taught):
    method = taught.straight.new_method(taught.device)
    optimizers = method.optimizers()
    method.train().begin(taught.data)
    descents = []

    def descend(terms, chosen=None):
        torch.stack(list(terms.values())).sum().backward()
        descents.append(terms)

    learns = {name for name, parameter in method.named_parameters() if parameter.requires_grad}
    method.progress = 0.0
    method.before_step(0, 0.0)
    method.step(method.batch(taught.data, torch.Generator().manual_seed(0)), 0, descend)
    method.after_step(0)
    assert bool(learns) == bool(optimizers) == bool(descents)
    gradients = {name: parameter.grad for name, parameter in method.named_parameters() if name in learns}
    for name, gradient in gradients.items():
        assert gradient is not None and (dense := gradient.to_dense()).isfinite().all() and dense.any(), name


def test_neither_pauses_nor_looks_change_what_is_learnt(taught):
    """A run that was resumed twice, and rendered between steps as by previews and viewers, equals one that was not."""
    assert taught.looks >= taught.straight.state.step - len(PAUSES) - 1
    assert taught.straight.state.step == taught.broken.state.step
    if in_any_order(taught.device):
        return
    same(taught.straight.method(taught.device).state_dict(), taught.broken.method(taught.device).state_dict())
    once, again = ([{**row, "seconds": 0} for row in run.metrics()] for run in (taught.straight, taught.broken))
    assert once == again


# Being kept


def test_its_config_and_frame_survive_the_folder(taught):
    fresh = Run(taught.straight.folder).new_method(taught.device)
    assert fresh.config == taught.kind.smallest() and fresh.frame == taught.data.frame
    assert methods.name_of(fresh) == taught.name and fresh.device.type == taught.device


def test_what_is_saved_is_what_was_trained(taught):
    same(taught.left, taught.method.state_dict())
    run = taught.straight if in_any_order(taught.device) else taught.broken
    again = run.method(taught.device).render(taught.cameras[SHOWN]).cpu()
    for name in ("rgb", "depth", "opacity"):
        assert torch.equal(getattr(taught.seen, name), getattr(again, name)), name


# Being seen


def sound(seen: Rendering, size: tuple[int, int]) -> None:
    width, height = size
    assert seen.rgb.shape == (height, width, 3) and seen.depth.shape == seen.opacity.shape == (height, width)
    assert seen.rgb.isfinite().all() and not seen.rgb.requires_grad
    assert (seen.depth > 0).all() and (seen.opacity >= -1e-6).all() and (seen.opacity <= 1 + 1e-5).all()
    assert all(value.shape[:2] == (height, width) for value in seen.extra.values())


def test_a_picture_is_sound(taught):
    sound(taught.seen, (tiny.SIZE, tiny.SIZE))
    assert taught.seen.opacity.max() > 0.05


def lens_of(kind: str) -> tuple[Lens, tuple[int, int]]:
    """The smallest lens of a kind, and the size of its picture."""
    focal, centre, whole = torch.tensor([[12.0, 12.0]]), torch.tensor([[8.0, 6.0]]), torch.tensor([[16.0, 8.0]])
    lenses = {
        "pinhole": Pinhole(focal, centre),
        "opencv": OpenCV(focal, centre, torch.tensor([[-0.1, 0.02, 1e-3, -1e-3, 0, 0, 0, 0]])),
        "fisheye": Fisheye(focal / 3, centre, torch.tensor([[0.05, 0, 0, 0]])),
        "thinprism": ThinPrism(focal / 3, centre, torch.tensor([[0.05, 0, 0, 0, 1e-3, -1e-3, 1e-3, 0]])),
        "radialthinprism": RadialThinPrism(
            focal / 3, centre, torch.tensor([[0.05, *[0] * 5, 1e-3, -1e-3, 1e-3, *[0] * 3]])
        ),
        "fieldofview": FieldOfView(focal, centre, torch.tensor([[0.8]])),
        "enhancedunified": EnhancedUnified(focal, centre, torch.tensor([[0.4]]), torch.tensor([[1.1]])),
        "division": Division(focal, centre, torch.tensor([[-0.1]])),
        "equirectangular": Equirectangular(whole),
        "omnidirectionalstereo": OmnidirectionalStereo(whole, offset=torch.tensor([[0.03]])),
    }
    return lenses[kind], (16, 8) if kind in ("equirectangular", "omnidirectionalstereo") else (16, 12)


@pytest.mark.parametrize("kind", KINDS)
def test_it_sees_through_every_lens_that_it_claims(taught, kind):
    if not taught.method.any_lens and kind not in ("pinhole", "opencv"):
        return
    lens, size = lens_of(kind)
    camera = Camera(taught.cameras[1].pose, lens, torch.tensor([size]))
    sound(taught.method.render(camera).cpu(), size)


def test_two_halves_are_the_whole(taught):
    if not isinstance(taught.method, RayMethod):
        return
    camera = taught.cameras[2]
    rays, background = camera.rays(camera.pixels()).to(taught.device), taught.method.background
    with torch.no_grad():
        whole = taught.method.render_rays(rays, background)
        halves = Rendering.cat(
            [taught.method.render_rays(rays[half], background) for half in (slice(250), slice(250, None))]
        )
    # On an H200, products in bfloat16 of 250 rays and of all differed by up to 0.6 % of the colour (nerf).
    bound = 1e-2 if taught.device == "cuda" else 1e-3
    for name in ("rgb", "depth", "opacity"):
        torch.testing.assert_close(getattr(halves, name), getattr(whole, name), atol=bound, rtol=bound)


def test_depth_is_distance_from_the_camera_whichever_way_it_turns(taught):
    """From one place, straight ahead and at the edge of a wide picture: along the axis they would be a fifth apart.
    The places that depth gives lie on their pixels in either picture."""
    ahead = taught.cameras[SHOWN]
    angle = torch.tensor(math.radians(35))
    turn = torch.tensor([[angle.cos(), 0, angle.sin()], [0, 1, 0], [-angle.sin(), 0, angle.cos()]])
    pose = torch.cat([ahead.pose[:, :, :3] @ turn, ahead.pose[:, :, 3:]], -1)
    lens = Pinhole(torch.full((1, 2), 32.0), torch.full((1, 2), 32.0))
    aside = Camera(pose, lens, torch.tensor([[64, 64]]))
    one, other = (taught.method.render(camera).cpu() for camera in (ahead, aside))
    pixels = ahead.pixels()
    depth, opacity = one.depth.flatten(), one.opacity.flatten()
    there = depth.isfinite() & (opacity > 0.7 * opacity.max())
    points = ahead.rays(pixels).at(depth.nan_to_num(posinf=1.0))[there]
    again, visible = ahead.project(points)
    assert len(points) and visible.all()
    torch.testing.assert_close(again, pixels[there], atol=0.01, rtol=0)
    found, visible = aside.project(points)
    inside = visible & (found > 0).all(-1) & (found < 64).all(-1)
    x, y = found[inside].long().unbind(-1)
    ratio = other.depth[y, x] / depth[there][inside]
    assert ratio.isfinite().float().mean() > 0.9
    assert float(ratio[ratio.isfinite()].median()) == pytest.approx(1, abs=0.05)


def test_it_can_be_told_what_it_says(taught):
    """Each control's default is what holds untold, and one of its ends shows."""
    method, camera = taught.method, taught.cameras[SHOWN]
    with pytest.raises(LumigraphError):
        method.given(object())
    with pytest.raises(LumigraphError, match="no-such-thing"):
        method.given(**{"no-such-thing": 1.0})
    for control in method.controls:
        untold = method.given(**{control.name: control.default}).render(camera).cpu()
        torch.testing.assert_close(untold.rgb, taught.seen.rgb)
        shown = [method.given(**{control.name: end}).render(camera).cpu() for end in control.choices or control.range]
        for seen in shown:
            sound(seen, (tiny.SIZE, tiny.SIZE))
        assert any((seen.rgb != taught.seen.rgb).any() for seen in shown), control.name


# What is made of it


@pytest.fixture
def lenient(taught, monkeypatch) -> Taught:
    """A method whose scene is but half solid counts as solid to exports."""
    monkeypatch.setattr(depth_map, "SURFACE_OPACITY", HALF_SOLID * float(taught.seen.opacity.max()))
    monkeypatch.setattr(export_points, "MIN_COSINE", 0.0)
    monkeypatch.setattr(export_points, "DEPTH_TOLERANCE", HALF_AGREED)
    monkeypatch.setattr(export_points, "MIN_VIEWS", 1)
    return taught


def around(points: torch.Tensor) -> None:
    assert len(points) > 3 and points.isfinite().all() and (points.abs() <= 1.5).all()


def test_what_it_knows_of_places(taught):
    method = taught.method
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)).to(taught.device) * 2 - 1
    directions = torch.nn.functional.normalize(points.flip(0), dim=-1)
    with torch.no_grad():
        if can(method, HasDensity):
            density = method.density(points)
            assert density.shape == (200,) and density.isfinite().all() and (density >= 0).all() and density.any()
        if can(method, HasDistance):
            distance = method.distance(points)
            assert distance.shape == (200,) and distance.isfinite().all() and distance.any()
        if can(method, HasField):
            density, rgb = method.field(points, directions)
            assert density.shape == (200,) and (density >= 0).all() and rgb.shape == (200, 3) and rgb.isfinite().all()
            if can(method, HasDensity):
                torch.testing.assert_close(density, method.density(points), atol=1e-3, rtol=1e-2)


def test_a_ray_is_explained(taught):
    if not can(taught.method, HasLooks):
        return
    y, x = divmod(int(taught.seen.opacity.argmax()), tiny.SIZE)
    sight = along_ray(taught.method, taught.cameras[SHOWN], (x, y))
    torch.testing.assert_close(sight.rgb, taught.seen.rgb[y, x], atol=2e-3, rtol=0)
    assert sight.opacity == pytest.approx(float(taught.seen.opacity[y, x]), abs=2e-3)
    for each in sight.passes:
        assert (each.density >= 0).all() and (each.end >= each.start).all()


def coarse(lenient, **options) -> MeshOptions:
    """Options of a mesh with cells of an eighth of the scene's unit."""
    return MeshOptions(cell_size=lenient.method.frame.to_export.scale / 8, views=6, **options)


def test_it_becomes_points_and_a_mesh(lenient):
    points = export_points.extract_points(lenient.method, lenient.cameras, PointsOptions(200, views=6))
    around(torch.from_numpy(points.positions))
    if can(lenient.method, HasMesh):
        mesh = lenient.method.mesh()
        assert isinstance(mesh, Mesh)
    else:
        mesh = extract_mesh(lenient.method, lenient.cameras, coarse(lenient, way="depth"))
    around(torch.from_numpy(mesh.vertices))
    assert len(mesh.faces) > 3 and mesh.faces.max() < len(mesh.vertices) == len(mesh.colours)


def test_its_density_becomes_a_mesh(lenient):
    if not can(lenient.method, HasDensity):
        return
    grid = torch.linspace(-1, 1, 12, device=lenient.device)
    with torch.no_grad():
        density = lenient.method.density(torch.cartesian_prod(grid, grid, grid))
    level = float(density.max()) / 4
    mesh = extract_mesh(lenient.method, lenient.cameras, coarse(lenient, way="density", level=level, smooth=0))
    around(torch.from_numpy(mesh.vertices))


def test_its_distance_becomes_a_mesh(lenient):
    if not can(lenient.method, HasDistance):
        return
    mesh = extract_mesh(lenient.method, lenient.cameras, coarse(lenient, smooth=0))
    around(torch.from_numpy(mesh.vertices))
    with torch.no_grad():
        distance = lenient.method.distance(torch.from_numpy(mesh.vertices).float().to(lenient.device))
    assert float(distance.abs().median()) < 1 / 16


def test_its_evaluation_is_read_again(taught):
    if taught.kind.learns_from in (Scene, Shapes):
        return  # tests of commands evaluate these
    evaluate_run(taught.straight, taught.method, taught.data, EvaluationOptions(views=1))
    result = Run(taught.straight.folder).evaluation()
    assert scores_of(result) and compared(result)
    assert evaluated(taught.straight.folder, CellSettings(eval_views=1)) or "views" in result["protocol"]


def test_it_becomes_a_film(taught, tmp_path):
    cameras = camera_path("orbit", taught.cameras, taught.method.frame, 2, (16, 16)).to(taught.device)
    about = film(taught.method, cameras, tmp_path / "orbit.mp4", FilmOptions(depth=True, pictures="png"))
    assert about["frames"] == 2 and len(list((tmp_path / "orbit").glob("*.png"))) == 4
    assert (tmp_path / "orbit.mp4").stat().st_size > 0


def test_it_becomes_a_page(taught, tmp_path):
    page, opening = tmp_path / "page.html", opening_of_scene("tiny", taught.cameras, taught.method.frame)
    views_page(page, taught.method, taught.cameras, opening, PageOptions(views=2, size=16))
    assert len(re.findall("<title>tiny</title>", page.read_text("utf-8"))) == 1


def test_its_gaussians_become_splats(taught, tmp_path):
    if not can(taught.method, HasGaussians):
        return
    cloud = taught.method.gaussians()
    write_gaussians(tmp_path / "cloud.ply", cloud.transformed(taught.method.frame.to_source.matrix))
    back = read_gaussians(tmp_path / "cloud.ply").transformed(taught.method.frame.to_source.inverse.matrix)
    for field in dataclasses.fields(cloud):
        if isinstance(value := getattr(cloud, field.name), torch.Tensor) and field.name != "quaternions":
            torch.testing.assert_close(getattr(back, field.name), value.detach().cpu(), atol=1e-4, rtol=1e-4)
    splats_page(tmp_path / "page.html", cloud, opening_of_scene("tiny", taught.cameras, taught.method.frame))
    assert (tmp_path / "page.html").stat().st_size > 1000


def test_it_can_be_stored_in_fewer_bytes(taught, tmp_path):
    """Pressed as little as it can be it looks as it did, and pressed hard it still learns, opens and is smaller."""
    if not can(taught.method, CanCompress):
        return
    run, camera = taught.straight, taught.cameras[SHOWN]
    important = dict.fromkeys(taught.method.importance(camera), 0)
    for view in (taught.cameras[i] for i in range(len(taught.cameras))):
        for name, weights in taught.method.importance(view).items():
            assert len(weights) and (weights >= 0).all() and weights.isfinite().all()
            important[name] = important[name] + weights
    assert set(taught.method.storage()) <= set(taught.method.state_dict())
    sizes = []
    for rung in (LADDER[0], LADDER[-1]):
        model = CompressedModel(run.method(taught.device), important, rung, STEPS)
        if rung.pruned:
            model.tune(taught.data, 2, None)
        sizes.append(len(packed := model.packed()))
        folder = tmp_path / str(sizes[-1])
        shutil.copytree(run.folder, folder, ignore=shutil.ignore_patterns("checkpoints"))
        Checkpoints(folder, taught.name).save_packed(run.state, packed)
        seen = Run(folder).method(taught.device).render(camera).cpu()
        assert torch.equal(seen.rgb, model.method.render(camera).rgb.cpu())
        assert psnr(seen.rgb, taught.seen.rgb) > (15 if rung.pruned else 28)
    assert sizes[1] < sizes[0] < run.model_bytes / 2


def test_rays_that_meet_nothing_show_the_background(taught):
    if not isinstance(taught.method, RayMethod):
        return
    away = torch.eye(3, device=taught.device)
    rays = Rays(3 + away, away, torch.full((3,), 0.01, device=taught.device))
    with torch.no_grad():
        seen = taught.method.render_rays(rays, taught.method.background)
    assert seen.rgb.isfinite().all() and seen.opacity.isfinite().all() and not seen.depth.isnan().any()
