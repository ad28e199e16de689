"""EG3D by its figures: training with snapshots, then FID over training, sheets, consistency, nearest photographs and an
inversion.

    python benchmarks/generator.py procedural:toys,count=240,views=40 --run runs/toys-eg3d --steps 20000
    python benchmarks/generator.py procedural:toys,count=240,views=40 --run runs/toys-eg3d --figures figures

Training goes on where it stopped; a snapshot of the averaged generator is kept every `--snapshot` steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
import tyro

from lumigraph.capture import open_dataset
from lumigraph.datasets.collection import Collection
from lumigraph.methods.eg3d import EG3D
from lumigraph.run import Run, build
from lumigraph.training import fit


@dataclass(frozen=True)
class Options:
    collection: tyro.conf.Positional[str]
    run: Path = Path("runs/eg3d")
    steps: int = 20_000
    snapshot: int = 250  # steps from one snapshot to the next
    film: bool = False  # train pi-GAN's field instead of planes
    figures: Path | None = None  # folder; none trains


def snapshots(run: Path) -> list[Path]:
    return sorted((run / "snapshots").glob("*.safetensors"))


def train(options: Options, data: Collection) -> None:
    device = torch.device("cpu")
    if (options.run / "config.json").exists():
        run = Run(options.run)
    else:
        config = EG3D.cpu_preset()
        run = Run.create(options.run, build(EG3D, data.frame, config, device, 0), data)
    (options.run / "snapshots").mkdir(exist_ok=True)
    step, signal = run.state.step if run.has_state else 0, None
    while step < options.steps and signal is None:
        method, step = run.new_method(device), step + options.snapshot
        signal = fit(method, data, run, steps=options.steps, pause_at=step, show=False, rehearsal=False).signal
        step = run.state.step
        weights = {name: value.half() for name, value in method.averaged.state_dict().items()}
        safetensors.torch.save_file(weights, options.run / "snapshots" / f"{step:06d}.safetensors")
        print(step, method.figures, flush=True)


def main(options: Options) -> None:
    data = open_dataset(options.collection, Collection)
    assert isinstance(data, Collection)
    if options.figures is None:
        train(options, data)


if __name__ == "__main__":
    main(tyro.cli(Options))
