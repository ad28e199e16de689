"""A wheel in an empty environment: megabytes and seconds of the installation, of the import, and of the demo; what each
extra would install, found by pip's dry run.

    make package
    python benchmarks/wheel.py dist/*.whl --output FOLDER [--torch torch==2.13.0] [--seconds 60]

FOLDER, outside the checkout, gets the environment, a cache of compiled kernels, and `elsewhere`, where the demo is run.
Files that the demo reads from other places than these, Python and the system are listed; there should be none.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
IMPORT = "import time; begin = time.perf_counter(); import lumigraph; print(time.perf_counter() - begin)"
IMPORTS = 9
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"].keys() - {"dev"}
# The command, with every file that Python opens written down.
WATCHED = """import sys
log = open({log!r}, "a")
sys.addaudithook(lambda event, about: event == "open" and isinstance(about[0], str) and print(about[0], file=log))
from lumigraph.__main__ import main
sys.argv = ["lumigraph", *sys.argv[1:]]
sys.exit(main())"""


def megabytes(folder: Path) -> float:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def timed(words: Sequence[object], environment: dict[str, str], folder: Path) -> tuple[float, str]:
    """Seconds of a program, and its output."""
    begin = time.monotonic()
    done = subprocess.run([str(word) for word in words], env=environment, cwd=folder, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise SystemExit(f"{words} ended with {done.returncode}: {done.stdout}")
    return time.monotonic() - begin, done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--output", type=Path, required=True, help="new folder outside the checkout")
    parser.add_argument("--torch", default="torch==2.13.0", help="build of PyTorch to install first")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the demo's training")
    given = parser.parse_args()
    output = given.output.resolve()
    if output.is_relative_to(ROOT):
        parser.error(f"{output} is inside the checkout")
    wheel, elsewhere, empty = given.wheel.resolve(), output / "elsewhere", output / "empty"
    elsewhere.mkdir(parents=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["LUMIGRAPH_CACHE"] = str(output / "cache")
    measured: dict[str, float] = {"wheel, MB": wheel.stat().st_size / 1e6}

    def run(name: str, *words: object) -> str:
        measured[f"{name}, s"], said = timed(words, environment, elsewhere)
        print(f"{name}: {measured[f'{name}, s']:.1f} s", flush=True)
        return said

    run("environment", sys.executable, "-m", "venv", empty)
    python, before = empty / "bin" / "python", megabytes(empty)
    for name, package in (("PyTorch", given.torch), ("Lumigraph and the rest", wheel)):
        run(name, python, "-m", "pip", "install", "--quiet", package)
        measured[f"{name}, MB"] = (after := megabytes(empty)) - before
        before = after
    measured["all, MB"] = before
    for extra in sorted(EXTRAS):
        said = run(
            f"[{extra}]", python, "-m", "pip", "install", "--dry-run", "--quiet", "--report", "-", f"{wheel}[{extra}]"
        )
        names = sorted(
            f"{each['metadata']['name']} {each['metadata']['version']}" for each in json.loads(said)["install"]
        )
        print(f"  {len(names)} packages more: {', '.join(names)}", flush=True)
    tries = [float(timed([python, "-c", IMPORT], environment, elsewhere)[1]) for _ in range(IMPORTS)]
    measured["import, first, s"], measured["import, median, s"] = tries[0], statistics.median(tries)
    log = output / "opened.txt"
    print(run("demo", python, "-c", WATCHED.format(log=str(log)), "demo", "--seconds", given.seconds))
    run("demo again", empty / "bin" / "lumigraph", "demo", "--seconds", given.seconds)
    print(json.dumps({name: round(value, 3) for name, value in measured.items()}, indent=1))

    ours = (output, Path(sys.base_prefix), *map(Path, ("/proc", "/sys", "/dev", "/etc", "/usr", "/lib", "/tmp/")))
    opened = {(elsewhere / line).resolve() for line in log.read_text().splitlines()}
    print("read elsewhere:", sorted(str(path) for path in opened if not any(map(path.is_relative_to, ours))))


if __name__ == "__main__":
    main()
