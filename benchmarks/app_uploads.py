"""Uploads that a browser sends to the app: many, malformed, with names that lead elsewhere, beyond the disk, foreign.

    python benchmarks/app_uploads.py --output FOLDER [--photographs 500] [--malformed 100]
    python benchmarks/app_uploads.py --output FOLDER --only tiny large home [--tiny 5000] [--large 40] [--scenes 200]

Photographs of 4 MB each are made in FOLDER and dropped onto the page in headless Chromium; malformed ones are made by
the fuzzer. The disk that fills is a tmpfs, which only root may mount; others pass over it. Prints seconds, memory of
the app's process, and the sentences on the page. --only does without a browser: `tiny` sends tiny files by requests,
`large` asks for thumbnails of photographs of 13000 x 13000 pixels, six at a time, and for advice about them, `home`
asks for the home page of many scenes, two of which have a huge folder and a lost one as their source. Everything but
the pictures of the page is deleted at the end. Exit code 1 if something that should be refused was taken, or the app
ended.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import hashlib
import http.server
import io
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import Request, urlopen

import numpy as np
import psutil
from app_walk import Walk, drop, until, windows
from fuzzing import templates
from fuzzing.bend import bend
from PIL import Image

SIZE, QUALITY = (2736, 1824), 97  # of a photograph of 4 MB
NAMES = (
    "../up.jpg",
    "a/../../up.jpg",
    "/etc/up.jpg",
    "..\\up.jpg",
    "con.jpg",
    ".hidden.jpg",
    "a\nb.jpg",
)
LARGE_SIDE = 13_000  # pixels
HUGE_FOLDERS, HUGE_FILES, PHOTOGRAPHS_EACH = 200, 1000, 50  # of the home page
DISK = "300m", "700m"  # of the disk that fills: before and after it gets room
ELSEWHERE = "evil.example"  # a name that leads to this machine, as after DNS rebinding
UPLOAD_NAMED = """async ([key, names]) => {
  const { upload } = await import("/static/uploads.js");
  upload(key, names.map((name) => ({ name, file: new File([new Uint8Array(64)], "x.jpg") })));
}"""
FAULTS = """async (key) => {
  const { isUploading, stateOf } = await import("/static/uploads.js");
  return isUploading(key) || !stateOf(key).count ? null : { faults: stateOf(key).faults };
}"""
ATTACK = """async (app) => {
  const said = [(answer) => `${answer.type} ${answer.status}`, (fault) => fault.name];
  const ask = (path, options) => fetch(app + path, options).then(...said);
  const project = { method: "POST", body: '{"title": "foreign"}' };
  return [
    await ask("/api/home", {}),
    await ask("/api/projects", { ...project, mode: "no-cors" }),
    await ask("/api/projects", { ...project, headers: { "Content-Type": "application/json" } }),
    await ask("/api/items/many/photographs?name=a.jpg&offset=0&size=4", { method: "PUT", body: "abcd" }),
  ];
}"""


class Silent(http.server.SimpleHTTPRequestHandler):
    """Files of a folder, without a log."""

    def log_message(self, *_: Any) -> None:
        pass


class Uploads(Walk):
    """The app in a folder of its own, and the findings."""

    def __init__(self, output: Path, port: int, patience: float):
        super().__init__(output, port, patience)
        self.found: dict[str, Any] = {}
        self.bad: list[str] = []

    def note(self, name: str, **values: Any) -> None:
        self.found[name] = values
        print(f"{name}: " + ", ".join(f"{key} {value}" for key, value in values.items()), flush=True)

    def expect(self, condition: object, fault: str) -> None:
        if not condition:
            self.bad.append(fault)
            print(f"FAULT: {fault}", flush=True)

    def memory(self) -> float:
        """Most memory that the app's process has had, in MB."""
        assert self.app
        text = Path(f"/proc/{self.app.pid}/status").read_text()
        return int(re.search(r"VmHWM:\s+(\d+)", text)[1]) / 1000  # type: ignore[index]

    def resident(self) -> tuple[int, int]:
        """Memory of the app's process now, and of its children, in MB."""
        assert self.app
        app = psutil.Process(self.app.pid)
        children = 0
        for child in app.children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                children += child.memory_info().rss
        return round(app.memory_info().rss / 1e6), round(children / 1e6)

    def project(self, page: Any, title: str) -> str:
        """Key of a new project, whose page is opened."""
        key = page.evaluate(
            "async (title) => (await (await fetch('/api/projects', {method: 'POST', body: JSON.stringify({title}),"
            " headers: {'Content-Type': 'application/json'}})).json()).key",
            title,
        )
        page.goto(f"{self.url}/#{key}")
        page.get_by_role("tab", name="Photographs").wait_for()
        return str(key)

    def faults_of(self, page: Any, key: str) -> list[str]:
        """Sentences of an upload that is over."""
        return list(until(lambda: page.evaluate(FAULTS, key), self.patience)["faults"])


