"""A walk through the app in headless Chromium, as a person would: photographs or a video dropped, made into a scene,
cropped, shared, and the page downloaded and opened. Screenshots of each step at desk and phone size, and times.

    python benchmarks/app_walk.py PHOTOS_OR_VIDEO --output FOLDER [--minutes 1] [--frames 30] [--kill] [--axe FILE]

At each step the page may not scroll sideways; messages of its console are printed. --axe runs that program
(`npm install axe-core`, node_modules/axe-core/axe.min.js) at each step; findings that it calls serious or critical fail
the walk.

--kill ends the app by SIGKILL while photographs arrive, while photographs or frames are looked at, while features are
found, while cameras are placed, while it trains, while the scene is open, while its views are compared and while a
page is made. Each time the app is started again and its page is loaded again; files are dropped again while they
arrive. The walk fails if anything is lost or there twice. The browser draws in software: it gets the app's priority,
and its note of that is hidden.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import psutil
from PIL import Image
from playwright.sync_api import Error as PlaywrightError

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from browser import ARGUMENTS, find_chromium
from waiting import until

from lumigraph.app.uploads import kind_of_file

DESK, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
PICTURE_BYTES = 150_000  # of a screenshot
NICENESS = 0  # of the browser: its drawing in software takes a higher priority of its own
# Hides the name of the graphics card, by which viser would show a note of drawing in software.
NO_CARD_NAME = """
for (const kind of [WebGLRenderingContext, WebGL2RenderingContext]) {
  const find = kind.prototype.getExtension;
  kind.prototype.getExtension = function (name) {
    return name === "WEBGL_debug_renderer_info" ? null : find.call(this, name);
  };
}
"""


class Walk:
    """The app's process, a browser at two sizes, and the times of its steps."""

    def __init__(self, output: Path, port: int, patience: float):
        self.output, self.port, self.patience = output, port, patience
        self.url = f"http://127.0.0.1:{port}"
        self.times: dict[str, float] = {}
        self.app: subprocess.Popen[bytes] | None = None
        self.faults: list[str] = []
        self.axe = ""  # source of axe-core
        self.begun = 0.0

    def start(self, *options: str) -> None:
        words = [
            "-m",
            "lumigraph",
            "app",
            str(self.output / "scenes"),
            "--no-browser",
            "--port",
            str(self.port),
            *options,
        ]
        with open(self.output / "app.log", "ab") as log:
            self.app = subprocess.Popen([sys.executable, *words], stdout=log, stderr=log)
        until(self.answers, 300)

    def stop(self) -> None:
        if self.app and self.app.poll() is None:
            self.app.send_signal(signal.SIGINT)
            self.app.wait(90)

    def answers(self) -> bool:
        try:
            return urlopen(self.url, timeout=10).status == 200
        except HTTPError:  # an address without its token
            return True
        except OSError:
            return False

    def kill(self, when: str, page: Any = None) -> None:
        """End the app by SIGKILL, start it again, and load a page of it again."""
        assert self.app
        self.app.send_signal(signal.SIGKILL)
        self.app.wait()
        self.start()
        if page:
            page.reload()
            page.locator("main.project").wait_for()
        self.mark(f"goes on after a kill while {when}")

    def detail(self, key: str) -> dict[str, Any]:
        return json.load(urlopen(f"{self.url}/api/items/{key}", timeout=600))

    def mark(self, step: str) -> None:
        self.times[step] = round(time.monotonic() - self.begun, 1)
        print(f"{self.times[step]:8.1f} s  {step}", flush=True)

    def shot(self, page: Any, name: str) -> None:
        """Save a screenshot as JPEG of at most PICTURE_BYTES, and note what is wrong with the page."""
        if page.evaluate("document.documentElement.scrollWidth > innerWidth"):
            self.faults.append(f"{name} scrolls sideways")
        if self.axe:
            page.evaluate(self.axe)
            found = page.evaluate("axe.run(document, { iframes: false })")["violations"]
            self.faults += [f"{name}: {one['help']}" for one in found if one["impact"] in ("serious", "critical")]
        image = Image.open(io.BytesIO(page.screenshot(timeout=600_000))).convert("RGB")
        for quality in (88, 80, 70, 55):
            image.save(out := io.BytesIO(), "JPEG", quality=quality)
            if out.tell() < PICTURE_BYTES:
                break
        (self.output / f"{name}.jpg").write_bytes(out.getvalue())

    def shots(self, desk: Any, phone: Any, name: str, panel: str = "", scene: str = "") -> None:
        """Save screenshots at both sizes. panel: shown on the phone; scene: selector of what shows that it is open"""
        give_way()
        self.shot(desk, f"{name}-desk")
        place = desk.url
        if scene:  # one viewer at a time: both are drawn in software
            desk.goto("about:blank")
        phone.goto(place)
        phone.locator("main").wait_for()
        if panel:
            with contextlib.suppress(PlaywrightError):  # it leaves the page when the work ends
                phone.get_by_label(panel, exact=True).scroll_into_view_if_needed(timeout=10_000)
        if scene:
            phone.frame_locator("iframe").locator(scene).wait_for()
        phone.wait_for_timeout(5000)
        self.shot(phone, f"{name}-phone")
        phone.goto("about:blank")
        if scene:
            desk.goto(place)
            desk.frame_locator("iframe").locator(scene).wait_for()


