"""Several methods in one picture: what hides what, moved and turned as asked, and the file that says so."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from balls import BLUE, RED, WHITE, Dense, Marched, Pictured, Splatted, eye
from budgets import budget

from lumigraph.camera.crop import CropBox
from lumigraph.camera.rays import Look, Samples
from lumigraph.commands import cli
from lumigraph.composition import Placed, compose, frame_around, standing
from lumigraph.composition.composed import union
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.exchange import write_gaussians
from lumigraph.geometry import Similarity, to_matrix
from lumigraph.large import open_any
from lumigraph.method.capabilities import HasDensity, HasGaussians, HasLooks, can
from lumigraph.method.controls import Control
from lumigraph.run import files
from lumigraph.run.composition import (
    CompositionPart,
    place_from_json,
    place_to_json,
    read_composition,
    write_composition,
)
from lumigraph.volume import composite, packed

pytestmark = budget("runs")

HERE = Similarity.make(1.0)
KINDS = {"ray": Dense, "cloud": Splatted, "picture": Pictured}


def at(*place: float, scale: float = 1.0) -> Similarity:
    return Similarity.make(scale, translation=torch.tensor(place).double())


def turned(scale: float = 0.7) -> Similarity:
    """A place with everything in it."""
    rotation = to_matrix(torch.tensor([[0.8, 0.3, -0.4, 0.2]], dtype=torch.float64))[0]
    return Similarity.make(scale, rotation, torch.tensor([0.3, -0.2, 0.5]))


def middle(rendering) -> tuple[torch.Tensor, float, float]:
    """Colour, depth and opacity of the pixel in the middle."""
    height, width = rendering.depth.shape
    row, column = height // 2, width // 2
    return rendering.rgb[row, column], rendering.depth[row, column].item(), rendering.opacity[row, column].item()


@pytest.mark.parametrize(("first", "second"), [(a, b) for a in KINDS for b in KINDS])
def test_what_is_in_front_hides_what_is_behind_from_both_sides(first, second):
    """A red ball of radius 0.5 at the origin, a blue one of 0.25 two units along x."""
    parts = [Placed(KINDS[first](RED), HERE, leads=True), Placed(KINDS[second](BLUE), at(2.0, 0, 0, scale=0.5))]
    both = compose(WHITE, parts)
    for position, colour, depth in (((-3.0, 0, 0), RED, 2.5), ((5.0, 0, 0), BLUE, 2.75)):
        rgb, distance, opacity = middle(both.render(eye(position)))
        assert torch.allclose(rgb, torch.tensor(colour), atol=0.03), (position, rgb)
        assert abs(distance - depth) < 0.05 and opacity > 0.98
    across = both.render(eye((1.0, -6.0, 0.0), (1.0, 0, 0)))  # from the side both are seen, with nothing between them
    row = across.rgb[16]
    assert torch.allclose(row[10], torch.tensor(RED), atol=0.05)
    assert torch.allclose(row[22], torch.tensor(BLUE), atol=0.05)
    assert middle(across)[2] < 0.01 and torch.allclose(middle(across)[0], torch.ones(3), atol=0.01)


@pytest.mark.parametrize(("first", "second"), [("ray", "cloud"), ("cloud", "ray"), ("ray", "picture")])
def test_a_ball_inside_a_clear_one_is_seen_through_it(first, second):
    """Haze before and behind an opaque ball: only what is before it dims it."""
    haze = {"ray": lambda: Marched((0.0, 1.0, 0.0), radius=1.0, thickness=0.8)}.get(first)
    if haze is None:
        parts = [Placed(KINDS[first](RED), HERE), Placed(Marched((0.0, 1.0, 0.0), radius=1.0, thickness=0.8), HERE)]
    else:
        parts = [Placed(haze(), HERE), Placed(KINDS[second](RED), HERE)]
    rgb = middle(compose(WHITE, parts).render(eye((-3.0, 0, 0))))[0]
    through = math.exp(-0.8 * 0.5)
    expected = through * torch.tensor(RED) + (1 - through) * torch.tensor([0.0, 1.0, 0.0])
    assert torch.allclose(rgb, expected, atol=0.02)


@pytest.mark.parametrize("kind", KINDS)
def test_a_part_that_is_placed_looks_as_if_the_camera_had_moved(kind):
    method, place = KINDS[kind](RED, radius=0.4, centre=(0.2, 0.1, -0.1)), turned()
    camera = eye((-2.0, 1.0, 1.2), (0.3, -0.2, 0.5), 41)
    seen = compose(WHITE, [Placed(method, place), Placed(method, at(0, 0, -500.0))]).render(camera)
    expected = method.render(camera.transformed(place.inverse.matrix))
    hit = expected.opacity > 0.5
    assert 0.02 < hit.float().mean() < 0.9
    assert torch.allclose(seen.rgb, expected.rgb, atol=0.05)
    assert (seen.rgb - expected.rgb).abs().mean() < 1e-4
    assert torch.allclose(seen.depth[hit], place.scale * expected.depth[hit], rtol=2e-3)


def test_a_composition_of_one_part_is_that_part():
    for kind in (Dense, Splatted):
        method, camera = kind(RED), eye((-2.0, 0.4, 1.2))
        alone = compose(WHITE, [Placed(method, HERE, leads=True)]).render(camera)
        for name in ("rgb", "depth", "opacity"):
            assert torch.equal(getattr(alone, name), getattr(method.render(camera), name))


def test_cameras_may_come_nearer_to_a_part_than_its_own_did():
    """The part's own cameras kept 1.5 away; those of the picture see it from half of that."""
    far = Frame(near=1.5)
    parts = [Placed(Dense(RED), at(50.0, 0, 0), leads=True), Placed(Marched(BLUE, frame=far), HERE)]
    rgb, depth, _ = middle(compose(WHITE, parts).render(eye((-1.25, 0, 0))))
    assert torch.allclose(rgb, torch.tensor(BLUE), atol=1e-3) and abs(depth - 0.75) < 0.02


