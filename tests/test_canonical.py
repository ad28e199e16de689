"""Canonical fields: what turns with the input and what does not, rotations found again, and the files that say so."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import tiny
import torch
from budgets import budget
from canonical_errors import about_vertical, rotation_errors

from lumigraph import kernels
from lumigraph.commands.cli import main
from lumigraph.composition import standing
from lumigraph.datasets.alignment import angles
from lumigraph.derive.canonical import CanonicalConfig, Instance, sampled, solve
from lumigraph.derive.canonical.canonicalise import best_rotations, described
from lumigraph.derive.canonical.harmonics import (
    band,
    harmonics,
    moments,
    near,
    nearest_rotation,
    random,
    spread,
    turning,
)
from lumigraph.derive.canonical.network import Canonicaliser, drawn, learn, losses, rotations_of
from lumigraph.errors import LumigraphError
from lumigraph.geometry import Similarity
from lumigraph.large import open_any
from lumigraph.opening import open_scene
from lumigraph.run import Run, State
from lumigraph.synthetic import categories, signed_distance
from lumigraph.synthetic.members import member_stage, members_of

pytestmark = budget("runs", 15)

QUICK = CanonicalConfig(steps=12, points=256, channels=8, templates=3)
CUBE = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)


def chair(member: int, cells: int = 24) -> tuple[Instance, torch.Tensor]:
    """The density grid of a chair, and how it was turned."""
    stage = member_stage(f"chairs,member={member},turned=1")
    found = sampled(lambda x: 200.0 * (signed_distance(stage.world, x) < 0), stage.bounds, cells)
    return found, torch.tensor(stage.turn, dtype=torch.float64)


def tripod(points: torch.Tensor) -> torch.Tensor:
    """Density of three arms of different lengths and places, which nothing turns into itself."""
    boxes = [
        ((-0.6, -0.2, -0.5), (0.6, 0.2, -0.1)),
        ((0.2, -0.2, -0.5), (0.6, 0.2, 0.6)),
        ((-0.6, 0.0, -0.5), (-0.2, 0.6, 0.0)),
    ]
    inside = [((points >= torch.tensor(a)) & (points <= torch.tensor(b))).all(-1) for a, b in boxes]
    return 60.0 * torch.stack(inside).any(0)


# Features


def test_harmonics_are_orthonormal_and_begin_as_the_kernel_has_them(generator):
    directions = torch.nn.functional.normalize(torch.randn(40_000, 3, generator=generator, dtype=torch.float64), dim=-1)
    values = harmonics(directions, 6)
    gram = values.T @ values * (4 * torch.pi / len(values))
    assert (gram - torch.eye(36)).abs().max() < 0.08  # as far as random directions tell
    assert torch.allclose(values[:, :16].float(), kernels.spherical_harmonics(directions.float(), 4), atol=1e-6)


def test_coefficients_turn_with_directions(generator):
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=-1)
    (turn,) = random(1, generator)
    before, after = harmonics(directions, 9), harmonics(directions @ turn.T, 9)
    for degree, matrix in enumerate(turning(turn, 9)):
        assert torch.allclose(after[:, band(degree)], before[:, band(degree)] @ matrix.T, atol=1e-12)
        assert torch.allclose(matrix @ matrix.T, torch.eye(2 * degree + 1, dtype=torch.float64), atol=1e-12)


def test_the_network_is_equivariant_to_rounding(generator):
    """Frames and rotations turn with the points, canonical coordinates stay."""
    network = Canonicaliser(12, 6, 5, 3, generator).double()
    points = torch.randn(2, 100, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(2, 100, generator=generator, dtype=torch.float64)
    weights = weights / weights.sum(1, keepdim=True)
    turn = random(2, generator)
    turned = points @ turn.mT
    before, after = network(points, weights), network(turned, weights)
    assert before.frame.abs().max() > 0.1
    assert torch.allclose(after.frame, turn @ before.frame, atol=1e-9)
    assert torch.allclose(after.coordinates, before.coordinates, atol=1e-9)
    first, second = rotations_of(before, points, weights), rotations_of(after, turned, weights)
    assert torch.allclose(second @ turn, first, atol=1e-7)


def test_rotations_are_spread_evenly_and_found_by_least_squares(generator):
    some, lattice = random(200, generator), spread(4608)
    cosine = (torch.einsum("aij,bij->ab", some, lattice).amax(1) - 1) / 2
    assert float(cosine.acos().rad2deg().max()) < 13
    assert torch.allclose(
        angles(near(3.0), torch.eye(3).expand(27, 3, 3))[[0, 26]], torch.tensor([3.0, 3.0]), atol=1e-4
    )
    points = torch.randn(3, 50, 3, generator=generator, dtype=torch.float64)
    turns = random(3, generator)
    assert torch.allclose(nearest_rotation((points @ turns.mT).mT @ points), turns, atol=1e-9)
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    assert torch.linalg.det(nearest_rotation(mirror)) > 0.99


# What is found


def test_a_grid_is_centred_and_scaled():
    found = sampled(lambda x: 100.0 * ((x - torch.tensor([0.3, 0.0, -0.2])).norm(dim=-1) < 0.4), CUBE, 40)
    assert float((found.weights[:, None] * found.points).sum(0).norm()) < 1e-5
    assert abs(float((found.weights * found.points.square().sum(-1)).sum()) - 1) < 1e-5
    middle = found.place.points(torch.zeros(3))
    assert torch.allclose(middle, torch.tensor([0.3, 0.0, -0.2]), atol=5e-3)
    assert abs(found.place.scale - 0.4 * 0.6**0.5) < 0.01  # of a solid ball
    with pytest.raises(LumigraphError, match="chair is empty"):
        sampled(lambda x: 0 * x[:, 0], CUBE, 8, "chair")


def test_a_known_rotation_is_found_again(generator):
    """Of one shape in eight poses, by all rotations that are tried; and its moments turn as it does."""
    shape, _ = chair(1)
    turns = random(8, generator)
    shapes = described([shape, *(shape.turned(turn) for turn in turns)])
    found = best_rotations(shapes[0], shapes)
    errors = angles(found[1:] @ turns, torch.eye(3).expand(8, 3, 3))
    assert float(angles(found[:1], torch.eye(3)[None])) < 0.5 and float(errors.max()) < 0.5
    turned = moments(shape.turned(turns[0]).points.double(), shape.weights.double(), 8, 6)
    assert (
        turned.shape == (8, 36)
        and float((turned - moments(shape.points.double(), shape.weights.double(), 8, 6)).abs().max()) > 1e-3
    )


def test_chairs_in_any_pose_come_to_stand_alike():
    instances, turns = zip(*map(chair, range(6)), strict=True)
    solution = solve(instances, QUICK)
    assert float(rotation_errors(solution.rotations, torch.stack(turns)).median()) < 6
    as_they_stood = rotation_errors(torch.eye(3).expand(6, 3, 3), torch.stack(turns))
    assert float(as_they_stood.median()) > 20
    assert 0.5 < solution.explained < 1 and (solution.agreement > 0.6).all()


def test_learning_lowers_what_it_is_told_to():
    """On poses that it has not seen; and the seed decides all of it."""
    instances, _ = zip(*(chair(i, 20) for i in range(4)), strict=True)
    config = CanonicalConfig(points=256, channels=12, batch=4)

    def loss(steps: int) -> float:
        points, weights = drawn(instances, config, torch.Generator().manual_seed(5))
        network = learn(instances, replace(config, steps=steps))
        return float(sum(losses(network(points, weights), points, weights, config).values()).detach())

    first = loss(0)
    assert loss(0) == first and loss(70) < 0.8 * first


def test_errors_are_up_to_one_rotation_and_the_symmetry(generator):
    turns, common = random(9, generator), random(1, generator)[0]
    tilt = near(4.0)[0]
    off = torch.eye(3, dtype=torch.float64).repeat(9, 1, 1)
    off[0] = tilt
    off[1] = about_vertical(2)[1]
    found = common @ off @ turns.mT
    plain, symmetric = (rotation_errors(found, turns, fold) for fold in (1, 2))
    assert torch.allclose(plain, torch.tensor([4.0, 180.0] + [0.0] * 7), atol=1e-3)
    assert torch.allclose(symmetric, torch.tensor([4.0] + [0.0] * 8), atol=1e-3)


# Members in random poses


@pytest.mark.parametrize("name", ["chairs", "toys", "cars"])
def test_turned_members_are_the_same_objects_turned(name, generator):
    upright, turned = (member_stage(f"{name},member=5,turned={turn}") for turn in (0, 1))
    motion = torch.tensor(turned.turn).double() @ torch.tensor(upright.turn).double().T
    points = 2 * torch.rand(500, 3, generator=generator, dtype=torch.float64) - 1
    before, after = signed_distance(upright.world, points), signed_distance(turned.world, points @ motion.T)
    assert torch.allclose(before, after, atol=1e-9) and float(angles(motion[None], torch.eye(3)[None])) > 10
    low, high = turned.world.bounds()
    assert low.min() > turned.bounds[0][0] and high.max() < turned.bounds[1][0]
    yaw = torch.tensor(upright.turn)
    assert yaw[2].tolist() == [0, 0, 1] and abs(float(torch.atan2(yaw[1, 0], yaw[0, 0]).rad2deg())) <= 25
    assert categories.stage(name, 5, 64, 20, 0).world == upright.world  # as without the option
    assert member_stage(f"{name},member=6,turned=1").turn != turned.turn


def test_a_turned_scene_says_how_it_is_turned():
    scene = open_scene("procedural:cars,member=2,turned=1,size=16,views=3")
    told = scene.about["turn"]
    assert told.shape == (4, 3, 3) and torch.allclose(
        told[0], torch.tensor(member_stage("cars,member=2,turned=1").turn)
    )
    asked = members_of("cars,count=2,turned=1,size=16")
    assert asked == {f"cars-{i:04d}": f"cars,member={i},size=16,views=20,seed=0,turned=1" for i in (0, 1)}
    assert "turned" not in members_of("cars,count=2")["cars-0000"]


# The command


def grid_run(folder: Path, turn: torch.Tensor, name: str = "voxel-grid") -> Run:
    """A run of a voxel grid that holds the turned tripod."""
    from lumigraph import methods
    from lumigraph.run import build

    kind = methods.find(name)
    config = kind.smallest()
    if name == "voxel-grid":
        config = kind.Config(grids=type(config.grids)(cells=24))
    scene = tiny.scene()
    method = build(kind, scene.frame, config, torch.device("cpu"), 0)
    if name == "voxel-grid":
        axis = torch.linspace(-1, 1, 24)
        points = torch.cartesian_prod(axis, axis, axis) @ turn.float()
        with torch.no_grad():
            method.logits.copy_(torch.where(tripod(points) > 0, 4.0, -4.0).view(1, 1, 24, 24, 24))
            method.colour.zero_()
    run = Run.create(folder, method, scene)
    run.save(State(), method, method.optimizers(), torch.Generator())
    return run


def density(self, points):
    grid = torch.nn.functional.grid_sample(self.logits, points.flip(-1)[None, None, None], align_corners=True)
    return torch.nn.functional.softplus(10 * grid[0, 0, 0, 0] - 2)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Three runs of one thing in three poses, and how each was turned."""
    folder = tmp_path_factory.mktemp("collection") / "runs"
    turns = random(3, torch.Generator().manual_seed(4))
    for name, turn in zip(("one", "two", "ten"), turns, strict=True):
        grid_run(folder / name, turn)
    return folder, dict(zip(("one", "two", "ten"), turns, strict=True))