def give_way() -> None:
    """Lower the priority of the browser's processes and all of their threads, and of their share as one session."""
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error, OSError):
            if "chrom" not in process.name():
                continue
            for thread in process.threads():
                os.setpriority(os.PRIO_PROCESS, thread.id, NICENESS)
            Path(f"/proc/{process.pid}/autogroup").write_text(str(NICENESS))


def of_folders(files: list[Path]) -> list[Path]:
    """Photographs and videos among files and in folders."""
    found = [one for file in files for one in (file.rglob("*") if file.is_dir() else [file])]
    return [one for one in found if kind_of_file(one.name)]


def drop(page: Any, files: list[Path]) -> None:
    """Drag files from the desktop onto the page, and drop them."""
    session = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(file.resolve()) for file in files], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, "x": 300, "y": 200, "data": data})


@contextlib.contextmanager
def windows(walk: Walk, arguments: Sequence[str] = ()) -> Iterator[tuple[Any, Any]]:
    """Pages of a browser at desk and phone size. arguments: further ones of the browser"""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=[*ARGUMENTS, *arguments])
        desk = browser.new_context(viewport=DESK, accept_downloads=True).new_page()
        phone = browser.new_context(viewport=PHONE, device_scale_factor=2, has_touch=True, is_mobile=True).new_page()
        for page in (desk, phone):
            page.add_init_script(NO_CARD_NAME)
            page.set_default_timeout(1000 * walk.patience)
            page.on("dialog", lambda dialog: dialog.accept())  # "leave the page?" while files arrive
            page.on(
                "console", lambda message: message.type == "log" or print(message.type, message.text[:200], flush=True)
            )
            page.on("pageerror", lambda error: walk.faults.append(str(error)))
        give_way()
        yield desk, phone
        browser.close()


def go(walk: Walk, files: list[Path], advanced: dict[str, float], kill: bool) -> None:
    """From a drop to an open page. advanced: numbers by the label of their field"""
    with windows(walk) as (desk, phone):
        desk.goto(walk.url)
        desk.get_by_text("Drop photographs").first.wait_for()
        walk.shots(desk, phone, "1-home")
        walk.begun = time.monotonic()
        drop(desk, files)
        desk.wait_for_url("**/#*")
        key = desk.url.rpartition("#")[2]
        if kill:
            walk.kill(f"photographs arrive, {len(walk.detail(key)['photographs'])} there", desk)
            drop(desk, files)
        count = len(of_folders(files))
        until(lambda: len(walk.detail(key)["photographs"]) >= count, walk.patience)
        desk.get_by_role("button", name="Make the scene").wait_for()
        walk.mark("all files are there")
        desk.wait_for_timeout(3000)
        if (there := len(walk.detail(key)["photographs"])) != count:
            raise SystemExit(f"{count} photographs were dropped, and {there} are there")
        walk.shots(desk, phone, "2-photographs")
        if advanced:
            desk.get_by_text("Advanced").click()
        for label, value in advanced.items():
            desk.get_by_label(label).fill(str(value))
        print(
            "         told:", desk.get_by_role("radiogroup", name="Quality").inner_text().replace("\n", " "), flush=True
        )
        desk.get_by_role("button", name="Make the scene").click()
        walk.mark("asked to make it")
        stages(walk, desk, phone, key, kill)
        crop_and_share(walk, desk, phone, key, kill)
    if walk.faults:
        raise SystemExit("The page complained: " + "; ".join(walk.faults))


def stages(walk: Walk, desk: Any, phone: Any, key: str, kill: bool) -> None:
    """From photographs to a run, with a picture of each stage."""

    def making() -> dict[str, Any]:
        made = until(lambda: walk.detail(key)["make"], walk.patience)
        if made["state"] == "failed":
            raise SystemExit(made["fault"])
        return made

    def marks() -> int:
        states = json.load(urlopen(f"{walk.url}/api/items/{key}/states", timeout=120)).values()
        return sum(bool(one.get("features")) for one in states)

    if kill:
        until(lambda: making()["state"] == "running", walk.patience)
        walk.kill("photographs are looked at", desk)
    until(lambda: making()["stage"] == "train" or marks() > 3, walk.patience)
    walk.mark("details of four photographs")
    if kill:
        before = marks()
        walk.kill("details are found", desk)
        until(lambda: marks() >= before, walk.patience)
    desk.wait_for_timeout(1500)
    walk.shots(desk, phone, "3-details")

    def cameras() -> int:
        return len(json.load(urlopen(f"{walk.url}/api/items/{key}/model", timeout=120))["cameras"])

    until(lambda: cameras() > 3 or making()["stage"] == "train", walk.patience, 0.2)
    walk.mark("first cameras in 3-D")
    with contextlib.suppress(Exception):
        desk.get_by_role("tab", name="Cameras").click(timeout=5000)
    desk.wait_for_timeout(1500)
    walk.shots(desk, phone, "4-cameras")
    if kill:
        walk.kill("cameras are placed", desk)
    until(lambda: making()["stage"] == "train", walk.patience)
    walk.mark("all cameras are placed")
    until(lambda: making()["progress"].get("step", 0) > 20 or making()["state"] == "done", walk.patience)
    desk.get_by_role("tab", name="Scene").click()
    desk.frame_locator("iframe").get_by_text("Controls").wait_for()
    walk.mark("first picture of the scene")
    if kill:
        step = making()["progress"].get("step", 0)
        walk.kill("it trains", desk)
        until(lambda: making()["progress"].get("step", 0) >= step or making()["state"] == "done", walk.patience)
    desk.wait_for_timeout(10_000)
    walk.shots(desk, phone, "5-training", panel="Progress" if making()["state"] == "running" else "")
    until(lambda: making()["state"] == "done", walk.patience)
    walk.mark("the scene is ready")


