"""Whether what was photographed stays in the viewer's window when somebody drags.

    lumigraph train gaussian-splatting CAPTURE --seconds 60 --output RUN
    python benchmarks/viewer_drag.py RUN ... --output drag

Opens each run in a headless Chromium, at a desktop's and at a phone's size, drags 60 pixels to the right, and says
where the focus of the photographs is before and after, in the window's half-sizes from its middle, and what share of
the scene around the focus is in the window (of the Gaussians' centres, or of the bounds' corners for other methods,
within a third of the typical distance). Writes a picture before and after.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from jaxtyping import Float
from torch import Tensor
from tyro.conf import Positional

from lumigraph.camera import Camera
from lumigraph.commands.view import subject_of
from lumigraph.files import write_json
from lumigraph.large import open_any
from lumigraph.method import Method
from lumigraph.method.capabilities import HasGaussians, can, needs
from lumigraph.viewer import Subject, Viewer, choose_address

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from waiting import until

SIZES = {"desktop": (1280, 800), "phone": (390, 844)}
DRAG = 60  # pixels
REST = 3.0  # seconds that the browser is given to draw
PATIENCE = 180.0  # seconds that it may take for anything, on a busy machine
NEAR_FOCUS = 1 / 3  # of the typical distance to the focus: what belongs to what was photographed
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")


@dataclass(frozen=True)
class Options:
    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN")]
    output: Path = Path("drag")
    chromium: Path = Path("/usr/bin/chromium")


def main(options: Options) -> None:
    options.output.mkdir(parents=True, exist_ok=True)
    found = []
    with browser(options.chromium) as chromium:
        for path in options.runs:
            opened = open_any(path)
            method, subject = opened.method(), subject_of(opened)
            with Viewer(method, subject, choose_address(port=0)) as viewer:
                for name, size in SIZES.items():
                    about = {"run": path.name, "window": name}
                    about |= dragged(viewer, chromium, size, options.output / f"{path.name}-{name}")
                    found.append(about)
                    print(about, flush=True)
    write_json(options.output / "drag.json", found)


def dragged(viewer: Viewer, chromium: Any, size: tuple[int, int], output: Path) -> dict[str, Any]:
    """What is in a window of (width, height) before and after a drag."""
    context = chromium.new_context(viewport={"width": size[0], "height": size[1]})
    context.set_default_timeout(1000 * PATIENCE)
    page = context.new_page()
    known = set(map(id, viewer._everyone()))
    page.goto(viewer.address.url)
    visitor = until(lambda: next((v for v in viewer._everyone() if id(v) not in known), None), PATIENCE)
    things = around_focus(viewer.method, viewer.subject)
    result: dict[str, Any] = {"distance": round(viewer.subject.opening.distance, 3)}

    def note(moment: str) -> None:
        until(visitor.painter.settled.is_set, PATIENCE)
        time.sleep(REST)
        page.screenshot(path=f"{output}-{moment}.png")
        camera = visitor.request().camera(size)
        (place,), _ = seen(camera, viewer.subject.around.focus[None].float())
        _, share = seen(camera, things)
        result.update(
            {f"focus {moment}": [round(x, 2) for x in place.tolist()], f"in window {moment}": round(share, 3)}
        )

    note("before")
    start = visitor.request().pose
    page.mouse.move(size[0] // 3, size[1] // 2)
    page.mouse.down()
    page.mouse.move(size[0] // 3 + DRAG, size[1] // 2, steps=6)
    page.mouse.up()
    until(lambda: visitor.request().pose != start, PATIENCE)
    note("after")
    context.close()
    return result


def seen(camera: Camera, points: Float[Tensor, "point 3"]) -> tuple[Float[Tensor, "point 2"], float]:
    """Places in half-sizes of the window from its middle, and the share of points that are inside and in front."""
    pixels, valid = camera.project(points)
    half = camera.size[0] / 2
    places = pixels / half - 1
    inside = valid & (places.abs() < 1).all(-1)
    return places, float(inside.double().mean())


def around_focus(method: Method, subject: Subject) -> Float[Tensor, "point 3"]:
    """Centres of Gaussians, or corners of the bounds, that are near to what the photographs look at."""
    focus = subject.around.focus.float()
    if can(method, HasGaussians):
        cloud = needs(method, HasGaussians).gaussians()
        points = cloud.means.detach().cpu()[cloud.opacities.detach().cpu() > 0]
    else:
        points = torch.cartesian_prod(*torch.tensor(subject.frame.bounds).T)
    typical = float(subject.around.polar[:, 2].median().exp())
    away = (points - focus).norm(dim=-1)
    near = points[away < NEAR_FOCUS * typical]
    return near if len(near) else focus[None]


@contextlib.contextmanager
def browser(program: Path) -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=str(program), args=list(WEBGL))
        yield chromium
        chromium.close()


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
