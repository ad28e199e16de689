"""NeRFactor on a still life of known materials: albedo, normals, roughness, and views under lights that it never saw.

    python benchmarks/relighting.py --steps 3000 --picture relit.jpg
    python benchmarks/relighting.py --light known --steps 3000

It learns from photographs under one light and is rendered under the others, at held-out views. Beside it: the same
without visibility (learnt and rendered so), and ambient light alone (its own albedo and reflectance, in the mean
radiance of the new light from everywhere). Albedo is known up to a factor on each channel where the light is unknown:
it is scaled by least squares before anything is compared, as in the paper's section 4.2. PSNR is of sRGB-encoded
pictures: of whole ones before white, and of the pixels that the still life covers.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from lumigraph.camera import Camera
from lumigraph.components.training.development import encoded
from lumigraph.datasets.scene import Scene
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.files import write_json
from lumigraph.large import open_any
from lumigraph.light import EnvironmentLight
from lumigraph.methods.nerfactor import NeRFactor
from lumigraph.opening import open_scene
from lumigraph.run import Run, State, build
from lumigraph.synthetic import lit, scenes
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

FACTORS = "red", "green", "blue"


@dataclass(frozen=True)
class Options:
    size: int = 128  # pixels
    photographs: int = 50
    seed: int = 0
    trained_in: int = 0  # number of the light of the photographs
    lights: tuple[int, ...] = (1, 2, 3, 4)  # numbers of the others
    light: Literal["unknown", "known"] = "unknown"
    steps: int | None = None
    seconds: float | None = None
    views: int = 4  # held-out ones
    bounces: int = 0
    geometry: Path | None = None  # a trained run of the same scene whose field is taken over; None learns it anew
    baselines: bool = True
    picture: Path | None = None
    output: Path | None = None


@dataclass
class Truth:
    """One held-out view: exact layers, and pictures by light."""

    camera: Camera
    layers: dict[str, Tensor]
    covered: Tensor
    relit: dict[int, Tensor]


def main(options: Options) -> None:
    o = options
    name = f"procedural:materials,size={o.size},views={o.photographs},seed={o.seed},light={o.trained_in}"
    scene = open_scene(name + (f",bounces={o.bounces}" if o.bounces else ""))
    truths = [
        truth_of(scene, i, o) for i in scene.splits["test"].tolist()[:: max(1, len(scene.splits["test"]) // o.views)]
    ]
    truths = truths[: o.views]
    found, pictures = dict[str, Any](), dict[str, dict[int, Tensor]]()

    def note(title: str, method: NeRFactor, ambient: bool = False) -> None:
        figures = measured(method, truths, o, ambient)
        pictures[title] = figures.pop("pictures")
        found[title] = figures
        print(f"{title:20} " + "  ".join(f"{key} {value:.2f}" for key, value in figures.items()), flush=True)

    full = trained(scene, o, "traced")
    note("nerfactor", full)
    if o.baselines:
        note("ambient light alone", full, ambient=True)
        note("without visibility", trained(scene, o, "none"))
    if o.picture:
        rows = [Row(f"light {k}", [truths[0].relit[k], *(pictures[title][k] for title in pictures)]) for k in o.lights]
        save_picture(o.picture, contact_sheet(name, ["truth", *pictures], rows))
    if o.output:
        write_json(o.output, found)


def trained(scene: Scene, o: Options, visibility: Literal["traced", "none"]) -> NeRFactor:
    config = replace(NeRFactor.cpu_preset(), visibility=visibility, light=o.light, seed=o.seed)
    config = replace(config, geometry_share=0.0) if o.geometry else config
    method = build(NeRFactor, scene.frame, config, torch.device("cpu"), o.seed)
    with TemporaryDirectory() as folder:
        run = Run.create(Path(folder) / "run", method, scene)
        if o.geometry:
            method.from_field(open_any(o.geometry).method(torch.device("cpu")), scene.cameras)
            run.save(State(), method, method.optimizers(), torch.Generator().manual_seed(0))
        begin = time.process_time()
        go_on_unless(fit(method, scene, run, steps=o.steps, seconds=o.seconds, show=False, rehearsal=False).signal)
        print(f"visibility {visibility}: learnt in {time.process_time() - begin:.0f} processor seconds", flush=True)
    return method.eval()


def truth_of(scene: Scene, index: int, o: Options) -> Truth:
    camera = scene.cameras[index]
    layers = scene.photograph(index, ("albedo", "normals", "roughness", "visibility", "depth")).extra
    world = scenes.stage("materials", o.size, o.photographs, o.seed, light=o.trained_in, bounces=o.bounces).world
    relit = {}
    for k in o.lights:
        light = torch.from_numpy(lit(replace(world, environment=scenes.scene("materials").environment(k)), camera))
        relit[k] = before_white(encoded(light[..., :3].clamp(0, 1)), light[..., 3:])
    return Truth(camera, layers, layers["depth"].isfinite(), relit)


def before_white(rgb: Tensor, opacity: Tensor) -> Tensor:
    return rgb * opacity + 1 - opacity


def measured(method: NeRFactor, truths: list[Truth], o: Options, ambient: bool = False) -> dict[str, Any]:
    """Figures of a trained method over all views and lights."""
    plain = [method.render(truth.camera).cpu() for truth in truths]
    both = [(seen.opacity > 0.5) & truth.covered for seen, truth in zip(plain, truths, strict=True)]

    def pairs(layer: str) -> tuple[Tensor, Tensor]:
        found = [(seen.extra[layer][b], t.layers[layer][b]) for seen, t, b in zip(plain, truths, both, strict=True)]
        return torch.cat([a for a, _ in found]), torch.cat([b for _, b in found])

    albedo, exact = pairs("albedo")
    factor = ((albedo * exact).sum(0) / albedo.square().sum(0)).clamp(0, 4)
    normals, up = pairs("normals")
    roughness, rough = pairs("roughness")
    visible, free = pairs("visibility")
    degrees = torch.rad2deg((normals * up).sum(-1).clamp(-1, 1).acos())
    figures: dict[str, Any] = {
        "albedo dB": decibels((factor * albedo - exact).square().mean()),
        "normals deg": float(degrees.mean()),
        "median deg": float(degrees.median()),
        "roughness": float((roughness - rough).abs().mean()),
        "visibility": float((visible - free).abs().mean()),
    }
    pictures, whole, inside = {}, [], []
    for k in o.lights:
        light = scenes.scene("materials").environment(k)
        if ambient:
            mean = (light.radiance * light.solid_angles[..., None]).sum((0, 1)) / light.solid_angles.sum()
            light = EnvironmentLight(mean.expand_as(light.radiance).contiguous())
        relit = method.given(light, **dict(zip(FACTORS, factor.tolist(), strict=True)))
        for truth in truths:
            seen = relit.render(truth.camera).rgb.cpu()
            error = (seen - truth.relit[k]).square().mean(-1)
            whole.append(decibels(error.mean()))
            inside.append(decibels(error[truth.covered].mean()))
            pictures.setdefault(k, seen)
        figures[f"light {k} dB"] = float(np.mean(whole[-len(truths) :]))
    return {**figures, "relit dB": float(np.mean(whole)), "covered dB": float(np.mean(inside)), "pictures": pictures}


def decibels(error: Tensor) -> float:
    return float(-10 * error.log10())


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
