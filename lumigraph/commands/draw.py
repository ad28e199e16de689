"""`lumigraph draw`: objects that a prior draws at random, as a sheet, a film, and their distance from photographs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.options import DeviceOption, Overwrite, Set, needed, option
from ..files.ranges import Count, FramesPerSecond, Pixels, between
from .common import choose_device, show

MAX_SEED, MAX_SEEDS = 9999, 256
FRAMES_PER_SEED = 30
MIN_CELL = 128  # pixels across, of a picture on the sheet


@dataclass(frozen=True)
class Draw:
    """Draw objects that nobody has photographed with a trained prior: eg3d, hyp-nerf or srn.

    Writes a sheet with a row for each seed, seen from several sides, and with --film a film that goes round and from
    one seed to the next. `--set truncation=0.7` draws objects closer to the average. --score compares drawn pictures
    with photographs that were learnt from, by FID and KID: always with the small network of fixed random weights that
    ships, whose figures no paper states, and with --inception as published. `lumigraph infer PRIOR --seed 3` keeps one
    object as a run of its own.
    """

    prior: Annotated[Positional[Path], needed("PRIOR")]
    """Folder of the prior's run."""
    seeds: Annotated[str, option("A:B or A,B,C")] = "0:16"
    """Numbers of the objects: 0:16 are the first sixteen; 3,7,9 are three."""
    views: Annotated[int, between(1, 24)] = 4
    """Views of each object on the sheet, evenly around it."""
    size: Annotated[Pixels | None, option("PIXELS", "that of training, or 128")] = None
    """Pixels across of a picture; larger renders slower."""
    output: Annotated[Path | None, option("FILE.png", "PRIOR/drawn.png")] = None
    """The sheet."""
    film: Annotated[Path | None, option("FILE.mp4", "none")] = None
    """Also render a film: .mp4, .gif or .webp."""
    frames: Annotated[Count, option("N")] = FRAMES_PER_SEED
    """Frames of the film for each seed; more are slower to watch."""
    fps: FramesPerSecond = 30.0
    """Frames per second of the film."""
    score: Annotated[Annotated[int, between(2, 100_000)] | None, option("N", "no score")] = None
    """Compare so many drawn pictures with as many photographs; more are exact, and take longer."""
    inception: Annotated[Path | None, option("FILE", "none")] = None
    """Weights of FID's Inception, pt_inception-2015-12-05-6726825d.pth or the same as .safetensors, for --score."""
    scene: Annotated[str | None, option("COLLECTION", "the path used in training")] = None
    """Path of the training data for --score, if it was moved since training."""
    overwrite: Overwrite = False
    settings: Set = ()
    device: DeviceOption = "auto"

    def run(self) -> int:
        from ..datasets.collection import Collection
        from ..export.film import claim_film
        from ..export.video import kind_of
        from ..figures import Row, contact_sheet, save_picture
        from ..files import claim, write_json
        from ..method.capabilities import CanDraw, HasViewpoint, can, needs
        from ..metrics.distribution import FeatureNetwork, RandomFeatures, load_inception
        from ..run import Run
        from ..run.opened import controlled
        from ..system.progress import track

        seeds = numbers(self.seeds)
        if self.inception and not self.score:
            raise LumigraphError("--inception is a network for --score; add --score 1000, for example")
        networks: list[FeatureNetwork] = [RandomFeatures()]
        if self.inception:
            networks.append(load_inception(self.inception))
        run = Run(self.prior)
        sheet = self.output or self.prior / "drawn.png"
        claim(sheet, "drawings", self.overwrite)
        if self.score:
            claim(sheet.with_suffix(".json"), "scores of drawings", self.overwrite)
        if self.film:
            kind_of(self.film, self.fps)
            claim_film(self.film, overwrite=self.overwrite)
        method = controlled(run, run.method(choose_device(self.device)), self.settings).eval()
        drawing = needs(method, CanDraw)
        if run.kind != Collection.kind:
            raise LumigraphError(f"{self.prior} learnt from {run.kind}, and draws no objects; name a prior of eg3d")
        usual = needs(method, HasViewpoint).viewpoint if can(method, HasViewpoint) else run.cameras()["train"][0]
        side = int(usual.size.max()) if can(method, HasViewpoint) else 128
        camera = usual.resized((self.size or side) / int(usual.size.max()))
        around = turned(camera, self.views)
        rows = []
        for seed in track(seeds, "Drawing", len(seeds)):
            told: Any = drawing.draw_object(seed)
            rows.append(Row(f"seed {seed}", [magnified(told.render(around[i]).rgb) for i in range(self.views)]))
        columns = [f"{360 * i // self.views}°" for i in range(self.views)]
        save_picture(sheet, contact_sheet(f"{run.title}: {len(seeds)} drawn objects", columns, rows), "drawings")
        told_rows: dict[str, Any] = {"sheet": str(sheet)}
        if self.film:
            told_rows["film"] = self._film(method, seeds, camera)
        if self.score:
            from ..evaluation.drawings import drawing_scores

            data = run.dataset(self.scene)
            assert isinstance(data, Collection)
            scores, protocol = drawing_scores(method, data, self.score, networks)
            told_rows |= {score.name: str(score) for score in scores} | {"compared": f"{self.score} of each"}
            about = {"scores": [score.to_json() for score in scores], "protocol": protocol, "steps": run.state.step}
            write_json(sheet.with_suffix(".json"), about, "scores of drawings")
        show(told_rows)
        return 0

    def _film(self, method: Any, seeds: list[int], camera: Any) -> str:
        """The film, as a row to print."""
        from ..export.film import animated, film
        from ..export.options import FilmOptions

        count = self.frames * len(seeds)
        if any(control.name == "seed" for control in method.controls):
            shown = animated(method, {"seed": [float(seed) for seed in seeds]}, count)
        else:
            drawn = [method.draw_object(seed) for seed in seeds]
            shown = [drawn[i // self.frames] for i in range(count)]
        assert self.film is not None
        cameras = turned(camera, count, max(1, len(seeds) // 4))
        about = film(shown, cameras, self.film, FilmOptions(fps=self.fps))
        return f"{self.film}, {about['frames']} frames, {about['seconds_per_frame']:.3f} s each"


def numbers(text: str) -> list[int]:
    """Seeds of a text: "0:16", "3,7,9". Raises LumigraphError for any other, and for too many."""
    fault = f"--seeds {text} names no seeds; give 0:16 for the first sixteen, or 3,7,9, from 0 to {MAX_SEED}"
    try:
        if ":" in text:
            first, last = (int(x) for x in text.split(":"))
            found = list(range(first, last)[: MAX_SEEDS + 1])
        else:
            found = [int(x) for x in text.split(",")]
    except ValueError:
        raise LumigraphError(fault) from None
    if not found or min(found) < 0 or max(found) > MAX_SEED:
        raise LumigraphError(fault)
    if len(found) > MAX_SEEDS:
        raise LumigraphError(f"--seeds {text} names more than {MAX_SEEDS} objects; give fewer")
    return found


def magnified(picture: Any) -> Any:
    """A picture with whole pixels enlarged, if it is small."""
    times = -(-MIN_CELL // picture.shape[0])
    return picture.cpu().repeat_interleave(times, 0).repeat_interleave(times, 1)


def turned(camera: Any, count: int, turns: int = 1) -> Any:
    """Cameras at equal angles around the vertical axis through the scene's origin. turns: number of revolutions"""
    import torch

    from ..camera import Camera

    found = []
    for i in range(count):
        angle = 2 * math.pi * turns * i / count
        turn = torch.tensor(
            [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
        )
        found.append(Camera(turn @ camera.pose, camera.lens, camera.size))
    return Camera.cat(found)