def make_photographs(folder: Path, count: int) -> list[Path]:
    """JPEG files of about 4 MB, all different."""
    folder.mkdir(parents=True)
    noise = np.random.default_rng(0).integers(0, 60, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    y, x = np.mgrid[: SIZE[1] // 8, : SIZE[0] // 8]
    made = []
    for i in range(count):
        made.append(folder / f"IMG_{i:04}.jpg")
        wave = 90 + 60 * np.sin(x / (17 + i % 31) + i) * np.cos(y / (11 + i % 23))
        smooth = np.asarray(Image.fromarray(wave.astype(np.uint8)).resize(SIZE, Image.Resampling.BILINEAR))
        Image.fromarray(smooth[..., None] + np.roll(noise, 97 * i, 1)).save(made[-1], quality=QUALITY)
    return made


def put(url: str, key: str, name: str, data: bytes) -> str:
    """Send a file as the page does. Returns the name that it has."""
    about = urlencode({"name": name, "size": len(data), "hash": hashlib.blake2s(data, digest_size=16).hexdigest()})
    place = f"{url}/api/items/{key}/photographs?{about}"
    found = json.load(urlopen(place, timeout=600))
    if not found["done"]:
        found = json.load(urlopen(Request(f"{place}&offset={found['have']}", data, method="PUT"), timeout=600))
    assert found["done"], found
    return str(found["name"])


def new(url: str, **about: str) -> str:
    """Key of a new project."""
    headers = {"Content-Type": "application/json"}
    asked = Request(f"{url}/api/projects", json.dumps(about).encode(), headers, method="POST")
    return str(json.load(urlopen(asked))["key"])


def tiny(walk: Uploads, count: int) -> None:
    """Tiny files by requests, three at a time; all of one name; all again."""
    pictures = []
    for i in range(count):
        Image.fromarray(np.array([[i & 255, i >> 8]], np.uint8)).save(out := io.BytesIO(), "PNG")
        pictures.append(out.getvalue())
    key, found = new(walk.url, title="tiny"), {}
    ways = {
        "own_names": lambda i: f"IMG_{i:04}.png",
        "again": lambda i: f"IMG_{i:04}.png",
        "one_name": lambda i: "image.png",
    }
    with ThreadPoolExecutor(3) as pool:
        for way, name in ways.items():
            key = new(walk.url, title=way) if way == "one_name" else key
            begun, halves = time.monotonic(), []
            for part in (range(count // 2), range(count // 2, count)):
                list(pool.map(lambda i, name=name, key=key: put(walk.url, key, name(i), pictures[i]), part))
                halves.append(round(time.monotonic() - begun, 1))
            there = len(walk.detail(key)["photographs"])
            walk.expect(there == count, f"{way}: {there} of {count} are there")
            found[f"{way}_half_and_all_seconds"] = halves
    walk.note("tiny", files=count, **found)


def large(walk: Uploads, count: int) -> None:
    """Thumbnails and advice of huge photographs, half of them PNG, a quarter each baseline and progressive JPEG."""
    key = new(walk.url, title="large")
    photos = walk.output / "scenes" / key / "photos"
    y, x = np.ogrid[:LARGE_SIDE, :LARGE_SIDE]
    image = Image.fromarray(np.stack([(x * k // 50 + y // (k + 1)).astype(np.uint8) for k in range(3)], -1))
    kinds = ["a.png", {}], ["b.jpg", {"quality": 85}], ["c.jpg", {"quality": 85, "progressive": True}]
    for name, options in kinds:
        image.save(photos / name, **({"compress_level": 1} if name == "a.png" else options))
    del image
    for i in range(count):
        os.link(
            photos / ("a.png" if i % 2 else "bc"[i // 2 % 2] + ".jpg"), photos / f"{i:02}{'.png' if i % 2 else '.jpg'}"
        )
    for name, _ in kinds:
        (photos / name).unlink()
    names, peak, ended = sorted(path.name for path in photos.iterdir()), Counter[str](), threading.Event()

    def watch() -> None:
        while not ended.wait(0.05):
            of_app, of_children = walk.resident()
            peak["app"] = max(peak["app"], of_app)
            peak["with_children"] = max(peak["with_children"], of_app + of_children)

    before, begun = walk.resident()[0], time.monotonic()
    (watching := threading.Thread(target=watch)).start()
    place = f"{walk.url}/api/items/{key}/picture?"
    with ThreadPoolExecutor(6) as pool:
        codes = Counter(pool.map(lambda name: urlopen(place + urlencode({"name": name}), timeout=1800).status, names))
    thumbnails = time.monotonic() - begun
    advice = json.load(urlopen(f"{walk.url}/api/items/{key}/advice", timeout=1800))
    seconds = time.monotonic() - begun
    time.sleep(2)
    ended.set()
    watching.join()
    walk.expect(codes == {200: len(names)} and advice, f"thumbnails: {codes}")
    walk.note(
        "large",
        files=len(names),
        thumbnails_seconds=round(thumbnails, 1),
        with_advice_seconds=round(seconds, 1),
        app_before_megabytes=before,
        app_peak_megabytes=peak["app"],
        peak_with_children_megabytes=peak["with_children"],
        app_after_megabytes=walk.resident()[0],
    )


def home(walk: Uploads, count: int, files: Path) -> None:
    """Home page of many scenes, with a source that is huge, one that is lost, and the whole disk."""
    folder = files / "huge"
    for i in range(HUGE_FOLDERS):
        (inner := folder / f"{i:03}").mkdir(parents=True)
        for j in range(HUGE_FILES):
            (inner / f"{j}.txt").touch()
    lost = files / "lost"
    lost.mkdir()
    Image.new("RGB", (40, 30)).save(folder / "a.jpg")
    Image.new("RGB", (40, 30)).save(lost / "a.jpg")
    for source in (folder, lost):
        new(walk.url, title=source.name, path=str(source))
    (folder / "a.jpg").unlink()
    shutil.rmtree(lost)
    key = new(walk.url, title="disk")
    record = walk.output / "scenes" / key / "project.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"source": "/"}))
    Image.new("RGB", (40, 30)).save(out := io.BytesIO(), "JPEG")
    for i in range(count - 3):
        photos = walk.output / "scenes" / new(walk.url, title=f"scene {i}") / "photos"
        for j in range(PHOTOGRAPHS_EACH):
            (photos / f"{j:03}.jpg").write_bytes(out.getvalue())
    times = []
    for _ in range(40):
        begun = time.monotonic()
        found = json.load(urlopen(f"{walk.url}/api/home", timeout=600))
        times.append(round(1000 * (time.monotonic() - begun)))
    cards = {card["title"]: card for card in found["cards"]}
    for title in ("huge", "lost"):
        walk.expect(cards[title]["fault"], f"the card of {title} has no sentence")
    pages = {}
    for title in ("huge", "lost", "disk"):
        begun = time.monotonic()
        walk.detail(cards[title]["key"])
        pages[f"page_of_{title}_ms"] = round(1000 * (time.monotonic() - begun))
    missing = sum(card["bytes"] is None or not card["picture"] for card in found["cards"])
    rest = sorted(times[20:])
    walk.note(
        "home",
        scenes=len(found["cards"]),
        first_ms=times[:3],
        later_median_ms=rest[len(rest) // 2],
        slowest_ms=max(times),
        without_size_or_picture=missing,
        sentences=[cards[title]["fault"] for title in ("huge", "lost")],
        **pages,
    )


def make_malformed(folder: Path, count: int) -> list[Path]:
    """Small photographs and videos of all kinds, bent by the fuzzer."""
    (good := folder / "good").mkdir(parents=True)
    (bad := folder / "bad").mkdir()
    templates.write_pictures(good)
    templates.write_photographs(good)
    templates.write_video(good)
    chance = random.Random(0)
    kinds = [path for path in sorted(good.iterdir()) if path.suffix != ".exr"]
    made = []
    for i in range(count):
        path = bad / f"{i:03}-{kinds[i % len(kinds)].name}"
        shutil.copy(kinds[i % len(kinds)], path)
        bend(path, chance)
        made.append(path)
    return made


def many(walk: Uploads, page: Any, files: list[Path]) -> None:
    """Hundreds of photographs, dropped at once."""
    before, size = walk.memory(), sum(file.stat().st_size for file in files)
    key = walk.project(page, "many")
    ended, slowest = threading.Event(), [0.0]

    def ask() -> None:
        while not ended.wait(2):
            begin = time.monotonic()
            try:
                urlopen(f"{walk.url}/api/home", timeout=600).read()
            except OSError as error:
                walk.expect(False, f"the home page got no answer: {error}")
            slowest[0] = max(slowest[0], time.monotonic() - begin)

    asking = threading.Thread(target=ask)
    asking.start()
    begin = time.monotonic()
    drop(page, files)
    page.get_by_label("Upload").wait_for()
    until(lambda: len(walk.detail(key)["photographs"]) == len(files), walk.patience, 2)
    seconds = time.monotonic() - begin
    faults = walk.faults_of(page, key)
    page.get_by_role("list", name="Photographs").get_by_role("button").nth(len(files) - 1).wait_for()
    page.wait_for_timeout(20_000)
    ended.set()
    asking.join()
    about = json.load(urlopen(f"{walk.url}/api/items/{key}/advice", timeout=600))
    walk.shot(page, "uploads-1-many")
    walk.expect(not faults, f"of {len(files)} photographs some were refused: {faults[:3]}")
    walk.note(
        "many",
        files=len(files),
        gigabytes=round(size / 1e9, 2),
        seconds=round(seconds, 1),
        megabytes_a_second=round(size / 1e6 / seconds, 1),
        slowest_answer_meanwhile=round(slowest[0], 2),
        memory_before=round(before),
        memory_after=round(walk.memory()),
        advice=[one["text"][:90] for one in about],
    )


def malformed(walk: Uploads, page: Any, files: list[Path]) -> None:
    """Malformed photographs: refused by a sentence each, or taken because they open."""
    key = walk.project(page, "malformed")
    drop(page, files)
    faults = walk.faults_of(page, key)
    page.get_by_role("alert").first.wait_for()
    taken = [one["name"] for one in walk.detail(key)["photographs"]]
    shown: Counter[int] = Counter()
    for name in taken:
        try:
            shown[urlopen(f"{walk.url}/api/items/{key}/picture?{urlencode({'name': name})}", timeout=60).status] += 1
        except HTTPError as error:
            shown[error.code] += 1
            walk.expect("fault" in json.load(error), f"{name} is refused without a sentence")
    walk.shot(page, "uploads-2-malformed")
    odd = [text for text in faults if not re.fullmatch(r"[^\n]{20,400}", text) or "Traceback" in text]
    walk.expect(not odd, f"no sentences: {odd[:3]}")
    walk.expect(len(faults) + len(taken) == len(files), f"{len(faults)} refused and {len(taken)} taken")
    walk.note("malformed", files=len(files), refused=len(faults), taken=len(taken), pictures=dict(shown))
    for name in [one["name"] for one in walk.detail(key)["photographs"] if one["video"]]:
        path = f"/api/items/{key}/photographs?{urlencode({'name': name})}"
        page.evaluate("(path) => fetch(path, { method: 'DELETE' })", path)
    page.get_by_role("button", name="Make the scene").click()
    until(lambda: (walk.detail(key)["make"] or {}).get("state") in ("failed", "done"), walk.patience)
    made = walk.detail(key)["make"]
    page.wait_for_timeout(3000)
    walk.shot(page, "uploads-3-malformed-made")
    walk.expect(made["state"] == "done" or re.fullmatch(r"[^\n]{20,600}", made["fault"]), f"made: {made['fault']}")
    walk.note("making a scene of the rest", state=made["state"], sentence=repr(made["fault"]))


def astray(walk: Uploads, page: Any) -> None:
    """Names that lead out of the folder."""
    key = walk.project(page, "astray")
    before = sorted(str(path) for path in walk.output.rglob("*up.jpg"))
    page.evaluate(UPLOAD_NAMED, [key, list(NAMES)])
    faults = walk.faults_of(page, key)
    page.get_by_role("alert").first.wait_for()
    walk.shot(page, "uploads-4-astray")
    there = sorted(str(path) for path in walk.output.rglob("*up.jpg"))
    walk.expect(not Path("/etc/up.jpg").exists(), "/etc/up.jpg was written")
    walk.expect(len(faults) == len(NAMES) and there == before, f"taken: {there}, refused: {faults}")
    walk.note("names that lead elsewhere", refused=f"{len(faults)} of {len(NAMES)}", first=repr(faults[0]))


def full(walk: Uploads, page: Any, files: list[Path]) -> None:
    """A disk that fills in the middle of an upload, and gets room."""
    key = walk.project(page, "full")
    drop(page, files)
    said = page.get_by_text(re.compile("The disk of .* is full"))
    said.wait_for()
    walk.shot(page, "uploads-5-full")
    sentence = said.inner_text()
    there = len(walk.detail(key)["photographs"])
    subprocess.run(["mount", "-o", f"remount,size={DISK[1]}", walk.output / "scenes"], check=True)
    until(lambda: len(walk.detail(key)["photographs"]) == len(files), walk.patience)
    walk.note("full disk", there_when_full=f"{there} of {len(files)}", sentence=repr(sentence), after_room="all")


def foreign(walk: Uploads, page: Any) -> None:
    """A page of another origin, and a foreign name of this machine."""
    with tempfile.TemporaryDirectory() as empty:
        handler = functools.partial(Silent, directory=empty)
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as site:
            threading.Thread(target=site.serve_forever, daemon=True).start()
            before = len(json.load(urlopen(f"{walk.url}/api/home"))["cards"])
            page.goto(f"http://127.0.0.1:{site.server_port}/")
            answers = page.evaluate(ATTACK, walk.url)
            site.shutdown()
    after = len(json.load(urlopen(f"{walk.url}/api/home"))["cards"])
    walk.expect(before == after and not any("200" in answer for answer in answers), f"a foreign page: {answers}")
    page.goto(f"http://{ELSEWHERE}:{walk.port}/")
    sentence = page.inner_text("body").strip()
    walk.expect("html" not in sentence and len(sentence) > 20, f"a foreign name: {sentence}")
    walk.note("foreign origin", answers=answers, scenes=f"{before} before and {after} after")
    walk.note("foreign name", sentence=repr(sentence))


def tokens(walk: Uploads, page: Any) -> None:
    """An app for other machines: without the token, with a wrong one, and with the right one."""
    sentences = []
    for query in ("", "?token=wrong"):
        page.goto(f"{walk.url}/{query}")
        sentences.append(page.inner_text("body").strip())
    walk.shot(page, "uploads-6-no-token")
    walk.expect(all("oken" in one for one in sentences), f"without a token: {sentences}")
    token = re.findall(r"token=([\w-]+)", (walk.output / "app.log").read_text())[-1]
    page.goto(f"{walk.url}/?token={token}")
    page.get_by_text("Drop photographs").first.wait_for()
    walk.note("no token", sentence=repr(sentences[0]), with_token="the page")


@contextlib.contextmanager
def running(walk: Uploads, *words: str) -> Iterator[None]:
    walk.start(*words)
    try:
        yield
    finally:
        walk.expect(walk.app and walk.app.poll() is None, "the app has ended by itself")
        walk.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--photographs", type=int, default=500)
    parser.add_argument("--malformed", type=int, default=100)
    parser.add_argument("--only", nargs="+", choices=("tiny", "large", "home"), default=[], help="without a browser")
    parser.add_argument("--tiny", type=int, default=5000)
    parser.add_argument("--large", type=int, default=40)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--port", type=int, default=8941)
    parser.add_argument("--patience", type=float, default=1800.0, help="seconds for each step")
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    walk = Uploads(given.output, given.port, given.patience)
    files, scenes = given.output / "files", given.output / "scenes"
    mounted = False
    try:
        if given.only:
            with running(walk):
                for name, measure in {
                    "tiny": lambda: tiny(walk, given.tiny),
                    "large": lambda: large(walk, given.large),
                    "home": lambda: home(walk, given.scenes, files),
                }.items():
                    if name in given.only:
                        measure()
            return
        photographs = make_photographs(files / "many", given.photographs)
        bent = make_malformed(files / "malformed", given.malformed)
        with windows(walk, [f"--host-resolver-rules=MAP {ELSEWHERE} 127.0.0.1"]) as (page, _):
            with running(walk):
                page.goto(walk.url)
                many(walk, page, photographs)
                malformed(walk, page, bent)
                astray(walk, page)
                foreign(walk, page)
            shutil.rmtree(scenes)
            scenes.mkdir()
            mounted = os.geteuid() == 0 and not subprocess.call(
                ["mount", "-t", "tmpfs", "-o", f"size={DISK[0]}", "tmpfs", scenes]
            )
            if mounted:
                with running(walk):
                    page.goto(walk.url)
                    full(walk, page, photographs[:40])
            with running(walk, "--host", "0.0.0.0"):
                tokens(walk, page)
    finally:
        walk.stop()
        if mounted:
            subprocess.call(["umount", scenes])
        for folder in (files, scenes):
            shutil.rmtree(folder, ignore_errors=True)
        (given.output / "uploads.json").write_text(json.dumps(walk.found | {"bad": walk.bad}, indent=2) + "\n")
        if walk.bad or walk.faults:
            sys.exit(1)


if __name__ == "__main__":
    main()
