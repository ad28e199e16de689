"""compress(): choose a rung of the ladder, fine-tune the run there, and write it as a new run.

References are the run's photographs where available, else its own renderings.
"""

from __future__ import annotations

import math
import shutil
import time
from bisect import bisect_left
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from ... import files
from ...budget import Budget
from ...camera import Camera
from ...camera.rays import Rendering
from ...datasets.images import ImageStore
from ...datasets.scene import Scene
from ...errors import LumigraphError
from ...evaluation.options import EvaluationOptions
from ...evaluation.views import evaluate
from ...geometry import evenly
from ...method import Method
from ...method.capabilities import CanCompress, needs
from ...metrics.rows import last_psnr
from ...run import Run, check_new
from ...run.checkpoint import Checkpoints
from ...run.derived import Compressed
from ...system.progress import NumberedStages, clock, track
from ...system.work import at_work
from ..options import CompressOptions
from .model import LADDER, RUNG_POSITIONS, CompressedModel, rung_at

JUDGED_VIEWS = 6  # training photographs that judge a rung; held-out ones judge the outcome alone
IMPORTANCE_VIEWS = 40  # photographs from which importance is computed
TRIAL_SHARE = 1 / 6  # of all tuning, per tried rung; the selected rung gets the rest
RENDERED_VIEWS = 40  # renderings in place of photographs, evenly spread
GRADIENT_COST = 3  # renderings that the importance of one view takes as long as
STAGES = "importance of each row", "pruning and codebook, by trial", "tune", "compare"
DEFAULT_PSNR = 30.0  # dB of a run without a recorded training PSNR


@at_work()
def compress(
    run: Run,
    output: Path,
    aim: CompressOptions = CompressOptions(),
    device: torch.device | str = "cpu",
    show: bool = False,
) -> Compressed:
    """Write a smaller run in a new folder, which opens like any other. Returns the contents of compress.json.

    show: whether stages are announced
    Where the photographs cannot be opened, the run's own renderings are learnt from and compared with.
    Raises LumigraphError for a run that was compressed already, a method that cannot be, a codebook larger than what it
    would stand for, and a size that no rung reaches.
    """
    if run.compressed:
        raise LumigraphError(f"{run.folder} is compressed already; compress the run that it was made of")
    check_new(output)
    before = run.method(device)
    needs(before, CanCompress)
    if aim.codebook is not None:
        check_codebook(before, aim.codebook)
    truth = truth_of(run, before, aim.scene, JUDGED_VIEWS)
    stages = NumberedStages(STAGES, about_time(truth, aim), show)
    stages.begin()
    ladder = Ladder(run, truth, aim, device, important(before, truth), stages)
    model = ladder.by_size(aim.bytes) if aim.bytes is not None else ladder.by_loss(aim.loss)
    stages.begin()
    return written(run, before, model, truth, output, aim)


def about_time(truth: Truth, aim: CompressOptions) -> str:
    """Duration of a compression as text; empty if steps limit it."""
    if (seconds := aim.tuning_seconds) is None:
        return ""
    learnt, held_out = min(len(truth.scene.splits["train"]), IMPORTANCE_VIEWS), len(truth.scene.splits["test"])
    views = GRADIENT_COST * learnt + len(LADDER).bit_length() * JUDGED_VIEWS + 2 * min(aim.views or held_out, held_out)
    return f", about {clock(seconds + views * truth.view_seconds)} in all"


