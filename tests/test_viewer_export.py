"""The viewer's tab Export: what `lumigraph export` does, with a client's crop and controls."""

from __future__ import annotations

from dataclasses import replace

import pytest
import tiny
from budgets import budget
from test_viewer import request_of, subject, until
from viewer_client import Client

from lumigraph.camera.crop import CropBox, Sphere
from lumigraph.commands.cli import main
from lumigraph.commands.export_menu import export_menu, run_export
from lumigraph.errors import LumigraphError
from lumigraph.viewer import Viewer, choose_address
from lumigraph.viewer.crop_panel import SPHERE
from lumigraph.viewer.shared import Exporter, ExportFormat, ExportOption

# A client may leave at any moment; viser warns of what was still on its way.
pytestmark = [budget("exports"), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]


def test_a_client_exports_what_it_sees(tmp_path):
    ran, faults = [], []

    def run(command, report) -> str:
        if "taken.ply" in command:
            raise LumigraphError("taken.ply is there already")
        ran.append(command)
        report("half of it")
        return "points  3"

    formats = {
        "web": ExportFormat(".html", "A page."),
        "points": ExportFormat(
            ".ply", "Points.", (ExportOption("count", "200"), ExportOption("way", "auto", ("auto", "depth")))
        ),
    }
    exporter = Exporter(
        formats, lambda kind, name, values, request: [kind, name, *values.values(), str(request.crop)], run
    )
    about = subject(tiny.scene(), tmp_path, exporter=exporter)
    with Viewer(tiny.method(about.frame).eval(), about, choose_address(port=0)) as viewer:
        client = Client(viewer.address.url)
        client.picture(width=120)
        (visitor,) = viewer._everyone()
        panel = visitor.export
        panel._notify = lambda title, text: faults.append(text)
        assert panel._name.value == "ball.html" and not panel._options["points"]["count"].visible
        client.turn(panel._format, "points")
        until(lambda: panel._name.value == "ball.ply" and panel._options["points"]["count"].visible)
        client.turn(panel._options["points"]["count"], "50")
        client.turn(panel._options["points"]["way"], "depth")
        client.turn(visitor.crop._shape, SPHERE)
        until(lambda: isinstance(visitor.request().crop, Sphere))
        client.turn(panel._button, True)
        until(lambda: "points  3" in panel._result.content and not panel._button.disabled)
        assert ran == [["points", "ball.ply", "50", "depth", str(visitor.request().crop)]]
        for name in ("taken.ply", "../up.ply"):
            client.turn(panel._name, name)
            until(lambda name=name: panel._name.value == name)
            client.turn(panel._button, True)
            until(lambda name=name: len(faults) == 1 + (name == "../up.ply"))
        assert "there already" in faults[0] and "letters" in faults[1] and len(ran) == 1
        client.close()


def test_every_export_is_offered_and_its_command_line_works(ball_run, tmp_path):
    menu = export_menu(ball_run, ball_run.method(), (), "auto")
    offered = {
        "web",
        "collision",
        "lightfield",
        "probes",
        "mesh",
        "panorama",
        "points",
        "stereo",
    }  # it has no Gaussians, no octree
    assert set(menu.formats) == offered
    options = {name: {option.name: option for option in kind.options} for name, kind in menu.formats.items()}
    assert (
        options["mesh"]["from"].choices == ("auto", "distance", "density", "own", "depth")
        and options["mesh"]["cell-size"].default == ""
    )
    assert options["mesh"]["unseen"].choices == ("default", "close", "cut") and "as" in options["web"]
    assert "1/256 of the box" in options["mesh"]["cell-size"].hint

    defaults = {name: option.default for name, option in options["points"].items()}
    box = CropBox((-1.0, -1.0, -1.0), (0.5, 0.5, 0.5))
    request = replace(request_of(tiny.scene().cameras[0], (60, 60)), crop=box)
    file = tmp_path / "ball.ply"
    command = menu.command("points", str(file), defaults | {"count": "500"}, request)
    assert command[5:] == ["--count=500", "--no-origin", "--box", *3 * ["-1.000000"], *3 * ["0.500000"]]
    assert main(command[1:]) == 0 and file.exists()


def test_a_browsers_text_stays_the_value_of_its_option(ball_run):
    menu = export_menu(ball_run, ball_run.method(), (), "auto")
    defaults = {option.name: option.default for option in menu.formats["panorama"].options}
    request = request_of(tiny.scene().cameras[0], (60, 60))
    placed = menu.command("panorama", "a.jpg", defaults | {"from": "0 -1.5 2"}, request)
    assert placed[-4:] == ["--from", "0", "-1.5", "2"]
    forced = menu.command("panorama", "a.jpg", defaults | {"from": "1 --overwrite 2"}, request)
    assert forced[-1] == "--from=1 --overwrite 2"


def test_a_failed_export_gives_its_sentence(tmp_path):
    with pytest.raises(LumigraphError, match=r"nothing does not exist"):
        run_export(
            ["lumigraph", "export", "points", str(tmp_path / "nothing"), str(tmp_path / "a.ply")], lambda _: None
        )