@pytest.fixture
def dense(monkeypatch):
    """Voxel grids that know their density."""
    from lumigraph import methods

    monkeypatch.setattr(methods.find("voxel-grid"), "density", density, raising=False)


def sums(folder: Path) -> dict[str, str]:
    return {str(x): hashlib.sha256(x.read_bytes()).hexdigest() for x in sorted(folder.rglob("*")) if x.is_file()}


def test_runs_are_written_as_they_stand_alike(runs, dense, tmp_path, monkeypatch, capsys):
    folder, turns = runs
    before, output = sums(folder), tmp_path / "aligned"
    said = ["canonicalise", str(folder), "--output", str(output), "--steps", "2", "--preset", "draft", "--like", "two"]
    assert main([*said, "--cells", "24"]) == 0 and "3 runs" in capsys.readouterr().out
    assert sums(folder) == before
    assert {x.name for x in output.iterdir()} == {"one.json", "two.json", "ten.json", "canonical.png", ".lumigraph"}
    opened = {name: open_any(output / f"{name}.json") for name in turns}
    written = torch.stack([opened[name].place.rotation for name in turns])
    assert float(rotation_errors(written, torch.stack(list(turns.values()))).max()) < 4
    assert float(angles(opened["two"].place.rotation[None], torch.eye(3)[None])) < 1e-3
    places = torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)) * 1.2 - 0.6
    solid = torch.stack([opened[name].method().density(places) > 10 for name in turns])
    assert 100 < int(solid[0].sum()) < 2000
    assert float(solid.all(0).sum() / solid.any(0).sum()) > 0.7  # the same places are full, by all of them
    assert main([*said, "--cells", "24"]) == 0  # its own folder, which nobody has changed
    (output / "one.json").write_text("{}")
    assert main(said) == 2 and "one.json in it is not as Lumigraph has written it" in capsys.readouterr().err


