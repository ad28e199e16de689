"""A film strip of a real capture under a moving sun, from a trained run.

    lumigraph capture banana --output SCENE
    lumigraph train instant-ngp SCENE --downscale 2 --seconds 90 --output RUN
    python benchmarks/relighting_film.py RUN --steps 600 --picture sun.jpg

NeRFactor takes over the run's field, learns materials and light from the photographs, and shows one camera's view in
the photographs' light, its albedo and visibility, and under a sun that moves around.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import tyro

from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.large import open_any
from lumigraph.methods.nerfactor import NeRFactor
from lumigraph.run import Run, State, build
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit


@dataclass(frozen=True)
class Options:
    run: tyro.conf.Positional[Path]
    steps: int = 600
    camera: int = 0
    size: int = 160  # longer side of the frames, pixels
    frames: int = 6
    columns: int = 5
    elevation: float = 30.0
    sun: float = 1.5
    sky: float = 0.25
    picture: Path = Path("sun.jpg")


def main(o: Options) -> None:
    opened = open_any(o.run)
    teacher, scene = opened.method(torch.device("cpu")), opened.open_scene(None)
    config = replace(NeRFactor.cpu_preset(), geometry_share=0.0)
    method = build(NeRFactor, scene.frame, config, torch.device("cpu"), 0)
    method.from_field(teacher, scene.cameras)
    with TemporaryDirectory() as folder:
        run = Run.create(Path(folder) / "run", method, scene)
        run.save(State(), method, method.optimizers(), torch.Generator().manual_seed(0))
        go_on_unless(fit(method, scene, run, steps=o.steps, show=False, rehearsal=False).signal)
    method.eval()
    camera = scene.cameras[o.camera]
    camera = camera.resized(o.size / int(camera.size.max()))
    pictures = {"the photographs' light": method.render(camera).rgb}
    pictures |= {name: method.given(show=name).render(camera).rgb for name in ("albedo", "normals", "visibility")}
    for k in range(o.frames):
        azimuth = 360 * (k + 0.5) / o.frames - 180
        told = method.given(sun_azimuth=azimuth, sun_elevation=o.elevation, sun=o.sun, sky=o.sky)
        pictures[f"sun at {azimuth:.0f} degrees"] = told.render(camera).rgb
    names = list(pictures)
    rows = [names[i : i + o.columns] for i in range(0, len(names), o.columns)]
    sheet = [Row(row, [pictures[name] for name in row]) for row in rows]
    save_picture(o.picture, contact_sheet(o.run.name, [""] * o.columns, sheet))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
