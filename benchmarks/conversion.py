"""Every method into every other: how alike teacher and student are, and what each takes.

    python benchmarks/conversion.py table procedural:still-life --output FOLDER
    python benchmarks/conversion.py template RUN --output sheet.png

`table` trains each method once (`lumigraph train`), then converts each run into each of the others (`lumigraph convert
--distil`), so that a student has nothing but its teacher. FOLDER/conversion.md holds the tables, conversion.svg the
map, conversion.json the figures. Cells that are done are not done again: the same command goes on where it was stopped.
`template` draws what docs/convert.md shows of one run: as trained, as moved, and after learning on.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lumigraph import methods
from lumigraph.commands.compress import size
from lumigraph.derive.conversion import convert, new_student
from lumigraph.derive.options import ConvertOptions
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.figures.charts import standalone
from lumigraph.files import claim, is_file, write_bytes, write_json
from lumigraph.method.capabilities import FromField, needs
from lumigraph.run import Run
from lumigraph.run.derived import Converted

SEVEN = ("nerf", "mip-nerf", "instant-ngp", "plenoxels", "dvgo", "tensorf", "gaussian-splatting")
CELL, SIDE, TOP = 64, 150, 120  # pixels of the map
LEAST, MOST = 20.0, 40.0  # dB, from the palest cell to the fullest
WANTED = 30.0  # dB, below which a cell is named


@dataclass(frozen=True)
class Table:
    """Train each method, and convert each run into every other method."""

    scene: tyro.conf.Positional[str]
    output: Path
    methods: tuple[str, ...] = SEVEN
    train_seconds: float = 60.0  # of each teacher
    seconds: float = 120.0  # that a conversion may take in all; a quarter of it is spent on learning on
    views: int = 8  # held-out views to compare
    device: str = "cpu"

    def run(self) -> None:
        for name in self.methods:
            self.teach(name)
        rows = [self.cell(name, other) for name in self.methods for other in self.methods if other != name]
        text = tables(rows, self)
        write_json(self.output / "conversion.json", rows, "benchmark")
        write_bytes(self.output / "conversion.svg", standalone(heat_map(rows, self.methods)), "benchmark")
        write_bytes(self.output / "conversion.md", text.encode(), "benchmark")
        print(text)

    def teach(self, name: str) -> None:
        """A run of a method, or what is left of its training."""
        folder = self.output / "runs" / name
        if not is_file(folder / "config.json"):
            told = ("--seconds", self.train_seconds, "--output", folder, "--device", self.device)
            lumigraph("train", name, self.scene, *told)
        elif (run := Run(folder)).state.seconds < self.train_seconds:
            lumigraph("resume", run.folder)

    def cell(self, name: str, other: str) -> dict[str, Any]:
        """What a conversion came to; wall is in seconds, 0 for one that an earlier process did."""
        folder, begin = self.output / "cells" / f"{name}-to-{other}", time.perf_counter()
        if done := Converted.read(folder):
            return asdict(done)
        told = ("--seconds", self.seconds / 4, "--views", self.views, "--device", self.device, "--distil")
        lumigraph("convert", self.output / "runs" / name, other, "--output", folder, *told)
        made = Converted.read(folder)
        assert made is not None
        print(f"{name} into {other}: {made.psnr:.2f} dB in {time.perf_counter() - begin:.0f} s", flush=True)
        return asdict(made)


@dataclass(frozen=True)
class Template:
    """Draw a run, what some methods begin as when they take it over, and what they are after learning on."""

    source: tyro.conf.Positional[Path]
    output: Path
    into: tuple[str, ...] = ("plenoxels", "gaussian-splatting")
    seconds: float = 30.0  # of learning on
    device: str = "cpu"

    def run(self) -> None:
        claim(self.output, "comparison")
        source, rows = Run(self.source), []
        camera = source.cameras()["test"][0]
        teacher = source.method(self.device)
        around = source.cameras()["train"]
        for name in self.into:
            student = new_student(methods.find(name), teacher, torch.device(self.device))
            needs(student, FromField).from_field(teacher, around)
            folder = self.output.with_suffix("") / name
            made = Converted.read(folder) or convert(
                source, name, folder, ConvertOptions(seconds=self.seconds), self.device
            )
            pictures = [x.render(camera).rgb.cpu() for x in (teacher, student.eval(), Run(folder).method(self.device))]
            rows.append(Row(("", f"{name}, {made.taking_over:.0f} s", f"{made.seconds:.0f} s"), pictures))
        columns = (f"train: {source.method_name}", "move", "continue")
        save_picture(self.output, contact_sheet(source.title, columns, rows), "comparison")


def lumigraph(*words: object) -> None:
    """Run a command in a process of its own."""
    subprocess.run([sys.executable, "-m", "lumigraph", *map(str, words)], check=True)


def tables(rows: Sequence[dict[str, Any]], options: Table) -> str:
    """Likeness, seconds per view, sizes, and what falls below WANTED."""
    command = f"python benchmarks/conversion.py table {options.scene} --train-seconds {options.train_seconds:g}"
    lines = [f"`{command} --seconds {options.seconds:g} --views {options.views} --output FOLDER`", ""]
    lines += ["PSNR in dB of held-out views, the student's against the teacher's. Rows: from; columns: into.", ""]
    lines += grid(rows, options.methods, lambda row: f"{row['psnr']:.1f}")
    lines += ["", "Seconds to take over and to learn on.", ""]
    lines += grid(rows, options.methods, lambda row: f"{row['taking_over']:.0f} + {row['seconds']:.0f}")
    lines += ["", "| method | model | seconds per view | PSNR against photographs, as trained |", "|---|---|---|---|"]
    for name in options.methods:
        own = next(row["teacher"] for row in rows if row["teacher"]["method"] == name)
        told = "" if own["psnr"] is None else f"{own['psnr']:.2f}"
        lines.append(f"| `{name}` | {size(own['bytes'])} | {own['seconds']:.3g} | {told} |")
    low = [row for row in rows if row["psnr"] < WANTED]
    names = ", ".join(f"{row['teacher']['method']} into {row['student']['method']}" for row in low)
    lines += ["", f"Below {WANTED:g} dB: {names or 'none'}.", ""]
    return "\n".join(lines)


def grid(rows: Sequence[dict[str, Any]], names: Sequence[str], told: Any) -> list[str]:
    """A table of Markdown with a cell for each conversion."""
    found = {(row["teacher"]["method"], row["student"]["method"]): told(row) for row in rows}
    lines = [f"| | {' | '.join(f'`{name}`' for name in names)} |", "|---|" + "---|" * len(names)]
    for name in names:
        lines.append(f"| `{name}` | {' | '.join(found.get((name, other), '') for other in names)} |")
    return lines


def heat_map(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> str:
    """The table as a map: the fuller a cell, the more alike."""
    width, height = SIDE + CELL * len(names) + 10, TOP + CELL * len(names) + 10
    parts = []
    for i, name in enumerate(names):
        along, down = SIDE + CELL * (i + 0.5), TOP + CELL * (i + 0.5)
        turned = f"transform='rotate(-45 {along:.0f} {TOP - 8})'"
        parts.append(f"<text class='label' x='{along:.0f}' y='{TOP - 8}' {turned}>{escape(name)}</text>")
        parts.append(f"<text class='label' x='{SIDE - 8}' y='{down + 4:.0f}' text-anchor='end'>{escape(name)}</text>")
    for row in rows:
        teacher, student = (names.index(row[who]["method"]) for who in ("teacher", "student"))
        x, y = SIDE + CELL * student, TOP + CELL * teacher
        share = min(max((row["psnr"] - LEAST) / (MOST - LEAST), 0.03), 1.0)
        parts.append(
            f"<rect class='c1' x='{x + 1}' y='{y + 1}' width='{CELL - 2}' height='{CELL - 2}' rx='3' "
            f"fill='currentColor' opacity='{share:.2f}'/><text class='label' x='{x + CELL / 2:.0f}' "
            f"y='{y + CELL / 2 + 4:.0f}' text-anchor='middle'>{row['psnr']:.1f}</text>"
        )
    about = "<text x='8' y='16'>from (rows) into (columns), dB</text>"
    return f"<svg viewBox='0 0 {width} {height}' role='img'>{about}{''.join(parts)}</svg>"


Command = Annotated[Table, tyro.conf.subcommand("table")] | Annotated[Template, tyro.conf.subcommand("template")]


if __name__ == "__main__":
    tyro.cli(Command, description=__doc__).run()
