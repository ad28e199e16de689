"""Light probes: harmonics, octahedral maps, files, light between probes, lit meshes and their shadows, the page."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
import torch
import trimesh
from balls import Dense, eye
from budgets import budget
from windows import SIZE, psnr

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.camera.rays import Rendering
from lumigraph.commands.cli import main
from lumigraph.components.training.development import decoded, encoded
from lumigraph.composition import LitComposition, LitMesh, Placed, ShadedMesh
from lumigraph.datasets.mesh import Mesh
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError
from lumigraph.export.options import ProbesOptions
from lumigraph.export.probes import bake_probes
from lumigraph.export.probes_page import ball, probes_page
from lumigraph.geometry import Similarity, look_at, unit
from lumigraph.large import open_any
from lumigraph.light.probes import FREE, MATTER, ProbeGrid, projected, read_probes, write_probes
from lumigraph.light.probes.harmonics import convolved, evaluated
from lumigraph.light.probes.octahedral import bordered, looked_up, texel_directions
from lumigraph.light.probes.octahedral import decoded as unfolded
from lumigraph.light.probes.octahedral import encoded as folded
from lumigraph.method import Method

pytestmark = budget("exports", 9)

BOX = ((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8))


class Room(Method):
    """A cube of walls at +-1, and a wall at x = 0 if divided: light on the side of negative x, black on the other."""

    def __init__(self, frame: Frame, divided: bool = False, light: float = 1.0):
        super().__init__(frame, None)
        self.divided, self.light = divided, light

    def batch(self, data, generator):
        raise NotImplementedError

    def render(self, camera):
        rays = camera.rays(camera.pixels())
        o, d = rays.origins, rays.directions
        t = ((d.sign() - o) / d).nan_to_num(torch.inf, torch.inf).amin(-1)
        dark = o[:, 0] > 0
        if self.divided:
            to_wall = -o[:, 0] / d[:, 0]
            t = torch.where((to_wall > 1e-6) & (to_wall < t), to_wall, t)
        else:
            dark = torch.zeros_like(dark)
        rgb = torch.where(dark[:, None], 0.0, encoded(torch.full((3,), self.light))).expand(len(o), 3)
        return Rendering(rgb, t, torch.ones_like(t)).reshape(*camera.size[0].flip(0).tolist())


def directions(count: int = 4000) -> torch.Tensor:
    return unit(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)))


def uniform(light: float = 1.0, counts=(2, 2, 2), order: int = 3) -> ProbeGrid:
    """Probes in the same light everywhere, far from anything."""
    count = math.prod(counts)
    radiance = torch.zeros(count, (order + 1) ** 2, 3)
    radiance[:, 0] = light * math.sqrt(4 * math.pi)
    maps = torch.full((count, 6, 6), 100.0)
    state = torch.zeros(count, dtype=torch.int64)
    up = torch.tensor([0.0, 0.0, 1.0])
    return ProbeGrid(-torch.ones(3), 2 * torch.eye(3), counts, radiance, maps, maps**2, state, 100.0, up)


def test_irradiance_of_known_lights():
    """L = 1 + w . a has E(n) = pi + 2 pi / 3 n . a; of a narrow light order 2 keeps E within a tenth (Ramamoorthi)."""
    w, a = directions(), unit(torch.tensor([1.0, 2.0, -1.0]))
    rows = torch.arange(200) + 0.5
    theta, phi = math.pi * rows / 200, 2 * math.pi * (torch.arange(100) + 0.5) / 100
    z, x, y = theta.cos()[:, None].expand(200, 100), theta.sin()[:, None] * phi.cos(), theta.sin()[:, None] * phi.sin()
    sphere, angles = torch.stack([x, y, z], -1).reshape(-1, 3), theta.sin()[:, None].expand(200, 100).reshape(-1)
    for order in (2, 3):
        smooth = convolved(projected(sphere, (1 + sphere @ a)[:, None].expand(-1, 3), angles, order))
        expected = math.pi + 2 * math.pi / 3 * (w @ a)
        assert (evaluated(smooth[None], w)[:, 0] - expected).abs().max() < 2e-3
        lamp = (sphere @ a > 0.99).float()[:, None].expand(-1, 3)
        power = float((lamp[:, 0] * angles).sum() / angles.sum()) * 4 * math.pi
        found = evaluated(convolved(projected(sphere, lamp, angles, order))[None], w)[:, 0] / power
        assert 0.03 < (found - (w @ a).clamp_min(0)).abs().max() < 0.1


def test_octahedral_maps_are_continuous():
    """Places and directions invert each other, and a smooth function is smooth across the fold and the corners."""
    w = directions()
    assert torch.allclose(unfolded(folded(w)), w, atol=1e-5)
    side = 64
    texels = texel_directions(side)
    a = unit(torch.tensor([0.3, -0.5, -0.8]))
    maps = bordered((texels @ a).view(1, side, side))
    assert (looked_up(maps, torch.zeros(len(w), dtype=torch.int64), w) - w @ a).abs().max() < 0.03


@pytest.mark.parametrize("order", [2, 3])
def test_files_hold_the_probes(tmp_path, order):
    chance = torch.Generator().manual_seed(1)
    made = uniform(counts=(3, 2, 4), order=order)
    count = len(made)
    radiance, mean = torch.randn(made.radiance.shape, generator=chance), torch.rand(count, 6, 6, generator=chance)
    state = torch.randint(0, 3, (count,), generator=chance)
    made = dataclasses.replace(made, radiance=radiance, mean=mean, squared=mean**2, state=state, far=1.5)
    write_probes(tmp_path / "out", made)
    found = read_probes(tmp_path / "out" / "probes.json")
    span = float(radiance.max() - radiance.min())
    assert (found.radiance - radiance).abs().max() < span / 65_535
    assert (found.mean - mean).abs().max() < 1.5 / 65_535 and (found.squared - mean**2).abs().max() < 2.25 / 65_535
    assert torch.equal(found.state, state) and found.counts == made.counts and found.order == order
    assert torch.allclose(found.positions, made.positions)


def test_damaged_files_are_refused(tmp_path):
    write_probes(tmp_path / "p", uniform())
    index, picture = tmp_path / "p" / "probes.json", tmp_path / "p" / "radiance.png"
    said, whole = json.loads(index.read_text()), picture.read_bytes()
    wrong = [
        ({"order": 5}, "order 5, and 2 and 3 are read"),
        ({"counts": [2, 2]}, "counts"),
        ({"low": said["low"][:4]}, "lacks the range"),
        ({"axes": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "span no space"),
        ({"format": "another"}, "no index of probes"),
        ({"order": 2, "low": said["low"][:9], "high": said["high"][:9]}, "its index promises 27x8"),
    ]
    for change, sentence in wrong:
        index.write_text(json.dumps(said | change))
        with pytest.raises(LumigraphError, match=sentence):
            read_probes(tmp_path / "p")
    index.write_text(json.dumps(said))
    picture.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(LumigraphError, match="cannot be read"):
        read_probes(tmp_path / "p")
    picture.unlink()
    with pytest.raises(LumigraphError, match="does not exist"):
        read_probes(tmp_path / "p")
    with pytest.raises(LumigraphError, match=r"holds no probes\.json"):
        read_probes(tmp_path)


def test_probes_of_a_room_in_another_frame():
    """In a room of one colour irradiance is pi times its light wherever one asks, distances are those to the walls, and
    all lies in the frame of exports."""
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2)))[0]
    to_source = Similarity.make(2.5, turn * torch.linalg.det(turn), torch.tensor([1.0, 2.0, 3.0]))
    room = Room(Frame(bounds=BOX, near=0.01, source_from_scene=to_source.rows, scale=2.0), light=0.4)
    grid = bake_probes(room, None, BOX, ProbesOptions(counts=(3, 3, 2), resolution=16))
    assert (grid.state == FREE).all() and grid.counts == (3, 3, 2)
    points, normals = 0.7 * directions(50), directions(50)
    there = room.frame.to_export
    light = grid.irradiance(there.points(points), there.directions(normals))
    assert (light - 0.4 * math.pi).abs().max() < 0.01
    assert torch.allclose(grid.positions[0], there.points(torch.tensor([[-0.8 + 1.6 / 6] * 2 + [-0.4]]))[0], atol=1e-4)
    down = there.directions(torch.tensor([[0.0, 0.0, -1.0]]))
    below = looked_up(grid.mean, torch.zeros(1, dtype=torch.int64), down)
    assert abs(float(below) / there.scale - 0.6) < 0.05


def test_walls_keep_light_out():
    """Behind a wall in the middle of a cell next to nothing of the light beyond it counts, and without visibility its
    trilinear share does."""
    room = Room(Frame(bounds=BOX, near=0.01), divided=True)
    grid = bake_probes(room, None, BOX, ProbesOptions(counts=(2, 3, 3), resolution=16))
    points = torch.tensor([[0.25, y, 0.1] for y in (-0.3, 0.0, 0.4)])
    normals = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    plain = dataclasses.replace(grid, mean=torch.full_like(grid.mean, grid.far))
    assert grid.irradiance(points, normals).max() < 0.04 * math.pi
    assert plain.irradiance(points, normals).min() > 0.12 * math.pi
    other = points * torch.tensor([-1.0, 1.0, 1.0])
    assert grid.irradiance(other, normals).min() > 0.95 * math.pi


def test_probes_in_matter_are_marked():
    """A ball of even density: probes inside are in matter, those around it are free, and none sees an empty region."""
    method = Dense((0.9, 0.1, 0.1), radius=0.5)
    grid = bake_probes(method, None, BOX, ProbesOptions(counts=(3, 3, 3), resolution=8))
    inside = grid.positions.norm(dim=-1) < 0.45
    assert (grid.state[inside] == MATTER).all() and (grid.state[grid.positions.norm(dim=-1) > 0.6] == FREE).all()
    with pytest.raises(LumigraphError, match="sees any matter"):
        bake_probes(
            Dense((1.0, 0, 0), centre=(9.0, 9, 90), radius=0.01),
            None,
            BOX,
            ProbesOptions(counts=(1, 1, 1), resolution=8),
        )
    with pytest.raises(LumigraphError, match="All probes lie in matter"):
        bake_probes(method, None, ((-0.2,) * 3, (0.2,) * 3), ProbesOptions(counts=(2, 2, 2), resolution=8))
    with pytest.raises(LumigraphError, match="is none that a file holds"):
        bake_probes(method, None, BOX, ProbesOptions(counts=(0, 2, 2)))


def test_shading_normals_keep_creases():
    """A cube keeps its faces flat, a ball's normals point outward."""
    cube = trimesh.creation.box()
    flat = ShadedMesh.of(
        Mesh(np.asarray(cube.vertices), np.asarray(cube.faces, np.int64), np.full((8, 3), 255, np.uint8))
    )
    assert len(flat.vertices) == 24 and (flat.normals.abs().amax(-1) > 0.999).all()
    round_one = ball()
    assert (unit(round_one.vertices) - round_one.normals).abs().max() < 0.02


