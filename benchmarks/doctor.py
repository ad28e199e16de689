"""Findings on spoiled photographs: one blurred, one mirrored, one of another scene, one pose turned by 5 degrees.

    python benchmarks/doctor.py FOLDER [FOLDER ...] [--method gaussian-splatting] [--steps 600] [--downscale 2]

Each folder of photographs with poses is examined twice, as it is and spoiled, first without and then with a run that
learnt from it. Prints the faults of the four photographs, and other photographs that are named, which are false alarms
or true faults of the data. Spoiled copies are in memory and a temporary folder.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image, ImageFilter, ImageOps

from lumigraph import methods
from lumigraph.budget import Budget
from lumigraph.evaluation.photographs import compare_all
from lumigraph.geometry import evenly
from lumigraph.opening import read_capture
from lumigraph.readers import Capture, Shot, assemble
from lumigraph.readers.pictures import list_images
from lumigraph.run import build
from lumigraph.sfm.doctor import Finding, findings, label
from lumigraph.system.signals import exit_code
from lumigraph.training import fit

TURN = np.radians(5)
TURNED = np.array([[np.cos(TURN), 0, np.sin(TURN)], [0, 1, 0], [-np.sin(TURN), 0, np.cos(TURN)]])
BLUR = 0.006  # of a picture's longer side: deviation of the Gaussian


@dataclass(frozen=True)
class Options:
    folders: tyro.conf.Positional[tuple[Path, ...]]
    method: str = "gaussian-splatting"
    steps: int = 600
    downscale: int | None = None
    seed: int = 0


def changed(shot: Shot, folder: Path, change: Callable[[Image.Image], Image.Image]) -> Shot:
    """The shot with a changed copy of its photograph."""
    assert isinstance(shot.image, dict)
    files = {}
    for times, path in shot.image.items():
        files[times] = folder / f"{times}-{Path(shot.name).stem}.png"
        with Image.open(path) as image:
            change(ImageOps.exif_transpose(image).convert("RGB")).save(files[times])
    return replace(shot, image=files)


def spoiled(capture: Capture, stranger: Path, folder: Path) -> tuple[Capture, dict[str, str]]:
    """The capture with four photographs spoiled, and what was done to each."""
    trained = [i for i in range(len(capture.shots)) if i % 8]
    blurred, mirrored, foreign, turned = evenly(trained[1:-1], 4)
    shots = list(capture.shots)
    blur = lambda image: image.filter(ImageFilter.GaussianBlur(BLUR * max(image.size)))  # noqa: E731
    shots[blurred] = changed(shots[blurred], folder, blur)
    shots[mirrored] = changed(shots[mirrored], folder, ImageOps.mirror)
    with Image.open(stranger) as image:
        other = image.convert("RGB")
    shots[foreign] = changed(shots[foreign], folder, lambda image: ImageOps.fit(other, image.size))
    pose = shots[turned].pose
    shots[turned] = replace(shots[turned], pose=np.concatenate([pose[:, :3] @ TURNED, pose[:, 3:]], 1))
    numbers = {blurred: "blurred", mirrored: "mirrored", foreign: "another scene", turned: "turned by 5 degrees"}
    return replace(capture, shots=shots), {label(shots[i].name): fault for i, fault in numbers.items()}


def with_run(capture: Capture, options: Options) -> list[Finding]:
    """Findings with the residuals of a run that learns from the capture."""
    scene = assemble(capture, options.downscale)
    kind = methods.find(options.method)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    method = build(kind, scene.frame, kind.preset(device), device, options.seed, learning=True)
    outcome = fit(method, scene, budget=Budget(options.steps), seed=options.seed, show=False)
    if outcome.signal is not None:
        sys.exit(exit_code(outcome.signal))
    residuals = [one.residual for one in compare_all(method, scene)]
    for one in sorted(residuals, key=lambda one: one.psnr)[:6]:
        print(f"    {one.photograph} {one.split} {one.psnr:.1f} dB, mirrored {one.mirrored:.1f}, "
              f"floating {one.floating:.2f}")  # fmt: skip
    return findings(capture, None, scene.frame.to_source.rotation.T.double().numpy(), residuals)


def tell(title: str, found: Sequence[Finding], done: dict[str, str]) -> None:
    """Print the faults of spoiled photographs, and of others."""
    faults = defaultdict(list)
    for finding in found:
        if finding.photograph:
            faults[finding.photograph].append(finding)
    print(f"  {title}: {sum(name in faults for name in done)} of {len(done)} named, "
          f"{len(faults.keys() - done.keys())} others")  # fmt: skip
    for name in [*done, *sorted(faults.keys() - done.keys())]:
        said = "; ".join(f"{f.fault} ({f.evidence})" for f in faults[name]) or "NOT NAMED"
        print(f"    {name} [{done.get(name, 'as it is')}]: {said}", flush=True)
    for finding in found:
        if not finding.photograph:
            print(f"    {finding.fault}: {finding}")


def main(options: Options) -> None:
    warnings.simplefilter("ignore")
    captures = [read_capture(folder) for folder in options.folders]
    for i, (folder, capture) in enumerate(zip(options.folders, captures, strict=True)):
        place = options.folders[i - 1] if len(captures) > 1 else Path(folder)
        stranger = place / list_images(place)[-1]
        print(f"{folder}: {len(capture.shots)} photographs", flush=True)
        tell("as it is", findings(capture), {})
        with tempfile.TemporaryDirectory() as temporary:
            wrong, done = spoiled(capture, stranger, Path(temporary))
            tell("spoiled, without a run", findings(wrong), done)
            if options.steps:
                tell(f"as it is, {options.method}", with_run(capture, options), {})
                tell(f"spoiled, {options.method}", with_run(wrong, options), done)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
