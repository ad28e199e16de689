"""A walk through the app in headless Chromium, as a person would: photographs or a video dropped, made into a scene,
cropped, shared, and the page downloaded and opened. Screenshots of each step at desk and phone size, and times.

    python benchmarks/app_walk.py PHOTOS_OR_VIDEO --output FOLDER [--minutes 1] [--kill]

--kill ends the app by SIGKILL while features are found, while cameras are placed and while it trains, and starts it
again each time. The walk fails if anything is lost.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from PIL import Image

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from browser import ARGUMENTS, find_chromium

DESK, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
PICTURE_BYTES = 150_000  # of a screenshot


class Walk:
    """The app's process, a browser at two sizes, and the times of its steps."""

    def __init__(self, output: Path, port: int, patience: float):
        self.output, self.port, self.patience = output, port, patience
        self.url = f"http://127.0.0.1:{port}"
        self.times: dict[str, float] = {}
        self.app: subprocess.Popen[bytes] | None = None
        self.faults: list[str] = []
        self.begun = 0.0

    def start(self) -> None:
        words = ["-m", "lumigraph", "app", str(self.output / "scenes"), "--no-browser", "--port", str(self.port)]
        with open(self.output / "app.log", "ab") as log:
            self.app = subprocess.Popen([sys.executable, *words], stdout=log, stderr=log)
        until(self.answers, 300)

    def answers(self) -> bool:
        with contextlib.suppress(OSError):
            return urlopen(self.url, timeout=10).status == 200
        return False

    def kill(self, when: str) -> None:
        assert self.app
        self.app.send_signal(signal.SIGKILL)
        self.app.wait()
        self.start()
        self.mark(f"goes on after a kill while {when}")

    def detail(self, key: str) -> dict[str, Any]:
        return json.load(urlopen(f"{self.url}/api/items/{key}", timeout=120))

    def mark(self, step: str) -> None:
        self.times[step] = round(time.monotonic() - self.begun, 1)
        print(f"{self.times[step]:8.1f} s  {step}", flush=True)

    def shot(self, page: Any, name: str) -> None:
        """Save a screenshot as JPEG of at most PICTURE_BYTES."""
        image = Image.open(io.BytesIO(page.screenshot(timeout=600_000))).convert("RGB")
        for quality in (88, 80, 70, 55):
            image.save(out := io.BytesIO(), "JPEG", quality=quality)
            if out.tell() < PICTURE_BYTES:
                break
        (self.output / f"{name}.jpg").write_bytes(out.getvalue())

    def shots(self, desk: Any, phone: Any, name: str) -> None:
        self.shot(desk, f"{name}-desk")
        with contextlib.suppress(Exception):  # a busy machine may not get this far
            phone.goto(desk.url, timeout=60_000)
            phone.wait_for_timeout(4000)
            self.shot(phone, f"{name}-phone")


def until(told: Callable[[], Any], seconds: float, pause: float = 0.5) -> Any:
    """Result of a function, as soon as it has one."""
    end = time.monotonic() + seconds
    while not (found := told()):
        if time.monotonic() > end:
            raise SystemExit(f"It did not come within {seconds:.0f} s")
        time.sleep(pause)
    return found


def drop(page: Any, files: list[Path]) -> None:
    """Drag files from the desktop onto the page, and drop them."""
    session = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(file.resolve()) for file in files], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, "x": 600, "y": 300, "data": data})


@contextlib.contextmanager
def windows(walk: Walk) -> Iterator[tuple[Any, Any]]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=ARGUMENTS)
        desk = browser.new_context(viewport=DESK, accept_downloads=True).new_page()
        phone = browser.new_context(viewport=PHONE, device_scale_factor=2, has_touch=True, is_mobile=True).new_page()
        for page in (desk, phone):
            page.set_default_timeout(1000 * walk.patience)
            page.on("pageerror", lambda error: walk.faults.append(str(error)))
        yield desk, phone
        browser.close()


