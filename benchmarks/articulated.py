"""Bodies on bones against exact truth: held-out cameras, unseen poses, disturbed bones.

    python benchmarks/articulated.py --steps 1600
    python benchmarks/articulated.py --characters walker FOX.glb:1 --methods articulated-splatting --degrees 0 5
    python benchmarks/articulated.py --seconds 90 --characters rig:41 rig:20:10 rig:20:3:sword+coat

Characters are `walker`, a skinned .glb with the number of its animation behind a colon, or a rig of so many joints, so
many seconds of motion (3) and what hangs loose on it: see `rigs.py`. Each method trains on one
moving camera, once for each number of degrees by which the bones that it is told are off. PSNR is over whole pictures
before white: four held-out cameras at moments of training, then between two of them, then poses that are in no motion,
every joint turned by 20 degrees. Seconds are those of processors; smoothing is the share of time that poses'
smoothing takes. OUTPUT/CHARACTER-DEGREES.png has the pictures.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from PIL import Image
from rigs import Rig

from lumigraph import methods
from lumigraph.components.skinning import bone_motion
from lumigraph.datasets.scene import Scene
from lumigraph.figures import to_bytes
from lumigraph.files import write_json
from lumigraph.method import Method
from lumigraph.metrics import psnr
from lumigraph.opening import open_scene
from lumigraph.readers.assemble import assemble
from lumigraph.run import build
from lumigraph.synthetic import capture
from lumigraph.synthetic.characters import ROUNDS, photographed
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

SAME_MOMENT = 1e-5  # difference of times that are one moment
STRIP = 8  # pictures of a strip
TIMED_VIEWS = 12


@dataclass(frozen=True)
class Options:
    characters: tuple[str, ...] = ("walker",)
    methods: tuple[str, ...] = ("articulated-splatting", "humannerf")
    degrees: tuple[int, ...] = (0, 5)  # of every joint
    size: int = 200  # pixels a side
    views: int = 100  # photographs of the moving camera
    steps: int = 1600
    seconds: float | None = None  # instead of steps
    output: Path = Path("articulated")


def main(options: Options) -> None:
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for character in options.characters:
        for degrees in options.degrees:
            scene = scene_of(character, degrees, options)
            print(f"{scene.source}: {ROUNDS * 360 / options.views:.1f} degrees from a photograph to the next")
            strips = [strip(scene, None)]
            for name in options.methods:
                rows.append(
                    {"character": character, "degrees": degrees, "method": name} | trained(name, scene, options)
                )
                method = rows[-1].pop("trained")
                strips.append(strip(scene, method))
                print(rows[-1], flush=True)
            stem = f"{character if character.startswith('rig:') else Path(character.partition(':')[0]).stem}-{degrees}"
            Image.fromarray(np.concatenate(strips)).save(options.output / f"{stem}.png")
            write_json(options.output / "articulated.json", rows)


def scene_of(character: str, degrees: int, options: Options) -> Scene:
    """Photographs of a character."""
    file, _, rest = character.partition(":")
    if file == "rig":
        joints, seconds, loose = (rest.split(":") + ["3", ""][rest.count(":") :])[:3]
        rig = Rig(int(joints), float(seconds), loose)  # type: ignore[arg-type]
        return assemble(capture(photographed(rig, options.size, options.views, 0, 0, degrees), character))
    name = "walker" if file == "walker" else f"character,file={file},clip={rest or 0}"
    return open_scene(f"procedural:{name},size={options.size},views={options.views},jitter_bones={degrees}")


def timed(function: Callable, spent: list[float]) -> Callable:
    """A function that adds its seconds to a list."""

    def called(*values: Any, **named: Any) -> Any:
        begin = time.perf_counter()
        try:
            return function(*values, **named)
        finally:
            spent.append(time.perf_counter() - begin)

    return called


def trained(name: str, scene: Scene, options: Options) -> dict:
    """Scores of a method after training, by what is held out."""
    kind = methods.find(name)
    method = build(kind, scene.frame, kind.cpu_preset(), torch.device("cpu"), 0, learning=True)
    go_on_unless(fit(method, scene, steps=1, show=False).signal)  # compiles
    method = build(kind, scene.frame, kind.cpu_preset(), torch.device("cpu"), 0, learning=True)
    plain, smoothing = bone_motion.on_splines, list[float]()
    bone_motion.on_splines = timed(plain, smoothing)
    begin, steps = time.process_time(), None if options.seconds else options.steps
    outcome = fit(method, scene, steps=steps, seconds=options.seconds, show=False, rehearsal=False)
    go_on_unless(outcome.signal)
    spent, bone_motion.on_splines = time.process_time() - begin, plain
    method.eval()
    assert scene.cameras.time is not None
    learnt = scene.cameras.time[scene.splits["train"]]
    held = {"held-out cameras": [], "between moments": [], "unseen poses": scene.splits["val"].tolist()}
    for index in scene.splits["test"].tolist():
        same = (scene.cameras.time[index] - learnt).abs().min() < SAME_MOMENT
        held["held-out cameras" if same else "between moments"].append(index)
    scores = {what: round(float(np.mean([score(method, scene, i) for i in some])), 2) for what, some in held.items()}
    some = scene.splits["test"].tolist()[:TIMED_VIEWS]
    begin = time.process_time()
    for index in some:
        method.render(scene.cameras[index])
    rate = len(some) / (time.process_time() - begin)
    assert scene.frame.skeleton is not None
    about = {"joints": len(scene.frame.skeleton), "steps": outcome.state.step}
    share = round(100 * sum(smoothing) / outcome.state.seconds, 2)
    about |= {"smoothing %": share, "processor seconds": round(spent, 1), "frames/s": round(rate, 1)}
    return scores | about | {"trained": method}


def score(method: Method, scene: Scene, index: int) -> float:
    """PSNR of one photograph, before the scene's background."""
    photograph = scene.photograph(index)
    return float(psnr(method.render(photograph.camera).rgb, photograph.before(scene.frame.background)))


def strip(scene: Scene, method: Method | None) -> np.ndarray:
    """Held-out cameras, then unseen poses, side by side; of the photographs without a method."""
    some = [scene.splits[name] for name in ("test", "val")]
    chosen = [int(part[i]) for part in some for i in np.linspace(0, len(part) - 1, STRIP // 2).astype(int)]
    pictures = [
        scene.photograph(i).before(scene.frame.background) if method is None else method.render(scene.cameras[i]).rgb
        for i in chosen
    ]
    return np.concatenate([to_bytes(picture) for picture in pictures], 1)


if __name__ == "__main__":
    main(tyro.cli(Options))