def crop_and_share(walk: Walk, desk: Any, phone: Any, key: str, kill: bool) -> None:
    """From a scene to a page of a part of it, downloaded and opened."""
    scene = desk.frame_locator("iframe")
    scene.locator("body.open").wait_for()
    if kill:
        kill_at_rest(walk, desk, key)
    walk.mark("the finished scene is open")
    desk.wait_for_timeout(5000)
    walk.shots(desk, phone, "6-scene", scene="body.open")
    desk.get_by_role("tab", name="Edit").click()
    scene.get_by_role("tab", name="Crop").click()
    scene.get_by_label("Show", exact=True).filter(visible=True).first.click()
    scene.get_by_role("option", name="inside a sphere").click()
    desk.wait_for_timeout(10_000)
    walk.shot(desk, "7-crop-desk")
    scene.get_by_role("button", name="Save", exact=True).filter(visible=True).first.click()
    until(lambda: next((one for one in walk.detail(key)["runs"] if one["name"].endswith("-part")), None), 600)
    walk.mark("the crop is saved")
    desk.get_by_label("Version").filter(has_text="a part").wait_for()
    desk.get_by_role("tab", name="Scene").click()  # makes its page
    if kill:
        desk.get_by_text("Making").wait_for()
        walk.kill("the page is made", desk)
    link = desk.get_by_role("link", name="Download Web page")
    link.wait_for()
    walk.mark("the page is made")
    link.scroll_into_view_if_needed()
    walk.shots(desk, phone, "8-share", panel="Share")
    with desk.expect_download() as download:
        link.click()
    page = walk.output / download.value.suggested_filename
    download.value.save_as(page)
    for window, name in ((desk, "desk"), (phone, "phone")):
        window.goto(page.resolve().as_uri())
        window.locator("body.open").wait_for()
        window.wait_for_timeout(5000)
        if name == "desk":
            walk.mark("the downloaded page is open")
        walk.shot(window, f"9-page-{name}")


def kill_at_rest(walk: Walk, desk: Any, key: str) -> None:
    """Kill the app while the finished scene is open, and while its views are compared with the photographs."""
    before = [run["name"] for run in walk.detail(key)["runs"]]
    walk.kill("the scene is open", desk)
    desk.get_by_role("tab", name="Compare").click()
    desk.get_by_role("button", name="Compare with photographs").click()
    desk.get_by_text("Rendering", exact=True).wait_for()
    walk.kill("its views are compared", desk)
    desk.get_by_role("tab", name="Compare").click()
    desk.get_by_label("Photograph against rendering").wait_for()
    walk.mark("its views are compared")
    if (after := [run["name"] for run in walk.detail(key)["runs"]]) != before:
        raise SystemExit(f"The scene had {before} and has {after}")
    desk.get_by_role("tab", name="Scene").click()
    desk.frame_locator("iframe").locator("body.open").wait_for()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--minutes", type=float, help="of training")
    parser.add_argument("--frames", type=int, help="of a video")
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--axe", type=Path, help="axe.min.js")
    parser.add_argument("--port", type=int, default=8931)
    parser.add_argument("--patience", type=float, default=1800.0, help="seconds for each step")
    given = parser.parse_args()
    place = given.photographs
    files = [place] if place.is_file() else sorted(path for path in place.iterdir() if not path.name.startswith("."))
    given.output.mkdir(parents=True, exist_ok=True)
    walk = Walk(given.output, given.port, given.patience)
    walk.axe = given.axe.read_text("utf-8") if given.axe else ""
    walk.start()
    try:
        fields = {"Minutes of training": given.minutes, "Frames of the video": given.frames}
        go(walk, files, {label: value for label, value in fields.items() if value}, given.kill)
    finally:
        walk.stop()
        (given.output / "walk.json").write_text(json.dumps(walk.times, indent=2) + "\n")


if __name__ == "__main__":
    main()