def test_a_union_is_exact(generator):
    """Random hazes that overlap in all ways, against the same two on a grid that holds every edge."""

    def haze() -> Look:
        counts = torch.tensor([3, 0, 5, 1, 0, 7])
        edges = [torch.randint(0, 64, (2 * n,), generator=generator).sort().values / 8 for n in counts.tolist()]
        begin, end = torch.cat([e[::2] for e in edges]), torch.cat([e[1::2] for e in edges])
        n = len(begin)
        density, rgb = torch.rand(n, generator=generator), torch.rand(n, 3, generator=generator)
        return Look("haze", Samples(begin, end, packed(counts)), density, rgb)

    def gridded(look: Look) -> tuple[torch.Tensor, torch.Tensor]:
        density, glow = torch.zeros(6, 64), torch.zeros(6, 64, 3)
        for i, ray in enumerate(look.samples.ray_index.tolist()):
            cells = slice(int(8 * look.samples.t_start[i]), int(8 * look.samples.t_end[i]))
            density[ray, cells] += look.density[i]
            glow[ray, cells] += look.density[i] * look.rgb[i]
        return density, glow

    looks = [haze(), haze(), haze()]
    found = union(looks)
    assert (found.samples.length > 0).all()
    joins = found.samples.t_start[1:] - found.samples.t_end[:-1]
    assert (joins[found.samples.ray_index.diff() == 0] >= 0).all()  # in order, and no piece lies over another
    density, glow = (sum(x) for x in zip(*map(gridded, looks), strict=True))
    grid = Samples.rows((torch.arange(64) / 8).expand(6, -1), torch.full((6,), 8.0))
    rgb = (glow / density.clamp_min(1e-9)[..., None]).flatten(0, 1)
    expected = composite(grid, density.flatten(), rgb)
    seen = composite(found.samples, found.density, found.rgb)
    assert torch.allclose(seen.rgb, expected.rgb, atol=1e-5)
    assert torch.allclose(seen.opacity, expected.opacity, atol=1e-5)


def test_a_composition_offers_what_all_its_parts_offer():
    cases = [
        ((Dense, Dense), (True, True, False)),
        ((Dense, Marched), (True, False, False)),
        ((Splatted, Splatted), (False, False, True)),
        ((Dense, Splatted), (False, False, False)),
        ((Dense, Pictured), (False, False, False)),
    ]
    for kinds, expected in cases:
        both = compose(WHITE, [Placed(kind(RED), HERE) for kind in kinds])
        assert tuple(can(both, x) for x in (HasLooks, HasDensity, HasGaussians)) == expected
        assert both.any_lens == expected[0] and not both.training
        with pytest.raises(LumigraphError, match="does not learn"):
            both.batch(None, torch.Generator())