def go(walk: Walk, files: list[Path], minutes: float | None, kill: bool) -> None:
    with windows(walk) as (desk, phone):
        desk.goto(walk.url)
        desk.get_by_text("Drop photographs").first.wait_for()
        walk.shots(desk, phone, "1-home")
        walk.begun = time.monotonic()
        drop(desk, files)
        desk.wait_for_url("**/#*")
        key = desk.url.rpartition("#")[2]
        until(lambda: len(walk.detail(key)["photographs"]) == len(files), walk.patience)
        desk.get_by_role("button", name="Make the scene").wait_for()
        walk.mark("all files are there")
        desk.wait_for_timeout(3000)
        walk.shots(desk, phone, "2-photographs")
        if minutes:
            desk.get_by_text("Advanced").click()
            desk.get_by_label("Minutes of training").fill(str(minutes))
        desk.get_by_role("button", name="Make the scene").click()
        walk.mark("asked to make it")
        stages(walk, desk, phone, key, kill)
        crop_and_share(walk, desk, phone)
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

    until(lambda: making()["stage"] == "train" or marks() > 3, walk.patience)
    walk.mark("details of four photographs")
    if kill:
        before = marks()
        walk.kill("details are found")
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
        walk.kill("cameras are placed")
    until(lambda: making()["stage"] == "train", walk.patience)
    walk.mark("all cameras are placed")
    until(lambda: making()["progress"].get("step", 0) > 20 or making()["state"] == "done", walk.patience)
    desk.get_by_role("tab", name="Scene").click()
    desk.frame_locator("iframe").get_by_role("tab", name="Crop").wait_for()
    walk.mark("first picture of the scene")
    if kill:
        step = making()["progress"].get("step", 0)
        walk.kill("it trains")
        until(lambda: making()["progress"].get("step", 0) >= step or making()["state"] == "done", walk.patience)
        desk.reload()
    desk.wait_for_timeout(15_000)
    walk.shots(desk, phone, "5-training")
    until(lambda: making()["state"] == "done", walk.patience)
    walk.mark("the scene is ready")


def crop_and_share(walk: Walk, desk: Any, phone: Any) -> None:
    scene = desk.frame_locator("iframe")
    scene.get_by_role("tab", name="Crop").wait_for()
    desk.wait_for_timeout(20_000)
    with contextlib.suppress(Exception):  # viser's notice of slow graphics
        scene.locator(".mantine-Notification-closeButton").first.click(timeout=5000)
    walk.mark("the finished scene is open")
    walk.shots(desk, phone, "6-scene")
    scene.get_by_role("tab", name="Crop").click()
    scene.get_by_label("Show", exact=True).filter(visible=True).first.click()
    scene.get_by_role("option", name="inside a sphere").click()
    desk.wait_for_timeout(10_000)
    walk.shot(desk, "7-crop-desk")
    desk.get_by_role("button", name="Make Web page").click()
    link = desk.get_by_role("link", name="Download Web page")
    link.wait_for()
    walk.mark("the page is made")
    link.scroll_into_view_if_needed()
    walk.shots(desk, phone, "8-share")
    with desk.expect_download() as download:
        link.click()
    page = walk.output / download.value.suggested_filename
    download.value.save_as(page)
    for window, name in ((desk, "desk"), (phone, "phone")):
        window.goto(page.resolve().as_uri(), timeout=600_000)
        window.wait_for_timeout(15_000)
        if name == "desk":
            walk.mark("the downloaded page is open")
        walk.shot(window, f"9-page-{name}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--kill", action="store_true")
    parser.add_argument("--port", type=int, default=8931)
    parser.add_argument("--patience", type=float, default=1800.0, help="seconds for each step")
    given = parser.parse_args()
    place = given.photographs
    files = [place] if place.is_file() else sorted(path for path in place.iterdir() if not path.name.startswith("."))
    given.output.mkdir(parents=True, exist_ok=True)
    walk = Walk(given.output, given.port, given.patience)
    walk.start()
    try:
        go(walk, files, given.minutes, given.kill)
    finally:
        if walk.app:
            walk.app.send_signal(signal.SIGINT)
            walk.app.wait(60)
        (given.output / "walk.json").write_text(json.dumps(walk.times, indent=2) + "\n")


if __name__ == "__main__":
    main()