def test_exports_and_compositions_honour_them(runs, dense, tmp_path, monkeypatch, capsys):
    folder, turns = runs
    output, name = tmp_path / "aligned", "one"
    assert main(["canonicalise", str(folder), "--output", str(output), "--steps", "1", "--preset", "draft"]) == 0
    monkeypatch.chdir(tmp_path)
    file = open_any(output / "ten.json")
    low, high = torch.tensor(file.frame.bounds)
    assert file.frame.to_source.matrix.equal(torch.eye(4, dtype=torch.float64)) and file.photographed
    assert (
        main(
            [
                "export",
                "mesh",
                str(output / "ten.json"),
                "ten.ply",
                "--size",
                "32",
                "--views",
                "4",
                "--smooth",
                "0",
                "--cell-size",
                "0.05",
            ]
        )
        == 0
    )
    mesh = open_mesh(tmp_path / "ten.ply")
    assert (mesh.amin(0) > low - 0.1).all() and (mesh.amax(0) < high + 0.1).all()
    assert ((mesh.amax(0) - mesh.amin(0)) > 0.8 * (high - low)).all()
    seen = file.method().render(file.cameras()["train"][0])
    plain = file.run.method().render(file.run.cameras()["train"][0])
    assert torch.allclose(seen.rgb, plain.rgb, atol=2e-3)  # a camera that moved with it sees what it saw
    assert (
        main(["compose", str(folder / name), str(output / "ten.json"), "--at", "0", "0", "1", "--output", "both.json"])
        == 0
    )
    lead = Run(folder / name)
    stands = open_any("both.json").places[1]
    upright = standing(file.frame, lead.frame, torch.tensor([0.0, 0.0, 1.0]))
    assert torch.allclose(stands.matrix, (lead.frame.to_source.inverse @ upright).matrix, atol=1e-6)
    assert torch.allclose(
        upright.rotation @ torch.tensor([0.0, 0, 1]).double(), lead.frame.to_source.rotation[:, 2], atol=1e-6
    )
    assert main(["info", str(output / "ten.json")]) == 0 and "in the canonical frame" in capsys.readouterr().out
    assert main(["convert", str(output / "ten.json"), "voxel-grid", "--output", "no"]) == 2


