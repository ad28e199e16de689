"""Methods on one scene at several resolutions at once: how each fares at each, trained for equally long.

    python benchmarks/multiscale.py procedural:still-life --methods nerf mip-nerf --seconds 600

The protocol of Barron 2021 (Mip-NeRF), section 4.1: every photograph at full, half, quarter and eighth size, all
learnt from together and all compared, PSNR and SSIM per view and averaged. Still-life shows aliasing best: at 200 x 200
pixels a rod of its abacus is about a pixel wide at full size, and a square of its chequered cube at an eighth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from rich.table import Table

from lumigraph import methods
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.views import evaluate
from lumigraph.figures import save_picture
from lumigraph.files import write_json
from lumigraph.opening import open_scene
from lumigraph.run import build
from lumigraph.system.console import console
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit


@dataclass(frozen=True)
class Options:
    scene: tyro.conf.Positional[str]
    methods: tuple[str, ...] = ("nerf", "mip-nerf")
    seconds: float = 600.0  # of training, each
    scales: int = 4
    downscale: int | None = None  # of the full size, on top
    seed: int = 0
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    sheets: Path | None = None  # folder for a contact sheet of each method
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    scene = open_scene(options.scene, downscale=options.downscale, scales=options.scales)
    result = [trained(name, scene, options) for name in options.methods]
    show(f"{options.scene}, {options.seconds:g} s each: dB (SSIM) by resolution", result)
    if options.output:
        write_json(options.output, result)


def trained(name: str, scene: Scene, options: Options) -> dict:
    """Train one method and compare it with all held-out photographs at all resolutions."""
    device, kind = torch.device(options.device), methods.find(name)
    method = build(kind, scene.frame, kind.preset(device), device, options.seed)
    outcome = fit(method, scene, seconds=options.seconds, seed=options.seed)
    go_on_unless(outcome.signal)
    evaluation = evaluate(method, scene)
    if options.sheets:
        save_picture(options.sheets / f"{name}.png", evaluation.contact_sheet(f"{name} · {evaluation.psnr:.2f} dB"))
    told = evaluation.to_json()
    del told["views"]
    return {
        "method": name,
        "scene": options.scene,
        "device": str(device),
        "steps": outcome.state.step,
        "seconds": outcome.state.seconds,
        **told,
    }


def show(title: str, result: list[dict]) -> None:
    sizes = list(result[0]["by_resolution"])
    table = Table("method", "steps", *sizes, "all", title=title)
    for row in result:
        cells = [*(row["by_resolution"][size] for size in sizes), row]
        table.add_row(row["method"], str(row["steps"]), *(f"{x['psnr']:.2f} ({x['ssim']:.3f})" for x in cells))
    console(width=160).print(table)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
