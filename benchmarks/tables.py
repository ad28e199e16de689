"""Tables of methods in README.md and docs/, made of benchmarks/results/.

    python benchmarks/tables.py                                             write the tables anew
    python benchmarks/tables.py --collect OUTPUT OUTPUT --commit COMMIT     collect the figures first
    python benchmarks/tables.py --gallery OUTPUT --commit COMMIT            the gallery's
    python benchmarks/tables.py --check                                     list stale results and tables made by hand

OUTPUT is a folder of `lumigraph bench methods` or of `lumigraph gallery`, COMMIT the one it ran. A table is between two
comments of a page: `table: methods` has a row for each method, `table: cells` one for each training, `table: gallery`
one for each method of the gallery, `table: sections` one for each of its sections. Names of methods behind that word
choose rows; `table: strangers` is of `strangers.py --publish`, `table: minute` of `one_minute.py --publish`,
`table: reading` of `reading.py --publish`; `parameters`, `owntests`, `trainings`, `loops` of `gsplat_compat.py
--publish`; `presets` and `preset NAME` of `paper_presets.py`;
`<!-- end of table -->` ends it. Below it are the commit, the machine, and the commands of those rows.
"""

from __future__ import annotations

import json
import os
import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ages

from lumigraph import methods
from lumigraph.lab.benchmark.gallery import SECTIONS, SHOWPIECES
from lumigraph.lab.benchmark.published import first_of
from lumigraph.lab.benchmark.table import protocol, published, size, trained_for
from lumigraph.metrics import scores_of

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "methods-cpu.json"
GALLERY, STRANGERS = RESULTS.with_name("gallery-cpu.json"), RESULTS.with_name("strangers-cpu.json")
MINUTE, READING = RESULTS.with_name("one-minute-cpu.json"), RESULTS.with_name("reading-cpu.json")
SPLATS, PRESETS = RESULTS.with_name("gsplat-cpu.json"), RESULTS.with_name("paper-presets-cpu.json")
TABLE = re.compile(r"(<!-- table: (\w+)((?: [\w-]+)*) -->\n).*?(?=<!-- end of table -->)", re.DOTALL)
SOURCE = 3  # place of the scene in a cell's command: lumigraph train METHOD SCENE
GUIDES = {  # pages about sections of the gallery, in docs/
    "Pictures and light fields": "light-fields",
    "Shape": "meshes",
    "Depth cameras": "depth",
    "What moves": "time",
    "Across scenes": "collections",
}
OF_SHOWPIECE = "method", "command", "budget", "steps", "training_seconds", "model_bytes", "scores"  # what is kept
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    collect: tuple[Path, ...] = ()  # outputs of `lumigraph bench methods`
    gallery: tuple[Path, ...] = ()  # output of `lumigraph gallery`
    commit: str = ""  # that they ran
    check: bool = False  # write nothing; list stale results, tables made by hand, and the share of generated figures

    def run(self) -> None:
        if self.check:
            texts = {str(page.relative_to(ROOT)): page.read_text("utf-8") for page in pages()}
            print(*ages.report(texts), sep="\n")
            return
        for outputs, path in ((self.collect, RESULTS), (self.gallery, GALLERY)):
            if outputs:
                found = collected(outputs, self.commit)
                if path == GALLERY:
                    found["cells"] = [{name: row[name] for name in OF_SHOWPIECE} for row in found["cells"]]
                    found["commands"] = [f"lumigraph gallery --seconds {found['cells'][0]['budget']['seconds']:g}"]
                path.write_text(json.dumps(found, indent=1) + "\n", "utf-8")
        results = read()
        for page in pages():
            text = page.read_text("utf-8")
            if (new := filled(text, page, results)) != text:
                page.write_text(new, "utf-8")
                print(page.relative_to(ROOT))


def read() -> dict[str, Any]:
    """Results of `lumigraph bench methods`, and of other programs as parts of them."""
    results: dict[str, Any] = json.loads(RESULTS.read_text("utf-8"))
    others = {"gallery": GALLERY, "strangers": STRANGERS, "minute": MINUTE, "reading": READING, "presets": PRESETS}
    splats = json.loads(SPLATS.read_text("utf-8"))
    parts = {
        name: splats | {"cells": splats[name], "commands": splats["commands"][name]} for name in splats["commands"]
    }
    return results | {name: json.loads(path.read_text("utf-8")) for name, path in others.items()} | parts