def test_a_ball_hides_its_solid_angle():
    """Under an even sky a ball of radius r hides (n . w) (r / d)^2 of the irradiance of a point below it at distance d;
    a convex mesh hides nothing of itself, and shows albedo times the light."""
    grid, place = uniform(0.5, (2, 2, 2)), Similarity.make(0.25)
    mesh = LitMesh(Frame(), ball(), grid, place)
    for point in ([0.0, 0.0, -0.6], [0.3, 0.0, -0.5], [0.9, 0.1, -0.4]):
        p = torch.tensor([point])
        expected = 1 - (-p[0, 2] / p.norm()) * (0.25 / p.norm()) ** 2
        found = mesh.shadows.shares(p, torch.tensor([[0.0, 0.0, 1.0]]), grid)
        assert (found - expected).abs().max() < 0.02, point
    assert mesh.openness.min() > 0.97
    seen = mesh.render(eye((-3.0, 0.0, 0.0)))
    albedo = decoded(torch.full((3,), 230 / 255))
    assert (decoded(seen.rgb[16, 16]) - 0.5 * albedo).abs().max() < 0.01


def test_a_mesh_in_a_room_casts_a_shadow():
    """The floor is darker under the ball, unchanged far from it, and hides the ball's lower half where it is nearer."""
    room = Room(Frame(bounds=BOX, near=0.01), light=0.6)
    grid = bake_probes(room, None, BOX, ProbesOptions(counts=(3, 3, 3), resolution=8))
    placed = Placed(LitMesh(Frame(), ball(), grid, Similarity.make(0.3, None, torch.tensor([0.0, 0.0, -0.8]))),
                    Similarity.make(0.3, None, torch.tensor([0.0, 0.0, -0.8])))  # fmt: skip
    both = LitComposition(room.frame, [Placed(room, Similarity.make(1.0), leads=True), placed])
    camera = eye((-0.9, 0.0, 0.3), (0.0, 0.0, -0.9), 65)
    bare, seen = room.render(camera), both.render(camera)
    ball_pixels = seen.depth < bare.depth - 1e-3
    assert 0.02 < ball_pixels.float().mean() < 0.4
    floor = camera.rays(camera.pixels()).at(seen.depth.flatten()).view(65, 65, 3)
    beneath = ~ball_pixels & (floor[..., 2] < -0.95) & (floor[..., :2].norm(dim=-1) < 0.33)
    far = ~ball_pixels & (floor[..., :2].norm(dim=-1) > 0.95)
    assert seen.rgb[beneath].mean() < 0.9 * bare.rgb[beneath].mean()
    assert (seen.rgb - bare.rgb)[far].abs().max() < 0.06
    lit = decoded(seen.rgb[ball_pixels])
    assert (lit.median(0).values - 0.6 * decoded(torch.full((3,), 230 / 255))).abs().max() < 0.06