class Dimmed(Marched):
    """A ball with a control."""

    controls = (Control("light", 1.0, range=(0.0, 1.0)),)

    def looks(self, rays):
        (look,) = super().looks(rays)
        return [replace(look, rgb=look.rgb * self.control("light"))]


def test_parts_are_told_what_they_have_a_control_for():
    both = compose(WHITE, [Placed(Dense(RED), at(0, 3.0, 0), leads=True), Placed(Dimmed(BLUE), HERE)])
    assert [control.name for control in both.controls] == ["light"]
    dark, camera = both.given(light=0.25), eye((-3.0, 0, 0))
    assert torch.allclose(middle(dark.render(camera))[0], 0.25 * torch.tensor(BLUE), atol=1e-3)
    assert torch.allclose(middle(both.render(camera))[0], torch.tensor(BLUE), atol=1e-3)  # it stays as it is
    with pytest.raises(LumigraphError, match="has no control 'sun'"):
        both.given(sun=1.0)


def test_density_adds_up_per_unit_of_the_picture():
    both = compose(
        WHITE, [Placed(Dense(RED, thickness=3.0), HERE), Placed(Dense(BLUE, thickness=5.0), at(0.4, 0, 0, scale=0.5))]
    )
    points = torch.tensor([[-0.3, 0, 0], [0.3, 0, 0], [0.6, 0, 0], [0.7, 0, 0]])
    assert torch.allclose(both.density(points), torch.tensor([3.0, 3.0 + 10.0, 10.0, 0.0]))