def pages() -> list[Path]:
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def collected(outputs: Iterable[Path], commit: str) -> dict[str, Any]:
    """Results of several benchmarks of one commit and machine in one. Scenes are called by their name, without their
    folder. Raises SystemExit where a cell failed, or machines differ."""
    cells: list[Row] = []
    for output in outputs:
        found = json.loads((output / "results.json").read_text("utf-8").replace(f"{output.resolve()}/", ""))
        for row in found["cells"]:
            words = shlex.split(row["command"])
            words[SOURCE] = Path(words[SOURCE]).name
            told = {name: found["settings"][name] for name in ("downscale", "eval_views")}
            cells.append({"source": words[SOURCE], **told} | row | {"command": shlex.join(words)})
    machines = {row["trained_on"] for row in cells if not row["failed"]}
    if not commit or len(machines) != 1 or any(row["failed"] for row in cells):
        raise SystemExit(f"One commit, one machine and no failed cell are needed; this is {commit!r} on {machines}")
    return {"commit": commit, "machine": machines.pop(), "commands": commands(cells), "cells": cells}


def commands(cells: Sequence[Row]) -> list[str]:
    """Commands that measure these cells and no others: one for scenes of the same settings, methods and seconds."""
    alike: dict[tuple[Any, ...], dict[str, list[str]]] = {}
    for row in cells:
        key = row["budget"]["seconds"], row["downscale"], row["eval_views"]
        alike.setdefault(key, {}).setdefault(row["source"], []).append(row["method"])
    scenes: dict[tuple[Any, ...], list[str]] = {}
    for key, sources in alike.items():
        for source, names in sources.items():
            scenes.setdefault((*key, *names), []).append(source)
    found = []
    for (seconds, downscale, views, *names), sources in scenes.items():
        words = f"--methods {' '.join(names)} --scenes {' '.join(sources)} --seconds {seconds:g}"
        told = "".join(f" --{n} {x}" for n, x in (("downscale", downscale), ("eval-views", views)) if x)
        found.append(f"lumigraph bench methods {words}{told} --output OUTPUT")
    return found


def filled(text: str, page: Path, results: dict[str, Any]) -> str:
    """A page with its tables made of these results."""

    def table(match: re.Match[str]) -> str:
        names = match[3].split()
        kind = match[2]
        if kind not in KINDS or not {*names} <= {*methods.available()}:
            raise SystemExit(f"{page.name}: `{match[0].splitlines()[0]}` names an unknown table or method")
        of = results[OTHERS[kind]] if kind in OTHERS else results
        cells = [row for row in of["cells"] if not names or row["method"] in names]
        if not cells:
            return f"{match[1]}Not measured.\n"
        commit = of.get("commit") or "`, `".join(sorted({row["commit"] for row in cells}))
        about, lines = f"Commit `{commit}`; {of['machine'].removeprefix('cpu, ')}, no GPU.", of["commands"]
        if kind == "preset":
            lines = [f"python benchmarks/paper_presets.py {names[0]} --again"]
        if kind not in OTHERS:
            about, lines = f"{about} {scenes_of(cells)}", commands(cells)
        return "\n".join([match[1].rstrip(), *KINDS[kind](cells, page), "", about, "", "```", *lines, "```", ""])

    return TABLE.sub(table, text)


def by_method(cells: Sequence[Row], page: Path) -> list[str]:
    """PSNR of each method on each scene; the highest is bold."""
    columns = list(dict.fromkeys((row["scene"], trained_for(row)) for row in cells))
    found = {(row["method"], row["scene"], trained_for(row)): row for row in cells}
    best = {column: max(row["psnr"] for key, row in found.items() if key[1:] == column) for column in columns}
    last = columns[-1] if len(columns) == 1 else next((c for c in columns if c[0] == "lego"), columns[-1])
    rows = [["method", "paper", *(", ".join(c) for c in columns), f"s/view, {last[0]}", f"model, {last[0]}"]]
    for name in dict.fromkeys(row["method"] for row in cells):
        line = [link(name, page), paper(name)]
        for column in columns:
            row = found.get((name, *column))
            value = f"{row['psnr']:.1f}" if row else ""
            line.append(f"**{value}**" if row and row["psnr"] == best[column] else value)
        row = found[name, *last]
        rows.append([*line, f"{row['seconds_per_view']:.2g}", size(row["model_bytes"])])
    return markdown(rows)