def open_mesh(path: Path) -> torch.Tensor:
    from lumigraph.readers.meshes import read_shape

    shape = read_shape(path, "mesh")
    return shape.frame.to_source.points(torch.from_numpy(shape.mesh.vertices)).float()


def test_cameras_that_were_refined_move_along(runs, dense, tmp_path, monkeypatch):
    from dataclasses import replace

    from lumigraph.composition import Placed, compose

    run = Run(runs[0] / "one")
    method, cameras = run.method(), run.cameras()["train"]
    moved = Similarity.make(1.0, translation=torch.tensor([0.0, 0.1, 0.0])).matrix
    monkeypatch.setattr(type(method), "refined", lambda self, x: x.transformed(moved))
    place = Similarity.make(0.5, random(1, torch.Generator().manual_seed(0))[0], torch.tensor([1.0, 2.0, 3.0]))
    whole = compose(replace(run.frame), [Placed(method, place, leads=True)])
    found = whole.refined(cameras.transformed(place.matrix))
    assert torch.allclose(found.pose, cameras.transformed(moved).transformed(place.matrix).pose, atol=1e-5)


def refusal(capsys, *said: object) -> str:
    capsys.readouterr()
    assert main(["canonicalise", *map(str, said)]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("lumigraph: ")]
    assert len(told) == 1
    return told[0]