class Ladder:
    """Search over rungs, each from the run's own weights."""

    def __init__(
        self,
        run: Run,
        truth: Truth,
        aim: CompressOptions,
        device: torch.device | str,
        importance: dict[str, Tensor],
        stages: NumberedStages,
    ):
        self.run, self.truth, self.aim, self.device, self.importance = run, truth, aim, device, importance
        self.stages = stages
        self.tuned = 0.0  # share of all tuning

    def by_loss(self, most: float) -> CompressedModel:
        """The highest rung within the loss, by bisection; the lowest if none is."""
        self.stages.begin()
        low, high, best = 0, len(LADDER) - 1, None
        while low <= high:
            middle = (low + high) // 2
            model = self.at(middle)
            self.tune(model, TRIAL_SHARE)
            if self.truth.loss(model.method, JUDGED_VIEWS) <= most:
                low, best = middle + 1, model
            else:
                high = middle - 1
        model = best or self.at(0)
        self.stages.begin()
        self.tune(model, 1 - self.tuned)
        return model

    def by_size(self, most: int) -> CompressedModel:
        """The lowest position on the ladder within the size, on a rung or between two. Fine-tuning changes the size a
        little, so the next one may be taken."""
        self.stages.begin()
        first = bisect_left(RUNG_POSITIONS, True, key=lambda place: len(self.at(place).packed()) <= most)
        self.stages.begin()
        for place in RUNG_POSITIONS[first:]:
            model, self.tuned = self.at(place), 0.0
            self.tune(model, 1.0)
            if len(model.packed()) <= most:
                return model
        smallest = len(self.at(len(LADDER) - 1).packed())
        raise LumigraphError(
            f"{self.run.folder} cannot be made as small as {told(most)}; the smallest reached is {told(smallest)}"
        )

    def at(self, place: float) -> CompressedModel:
        """The run on a rung, or between two."""
        rung, step = rung_at(place), self.run.state.step
        if self.aim.codebook is not None:
            rung = replace(rung, recipe=replace(rung.recipe, codebook=self.aim.codebook))
        method = self.run.method(self.device)
        if self.run.settings.budget:
            method.progress = Budget.from_json(self.run.settings.budget).progress(step, self.run.state.seconds)
            method.before_step(step, method.progress)  # how finely it looks, at this share of its training
            self.run.restore_weights(method)
        return CompressedModel(method, self.importance, rung, step)

    def tune(self, model: CompressedModel, share: float) -> None:
        if share > 0:
            model.tune(self.truth.scene, *self.aim.part(share))
            self.tuned += share


def important(method: Method, truth: Truth) -> dict[str, Tensor]:
    """Importance of each row of the method's tensors, over all photographs or a subset."""
    train = evenly(truth.scene.splits["train"].tolist(), IMPORTANCE_VIEWS)
    total: dict[str, Tensor] = {}
    for i in track(train, "Weighing what matters", len(train)):
        camera = method.refined(truth.scene.cameras[i])
        for name, weights in needs(method, CanCompress).importance(camera).items():
            total[name] = total[name] + weights if name in total else weights
    return total


def check_codebook(method: Method, size: int) -> None:
    """Raise LumigraphError for a codebook with more rows than there are to be coded."""
    state = method.state_dict()
    counts = {
        name: state[name].numel() // row_width(state[name], how.layout)
        for name, how in needs(method, CanCompress).storage().items()
        if how.how == "coded"
    }
    for name, count in counts.items():
        if size > count:
            raise LumigraphError(
                f"A codebook of {size:,} rows is larger than what it would stand for: {name} has {count:,}; give a "
                "smaller --codebook"
            )


def row_width(tensor: Tensor, layout: str) -> int:
    """Columns of a tensor's rows, see `packing.Stored`."""
    channels = tensor.shape[min(1, tensor.dim() - 1)]
    return {"rows": tensor[:1].numel(), "cells": tensor.shape[-1], "channels": channels}[layout]


def written(
    run: Run, before: Method, model: CompressedModel, truth: Truth, output: Path, aim: CompressOptions
) -> Compressed:
    """Write the run; its recorded figures are measured after reopening."""
    views = min(aim.views or len(truth.scene.splits["test"]), len(truth.scene.splits["test"]))
    compared = EvaluationOptions("test", views)
    settings = replace(run.settings, said=run.settings.said | {"compressed": {"source": str(run.folder.resolve())}})
    rung = model.rung
    with files.replacing_folder(output) as partial:
        if files.is_file(run.folder / "cameras.json"):
            shutil.copy2(run.folder / "cameras.json", partial / "cameras.json")
        Checkpoints(partial, run.method_name).save_packed(run.state, model.packed())
        settings.write(partial / "config.json")
        small = Run(partial)
        told_of = Compressed(
            source=str(run.folder.resolve()),
            method=run.method_name,
            bytes_before=run.model_bytes,
            bytes_after=small.model_bytes,
            folder_before=folder_bytes(run.folder),
            folder_after=folder_bytes(partial),
            psnr_before=evaluate(before, truth.scene, compared).psnr if truth.photographed else None,
            psnr_after=evaluate(small.method(before.device), truth.scene, compared).psnr,
            compared_with="photographs" if truth.photographed else "renderings of the run",
            views=views,
            pruned=rung.pruned,
            **asdict(rung.recipe),
            steps=model.steps,
            seconds=model.seconds,
        )
        told_of.write(partial)
    return told_of