CELL: dict[str, Callable[[Row], str]] = {
    "trained for": trained_for,
    "PSNR": lambda row: f"{row['psnr']:.2f}",
    "SSIM": lambda row: f"{row['ssim']:.3f}",
    "steps": lambda row: str(row["steps"]),
    "s/view": lambda row: f"{row['seconds_per_view']:.2g}",
    "memory": lambda row: size(row["peak_memory"]),
    "model": lambda row: size(row["model_bytes"]),
    "published PSNR": published,
}


def by_cell(cells: Sequence[Row], page: Path) -> list[str]:
    """Figures of each training."""
    names = [name for name in ("scene", "method") if len({row[name] for row in cells}) > 1]
    rows = [[*names, *CELL]]
    for row in cells:
        own = {"scene": row["scene"], "method": link(row["method"], page)}
        rows.append([*(own[name] for name in names), *(value(row) for value in CELL.values())])
    return markdown(rows)


def by_section(cells: Sequence[Row], page: Path) -> list[str]:
    """Methods of each section of the gallery, with their own scores."""
    rows = [["section", "methods, and their scores after a minute of training"]]
    for title, section in SECTIONS.items():
        found = [f"{link(row['method'], page)} {qualified(row)}" for row in cells if row["method"] in section]
        if found:
            guide = ROOT / "docs" / f"{GUIDES[title]}.md" if title in GUIDES else None
            rows.append([linked(title, guide, page) if guide else title, ", ".join(found)])
    return markdown(rows)


def by_showpiece(cells: Sequence[Row], page: Path) -> list[str]:
    """Each method of the gallery: data, score, time, and the published figure with its protocol."""
    rows = [["method", "paper", "smallest data", "score", "training, s", "model", "published, of other data"]]
    for row in cells:
        told = [f"`{SHOWPIECES[row['method']].source}`", qualified(row), f"{row['training_seconds']:.0f}"]
        known = first_of(row["method"])
        told += [size(row["model_bytes"]), known.sentence if known else ""]
        rows.append([link(row["method"], page), paper(row["method"]), *told])
    return markdown(rows)


def by_verdict(cells: Sequence[Row], page: Path) -> list[str]:
    """Settings of each method by what became of it, with score and baseline."""
    verdicts = [name for name in VERDICTS if any(row["verdict"] == name for row in cells)]
    rows = [["method", *(VERDICTS[name] for name in verdicts)]]
    for method in dict.fromkeys(row["method"] for row in cells):
        own = [row for row in cells if row["method"] == method]
        told = [
            "; ".join(": ".join(filter(None, (x["setting"], x["score"]))) for x in own if x["verdict"] == v)
            for v in verdicts
        ]
        rows.append([link(method, page), *told])
    return markdown(rows)


def by_seconds(cells: Sequence[Row], page: Path) -> list[str]:
    """Means over seeds of each capture, method and budget, with the deviation of the PSNR."""
    rows = [["capture", "method", "s", "PSNR", "SSIM", "LPIPS", "steps", "Gaussians", "needles", "memory"]]
    for row in cells:
        deviation = f" ± {row['deviation']:.2f}" if row["deviation"] is not None else ""
        lpips = f"{row['lpips']:.3f}" if row["lpips"] is not None else ""
        cloud = [f"{row['gaussians']:,.0f}", f"{row['needles']:.1%}"] if "gaussians" in row else ["", ""]
        told = [f"{row['scene']}, {row['resolution']}", link(row["method"], page), f"{row['seconds']:g}"]
        told += [f"{row['psnr']:.2f}{deviation}", f"{row['ssim']:.3f}", lpips, f"{row['steps']:.0f}", *cloud]
        rows.append([*told, size(int(row["peak_memory"]))])
    return markdown(rows)


