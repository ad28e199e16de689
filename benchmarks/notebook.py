"""The notebook of the documents, executed as Jupyter does; and the cost of a step in it, beside the command line.

    python benchmarks/notebook.py --photographs FOLDER [--output executed.ipynb]
    python benchmarks/notebook.py --steps [--rounds 3]

With photographs, docs/photographs-to-page.ipynb is executed as it is, in a temporary folder. `--steps` trains by
`lumigraph train` and by `lumigraph.train` in a kernel, in turn, and compares the seconds of training that the runs
state, which are those of their steps alone. Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lumigraph.run import Run

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOK = ROOT / "docs" / "photographs-to-page.ipynb"
SCENE, METHOD, STEPS = "procedural:still-life", "instant-ngp", 500
CELL = "import lumigraph\nlumigraph.train({scene!r}, {method!r}, {output!r}, steps={steps})"


def execute(notebook: Any, folder: Path, changes: Mapping[str, str] | None = None, seconds: int = 3600) -> Any:
    """A notebook, executed with a folder as its working directory. changes: replacements in its cells"""
    from nbclient import NotebookClient

    for cell in notebook.cells:
        for before, after in (changes or {}).items():
            cell.source = cell.source.replace(before, after)
    resources = {"metadata": {"path": str(folder)}}
    return NotebookClient(notebook, timeout=seconds, kernel_name="python3", resources=resources).execute()


def outputs(cell: Any) -> dict[str, Any]:
    """Data of a cell's outputs by media type, the last of each."""
    found: dict[str, Any] = {}
    for output in cell.get("outputs", ()):
        found |= output.get("data", {})
    return found


def run_photographs(photographs: Path, output: Path | None) -> None:
    import nbformat

    notebook = nbformat.read(NOTEBOOK, 4)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "photographs").symlink_to(photographs.resolve())
        begin = time.monotonic()
        execute(notebook, Path(folder))
        print(f"executed in {time.monotonic() - begin:.0f} s")
        print(f"page.html: {(Path(folder) / 'page.html').stat().st_size / 1e6:.1f} MB")
    for cell in notebook.cells:
        if cell.cell_type == "code":
            shown = {kind: data if kind == "text/plain" else len(data) for kind, data in outputs(cell).items()}
            print(f"{cell.source.splitlines()[-1][:60]:60}  {shown}")
    if output:
        nbformat.write(notebook, output)


def by_command(output: Path) -> None:
    """A run by `lumigraph train`."""
    words = ["train", METHOD, SCENE, "--steps", str(STEPS), "--output", str(output)]
    subprocess.run([sys.executable, "-m", "lumigraph", *words], check=True, capture_output=True)


def by_notebook(output: Path) -> None:
    """A run by `lumigraph.train` in a kernel."""
    import nbformat.v4

    source = CELL.format(scene=SCENE, method=METHOD, output=str(output), steps=STEPS)
    execute(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)]), output.parent)


def compare_steps(rounds: int) -> None:
    costs: dict[str, list[float]] = {"command line": [], "notebook": []}
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(rounds):
            for name, train in (("command line", by_command), ("notebook", by_notebook)):
                train(output := Path(folder) / f"{name}-{turn}")
                costs[name].append(1000 * Run(output).state.seconds / STEPS)
                print(f"{name}: {costs[name][-1]:.2f} ms a step", flush=True)
    medians = {name: statistics.median(values) for name, values in costs.items()}
    ratio = medians["notebook"] / medians["command line"]
    print(json.dumps(medians | {"notebook / command line": round(ratio, 4)}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=Path)
    parser.add_argument("--output", type=Path)
    parser.add_argument("--steps", action="store_true")
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    if given.photographs:
        run_photographs(given.photographs, given.output)
    if given.steps:
        compare_steps(given.rounds)


if __name__ == "__main__":
    main()
