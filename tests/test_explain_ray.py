"""The figure of one ray: its numbers are the rendering's, and it draws what they say."""

from __future__ import annotations

import json
import math
from xml.etree import ElementTree

import pytest
import tiny
import torch
from budgets import budget
from solids import Seen, around, ball, painted
from test_instant_ngp import method as small_instant_ngp

import lumigraph.methods
from lumigraph.camera.rays import Look, Samples
from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.figures.charts import standalone
from lumigraph.lab.explain.ray import Sight, along_ray
from lumigraph.lab.explain.ray_figure import LEFT, RIGHT, ray_figure
from lumigraph.run import Run
from lumigraph.volume import composite

pytestmark = budget("exports")

NEAR, FAR, SIGMA = 2.0, 4.0, 3.0
SVG = "{http://www.w3.org/2000/svg}"


class TwoLooks(Seen):
    """A ball of even fog, looked at in few long samples and then in many short ones."""

    last_end = FAR

    def looks(self, rays):
        return [self.look("coarse", rays, 8), self.look("fine", rays, 50)]

    def look(self, name, rays, count):
        edges = torch.linspace(NEAR, FAR, count + 1)
        start, end = edges[:-1].repeat(len(rays)), edges[1:].clone().repeat(len(rays))
        end[count - 1 :: count] = self.last_end
        samples = Samples(start, end, count * torch.arange(len(rays) + 1))
        points, _ = samples.along(rays)
        return Look(name, samples, SIGMA * (self.shape(points) < 0).float(), painted(points))

    def render_rays(self, rays, background):
        look = self.looks(rays)[-1]
        return composite(look.samples, look.density, look.rgb, background)


def voxels():
    return tiny.method().eval(), tiny.scene().cameras[0]


def tables():
    scene = tiny.scene()
    made = small_instant_ngp(scene).eval()
    made.begin(scene)
    return made, scene.cameras[0]


def fog():
    return TwoLooks(ball(0.5)).eval(), around(4, 40)[1]


def drawn(sight: Sight) -> ElementTree.Element:
    return ElementTree.fromstring(standalone(ray_figure(sight, "A < B")))


def of_class(figure: ElementTree.Element, kind: str, name: str) -> list[dict[str, str]]:
    return [x.attrib for x in figure.iter(SVG + kind) if name in x.get("class", "").split()]


@pytest.mark.parametrize("made", [voxels, tables, fog])
@pytest.mark.parametrize("pixel", [(11, 11), (14, 9)])
def test_the_colour_built_up_is_the_pixel_that_is_rendered(made, pixel):
    method, camera = made()
    sight, whole = along_ray(method, camera, pixel), method.render(camera)
    x, y = pixel
    last = sight.passes[-1]
    assert torch.allclose(last.so_far[-1], whole.rgb[y, x], atol=1e-3)
    assert torch.allclose(sight.rgb, whole.rgb[y, x], atol=1e-3)
    assert sight.opacity == pytest.approx(float(whole.opacity[y, x]), abs=1e-3)
    assert sight.depth == pytest.approx(float(whole.depth[y, x]), rel=1e-3)
    background = torch.tensor(method.frame.background)
    for each in sight.passes:
        assert torch.equal(each.so_far[0], background) and each.transmittance[0] == 1
        assert torch.allclose(each.transmittance, 1 - torch.nn.functional.pad(each.weight.cumsum(0), (1, 0)), atol=1e-5)


def test_light_falls_exponentially_through_even_fog():
    method, camera = fog()
    coarse, fine = along_ray(method, camera, (20, 20)).passes
    assert (coarse.name, fine.name) == ("coarse", "fine") and (len(coarse), len(fine)) == (8, 50)
    inside = fine.density > 0
    depth = (fine.end - fine.start)[inside].cumsum(0)
    assert 0.9 < float(depth[-1]) < 1.1
    assert torch.allclose(fine.transmittance[1:][inside], torch.exp(-SIGMA * depth), atol=1e-5)


def test_the_figure_draws_every_sample_where_it_is():
    method, camera = fog()
    sight = along_ray(method, camera, (20, 20))
    photograph = torch.full((40, 40, 3), 0.25)
    figure = drawn(sight.beside(photograph))
    bars, patches = of_class(figure, "rect", "edge"), of_class(figure, "rect", "patch")
    glowing = int((sight.passes[-1].density > 0).sum())
    assert len(bars) == 8 + 50 + 2 and len(patches) == glowing + 51  # the last two are the pixel and its photograph
    assert bars[-1]["fill"] == "#404040" and bars[-2]["fill"] == patches[-1]["fill"]
    assert patches[glowing]["fill"] == "#ffffff"  # the background, ahead of the first sample
    heights = torch.tensor([float(bar["height"]) for bar in bars[8:58]])
    weight = sight.passes[-1].weight
    assert torch.allclose(heights / heights.max(), weight / weight.max(), atol=2e-3)
    ticks = [x["d"].count("M") for x in of_class(figure, "path", "thin") if "v10" in x["d"]]
    assert ticks == [8, 50]
    (line,) = of_class(figure, "path", "depth")
    left, right = float(bars[8]["x"]), float(bars[57]["x"])
    at = float(line["d"][1:].split()[0])
    share = (sight.depth - NEAR) / (FAR - (FAR - NEAR) / 50 - NEAR)
    assert at == pytest.approx(left + share * (right - left), abs=0.2)
    (picture,) = figure.iter(SVG + "image")
    assert picture.get("href", "").startswith("data:image/png;base64,")
    text = "".join(figure.itertext())
    assert "A < B" in text and "coarse sample" in text and "photograph" in text and "NaN" not in text