def test_what_cannot_be_aligned_is_told_in_a_sentence(runs, tmp_path, capsys, monkeypatch):
    folder, _ = runs
    assert "does not exist" in refusal(capsys, tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    assert "holds no runs" in refusal(capsys, tmp_path / "empty")
    assert "holds no runs with a density" in refusal(capsys, folder)  # no density: this grid is never asked for it
    assert main(["canonicalise", str(folder)]) == 2
    assert "one is passed over" in (told := capsys.readouterr().err) and "voxel-grid, which holds no density" in told
    assert "stay as they are" in refusal(capsys, folder, "--output", folder)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    assert "something else in it" in refusal(capsys, folder, "--output", tmp_path / "mine")


def test_a_run_that_nobody_is_like(runs, dense, tmp_path, capsys):
    told = refusal(capsys, runs[0], "--like", "three", "--steps", "1", "--output", tmp_path / "new")
    assert "There is no run three to stand like; there are one, ten, two" in told


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"bounds": [[0, 0, 0], [0, 1, 1]]}, "nothing between"),
        ({"agreement": 2}, "should be from 0 to 1"),
        ({"source": "gone"}, "gone does not exist"),
        ({"sauce": 1}, "nothing is known of 'sauce'"),
    ],
)
def test_a_damaged_file_is_refused(runs, tmp_path, said, words):
    import json

    sound = {"format": "lumigraph canonical 1", "source": str(runs[0] / "one"), "place": {}, "agreement": 0.5}
    sound |= {"bounds": [[-1, -1, -1], [1, 1, 1]]}
    (tmp_path / "x.json").write_text(json.dumps(sound))
    assert open_any(tmp_path / "x.json").agreement == 0.5
    (tmp_path / "x.json").write_text(json.dumps(sound | said))
    with pytest.raises(LumigraphError, match=words) as fault:
        open_any(tmp_path / "x.json")
    assert "\n" not in str(fault.value)


def test_a_folder_that_is_called_like_a_category_does_not_hide_it(tmp_path, monkeypatch):
    from lumigraph.synthetic import is_collection

    monkeypatch.chdir(tmp_path)
    Path("chairs").mkdir()
    assert not is_collection("chairs,member=3,turned=1") and members_of("chairs,count=1").keys() == {"chairs-0000"}
    assert is_collection("./chairs")