def test_from_the_command_line(ball_run, tmp_path, capsys):
    """Export, compose and render; and what is refused in a sentence."""
    folder, mesh = tmp_path / "probes", tmp_path / "cube.obj"
    trimesh.creation.box().export(mesh)
    run = str(ball_run.folder)
    assert main(["export", "probes", run, str(folder), "--counts", "2", "2", "3", "--resolution", "8"]) == 0
    assert read_probes(folder).counts == (2, 2, 3)
    both = tmp_path / "both.json"
    words = ["compose", run, str(mesh), "--output", str(both), "--probes", str(folder), "--at", "0.9", "0", "0"]
    assert main([*words, "--scale", "0.3"]) == 0
    opened = open_any(both)
    camera = opened.cameras()["train"][0]
    seen, alone = opened.method().render(camera), ball_run.method().render(camera)
    assert 0.01 < (seen.rgb - alone.rgb).abs().amax(-1).gt(0.05).float().mean() < 0.5
    assert main(["render", str(both), "--frames", "2", "--size", "16", "--output", str(tmp_path / "a.gif")]) == 0
    for wrong, sentence in (
        (
            ["export", "probes", run, str(tmp_path / "q"), "--counts", "2", "2", "2", "--spacing", "1"],
            "give one of them",
        ),
        (["export", "probes", run, str(tmp_path / "q"), "--mesh", str(mesh)], "give --page"),
        (["compose", run, str(mesh), "--output", str(both), "--probes", str(tmp_path)], "holds no probes.json"),
    ):
        assert main(wrong) != 0
        assert sentence in " ".join(capsys.readouterr().err.split())