def test_a_sample_without_end_leaves_room_for_the_others():
    method, camera = fog()
    method.last_end = 1e10
    bars = of_class(drawn(along_ray(method, camera, (20, 20))), "rect", "edge")[8:58]
    assert all(LEFT <= float(bar["x"]) and float(bar["x"]) + float(bar["width"]) <= RIGHT + 0.1 for bar in bars)
    assert float(bars[0]["width"]) > 5


def test_empty_space_can_be_drawn_too():
    method, camera = fog()
    sight = along_ray(method, camera, (0, 0))
    assert sight.opacity == 0 and math.isinf(sight.depth) and sight.to_json()["depth"] is None
    assert not of_class(drawn(sight), "path", "depth")


def test_what_cannot_be_drawn_is_said():
    method, camera = fog()
    for pixel in ((40, 0), (0, 40), (-1, 5)):
        with pytest.raises(LumigraphError, match="outside of the picture.*39 39"):
            along_ray(method, camera, pixel)
    with pytest.raises(LumigraphError, match="no samples along rays"):
        along_ray(Seen(ball()).eval(), camera, (0, 0))
    splats = lumigraph.methods.find("gaussian-splatting")
    with pytest.raises(LumigraphError, match="no samples along rays"):
        along_ray(splats(tiny.scene().frame, splats.Config()), camera, (0, 0))
    carved, camera = tables()
    with pytest.raises(LumigraphError, match="No sample"):
        along_ray(carved, camera, (0, 0))


@pytest.fixture(scope="module")
def trained(ball_folder, tmp_path_factory):
    run = tmp_path_factory.mktemp("explain") / "run"
    arguments = ["--output", str(run), "--steps", "30", "--device", "cpu"]
    assert main(["train", "voxel-grid", str(ball_folder), *arguments]) == 0
    return run


def test_the_command_writes_a_figure_and_its_numbers(trained, capsys):
    names = Run(trained).view_names()["test"]
    assert main(["explain", "ray", str(trained), "--pixel", "12", "10", "--view", names[1], "--device", "cpu"]) == 0
    said = capsys.readouterr().out
    figure = next((trained / "rays").glob("*-12-10.svg"))
    ElementTree.parse(figure)
    numbers = json.loads(figure.with_suffix(".json").read_text())
    run = Run(trained)
    seen = run.method().render(run.cameras()["test"][1]).rgb[10, 12]
    assert torch.allclose(torch.tensor(numbers["rgb"]), seen, atol=1e-3)
    *rgb, alpha = tiny.picture(tiny.poses()[4])[10, 12] / 255  # every fourth view is held out
    assert numbers["photograph"] == pytest.approx([alpha * c + 1 - alpha for c in rgb], abs=1e-5)
    assert numbers["view"] == names[1] and len(numbers["passes"][0]["weight"]) == 24
    assert "photograph" in said and figure.name in said


def test_the_command_does_without_photographs(trained, tmp_path, monkeypatch, capsys):
    def gone(self, source=None):
        raise LumigraphError("the photographs are gone")

    monkeypatch.setattr(Run, "scene", gone)
    output = tmp_path / "ray.svg"
    command = ["explain", "ray", str(trained), "--view", "2", "--split", "train", "--output", str(output)]
    assert main(command) == 0
    assert "gone" in capsys.readouterr().err
    assert json.loads(output.with_suffix(".json").read_text())["pixel"] == [12, 12]  # the middle
    assert main([*command, "--scene", "elsewhere"]) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--view", "3"], "from 0 to 2"),
        (["--view", "nobody"], "'nobody'"),
        (["--split", "val"], "--split"),
        (["--pixel", "24", "0"], "--pixel"),
        (["--output", "ray.png"], ".svg"),
    ],
)
def test_misuse_is_said_in_a_sentence(trained, capsys, arguments, words):
    assert main(["explain", "ray", str(trained), *arguments]) == 2
    assert words in capsys.readouterr().err and not (trained / "ray.png").exists()