def by_program(cells: Sequence[Row], page: Path) -> list[str]:
    """Programs of the reading edition, and the same work with the package's kernels, in columns with figures."""
    rows = [
        ["program", "lines", "s", "result", "s, kernels", "result", "operation", "ms", "ms, kernel", "times as fast"]
    ]
    for row in cells:
        whole = [row.get("figure", ""), f"{row['kernel_seconds']:.0f}" if "kernel_seconds" in row else ""]
        told = [
            f"[{row['name']}](#{row['name']})",
            f"{row['lines']}",
            f"{row['seconds']:.0f}" if "seconds" in row else "",
        ]
        told += [*whole, row.get("kernel_figure", "")]
        if "operation" in row:
            own, its = row["ms"], row["kernel_ms"]
            told += [f"`{row['operation']}`", f"{own:.1f}", f"{its:.2f}", f"{own / its:.1f}"]
        rows.append(told + [""] * (len(rows[0]) - len(told)))
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]
    return markdown(list(zip(*columns, strict=True)))


def by_parameter(cells: Sequence[Row], page: Path) -> list[str]:
    """Parameters of `rasterization`, with errors or the check."""
    rows = [["parameter", "default", "accepted", "error of pictures", "of gradients"]]
    for row in cells:
        errors = [f"{row['value']:.0e}", f"{row['gradient']:.0e}"] if "value" in row else [row.get("check", ""), ""]
        default = f"`{row['default']}`" if row["default"] else ""
        rows.append([f"`{row['parameter']}`", default, row["accepted"], *errors])
    return markdown(rows)


def by_test(cells: Sequence[Row], page: Path) -> list[str]:
    """Outcomes of gsplat's tests by file, without those of its CUDA operators."""
    rows = [["file", "passed", "failed", "refused"]]
    for file in dict.fromkeys(row["test"].split()[0] for row in cells):
        own = [row for row in cells if row["test"].split()[0] == file]
        rows.append([f"`{file}`", *(str(sum(row.get(x, 0) for row in own)) for x in ("passed", "failed", "refused"))])
    return markdown(rows)


def by_strategy(cells: Sequence[Row], page: Path) -> list[str]:
    """Small trainings, with their PSNR on held-out photographs."""
    rows = [["capture", "strategy", "steps", "Gaussians", "PSNR", "processor's s"]]
    for row in cells:
        told = [f"{row['scene']}, {row['size']}", row["strategy"], str(row["steps"]), f"{row['gaussians']:,}"]
        rows.append([*told, f"{row['psnr']:.2f}", f"{row['seconds']:.0f}"])
    return markdown(rows)


def by_preset(cells: Sequence[Row], page: Path) -> list[str]:
    """Each `--preset paper` after some steps: its loss, time, memory, and the hours of the paper's length."""
    rows = [["method", "scene", "steps", "loss, first and last fifth", "s a step", "memory", "paper's steps", "hours"]]
    for row in cells:
        told = [f"`{Path(row['scene']).name}`", str(row["steps"]), loss_of(row), "", "", "", ""]
        if row["seconds_per_step"]:
            told[3] = f"{row['seconds_per_step']:.2g}"
        if row["peak_memory"]:
            told[4] = size(row["peak_memory"])
        if row["paper_steps"] and row["seconds_per_step"]:
            told[5:] = [f"{row['paper_steps']:,}", hours_of(row)]
        rows.append([link(row["method"], page), *told])
    return markdown(rows)


def by_one_preset(cells: Sequence[Row], page: Path) -> list[str]:
    """A sentence on the first steps of a method's `--preset paper`."""
    (row,) = cells
    few = ", ".join(f"`{name}` {number:,}" for name, number in row["numbers"].items())
    text = f"**The preset `paper`** was not trained to its end here. It took {row['steps']} steps on `{row['scene']}`"
    text += f" with {few}." if few else "."
    if row["loss"]:
        text += f" Its loss, over the first and the last fifth of them: {loss_of(row)}."
    if row["seconds_per_step"]:
        text += f" A step takes {row['seconds_per_step']:.2g} s of one processor"
        text += f", in {size(row['peak_memory'])} of memory." if row["peak_memory"] else "."
    if row["paper_steps"] and row["seconds_per_step"]:
        text += f" The paper's {row['paper_steps']:,} steps would take hours: {hours_of(row)}."
    return [text]


def loss_of(row: Row) -> str:
    """Means of the loss over the first and the last fifth of the steps, and why it does not fall where it does not."""
    if not row["loss"]:
        return "it does not train" if row["method"] in UNTRAINED else "too few steps"
    first, *_, last = row["loss"]
    return f"{first:.3g} to {last:.3g}" + (f" ({RISES.get(row['method'], 'few rays')})" if last >= first else "")