@pytest.mark.parametrize("kind", KINDS)
def test_a_box_cuts_a_part(kind):
    """Without the half towards -x, the ball behind it in -x is seen from +x to end in the middle."""
    half = CropBox((0.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    parts = [Placed(KINDS[kind](RED), HERE, half), Placed(KINDS[kind](BLUE), at(0.0, 0, 0, scale=0.4))]
    both = compose(WHITE, parts)
    rgb, depth, _ = middle(both.render(eye((3.0, 0, 0))))
    assert torch.allclose(rgb, torch.tensor(RED), atol=0.03) and abs(depth - 2.5) < 0.05
    if kind == "ray":  # of a surface seen in front of the box, nothing tells what is inside
        rgb, depth, _ = middle(both.render(eye((-3.0, 0, 0))))
        assert torch.allclose(rgb, torch.tensor(BLUE), atol=0.03) and abs(depth - 2.8) < 0.05


def test_clouds_of_several_kinds_become_one():
    plain, fine = Splatted(RED, degree=2), Splatted(BLUE, antialiased=True)
    with pytest.warns(LumigraphWarning, match="antialiasing filter"):
        cloud = compose(WHITE, [Placed(plain, HERE), Placed(fine, HERE)]).gaussians()
    assert len(cloud) == 3000 and cloud.degree == 2 and not cloud.antialiased


def test_a_part_stands_upright_on_the_spot():
    """Whatever its source's vertical is: here that of splat files, y down."""
    down = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
    to_file = Similarity.make(3.0, down, torch.tensor([1.0, 2.0, 3.0]))
    part = Frame(bounds=((-0.5, -0.5, -0.2), (0.5, 0.5, 0.8)), source_from_scene=to_file.rows)
    lead = Frame(source_from_scene=at(5.0, 5, 5, scale=2.0).rows)
    place = standing(part, lead, torch.tensor([6.0, 4.0, 5.0]), scale=0.1, turn=90.0)
    inside = lead.to_source.inverse @ place @ part.to_source
    assert torch.allclose(inside.points(torch.tensor([0.0, 0, -0.2])), torch.tensor([0.5, -0.5, 0.0]), atol=1e-6)
    assert torch.allclose(inside.directions(torch.tensor([0.0, 0, 1])), torch.tensor([0.0, 0, 1]), atol=1e-6)
    assert torch.allclose(inside.directions(torch.tensor([1.0, 0, 0])), torch.tensor([0.0, 1, 0]), atol=1e-6)
    assert abs(place.scale - 0.1) < 1e-9
    grown = frame_around(lead, [(part, inside, None)])
    assert grown.bounds == lead.bounds and grown.reach == 1.0
    grown = frame_around(lead, [(part, at(2.5, 0, 0), None)])
    assert grown.bounds == ((-1.0, -1.0, -1.0), (3.0, 1.0, 1.0)) and grown.reach == 4.0


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"scale": -1.0}, "scale is -1.0, and should be from 1e-9 to 1e9"),
        ({"scale": 0.0}, "scale is 0.0, and should be from 1e-9 to 1e9"),
        ([[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "more than move, turn and scale"),
        ([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "should be `array` of length 4, got 3"),
        ({"rotation": [0.0, 1.0]}, r"rotation is \[0.0, 1.0\], and should be `array` of length 4"),
        ({"rotation": [0, 0, 0, 0]}, "turns nothing"),
        ({"scales": 2.0}, "nothing is known of 'scales'"),
    ],
)
def test_places_that_are_none(said, words):
    with pytest.raises(LumigraphError, match=words):
        place_from_json(said)


def test_places_survive_their_file():
    for place in (HERE, turned(), at(1, 2, 3, scale=0.1)):
        back = place_from_json(json.loads(json.dumps(place_to_json(place))))
        assert torch.allclose(back.matrix, place.matrix, atol=1e-12)
    quarter = place_from_json({"rotation": 90, "translation": [1, 0, 0], "scale": 2})
    assert torch.allclose(quarter.points(torch.tensor([1.0, 0, 0])), torch.tensor([1.0, 2.0, 0.0]), atol=1e-6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two splat files."""
    folder = tmp_path_factory.mktemp("files")
    write_gaussians(folder / "red.ply", Splatted(RED).gaussians())
    write_gaussians(folder / "blue.ply", Splatted(BLUE).gaussians())
    return folder


def test_a_file_opens_as_it_was_written(folder):
    parts = [
        CompositionPart("red.ply", HERE),
        CompositionPart("blue.ply", at(0, -0.75, 0), CropBox((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))),
    ]
    write_composition(folder / "two.json", parts, lead=1)
    read, lead = read_composition(folder / "two.json")
    assert lead == 1 and [(p.source, p.box) for p in read] == [(p.source, p.box) for p in parts]
    opened = open_any(folder / "two.json")
    assert opened.title == "two" and not opened.photographed and set(opened.cameras()) == {"train"}
    seen = opened.method().render(opened.cameras()["train"][0].resized(0.1))
    assert seen.rgb.shape == (80, 80, 3)
    # Splat files have y down: the blue ball, which leads, stands above the red one. The picture is about the blue one.
    rows = torch.arange(80.0)[:, None]
    red, blue = ((seen.rgb[..., a] - seen.rgb[..., b]).clamp_min(0) for a, b in ((0, 2), (2, 0)))
    assert (blue * rows).sum() / blue.sum() < (red * rows).sum() / red.sum() - 10
    # The photographs' frame of the composition is that of the part which leads, as the file places it.
    middle = opened.frame.to_source.points(torch.zeros(3))
    assert torch.allclose(middle, torch.tensor([0.0, -0.75, 0.0]), atol=0.02)
    assert opened.frame.bounds[0][2] < -1.5 and opened.frame.reach == 64.0


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (
            {"parts": [{"source": "gone.ply"}]},
            r"names gone\.ply as a part, but there is no .*gone\.ply; correct its path",
        ),
        ({"parts": [{"source": "self.json"}]}, "holds itself, by way of its parts"),
        ({"parts": []}, "part 0 should lead, and there are 0"),
        ({"parts": [{"source": "red.ply"}], "lead": 1}, "part 1 should lead, and there are 1"),
        ({"parts": [{"source": "red.ply", "plaice": {}}]}, "nothing is known of 'plaice'"),
        ({"parts": [{"source": "red.ply", "box": [[0, 0, 0], [0, 1, 1]]}]}, "has nothing between"),
        ({"parts": [{"source": "red.ply", "place": [[1]]}]}, "should be `array` of length 4, got 1"),
        ({}, "does not hold what it should: it lacks `parts`"),
        ({"format": "lumigraph camera path 1"}, "is no composition: it does not say"),
    ],
)
def test_a_file_that_cannot_be_is_refused_in_a_sentence(folder, said, words):
    (folder / "self.json").write_text(json.dumps({"format": "lumigraph composition 1"} | said))
    with pytest.raises(LumigraphError, match=words) as fault:
        open_any(folder / "self.json")
    assert "self.json" in str(fault.value) and "\n" not in str(fault.value)


def test_a_circle_of_compositions_is_refused(folder):
    write_composition(folder / "inner.json", [CompositionPart("outer.json", HERE)])
    write_composition(folder / "outer.json", [CompositionPart("red.ply", HERE), CompositionPart("inner.json", HERE)])
    with pytest.raises(LumigraphError, match=r"outer\.json holds itself"):
        open_any(folder / "outer.json")


def test_each_path_is_opened_once_however_often_it_is_named(folder, monkeypatch):
    write_composition(folder / "many.json", [CompositionPart("red.ply", HERE)] * 400)
    opened, read = list[Path](), files.read_gaussians
    monkeypatch.setattr(files, "read_gaussians", lambda path: opened.append(path) or read(path))
    many = open_any(folder / "many.json")
    assert len(opened) == 1 and many.count == 400
    monkeypatch.setattr("lumigraph.system.memory.free_memory", lambda: 1 << 20)
    with pytest.raises(LumigraphError, match=r"many\.json with 400 parts would need .* GB of memory.*name fewer parts"):
        many.method()


def test_files_that_name_each_other_twice_end_in_a_sentence(folder):
    for i in range(25):
        part = CompositionPart(f"twice{i + 1}.json" if i < 24 else "red.ply", HERE)
        write_composition(folder / f"twice{i}.json", [part, part])
    with pytest.raises(LumigraphError, match=r"twice15\.json has 1,024 parts, and 1,000 are the most"):
        open_any(folder / "twice0.json")
    assert open_any(folder / "twice20.json").count == 32


def test_a_long_chain_of_compositions_ends_in_a_sentence(folder):
    for i in range(1500):
        said = {"format": "lumigraph composition 1", "parts": [{"source": f"chain{i + 1}.json"}]}
        (folder / f"chain{i}.json").write_text(json.dumps(said))
    with pytest.raises(LumigraphError, match=r"chain32\.json lies inside 32 compositions"):
        open_any(folder / "chain0.json")


def test_many_parts_that_march_take_fewer_rays_at_a_time():
    parts = [Placed(Marched(RED), HERE, leads=i == 0) for i in range(8)]
    assert compose(WHITE, parts).rays_per_chunk == Marched(RED).rays_per_chunk // 8


def test_the_command_writes_a_file_that_everything_opens(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    red, blue = str(folder / "red.ply"), str(folder / "blue.ply")
    said = ["compose", red, blue, "--at", "0", "-0.5", "0", "--scale", "0.5", "--turn", "30"]
    assert cli.main([*said, "--output", "on.json"]) == 0
    assert cli.main([*said, "--output", "on.json"]) == 0  # its own file, which nobody has changed
    (tmp_path / "theirs.json").write_text("{}")
    assert cli.main([*said, "--output", "theirs.json"]) == 2 and "--overwrite" in capsys.readouterr().err
    assert cli.main([*said, "--output", "on.json", "--overwrite", "--box", *"-2 -2 -2 2 2 2".split()]) == 0
    assert cli.main([*said, "--output", "on.txt"]) == 2 and cli.main([*said, "--output", "x.json", "--scale", "0"]) == 2
    first, second = json.loads((tmp_path / "on.json").read_text())["parts"]
    assert "place" not in first and (tmp_path / second["source"]).resolve() == (folder / "blue.ply").resolve()
    assert second["box"] == [[-2, -2, -2], [2, 2, 2]] and abs(second["place"]["scale"] - 0.5) < 1e-9
    capsys.readouterr()
    assert cli.main(["info", "on.json"]) == 0 and "a composition of 2 parts" in capsys.readouterr().out
    assert cli.main(["render", "on.json", "--frames", "2", "--size", "32"]) == 0
    assert (tmp_path / "renders/on/orbit.mp4").stat().st_size > 0
    assert cli.main(["export", "splats", "on.json", "on.ply"]) == 0 and "3,000" in capsys.readouterr().out
    assert cli.main(["compose", "on.json", red, "--at", "2", "0", "0", "--output", "three.json"]) == 0
    three = open_any("three.json").method().gaussians()
    assert len(three) == 4500