def test_the_page_lights_the_ball_as_we_do(tmp_path, window):
    """The ball in the page against our own rendering of it, and the mouse moves it."""
    room = Room(Frame(bounds=BOX, near=0.05), divided=True)
    grid = bake_probes(room, None, BOX, ProbesOptions(counts=(4, 4, 4), resolution=8))
    position = torch.tensor([[-0.8, -0.7, 0.3]])
    pose = look_at(position, torch.tensor([[0.75, 0.8, -0.5]]), torch.tensor([0.0, 0.0, 1.0]))
    camera = Camera(
        pose, Pinhole(torch.full((1, 2), 1.2 * SIZE), torch.full((1, 2), SIZE / 2)), torch.full((1, 2), SIZE)
    )
    place = (-0.1, 0.0, -0.2)
    probes_page(tmp_path / "page.html", room, camera, grid, "A room", place=(place, 0.3))
    opened = window(tmp_path / "page.html")
    shown = opened.settled()
    where = Similarity.make(0.15, None, torch.tensor(place))
    mesh = Placed(LitMesh(Frame(), ball(), grid, where), where).rendering(camera)
    inside = (mesh.opacity > 0.999).numpy()
    assert inside.mean() > 0.02
    assert psnr(shown[inside], mesh.rgb.numpy()[inside]) > 35
    before = opened.picture()
    opened.page.mouse.move(*[int(x) for x in np.argwhere(inside).mean(0)[::-1]])
    opened.page.mouse.down()
    opened.page.mouse.move(SIZE // 4, 3 * SIZE // 4, steps=2)
    opened.page.mouse.up()
    assert psnr(opened.settled(), before) < 30