def hours_of(row: Row) -> str:
    """Hours that the paper's steps take at this batch, which is less than the paper's."""
    few = f", at 1/{1 / row['batch_share']:,.0f} of its batch" if row["batch_share"] < 1 else ""
    return f"over {row['seconds_per_step'] * row['paper_steps'] / 3600:,.0f}{few}"


UNTRAINED = "lumigraph", "view-interpolation", "tsdf-fusion"  # by descent; their preparation is in the first step
RISES = {  # losses that do not fall within a hundred steps
    "tensorf": "a grid of 128³ cells begins almost transparent",
    "plenoxels": "a grid of 256³ cells learns in each step from few of them",
    "hyp-nerf": "16 rays a step, each of another object",
    "eg3d": "an adversary learns too",
    "gancraft": "an adversary learns too",
}
QUALIFIERS = {  # of scores in the gallery that are not of held-out views, or that a minute says little about
    "occupancy-network": "of the mesh that it learnt",
    "deepsdf": "of the mesh that it learnt",
    "nglod": "of the mesh that it learnt",
    "dream-fields": "by the guide that it learnt from",
    "dream-splats": "by the guide that it learnt from",
    "gancraft": "between its own views, compared with nothing",
    "tsdf-fusion": "poses given",
    "imap": "poses given",
    "splat-slam": "poses given",
    "pixelnerf": "needs longer than a minute",
}


def qualified(row: Row) -> str:
    """Headline of a gallery's row with its qualifier."""
    said = QUALIFIERS.get(row["method"])
    return f"{headline(row)} ({said})" if said else headline(row)


def by_loop(cells: Sequence[Row], page: Path) -> list[str]:
    """A loop of public functions beside `lumigraph train`."""
    rows = [["capture", "steps", "seed", "own loop, dB", "`train`, dB", "Gaussians"]]
    for row in cells:
        told = [row["scene"], str(row["steps"]), str(row["seed"]), f"{row['own']:.2f}", f"{row['train']:.2f}"]
        rows.append([*told, f"{row['gaussians']:,}"])
    return markdown(rows)


def headline(row: Row) -> str:
    """The first score of a method, whatever it is measured by."""
    score = next(iter(scores_of(row)))
    return f"{score.value:.1f} dB" if score.unit == "dB" else f"{score.name} {score.value:.3g} {score.unit}".strip()


VERDICTS = {
    "above": "better than the baseline",
    "below": "worse",
    "refused": "refused",
    "too slow": "too slow",
    "crash": "crashed",
}
KINDS: dict[str, Callable[[Sequence[Row], Path], list[str]]] = {
    "methods": by_method,
    "cells": by_cell,
    "sections": by_section,
    "gallery": by_showpiece,
    "strangers": by_verdict,
    "minute": by_seconds,
    "reading": by_program,
    "parameters": by_parameter,
    "owntests": by_test,
    "trainings": by_strategy,
    "loops": by_loop,
    "presets": by_preset,
    "preset": by_one_preset,
}
OTHERS = {
    "sections": "gallery",
    "gallery": "gallery",
    "strangers": "strangers",
    "minute": "minute",
    "reading": "reading",
    "parameters": "parameters",
    "owntests": "owntests",
    "trainings": "trainings",
    "loops": "loops",
    "presets": "presets",
    "preset": "presets",
}  # where the figures of a table are


def scenes_of(cells: Sequence[Row]) -> str:
    """Protocol of each scene, as a sentence."""
    return "; ".join(dict.fromkeys(f"{row['scene']}: {protocol(row)}" for row in cells)) + "."


def link(name: str, page: Path) -> str:
    """Name of a method, which leads to its page unless it is on that."""
    target = ROOT / "docs" / "methods" / f"{name.replace('-', '_')}.md"
    return name if target == page else linked(name, target, page)


def linked(name: str, target: Path, page: Path) -> str:
    return f"[{name}]({Path(os.path.relpath(target, page.parent)).as_posix()})"


def paper(name: str) -> str:
    """Authors and year, as a method's file names them."""
    found = re.search(r"\(([^()]*\d{4}), arXiv", methods.summary(name))
    return found[1].split(", arXiv")[0] if found else ""


def markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (rows[0], ["---"] * len(rows[0]), *rows[1:])]


if __name__ == "__main__":
    import tyro

    tyro.cli(Options, description=__doc__).run()
