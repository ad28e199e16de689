"""HyP-NeRF by its parts: members that it learnt, and what each step of finding one from few photographs adds.

    python benchmarks/hyp_nerf.py runs/toys-hyp-nerf-1 --output results.png

Members learnt from are shown by their own codes, on photographs learnt from and on held-out ones. Unseen members are
found from the photographs that `--views` of `lumigraph infer` spreads: the mean of all codes, the best of the learnt
codes, the code that was found, the field tuned to the photographs, and tuned to denoised views as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.geometry import evenly
from lumigraph.readers.views import with_fewer_views
from lumigraph.run import Run

NOTHING = {"code_steps": 0, "tune_steps": 0, "denoise_steps": 0}
STEPS = {
    "nearest code": ("code_steps", "tune_steps", "denoise_steps"),
    "code found": ("tune_steps", "denoise_steps"),
    "tuned": ("denoise_steps",),
    "denoised": (),
}


@dataclass(frozen=True)
class Options:
    run: tyro.conf.Positional[Path]
    output: Path = Path("hyp_nerf.png")
    photographs: tuple[int, ...] = (1, 2)  # that unseen members are found from
    views: int = 4  # of each member that are compared
    members: int = 8  # of each split at most
    collection: str | None = None  # where the members are, if not where they were


def average(values: list[float]) -> float:
    return sum(values) / max(len(values), 1)


def table(rows: dict[str, list[Any]]) -> None:
    for name, evaluations in rows.items():
        psnr, ssim = average([x.psnr for x in evaluations]), average([x.ssim for x in evaluations])
        print(f"{name:40} {psnr:6.2f} dB  {ssim:.3f}   " + " ".join(f"{x.psnr:.1f}" for x in evaluations), flush=True)


def main(options: Options) -> None:
    run = Run(options.run)
    method, data = run.method(), run.dataset(options.collection)
    config, rows, pictures = method.config, {}, list[Row]()
    learnt = evenly(list(data.members("train")), options.members)
    for split in ("train", "test"):
        told = [method.given(instance=name.rpartition("-")[2].lstrip("0") or "0") for name, _ in learnt]
        shown = [
            evaluate(x, scene, EvaluationOptions(split, options.views))
            for x, (_, scene) in zip(told, learnt, strict=True)
        ]
        rows[f"learnt members, {split} views"] = shown
    table(rows)
    for (name, _), seen in list(zip(learnt, rows["learnt members, test views"], strict=True))[:4]:
        pictures.append(Row(name, [x for view in list(seen.shown.values())[:3] for x in (view[0], view[1].rgb)]))
    columns = ["photograph", "its own code"] * 3
    sheet = contact_sheet("Members that were learnt, held-out views", columns, pictures)
    save_picture(options.output.with_name(f"{options.output.stem}-learnt.png"), sheet, "evaluation")
    unseen = evenly(list(data.members("test")), options.members)
    pictures = []
    for count in options.photographs:
        rows = {
            "average code": [evaluate(method, scene, EvaluationOptions(views=options.views)) for _, scene in unseen]
        }
        for step, without in STEPS.items():
            method.config, found = replace(config, **{name: 0 for name in without}), []
            for _, scene in unseen:
                fewer = with_fewer_views(scene, count)
                told = method.given(replace(fewer, splits={"train": fewer.splits["train"]}))
                found.append(evaluate(told, scene, EvaluationOptions(views=options.views)))
            rows[step] = found
        method.config = config
        table({f"{count} photographs, {step}": found for step, found in rows.items()})
        for i, (name, scene) in enumerate(unseen[:4]):
            given = scene.photograph(int(with_fewer_views(scene, count).splits["train"][0]))
            view = next(iter(rows["denoised"][i].shown))
            true = rows["denoised"][i].shown[view][0]
            seen = [found[i].shown[view][1].rgb for found in rows.values()]
            pictures.append(Row(f"{name}, {count}", [given.before(scene.frame.background), true, *seen]))
    columns = ["a photograph that it was given", "a held-out one", *rows]
    sheet = contact_sheet("Members that it has not seen", columns, pictures)
    save_picture(options.output, sheet, "evaluation")


if __name__ == "__main__":
    main(tyro.cli(Options))
