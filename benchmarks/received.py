"""A received folder, made to do harm, in the app and at a terminal: nothing of it runs, nothing outside it is written.

    python benchmarks/received.py --output FOLDER

In FOLDER/scenes: a run and a project with modules of the names that Python, Lumigraph and its libraries import, jobs
that wait with hostile methods and names, a title that is an option of the command line, a title of markup, and projects
in which each place that the app writes to is a link to FOLDER/outside. The app starts there, headless Chromium presses
every button of every page, and commands run in the folders. The exit code is 1 if a file of theirs ran, or if anything
outside has changed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from urllib.parse import quote
from urllib.request import urlopen

from app_walk import Walk, until
from playwright.sync_api import Error as PlaywrightError
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from browser import ARGUMENTS, find_chromium

LIBRARIES = {"numpy", "torch", "numba", "tyro", "msgspec", "PIL", "scipy", "rich", "pycolmap", "safetensors", "viser"}
OPTION = "--method-file=evil.py"
MARKUP = "<img src=x onerror='window.ran=1'>\n<script>window.ran=1</script>"
LINKS = (
    "app.log", "job.json", "project.json", "photos", "left-out", "scene", "runs", "shared", "scene/work/database.db",
    "runs/a/metrics.jsonl", "runs/a/checkpoints", "runs/a/eval", "runs/a/renders", "photos/.b.jpg.part", "lock.json",
)  # fmt: skip
COMMANDS = (
    "info .", "resume . --steps 45", "eval . --views 1", "render . --frames 1 --size 32", "export points . made.ply"
)  # fmt: skip
STEPS, PRESS_MS = 40, 4000
OUTSIDE_ACTIONS = "Show in folder"  # begins a program of the desktop, on a folder of the app


def evil(folder: Path, ran: Path) -> None:
    """Modules that leave a file where they run, and a Numba configuration that names code."""
    text = f"open({str(ran)!r}, 'a').write(__file__ + '\\n'); raise SystemExit('a received file ran')\n"
    for name in LIBRARIES | set(sys.stdlib_module_names) | {"lumigraph", "sitecustomize", "usercustomize"}:
        (folder / f"{name}.py").write_text(text)
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {folder}\n")


def project(folder: Path, run: Path, title: str, photograph: bytes) -> Path:
    """A project with a run, photographs, and jobs that were asked for by nobody here."""
    (folder / "photos").mkdir(parents=True)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        (folder / "photos" / name).write_bytes(photograph)
    shutil.copytree(run, folder / "runs" / "a")
    (folder / "project.json").write_text(json.dumps({"title": title, "made": 1.0}))
    make = {"state": "queued", "asked": 1.0, "method": OPTION, "stage": "train", "run": "a"}
    share = {"kind": "page", "run": "a", "options": [OPTION], "state": "queued", "asked": 1.0}
    shares = [share | {"name": f"{folder.name}.html"}, share | {"name": "page.html", "kind": "film"}]
    (folder / "job.json").write_text(json.dumps({"make": make, "shares": shares}))
    return folder


def received(scenes: Path, run: Path, outside: Path, ran: Path) -> None:
    """The folder, as somebody may have made it."""
    photograph = next((run / "previews").glob("*.png")).read_bytes()
    scenes.mkdir(parents=True)
    outside.mkdir()
    (outside / "kept.txt").write_text("kept")
    (outside / "folder").mkdir()
    shutil.copytree(run, scenes / "run")
    project(scenes / "option", run, OPTION, photograph)
    project(scenes / "markup", run, MARKUP, photograph)
    project(scenes / "long", run, "x" * 10_000, photograph)
    out = project(scenes / "leads-out", run, "leads out", photograph)
    job = json.loads((out / "job.json").read_text())
    job["shares"][0]["name"] = "../../../outside/page.html"
    (out / "job.json").write_text(json.dumps(job))
    for number, name in enumerate(LINKS):
        place = project(scenes / f"link-{number}", run, f"link {number}", photograph) / name
        shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(outside / ("kept.txt" if Path(name).suffix else "folder"))
    for folder in [scenes, *(path for path in scenes.rglob("*") if path.is_dir() and not path.is_symlink())]:
        evil(folder, ran)


def checksums(folder: Path) -> dict[str, str]:
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


def open_page(page: Any, url: str, wait: float) -> None:
    """Load a page anew, with all that it folds open."""
    page.goto("about:blank")
    page.goto(url)
    page.locator("main.project, .card, main .fault").first.wait_for(timeout=60_000)
    page.wait_for_timeout(wait)
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")


def press_everything(page: Any, url: str, wait: float) -> tuple[int, int]:
    """Press each button of a page, loading it anew for each; the dangerous ones last. Returns presses and misses."""
    open_page(page, url, wait)
    labels = page.eval_on_selector_all(
        "button:not([disabled]), a.button, summary",
        "all => all.map(one => [one.classList.contains('danger') ? 1 : 0, one.ariaLabel || one.textContent.trim()])",
    )
    wanted = dict.fromkeys(label for _, label in sorted(labels) if label != OUTSIDE_ACTIONS)
    pressed = missed = 0
    for label in wanted:
        try:
            open_page(page, url, wait)
            found = page.locator("button, a.button, summary").filter(has_text=label)
            found = found if found.count() else page.get_by_label(label, exact=True)
            found.first.click(timeout=PRESS_MS, force=True)
            page.wait_for_timeout(wait)
            pressed += 1
        except PlaywrightError:  # it went with the state that it belonged to
            missed += 1
    return pressed, missed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--port", type=int, default=8090)
    options = parser.parse_args()
    output = options.output.resolve()
    run, scenes, outside, ran = output / "run", output / "scenes", output / "outside", output / "RAN"
    lumigraph = [str(Path(sys.executable).with_name("lumigraph"))]
    train = ["train", "gaussian-splatting", "procedural:still-life", "--steps", str(STEPS), "--output", str(run)]
    subprocess.run([*lumigraph, *train], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    received(scenes, run, outside, ran)
    shutil.copytree(scenes, typed := output / "terminal", symlinks=True)
    before = checksums(outside)

    walk = Walk(output, options.port, 120)
    os.chdir(scenes)  # where `python -m` and Numba look
    with open(output / "app.log", "wb") as log:
        words = [*lumigraph, "app", ".", "--no-browser", "--port", str(options.port)]
        walk.app = subprocess.Popen(words, stdout=log, stderr=log, cwd=scenes)
    until(walk.answers, 300)
    home = f"{walk.url}/api/home"
    keys = [card["key"] for card in json.load(urlopen(home))["cards"]]
    pressed = missed = 0
    script = False
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=ARGUMENTS)
        page = browser.new_page()
        page.on("dialog", lambda dialog: dialog.accept())
        for url in [f"{walk.url}/#{quote(key)}" for key in sorted(keys)] + [walk.url]:
            got = press_everything(page, url, 700)
            pressed, missed = pressed + got[0], missed + got[1]
            script = script or bool(page.evaluate("window.ran"))
            print(f"{got[0]:4} pressed, {got[1]:2} gone  {url.rpartition('/')[2]}", flush=True)
        end = time.monotonic() + 120  # what was asked for is made
        while json.load(urlopen(home))["queue"] and time.monotonic() < end:
            page.wait_for_timeout(1000)
        browser.close()
    walk.stop()

    terminal = 0
    for folder in [typed / "run", typed / "option" / "runs" / "a", *sorted(typed.glob("link-*/runs/a"))]:
        for words in map(str.split, COMMANDS):
            done = subprocess.run([*lumigraph, *words], cwd=folder, capture_output=True, text=True, errors="replace")
            terminal += 1
            if done.returncode not in (0, 2) or "Traceback" in done.stderr:
                print(folder, words, done.returncode, done.stderr[-300:])
    after = checksums(outside)
    changed = [name for name in after.keys() | before if after.get(name) != before.get(name)]
    print(f"buttons pressed: {pressed}, gone before they could be: {missed}; commands at a terminal: {terminal}")
    print(f"received files that ran: {len(ran.read_text().splitlines()) if ran.exists() else 0}")
    print(f"scripts of titles that ran: {int(script)}; files outside that changed: {len(changed)} {changed[:5]}")
    return int(ran.exists() or script or bool(changed))


if __name__ == "__main__":
    raise SystemExit(main())