def folder_bytes(folder: Path) -> int:
    """Bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def told(size: float) -> str:
    """Bytes as text, to three digits, in the format of --to."""
    return f"{size / 1e6:.3g}MB" if size >= 1e6 else f"{size / 1e3:.3g}kB"


@dataclass(frozen=True)
class Truth:
    """References for fine-tuning and comparison.

    photographed: whether these are photographs; otherwise renderings of the run before compression
    error:        mean squared error of the run before, on its training photographs
    view_seconds: rendering time of a view of it
    """

    scene: Scene
    photographed: bool
    error: float
    view_seconds: float

    def loss(self, method: Method, views: int) -> float:
        """PSNR loss of a method in dB on training photographs. With renderings instead, independent errors are
        assumed to add up."""
        error = squared_error(method, self.scene, "train", views)
        return decibels(error if self.photographed else self.error + error) * -1 + decibels(self.error)


def truth_of(run: Run, method: Method, source: str | None, views: int) -> Truth:
    """The run's photographs; where they cannot be opened, and no other place is named, its own renderings."""
    try:
        scene = run.scene(source)
        found = evaluate(method, scene, EvaluationOptions("train", views))
        return Truth(scene, True, 10 ** (-found.psnr / 10), found.seconds_per_view)
    except LumigraphError:
        if source is not None:
            raise
    learnt = last_psnr(run.metrics())
    begin, scene = time.perf_counter(), rendered(run, method)
    error = 10 ** (-(DEFAULT_PSNR if learnt is None else learnt) / 10)
    return Truth(scene, False, error, (time.perf_counter() - begin) / len(scene))


def squared_error(method: Method, scene: Scene, split: Literal["test", "train"], views: int) -> float:
    """Mean over views of what their PSNR is the logarithm of, so that errors can be added."""
    return 10 ** (-evaluate(method, scene, EvaluationOptions(split, views)).psnr / 10)


def decibels(error: float) -> float:
    return -10 * math.log10(max(error, 1e-12))


def rendered(run: Run, method: Method) -> Scene:
    """A Scene of a method's renderings at its photographs' cameras."""
    cameras = run.cameras()
    some = {split: evenly(range(len(own)), RENDERED_VIEWS) for split, own in cameras.items() if len(own)}
    chosen = [cameras[split][i] for split, index in some.items() for i in index]
    counts = torch.tensor([0, *(len(index) for index in some.values())]).cumsum(0).tolist()
    splits = {
        split: torch.arange(*pair) for split, pair in zip(some, zip(counts, counts[1:], strict=False), strict=True)
    }
    splits.setdefault("test", splits["train"])
    frame = run.frame
    pictures = [
        bytes_of(method.render(camera).cpu(), frame.background if frame.has_alpha else None)
        for camera in track(chosen, "Rendering what there is to keep", len(chosen))
    ]
    images, names = ImageStore.from_arrays(pictures), [f"{i:03d}" for i in range(len(chosen))]
    return Scene(Camera.cat(chosen), images, frame, splits, names, f"renderings of {run.folder}")


def bytes_of(
    seen: Rendering, background: tuple[float, float, float] | None
) -> UInt8[np.ndarray, "height width channel"]:
    """A rendering as a photograph; with straight alpha, where a background was behind it."""
    rgb, alpha = seen.rgb, seen.opacity[..., None].clamp(0, 1)
    if background is not None:
        own = (rgb - (1 - alpha) * torch.tensor(background)) / alpha.clamp_min(1e-3)
        rgb = torch.cat([own, alpha], -1)
    return (255 * rgb.clamp(0, 1)).round().byte().numpy()
