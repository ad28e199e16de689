"""`lumigraph convert`: turn a trained run into one of another method."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from tyro.conf import Positional

from ..derive.options import ConvertOptions
from ..errors import LumigraphError
from ..files.options import DeviceOption, needed
from .common import choose_device, method_config, say, show_table, typed
from .compress import size
from .results import Output, Reports, Result

LIST_WIDTH, INDENT = 80, 12  # letters


@dataclass(frozen=True, kw_only=True)
class Convert(Reports, ConvertOptions, Output):
    """Turn a trained run, or a splat file, into a run of another method.

    The new method is initialised from the old one: grids and networks from its density and colour at points, Gaussians
    on its surfaces. Then it trains on the photographs if they are available, otherwise on renderings of the old one.
    NEW/convert.json has the PSNR between the two on held-out views, and the size and speed of each. After Ctrl-C the
    same command continues. `lumigraph convert RUN METHOD --help` adds the method's own options.
    """

    source: Annotated[Positional[Path | None], needed("RUN_OR_FILE")] = None
    """Folder of a run, which does not change, or a splat file."""
    method: Annotated[Positional[str | None], needed("METHOD")] = None
    """Method to convert to, for example plenoxels."""
    output: Annotated[Path | None, needed("NEW")] = None
    """New folder for the run."""
    list: bool = False
    """Print the table of possible conversions, and exit."""
    taught: ClassVar[bool] = True  # the method's defaults are those that follow another method
    device: DeviceOption = "auto"
    preset: Literal["auto", "laptop", "paper"] = "auto"
    """Defaults of the method's options: the paper's, or those tuned for a CPU; auto decides by --device."""

    def run(self) -> int:
        if self.list:
            print(listed())
            return 0
        if self.source is None or self.method is None or self.output is None:
            raise LumigraphError("Name a run, a method and a new folder: lumigraph convert RUN METHOD --output NEW")
        return super().run()

    def of(self, opened: Any) -> Result:
        from .. import methods
        from ..derive.conversion import convert

        assert self.source and self.method and self.output  # by `run`
        name, device = methods.check(self.method), choose_device(self.device)
        try:
            made = convert(opened, name, self.output, self, device, True, method_config(self, name))
        except KeyboardInterrupt:
            say(kept(self.output))
            raise
        show_table(table(made))
        took = f"{made.taking_over:.1f} s to take over, {made.steps} steps in {made.seconds:.1f} s to learn on"
        rows = {"alike": f"{made.psnr:.2f} dB, the mean of {made.views} held-out views", "by": f"{made.how}; {took}"}
        rows |= {"cost": cost(made), "learnt from": made.learnt_from, "saved": str(self.output)}
        rows |= {"verdict": verdict(made, self.source, self.output), "next": typed("view", self.output)}
        return Result(self.output, rows=rows)


def kept(output: Path) -> str:
    """Sentence on what an interrupted conversion keeps."""
    from ..run import Run

    if not (output / "config.json").exists() or not (run := Run(output)).has_state:
        return "Stopped before training, so nothing is kept; the same command begins anew"
    return f"Stopped and saved after step {run.state.step} of training; the same command goes on"


def cost(made: Any) -> str:
    """PSNR lost, bytes of the model and seconds of the conversion."""
    old, new = made.teacher, made.student
    lost = f"{old.psnr - new.psnr:.2f} dB, " if old.psnr is not None and new.psnr is not None else ""
    return f"{lost}{size(new.bytes)} instead of {size(old.bytes)}, {made.taking_over + made.seconds:.0f} s"


def verdict(made: Any, source: Path, output: Path) -> str:
    """Rows in which the new method is better and worse; if it is better in none, what to do."""
    from ..budget import Budget
    from ..run import Run
    from .outcome import more_time

    old, new = made.teacher, made.student
    found = [
        ("smaller", "larger", old.bytes / max(new.bytes, 1)),
        ("faster", "slower", old.seconds / max(new.seconds, 1e-9)),
    ]
    said = {True: list[str](), False: list[str]()}
    for good, bad, ratio in found:
        said[ratio > 1].append(f"{max(ratio, 1 / ratio):.1f} times {good if ratio > 1 else bad}")
    if old.psnr is not None and new.psnr is not None:
        change = new.psnr - old.psnr
        said[change > 0].append(f"{abs(change):.2f} dB {'closer to' if change > 0 else 'farther from'} the photographs")
    better, worse = (" and ".join([", ".join(some[:-1]), some[-1]] if some[1:] else some) for some in said.values())
    if better:
        return f"better: {better}" + (f"; worse: {worse}" if worse else "")
    longer = more_time(output, Budget.from_json(Run(output).settings.budget))
    if made.learnt_from != "photographs":
        longer = "convert again with a longer --seconds"
    return f"worse in every row: {worse}; keep {source}, or train for longer: {longer}"


def table(made: Any) -> Any:
    """Both methods, side by side."""
    from rich.table import Table

    pair = made.teacher, made.student
    rows = Table("", *(x.method for x in pair))
    if all(x.psnr is not None for x in pair):
        rows.add_row("PSNR against photographs", *(f"{x.psnr:.2f} dB" for x in pair))
    rows.add_row("model", *(size(x.bytes) for x in pair))
    rows.add_row("a view", *(f"{x.seconds:.3g} s" for x in pair))
    return rows


def listed() -> str:
    """Conversions: source methods with the same targets together, below them the targets by way."""
    from ..derive.conversion import ways

    alike: dict[tuple[Any, ...], list[str]] = {}
    for name, into in ways().items():
        alike.setdefault(tuple(into.items()), []).append(name)
    lines = []
    for ways_in, names in alike.items():
        targets: dict[str, list[str]] = {}
        for target, way in ways_in:
            targets.setdefault(way or "not into", []).append(target)
        ordered = sorted(targets.items(), key=lambda item: (item[0] == "not into", item[0]))
        lines += ["", *(listing(title, names) for title, names in [("from", names), *ordered])]
    return "\n".join(lines[1:])


def listing(title: str, names: Sequence[str]) -> str:
    """Names behind a title, in lines of 80 letters."""
    indent = " " * INDENT
    return textwrap.fill(", ".join(names), LIST_WIDTH, initial_indent=f"{title:<{INDENT}}", subsequent_indent=indent)
