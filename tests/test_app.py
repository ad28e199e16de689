"""The app's routes: uploads, projects, jobs with a quick command in place of ours, and who is let in."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import shutil
import signal
import sqlite3
import sys
import threading
import time
import zlib
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from app_uploads import make_malformed
from budgets import budget
from PIL import Image
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from waiting import until
from websockets.sync.server import serve as serve_websockets

from lumigraph.app import folders, jobs, pace, pictures, progress, projects, sharing, uploads
from lumigraph.app.job_record import Making, change, read_job
from lumigraph.app.jobs import child_address
from lumigraph.app.projects import find_item, new_project
from lumigraph.app.scene_views import SceneView
from lumigraph.app.server import App, build, qr_code
from lumigraph.errors import LumigraphError
from lumigraph.viewer.address import Address

pytestmark = budget("exports", 12)

BASE = "http://127.0.0.1:8080"
HOST = {"Host": "127.0.0.1:8080"}  # for websockets, where the client would have another
TOKEN = "a-token-nobody-guesses"
# The commands, in short: capture makes a scene, train a run. It waits for the file `go`, and fails as `fault` says.
PROGRAM = """
import json, os, pathlib, shutil, signal, sys, time
request = json.load(sys.stdin)
command, options = request["command"], request["options"]
root = pathlib.Path(sys.argv[0]).parent / "scenes-here"
made = pathlib.Path(options.get("output") or options["run_folder"])
here = root / made.relative_to(root).parts[0]
def stop(number, frame):
    print("saved", flush=True)
    sys.exit(128 + number)
signal.signal(signal.SIGINT, stop)
signal.signal(signal.SIGTERM, stop)
with open(here / "calls.txt", "a") as calls:
    calls.write(json.dumps(request) + "\\n")
while not (root / "go").exists():
    time.sleep(0.01)
if (fault := root / "fault").exists():
    sys.exit(print("warning: something\\nlumigraph: " + fault.read_text()) or 2)
if command == "capture":
    made.mkdir()
    (made / "transforms.json").write_text("{}")
elif command in ("train", "resume"):
    shutil.copytree((root.parent / "ball.txt").read_text(), made, dirs_exist_ok=True)
elif command != "eval":
    made.write_bytes(b"<p>made</p>")
"""


def jpeg(seed: int = 0, size: tuple[int, int] = (64, 48), scale: float = 1.0) -> bytes:
    """A photograph full of fine detail."""
    noise = np.random.default_rng(seed).integers(0, 255, (*size[::-1], 3))
    out = io.BytesIO()
    Image.fromarray((noise * scale).astype(np.uint8)).save(out, "JPEG", quality=95)
    return out.getvalue()


@pytest.fixture
def app(tmp_path, ball_run) -> App:
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "ball.txt").write_text(str(Path(ball_run.path).resolve()))
    (tmp_path / "scenes-here").mkdir()
    return App(tmp_path / "scenes-here", Address("127.0.0.1", 8080), ["-S", str(tmp_path / "program.py")])


@pytest.fixture
def client(app):
    return TestClient(build(app), base_url=BASE)


@pytest.fixture
def running(app):
    """A client of an app whose jobs run."""
    with TestClient(build(app), base_url=BASE) as client:
        yield client


@pytest.fixture
def project(app) -> str:
    return new_project(app.root, "Garden").key


def put(client, key: str, name: str, data: bytes, offset: int = 0, size: int | None = None, **more):
    about = {"name": name, "offset": offset, "size": len(data) if size is None else size, **more}
    return client.put(f"/api/items/{key}/photographs", params=about, content=data)


def names(app, key: str) -> list[str]:
    return sorted(uploads.listed(find_item(app.root, key).path / "photos"))


# Who is let in


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example:8080", "me@127.0.0.1:8080", "192.168.1.9:8080"]
)
def test_foreign_hosts_get_nothing(client, project, host):
    for method, path in (("GET", "/"), ("GET", "/api/home"), ("DELETE", f"/api/items/{project}")):
        assert client.request(method, path, headers={"Host": host}).status_code == 403


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1:8080"])
def test_pages_of_other_sites_get_nothing(app, client, project, origin):
    headers = {"Origin": origin}
    about = {"name": "a.jpg", "offset": 0, "size": 9}
    assert (
        client.put(f"/api/items/{project}/photographs", params=about, content=jpeg(), headers=headers).status_code
        == 403
    )
    assert client.post("/api/projects", json={"title": "x"}, headers=headers).status_code == 403
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(f"/scene/{project}/live", headers=HOST | headers):
        pass
    assert names(app, project) == [] and len(projects.items(app.root)) == 1


def test_our_own_page_is_let_in_and_framed_by_nobody(client):
    page = client.get("/", headers={"Origin": BASE})
    assert page.status_code == 200 and "app.js" in page.text
    assert "frame-ancestors 'none'" in page.headers["Content-Security-Policy"]
    assert page.headers["X-Content-Type-Options"] == "nosniff" and "Set-Cookie" not in page.headers
    assert client.get("/static/app.js").headers["Content-Type"].startswith("text/javascript")
    assert client.get("/static/..%2fserver.py").status_code == 404


def test_others_need_the_token_and_name_no_path(tmp_path):
    app = App(tmp_path, Address("0.0.0.0", 8080, TOKEN))
    client = TestClient(build(app), base_url=BASE)
    assert client.get("/").status_code == client.get("/?token=wrong").status_code == 403
    assert client.post("/api/projects", json={"title": "x"}).status_code == 403
    assert f"lumigraph-8080={TOKEN}" in client.get(f"/?token={TOKEN}").headers["Set-Cookie"]  # which the client keeps
    assert client.get("/api/home").json()["local"] is False
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "a.jpg").write_bytes(jpeg())
    refused = client.post("/api/projects", json={"title": "x", "path": str(tmp_path / "pictures")})
    assert refused.status_code == 400 and "on this machine" in refused.json()["fault"]


def test_a_phone_gets_the_address_with_its_token_as_a_code(tmp_path, client, project, monkeypatch):
    monkeypatch.setattr("lumigraph.viewer.address.own_addresses", lambda: ["127.0.0.1", "192.0.2.7"])
    app = App(tmp_path, Address("0.0.0.0", 8080, TOKEN))
    phone, key = TestClient(build(app), base_url=BASE), new_project(tmp_path, "Garden").key
    assert phone.get("/api/phone.svg").status_code == 403
    url = f"http://192.0.2.7:8080/?token={TOKEN}"
    assert phone.get(f"/api/home?token={TOKEN}").json()["phone"] == url
    assert phone.get(f"/api/items/{key}").json()["phone"] == f"{url}#{key}"
    code = phone.get("/api/phone.svg", params={"key": key})
    assert code.headers["Content-Type"] == "image/svg+xml" and code.content == qr_code(f"{url}#{key}")
    assert phone.get("/api/phone.svg", params={"key": "no"}).status_code == 400
    assert client.get("/api/home").json()["phone"] == "" and client.get("/api/phone.svg").status_code == 400


# Uploads


def test_a_photograph_arrives_in_pieces(app, client, project):
    data = jpeg(1)
    half = len(data) // 2
    assert put(client, project, "a b/één.JPG", data[:half], 0, len(data)).json()["done"] is False
    assert names(app, project) == []  # not before it is whole
    astray = put(client, project, "a b/één.JPG", data[half + 5 :], half + 5, len(data))
    assert astray.status_code == 409 and astray.json()["have"] == half
    about = {"name": "a b/één.JPG", "size": len(data)}
    assert client.get(f"/api/items/{project}/photographs", params=about).json() == {
        "have": half,
        "name": "a b/één.JPG",
        "done": False,
    }
    assert put(client, project, "a b/één.JPG", data[half:], half, len(data)).json()["done"] is True
    assert (find_item(app.root, project).path / "photos/a b/één.JPG").read_bytes() == data
    other = jpeg(2, (80, 60))
    assert put(client, project, "a b/één.JPG", other).json()["name"] == "a b/één-2.JPG"
    assert names(app, project) == ["a b/één-2.JPG", "a b/één.JPG"]


def contents(app, key: str, folder: str = "photos") -> list[bytes]:
    return sorted(path.read_bytes() for path in (app.root / key / folder).rglob("*") if path.is_file())


def bitmap(seed: int) -> bytes:
    """A small picture of always the same number of bytes."""
    Image.fromarray(np.full((4, 5), seed, np.uint8)).save(out := io.BytesIO(), "BMP")
    return out.getvalue()


def hash_of(data: bytes) -> str:
    return hashlib.blake2s(data, digest_size=16).hexdigest()


@pytest.mark.parametrize("hashed", [True, False], ids=["with a hash", "without"])
def test_photographs_of_one_name_and_size_both_stay_and_repeats_do_not(app, client, project, hashed):
    both = [bitmap(1), bitmap(2)]
    about = [{"hash": hash_of(data)} if hashed else {} for data in both]
    half = len(both[0]) // 2
    for _ in range(2):  # the second time they are there already
        for data, more, name in zip(both, about, ["image.bmp", "image-2.bmp"], strict=True):
            if not put(client, project, "image.bmp", data[:half], 0, len(data), **more).json()["done"]:
                put(client, project, "image.bmp", data[half:], half, len(data), **more)
            asked = {"name": "image.bmp", "size": len(data), **more}
            found = client.get(f"/api/items/{project}/photographs", params=asked).json()
            assert found == ({"have": len(data), "name": name, "done": True} if hashed else found | {"have": 0})
    assert names(app, project) == ["image-2.bmp", "image.bmp"] and contents(app, project) == sorted(both)


def test_uploads_of_one_name_and_size_do_not_mix_on_their_way(app, client, project):
    both = [bitmap(1), bitmap(2)]
    for part in (slice(0, 9), slice(9, None)):
        for data in both:
            more = {"hash": hash_of(data)}
            assert put(client, project, "a.bmp", data[part], part.start, len(data), **more).status_code == 200
    assert contents(app, project) == sorted(both)


def test_left_out_photographs_of_one_name_both_stay(app, client, project):
    both = [bitmap(1), bitmap(2)]
    for data in both:
        put(client, project, "walk/a.bmp", data)
        client.delete(f"/api/items/{project}/photographs", params={"name": "walk/a.bmp"})
    assert contents(app, project, "left-out") == sorted(both) and names(app, project) == []
    assert client.delete(f"/api/items/{project}/photographs", params={"name": "../project.json"}).status_code == 400


def test_a_piece_that_comes_several_times_at_once_is_added_once(app, project):
    data, barrier = jpeg(1), threading.Barrier(6)
    file = uploads.upload(app.root / project / "photos", "a.jpg", len(data))
    for offset, piece in ((0, data[:900]), (900, data[900:])):

        def add(offset=offset, piece=piece) -> str:
            barrier.wait()
            try:
                return str(file.add(offset, piece).have)
            except uploads.MisplacedError:
                return "misplaced"

        with ThreadPoolExecutor(6) as pool:
            said = [one.result() for one in [pool.submit(add) for _ in range(6)]]
        assert sorted(said) == [str(offset + len(piece)), *["misplaced"] * 5]
    assert contents(app, project) == [data]


def test_a_link_in_a_received_project_leads_no_upload_out(app, client, project, tmp_path):
    photos, data = app.root / project / "photos", jpeg()
    (elsewhere := tmp_path / "elsewhere").mkdir()
    (photos / "walk").symlink_to(elsewhere)
    (photos / f".a.jpg.{len(data)}-.part").symlink_to(elsewhere / "a.jpg")
    for name in ("walk/a.jpg", "a.jpg"):
        refused = put(client, project, name, data)
        assert refused.status_code == 400 and "is a link" in refused.json()["fault"]
        assert client.get(f"/api/items/{project}/picture", params={"name": name}).status_code == 400
    assert list(elsewhere.iterdir()) == []


def test_uploads_list_the_folder_once(app, client, project, monkeypatch):
    asked = []
    monkeypatch.setattr(uploads, "listed", lambda folder, real=uploads.listed: asked.append(folder) or real(folder))
    monkeypatch.setattr(uploads, "MAX_FILES", 8)
    for i in range(8):
        assert put(client, project, "image.bmp", bitmap(i)).status_code == 200
    assert len(asked) == 1 and len(names(app, project)) == 8
    refused = put(client, project, "one-more.bmp", bitmap(9))
    assert refused.status_code == 400 and "8 files are the most" in refused.json()["fault"]
    assert put(client, project, "image.bmp", bitmap(3), hash=hash_of(bitmap(3))).json()["done"]
    (app.root / project / "photos" / "image.bmp").unlink()
    monkeypatch.setattr(uploads, "RELIST_SECONDS", 0.0)
    assert put(client, project, "one-more.bmp", bitmap(9)).status_code == 200


def test_parts_of_uploads_that_nobody_continues_go(app, client, project):
    photos, data = app.root / project / "photos", jpeg(1)
    put(client, project, "new.jpg", data[:100], 0, len(data))
    put(client, project, "old.jpg", data[:100], 0, len(data))
    put(client, project, "refused.jpg", data[:100], 0, 120)
    assert put(client, project, "refused.jpg", data[100:], 100, 120).status_code == 400
    os.utime(next(photos.glob(".old*")), (1e9, 1e9))
    uploads.Album(photos)
    assert [path.name[:4] for path in photos.iterdir()] == [".new"]
    assert put(client, project, "new.jpg", data[100:], 100, len(data)).json()["done"]


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ('the "best" one?.jpg', "the -best- one-.jpg"),
        ("it's.jpg", "it's.jpg"),
        ("C:a.jpg", "C-a.jpg"),
        ("a*.jpg", "a-.jpg"),
        ("a\\b.jpg", "a-b.jpg"),
        ("a\x00.jpg", "a.jpg"),
        ("a\nb.jpg", "a b.jpg"),
        ("Screenshot 1.02\u202fPM.PNG", "Screenshot 1.02 PM.PNG"),
        ("\u202egpj.a.jpg", "gpj.a.jpg"),
        (".hidden.jpg", "hidden.jpg"),
        ("\x01.jpg", "photograph.jpg"),
        ("a/.b/c .jpg", "a/b/c.jpg"),
        ("a /b./c.jpg. ", "a/b/c.jpg"),
        ("con.jpg", "_con.jpg"),
        ("a/b/c/d/e.jpg", "a/b/c-d/e.jpg"),
        ("x" * 300 + ".jpg", "x" * 176 + ".jpg"),
        ("ж" * 300 + ".jpeg", "ж" * 87 + ".jpeg"),
        ("f" * 200 + "/" + "g" * 200 + "/" + "x" * 200 + ".jpg", "f" * 40 + "/" + "g" * 40 + "/" + "x" * 94 + ".jpg"),
        ("фото/été 日本.JPG", "фото/été 日本.JPG"),
    ],
)
def test_names_that_are_not_safe_are_changed(app, client, project, name, safe):
    data = jpeg()
    assert put(client, project, name, data).json() == {"have": len(data), "name": safe, "done": True}
    assert names(app, project) == [safe] and len(safe.encode()) <= uploads.MAX_NAME_BYTES
    assert client.get(f"/api/items/{project}/picture", params={"name": safe}).status_code == 200
    assert put(client, project, name, jpeg(1)).json()["name"].rpartition(".")[0] == f"{safe.rpartition('.')[0]}-2"


@pytest.mark.parametrize(
    "name", ["../a.jpg", "a/../../b.jpg", "/etc/a.jpg", "..\\a.jpg", "\\\\host\\a.jpg", "", ".", "jpg"]
)
def test_names_that_lead_elsewhere_are_refused(app, client, project, name):
    before = sorted(app.root.parent.rglob("*"))
    refused = put(client, project, name, jpeg())
    assert refused.status_code == 400 and refused.json()["fault"].count(". ") == 0
    assert (
        "'" not in refused.json()["fault"] and "\\\\" not in refused.json()["fault"][2:]
    )  # names are shown as they read, not as Python writes them
    assert sorted(app.root.parent.rglob("*")) == before


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("page.jpg", b"<script>alert(1)</script>"),
        ("empty.png", b"\x89PNG\r\n\x1a\n"),
        ("list.mp4", b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n"),
        ("joined.mkv", b"ffconcat version 1.0\nfile /etc/passwd\n"),
        ("notes.txt", b"hello"),
        ("scene.json", b"{}"),
        ("run.sh", b"#!/bin/sh\n"),
        ("nothing.jpg", b""),
    ],
)
def test_what_is_no_photograph_is_refused_and_leaves_nothing(app, client, project, name, data):
    refused = put(client, project, name, data)
    assert refused.status_code == 400 and name in refused.json()["fault"]
    assert [path for path in (app.root / project / "photos").rglob("*") if path.is_file()] == []


def test_a_bomb_of_pixels_is_refused(client, project):
    header = (
        b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + b"IHDR" + (60_000).to_bytes(4, "big") * 2 + b"\x08\x02\0\0\0"
    )
    header += zlib.crc32(header[12:]).to_bytes(4, "big") + b"\0\0\0\0IEND\xaeB`\x82"
    refused = put(client, project, "bomb.png", header)
    assert refused.status_code == 400 and "3600000000 pixels" in refused.json()["fault"]


def test_malformed_photographs_are_refused_or_opened(app, client, project, tmp_path):
    """Bent by the fuzzer; `benchmarks/app_uploads.py` drops a hundred onto the page."""
    refused = {}
    for path in make_malformed(tmp_path / "made", 30):
        answer = put(client, project, path.name, path.read_bytes())
        if answer.status_code != 200:
            refused[path.name] = answer.json()["fault"]
            assert answer.status_code == 400 and 20 < len(refused[path.name]) < 400 and "\n" not in refused[path.name]
    taken = names(app, project)
    assert refused and taken and len(refused) + len(taken) == 30
    for name in taken:
        shown = client.get(f"/api/items/{project}/picture", params={"name": name})
        assert shown.status_code == 200 or name in shown.json()["fault"]
    assert client.get(f"/api/items/{project}/advice").status_code == 200
    assert not [path for path in (app.root / project).rglob("*.part")]


def test_sizes_are_kept_to(app, client, project):
    assert put(client, project, "a.jpg", jpeg(), size=10).status_code == 400  # more than announced
    assert put(client, project, "a.jpg", jpeg(), size=10**12).status_code == 400
    assert put(client, project, "a.jpg", jpeg(), size=0).status_code == 400
    for size in ("-1", "1e3", "x", "9" * 30, "٣"):
        assert (
            client.put(f"/api/items/{project}/photographs", params={"name": "a.jpg", "size": size}).status_code == 400
        )
    assert client.post("/api/projects", content=b"{" + b" " * 70_000).status_code == 400
    assert names(app, project) == []


def test_a_full_disk_is_told_and_the_upload_goes_on(app, client, project, monkeypatch):
    data, usage = jpeg(1), namedtuple("Usage", "total used free")
    assert not put(client, project, "a.jpg", data[:100], 0, len(data)).json()["done"]
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda place: usage(1 << 40, 1 << 40, 1000))
        refused = put(client, project, "a.jpg", data[100:], 100, len(data))
    assert refused.status_code == 507 and "full" in refused.json()["fault"]
    assert put(client, project, "a.jpg", data[100:], 100, len(data)).json()["done"]
    full = Path("/dev/full")
    if full.exists():  # the system's own refusal, in the middle of a piece
        with monkeypatch.context() as patch:
            patch.setattr(uploads.Upload, "partial", property(lambda upload: full))
            assert put(client, project, "b.jpg", data).status_code == 507
    assert names(app, project) == ["a.jpg"]


def test_advice_comes_while_photographs_arrive(client, project):
    for i in range(5):
        put(client, project, f"{i}.jpg", jpeg(i, (320, 240)))
    put(client, project, "dark.jpg", jpeg(7, (320, 240), 0.08))
    put(client, project, "again.jpg", jpeg(3, (320, 240)))
    soft = Image.open(io.BytesIO(jpeg(9, (12, 9)))).resize((320, 240), Image.Resampling.BICUBIC)
    soft.save(out := io.BytesIO(), "JPEG")
    put(client, project, "soft.jpg", out.getvalue())
    said = {one["text"].partition(":")[0]: one["names"] for one in client.get(f"/api/items/{project}/advice").json()}
    assert said["Blurred"] == ["soft.jpg"] and said["Very dark"] == ["dark.jpg"]
    assert said["Shown twice"] in (["again.jpg"], ["3.jpg"])
    assert any("8 photographs" in text for text in said) and "No two show enough of the same. Take them" in str(said)
    left = client.delete(f"/api/items/{project}/photographs", params={"name": "soft.jpg"}).json()
    assert "soft.jpg" not in [one["name"] for one in left["photographs"]]
    shown = client.get(f"/api/items/{project}/picture", params={"name": "0.jpg", "side": 99})
    assert Image.open(io.BytesIO(shown.content)).size == (99, 74)


PICTURES = {
    "rgb.png": ("RGB", {}),
    "alpha.png": ("RGBA", {}),
    "palette.png": ("P", {}),
    "grey16.png": ("I;16", {}),
    "baseline.jpg": ("RGB", {"quality": 95}),
    "progressive.jpg": ("RGB", {"quality": 95, "progressive": True}),
    "print.jpg": ("CMYK", {"quality": 95}),
    "turned.tif": ("RGB", {"exif": {0x0112: 6}}),
}


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("is_large", [False, True], ids=["", "in a process"])
def test_thumbnails_show_pictures_of_all_kinds(tmp_path, monkeypatch, name, is_large):
    mode, options = PICTURES[name]
    ramp = np.linspace(20, 235, 900)[None].repeat(600, 0)
    grey = Image.fromarray(ramp.astype(np.uint8))
    image = Image.fromarray((ramp * 257).astype(np.uint16)) if mode == "I;16" else grey.convert("RGB").convert(mode)
    if tags := options.get("exif"):
        options = {"exif": (exif := Image.Exif())}
        exif.update(tags)
    image.save(tmp_path / name, **options)
    if is_large:
        monkeypatch.setattr(pictures, "LARGE_PIXELS", 1000)
        monkeypatch.setattr(pictures, "REDUCED_SIDE", 200)
    small = Image.open(io.BytesIO(pictures.thumbnail(tmp_path / name, 120)))
    assert small.size == ((80, 120) if tags else (120, 80))
    wanted = grey.convert("RGB").transpose(Image.Transpose.ROTATE_270) if tags else grey.convert("RGB")
    difference = np.asarray(small, float) - np.asarray(wanted.resize(small.size, Image.Resampling.BOX), float)
    assert np.abs(difference).mean() < 4


def test_large_pictures_are_decoded_one_at_a_time_elsewhere_and_once(app, client, project, monkeypatch):
    monkeypatch.setattr(pictures, "LARGE_PIXELS", 1000)
    children, alive = [], []
    real = pictures.start_python

    def start(command, *options, **more):
        alive.append(sum(child.poll() is None for child in children))
        children.append(real(command, *options, **more))
        return children[-1]

    monkeypatch.setattr(pictures, "start_python", start)
    for i in range(3):
        Image.fromarray(np.full((60, 80, 3), 40 * i, np.uint8)).save(app.root / project / "photos" / f"{i}.png")
    asked = [{"name": f"{i}.png", "side": side} for i in range(3) for side in (320, 512)]
    with ThreadPoolExecutor(4) as pool:
        advised = pool.submit(client.get, f"/api/items/{project}/advice")
        shown = list(pool.map(lambda one: client.get(f"/api/items/{project}/picture", params=one).status_code, asked))
    assert shown == [200] * 6 and advised.result().status_code == 200
    assert alive == [0, 0, 0] and all(child.poll() == 0 for child in children)


def test_a_large_picture_that_memory_does_not_hold_is_refused(tmp_path, monkeypatch):
    Image.new("RGB", (80, 60)).save(tmp_path / "a.png")
    monkeypatch.setattr(pictures, "LARGE_PIXELS", 1000)
    monkeypatch.setattr("lumigraph.readers.numbers.free_memory", lambda: 100)
    with pytest.raises(LumigraphError, match="a.png cannot be shown: its 80x60 pixels take .* GB are free"):
        pictures.thumbnail(tmp_path / "a.png")


# Projects


@pytest.mark.parametrize(
    "key", ["..", "..:x", ".lumigraph-app", "Garden:photos", "%2e%2e", "..%2f..", "Garden%2f..", "no"]
)
def test_keys_name_items_only(client, project, key):
    assert client.get(f"/api/items/{key}").status_code in (400, 404)
    assert client.delete(f"/api/items/{key}").status_code in (400, 404, 405)


def test_a_project_is_renamed_copied_deleted_and_brought_back(app, client, project):
    put(client, project, "a.jpg", jpeg())
    item = find_item(app.root, project)
    (item.path / "scene" / "work").mkdir(parents=True)
    (item.path / "scene" / "work" / "sources.json").write_text(json.dumps([str(item.path / "photos")]))
    assert client.patch(f"/api/items/{project}", json={"title": " My  garden "}).json()["key"] == project
    copy = client.post(f"/api/items/{project}/duplicate").json()["key"]
    (source,) = json.loads((app.root / copy / "scene/work/sources.json").read_text())
    assert source == str(app.root / copy / "photos")
    assert sorted(card["title"] for card in client.get("/api/home").json()["cards"]) == ["My garden", "My garden copy"]
    trash = client.delete(f"/api/items/{project}").json()["trash"]
    home = client.get("/api/home").json()
    assert [card["key"] for card in home["cards"]] == [copy] and home["trash"][0]["title"] == "My garden"
    assert client.post(f"/api/trash/{trash}").json()["key"] == project
    assert names(app, project) == ["a.jpg"]
    client.delete(f"/api/items/{copy}")
    client.delete("/api/trash")
    assert client.get("/api/home").json()["trash"] == [] and not (app.root / copy).exists()
    assert client.post("/api/trash/..").status_code in (400, 404, 405)
    assert client.patch(f"/api/items/{project}", json={"title": "x" * 130}).status_code == 400
    assert client.patch(f"/api/items/{project}", json={"name": "x"}).status_code == 400


def test_a_moved_folder_keeps_its_paths_right(app, project):
    item = find_item(app.root, project)
    (item.path / "runs" / "a").mkdir(parents=True)
    (item.path / "runs" / "a" / "config.json").write_text(json.dumps({"scene": {"source": str(item.path / "scene")}}))
    item.path.rename(app.root / "elsewhere")
    projects.relocate(moved := find_item(app.root, "elsewhere"))
    said = json.loads((moved.path / "runs/a/config.json").read_text())
    assert said["scene"]["source"] == str(app.root / "elsewhere" / "scene")


def test_a_path_on_this_machine_needs_no_upload(app, client, tmp_path):
    (tmp_path / "pictures").mkdir()
    refused = client.post("/api/projects", json={"title": "x", "path": str(tmp_path / "pictures")})
    assert refused.status_code == 400 and "no photographs" in refused.json()["fault"]
    (tmp_path / "pictures" / "a.jpg").write_bytes(jpeg())
    key = client.post("/api/projects", json={"title": "", "path": str(tmp_path / "pictures")}).json()["key"]
    assert [one["name"] for one in client.get(f"/api/items/{key}").json()["photographs"]] == ["a.jpg"]
    assert put(client, key, "b.jpg", jpeg()).status_code == 400
    client.delete(f"/api/items/{key}/photographs", params={"name": "a.jpg"})
    assert (tmp_path / "pictures" / "a.jpg").exists()
    assert client.post("/api/projects", json={"title": "x", "path": "/etc/passwd"}).status_code == 400


# Jobs


def calls(app, key: str) -> list[tuple[str, dict]]:
    """Commands that ran, with those of their options that are given."""
    place = app.root / key / "calls.txt"
    asked = map(json.loads, place.read_text().splitlines() if place.exists() else ())
    return [(one["command"], {k: x for k, x in one["options"].items() if x is not None}) for one in asked]


def state(client, key: str) -> str:
    return client.get(f"/api/items/{key}").json()["make"]["state"]


def let(app) -> None:
    (app.root / "go").touch()


def test_photographs_become_a_run_and_a_file(app, running, project):
    let(app)
    assert running.post(f"/api/items/{project}/make", json={}).status_code == 400  # nothing to make it of
    put(running, project, "a.jpg", jpeg())
    assert running.post(f"/api/items/{project}/make", json={"method": "no-such"}).status_code == 400
    assert running.post(f"/api/items/{project}/make", json={"quality": "superb"}).status_code == 400
    running.post(f"/api/items/{project}/make", json={"quality": "good", "mapper": "global"})
    until(lambda: state(running, project) == "done")
    (capture, scene), (train, run) = calls(app, project)
    here = app.root / project
    made = {"what": [str(here / "photos")], "output": str(here / "scene"), "mapper": "global", "mask_object": False}
    assert (capture, scene) == ("capture", made) and train == "train" and len(run.pop("token")) > 20
    place = str(here / "runs/gaussian-splatting-1")
    expected = {"method": "gaussian-splatting", "scene": str(here / "scene"), "output": place, "quality": "good"}
    assert run == expected | {"view": True, "stay": False, "port": run["port"]}

    asked = {"kind": "film", "run": "gaussian-splatting-1"}
    assert running.post(f"/api/items/{project}/shares", json=asked | {"run": "../x"}).status_code == 400
    running.post(f"/api/items/{project}/shares", json=asked)
    row = until(
        lambda: next((one for one in running.get(f"/api/items/{project}").json()["shares"] if one["bytes"]), None)
    )
    assert calls(app, project)[2] == ("render", {"source": place, "output": str(here / "shared" / row["name"])})
    file = running.get(f"/api/items/{project}/shares/{row['name']}")
    assert file.content == b"<p>made</p>"
    assert file.headers["Content-Disposition"] == f'attachment; filename="Garden{Path(row["name"]).suffix}"'
    assert "sandbox" in file.headers["Content-Security-Policy"]
    assert running.get(f"/api/items/{project}/shares/..%2fproject.json").status_code in (400, 404)
    os.utime(Path(place) / "checkpoints", (time.time() + 60,) * 2)  # trained further: the file shows an earlier state
    assert [one["bytes"] for one in running.get(f"/api/items/{project}").json()["shares"]] == [None]
    assert running.delete(f"/api/items/{project}/shares/{row['name']}").json()["shares"] == []


def test_the_folder_is_shown_on_its_own_machine_alone(app, client, project, tmp_path, monkeypatch):
    folder, asked = app.root / project / "shared", []
    assert "does not exist yet" in client.post(f"/api/items/{project}/reveal").json()["fault"]
    folder.mkdir()
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "No file manager was found" in client.post(f"/api/items/{project}/reveal").json()["fault"]
    monkeypatch.setattr(sharing.subprocess, "Popen", lambda words, **options: asked.append(words))
    for platform, program in (("linux", "xdg-open"), ("darwin", "open"), ("win32", "explorer")):
        monkeypatch.setattr(sharing, "sys", SimpleNamespace(platform=platform))
        assert client.post(f"/api/items/{project}/reveal").status_code == 200
        assert asked.pop() == [program, folder]
    monkeypatch.setattr(app, "address", Address("0.0.0.0", 8080, TOKEN))
    with pytest.raises(LumigraphError, match="browsers on its machine"):
        app.reveal(find_item(app.root, project))
    assert asked == []


def test_a_run_is_compared_with_its_photographs(app, running, project, ball_run):
    import tiny

    from lumigraph.evaluation.options import EvaluationOptions
    from lumigraph.evaluation.run import evaluate_run
    from lumigraph.run import Run

    place = find_item(app.root, project).path / "runs" / "a"
    shutil.copytree(ball_run.path, place)
    assert running.get(f"/api/items/{project}").json()["runs"][0]["compared"] is None
    let(app)
    running.post(f"/api/items/{project}/shares", json={"kind": "compare", "run": "a"})
    until(lambda: running.get(f"/api/items/{project}").json()["shares"][0]["state"] == "done")
    expected = {"run_folder": str(place), "split": "test", "views": 12, "save_images": True, "overwrite": True}
    assert calls(app, project) == [("eval", expected)]
    run = Run(place)
    evaluate_run(
        run, run.method("cpu"), tiny.scene(), EvaluationOptions(views=2, save_images=True)
    )  # as the command does
    compared = running.get(f"/api/items/{project}").json()["runs"][0]["compared"]
    assert len(compared["views"]) == 2 and not compared["stale"] and compared["views"][0]["held_out"]
    about = {"run": "a", "name": compared["views"][0]["name"]}
    shown = running.get(f"/api/items/{project}/picture", params=about)
    assert Image.open(io.BytesIO(shown.content)).size == (tiny.SIZE, tiny.SIZE)
    astray = running.get(f"/api/items/{project}/picture", params=about | {"name": "../../previews/000060"})
    assert astray.status_code == 400


def test_a_failure_is_the_sentence_of_the_command(app, running, project):
    put(running, project, "a.jpg", jpeg())
    let(app)
    (app.root / "fault").write_text("at most 2 of 3 show the same things; take 20 or more")
    running.post(f"/api/items/{project}/make", json={})
    until(lambda: state(running, project) == "failed")
    making = running.get(f"/api/items/{project}").json()["make"]
    assert making["fault"] == "at most 2 of 3 show the same things; take 20 or more" and making["stage"] == "capture"
    (app.root / "fault").unlink()
    running.post(f"/api/items/{project}/more", json={})
    until(lambda: state(running, project) == "done")


def test_a_job_is_paused_and_goes_on_by_resume(app, running, project):
    put(running, project, "a.jpg", jpeg())
    running.post(f"/api/items/{project}/make", json={})
    until(lambda: calls(app, project))
    assert running.post(f"/api/items/{project}/make", json={}).status_code == 400  # one at a time
    running.post(f"/api/items/{project}/pause")
    until(lambda: app.runner.making is None)
    assert state(running, project) == "paused" and "saved" in jobs.log_lines(find_item(app.root, project))
    let(app)
    running.post(f"/api/items/{project}/more", json={})
    until(lambda: state(running, project) == "done")
    running.post(f"/api/items/{project}/more", json={"minutes": 2})
    until(lambda: len(calls(app, project)) == 4 and state(running, project) == "done")
    assert [command for command, _ in calls(app, project)] == ["capture", "capture", "train", "resume"]
    assert calls(app, project)[3][1]["seconds"] == 120.0


def test_a_training_gets_more_time_while_it_runs(app, running, project):
    put(running, project, "a.jpg", jpeg())
    let(app)
    running.post(f"/api/items/{project}/make", json={})
    until(lambda: state(running, project) == "done")
    (app.root / "go").unlink()
    running.post(f"/api/items/{project}/more", json={"minutes": 1})
    until(lambda: len(calls(app, project)) == 3)
    running.post(f"/api/items/{project}/more", json={"quality": "good"})
    until(lambda: len(calls(app, project)) == 4)
    assert state(running, project) == "running"
    let(app)
    until(lambda: state(running, project) == "done")
    command, options = calls(app, project)[3]
    assert command == "resume" and options["quality"] == "good" and "seconds" not in options


def test_a_scene_with_poses_is_trained_without_a_capture(app, running, ball_folder):
    scene = app.root / "scenes" / "ball"
    shutil.copytree(ball_folder, scene)
    let(app)
    (card,) = running.get("/api/home").json()["cards"]
    assert (card["kind"], card["key"]) == ("scene", "scenes:ball")
    made = running.post("/api/items/scenes:ball/make", json={"minutes": 1}).json()
    until(lambda: state(running, made["key"]) == "done")
    ((train, options),) = calls(app, made["key"])
    assert (train, options["method"], options["scene"]) == ("train", "gaussian-splatting", str(scene))
    assert options["seconds"] == 60.0 and "quality" not in options


def test_jobs_wait_for_each_other_and_go_with_their_project(app, running):
    keys = [new_project(app.root, name).key for name in ("one", "two")]
    for key in keys:
        put(running, key, "a.jpg", jpeg())
        running.post(f"/api/items/{key}/make", json={})
    until(lambda: calls(app, "one"))
    assert state(running, "two") == "queued" and running.get("/api/home").json()["queue"][1]["key"] == "two"
    trash = running.delete("/api/items/one").json()["trash"]
    until(lambda: calls(app, "two"))
    let(app)
    until(lambda: state(running, "two") == "done")
    running.post(f"/api/trash/{trash}")
    assert state(running, "one") == "stopped"


def test_a_file_is_made_beside_a_training_and_a_waiting_scene_is_put_first(app, running, ball_run):
    """Another scene's file waits for no training, its own scene's does."""
    one, two, done = (new_project(app.root, name).key for name in ("one", "two", "done"))
    shutil.copytree(ball_run.path, find_item(app.root, done).path / "runs" / "a")
    for key in (one, two):
        put(running, key, "a.jpg", jpeg())
        running.post(f"/api/items/{key}/make", json={})
    until(lambda: calls(app, one))
    running.post(f"/api/items/{done}/shares", json={"kind": "mesh", "run": "a"})
    until(lambda: calls(app, done))
    assert state(running, one) == "running" and app.runner.running.keys() == {"make", "share"}
    ahead = running.get(f"/api/items/{two}").json()["ahead"]
    assert ahead.pop("left") > 0 and ahead == {"title": "one", "between": 0}

    running.post(f"/api/items/{two}/first")
    until(lambda: calls(app, two))
    assert (state(running, one), state(running, two)) == ("queued", "running")
    assert "saved" in jobs.log_lines(find_item(app.root, one))
    let(app)
    until(lambda: state(running, one) == state(running, two) == "done")
    assert running.get(f"/api/items/{done}").json()["shares"][0]["bytes"]


def test_no_two_commands_work_in_one_scene(app, running, project, ball_run):
    shutil.copytree(ball_run.path, find_item(app.root, project).path / "runs" / "a")
    put(running, project, "a.jpg", jpeg())
    running.post(f"/api/items/{project}/make", json={})
    until(lambda: calls(app, project))
    running.post(f"/api/items/{project}/shares", json={"kind": "mesh", "run": "a"})
    with pytest.raises(TimeoutError):
        until(lambda: len(calls(app, project)) > 1, 1)
    let(app)
    until(lambda: running.get(f"/api/items/{project}").json()["shares"][0]["bytes"])
    assert [command for command, _ in calls(app, project)] == ["capture", "train", "export mesh"]


def test_minutes_are_told_and_follow_what_earlier_ones_took(app, client, project, ball_run, tmp_path, monkeypatch):
    monkeypatch.setenv("LUMIGRAPH_CACHE", str(tmp_path / "cache"))
    for i in range(4):
        put(client, project, f"{i}.jpg", jpeg(i))
    item = find_item(app.root, project)
    first = client.get(f"/api/items/{project}/estimates").json()["gaussian-splatting"]
    assert 0 < first["draft"] < first["good"] < first["best"]
    pace.note_capture(item, 4 * 10.0)  # ten seconds a photograph
    later = client.get(f"/api/items/{project}/estimates").json()["gaussian-splatting"]
    assert later["draft"] - first["draft"] == pytest.approx(4 * (10 - pace.PER_PHOTOGRAPH) / 2, abs=1)
    pace.note_training(Path(ball_run.path))
    assert pace.known().step["voxel-grid"] > 0
    (tmp_path / "cache" / "pace.json").write_text("{")
    assert client.get(f"/api/items/{project}/estimates").json()["gaussian-splatting"] == first


def test_a_file_that_is_being_written_is_no_version(app, project, ball_run):
    runs = find_item(app.root, project).path / "runs"
    shutil.copytree(ball_run.path, runs / "a")
    shutil.copytree(ball_run.path, runs / ".lumigraph-0123456789abcdef.partial")
    assert [path.name for path in find_item(app.root, project).runs] == ["a"]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux ends the children of a killed process")
def test_a_killed_app_goes_on_where_it_was(app, project):
    item = find_item(app.root, project)
    (item.path / "photos" / "a.jpg").write_bytes(jpeg())
    jobs.make(item)
    app.runner.begin()
    until(lambda: calls(app, project))
    child = app.runner.making.child
    app.runner._ended = True  # as after a kill, nobody changes the record any more
    child.send_signal(signal.SIGKILL)
    app.runner._threads[0].join(10)
    assert read_job(item).make.state == "running"
    let(app)
    again = App(app.root, app.address, app.runner.program)
    again.runner.begin()
    until(lambda: read_job(item).make.state == "done")
    again.runner.end()
    assert [command for command, _ in calls(app, project)] == ["capture", "capture", "train"]


def test_a_damaged_record_is_told_and_stops_nobody_else(app, running, project):
    let(app)
    (app.root / project / "job.json").write_text('{"make": {"state": "dancing"}}')
    assert "job.json" in running.get(f"/api/items/{project}").json()["fault"]
    assert "job.json" in running.get("/api/home").json()["cards"][0]["fault"]
    other = new_project(app.root, "other").key
    put(running, other, "a.jpg", jpeg())
    running.post(f"/api/items/{other}/make", json={})
    until(lambda: state(running, other) == "done")


# Progress


def test_features_and_matches_are_read_while_colmap_writes(app, project):
    item = find_item(app.root, project)
    work = item.path / "scene" / "work"
    work.mkdir(parents=True)
    assert progress.photographs_state(item) == {} and progress.features(item, "a.jpg") == []
    with contextlib.closing(sqlite3.connect(work / "database.db")) as rows:
        rows.execute("CREATE TABLE cameras (camera_id INTEGER, width INTEGER, height INTEGER)")
        rows.execute("CREATE TABLE images (image_id INTEGER, name TEXT, camera_id INTEGER)")
        rows.execute("CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)")
        rows.execute("CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER)")
        rows.execute("INSERT INTO cameras VALUES (1, 200, 100)")
        rows.executemany("INSERT INTO images VALUES (?, ?, 1)", [(1, "a.jpg"), (2, "b.jpg"), (3, "c.jpg")])
        points = np.array([[100, 50, 1, 0], [20, 10, 1, 0]], np.float32)
        rows.executemany("INSERT INTO keypoints VALUES (?, 2, 4, ?)", [(1, points.tobytes()), (2, points.tobytes())])
        rows.executemany("INSERT INTO two_view_geometries VALUES (?, ?)", [(2147483647 + 2, 40), (2147483647 + 3, 3)])
        rows.commit()
    (item.path / "scene" / "capture.json").write_text(
        json.dumps({"registered": ["a.jpg"], "left_out": {"c.jpg": "too few details"}})
    )
    found = progress.photographs_state(item)
    assert found["a.jpg"] == {"features": 2, "matched": 1, "placed": True} and found["b.jpg"]["matched"] == 1
    assert found["c.jpg"] == {"features": None, "matched": 0, "left_out": "too few details"}
    assert progress.features(item, "a.jpg") == [[0.5, 0.5], [0.1, 0.1]]
    (work / "stages.json").write_text(json.dumps({"features": {"key": "k", "done": False, "seconds": 1}}))
    assert progress.capture_progress(item)["stage"] == "Finding details"
    assert progress.capture_progress(item)["share"] == pytest.approx(0.03 + 0.95 * 0.4 * 2 / 3)
    assert progress.model(item)["cameras"] == []


@pytest.fixture
def database(app, project):
    """An empty database of COLMAP's, open for writing."""
    work = app.root / project / "scene" / "work"
    work.mkdir(parents=True)
    (work / "stages.json").write_text(json.dumps({"features": {"key": "k", "done": False, "seconds": 1}}))
    make_running(app, project, "capture")
    with contextlib.closing(sqlite3.connect(work / "database.db", timeout=0)) as rows:
        yield rows


def make_running(app, key: str, stage: str) -> None:
    change(find_item(app.root, key), lambda job: replace(job, make=Making("running", 1.0, stage=stage, run="a")))


PAGES = "", "/states", "/features?name=a.jpg", "/model", "/advice"
TABLES = [
    "CREATE TABLE cameras (camera_id INTEGER, width INTEGER, height INTEGER)",
    "CREATE TABLE images (image_id INTEGER, name TEXT, camera_id INTEGER)",
    "CREATE TABLE keypoints (image_id INTEGER, rows INTEGER, cols INTEGER, data BLOB)",
    "CREATE TABLE two_view_geometries (pair_id INTEGER, rows INTEGER)",
]
DAMAGE = {
    "no tables": [],
    "no keypoints": TABLES[:2],
    "other columns": ["CREATE TABLE images (a)", "CREATE TABLE keypoints (b)"],
    "empty": TABLES,
    "short blob": [*TABLES, "INSERT INTO cameras VALUES (1, 9, 9)", "INSERT INTO images VALUES (1, 'a.jpg', 1)",
                   "INSERT INTO keypoints VALUES (1, 5, 4, x'00112233')"],
    "no width": [*TABLES, "INSERT INTO cameras VALUES (1, 0, NULL)", "INSERT INTO images VALUES (1, 'a.jpg', 1)",
                 "INSERT INTO keypoints VALUES (1, 1, 2, x'0011223300112233')"],
    "NaN": [*TABLES, "INSERT INTO cameras VALUES (1, 9, 9)", "INSERT INTO images VALUES (1, 'a.jpg', 1)",
            "INSERT INTO keypoints VALUES (1, 1, 2, x'0000c07f0000c07f')"],
    "nulls": [*TABLES, "INSERT INTO images VALUES (NULL, NULL, NULL)", "INSERT INTO images VALUES (1, x'ff', 1)",
              "INSERT INTO images VALUES ('x', 'a.jpg', 'y')", "INSERT INTO keypoints VALUES ('x', 'y', 'z', 3)",
              "INSERT INTO two_view_geometries VALUES (NULL, 90)", "INSERT INTO two_view_geometries VALUES ('x', 90)"],
    "no letters": [*TABLES, "INSERT INTO images VALUES (1, CAST(x'ff' AS TEXT), 1)"],
    "no end": [*TABLES[:1], *TABLES[2:], "CREATE VIEW images AS WITH RECURSIVE n(image_id, name, camera_id) AS "
               "(VALUES (1, 'a', 1) UNION ALL SELECT image_id + 1, 'a', 1 FROM n) SELECT * FROM n WHERE image_id < 0"],
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_database_gives_a_page(client, project, database, damage, monkeypatch):
    monkeypatch.setattr(progress, "QUERY_SECONDS", 0.1)
    for line in DAMAGE[damage]:
        database.execute(line)
    database.commit()
    found = [client.get(f"/api/items/{project}{page}") for page in PAGES]
    assert [one.status_code for one in found] == [200] * 5 and found[2].json() == []


def test_a_locked_database_gives_a_page(app, client, project, database):
    for line in [*TABLES, "INSERT INTO images VALUES (1, 'a.jpg', 1)"]:
        database.execute(line)
    database.commit()
    database.execute("BEGIN EXCLUSIVE")
    found = [client.get(f"/api/items/{project}{page}") for page in PAGES]
    assert [one.status_code for one in found] == [200] * 5 and found[1].json() == {}
    database.rollback()
    assert client.get(f"/api/items/{project}/states").json() == {"a.jpg": {"features": None, "matched": 0}}
    (app.root / project / "scene/work/database.db").write_bytes(b"no database at all" * 99)
    assert [client.get(f"/api/items/{project}{page}").status_code for page in PAGES] == [200] * 5


WRONG = "null", "[]", "3", '"x"', "{", '{"a": 1}', "[[1]]"
WRONG_PARTS = {
    "scene/capture.json": ['{"registered": 3}', '{"left_out": [1]}', '{"warnings": [null]}', '{"points": "x"}'],
    "scene/work/stages.json": ['{"features": {}}', '{"features": {"key": 1, "done": "x", "seconds": []}}'],
    "runs/a/metrics.jsonl": ['{"step": "x"}', '{"step": 1, "seconds": 1, "psnr": 1e308}\n' * 3],
    "runs/a/eval.json": ['{"views": 3}', '{"protocol": {"split": "test", "views": 1}, "steps": 1, "views": [{}]}'],
    "runs/a/config.json": ['{"method": 3}', '{"budget": []}'],
    "runs/a/cameras.json": ['{"names": 3}'],
    "project.json": ['{"title": 3, "made": 0}', '{"title": "x", "made": 0, "source": "\\u0000"}'],
}


@pytest.mark.parametrize("name", WRONG_PARTS)
def test_a_received_project_of_any_content_gives_pages(app, client, project, ball_run, name):
    item = find_item(app.root, project)
    shutil.copytree(ball_run.path, item.path / "runs" / "a")
    (item.path / "scene" / "work").mkdir(parents=True)
    other = new_project(app.root, "other").key
    for stage in ("capture", "train"):
        make_running(app, project, stage)
        for text in [*WRONG, *WRONG_PARTS[name]]:
            (item.path / name).write_text(text)
            home = client.get("/api/home")
            assert home.status_code == 200 and {card["key"] for card in home.json()["cards"]} == {project, other}
            for page in ["", "/states", "/model"]:
                found = client.get(f"/api/items/{project}{page}")
                assert found.status_code == 200 or (found.status_code == 400 and found.json()["fault"])


def test_damage_is_named_and_the_rest_is_shown(app, client, project):
    put(client, project, "a.jpg", jpeg())
    (app.root / project / "scene").mkdir()
    (app.root / project / "scene/capture.json").write_text('{"registered": 3}')
    found = client.get(f"/api/items/{project}").json()
    assert [one["name"] for one in found["photographs"]] == ["a.jpg"] and found["result"] is None
    assert len(found["faults"]) == 1 and "capture.json does not hold what it should" in found["faults"][0]


def test_a_home_page_waits_for_no_folder(app, client, project, tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "MAX_ENTRIES", 50)
    (huge := tmp_path / "huge").mkdir()
    for i in range(60):
        (huge / f"{i}.txt").touch()
    places = {"huge": huge, "gone": tmp_path / "gone", "root": Path("/"), "proc": Path("/proc"), "null": "/dev/null"}
    keys = {}
    for name, place in places.items():
        record = projects.ProjectRecord(name, 0.0, str(place))
        keys[name] = (item := new_project(app.root, name)).key
        item.keep(record)
    shutil.copytree(huge, app.root / project / "photos", dirs_exist_ok=True)
    client.delete(f"/api/items/{keys['null']}")
    home = client.get("/api/home").json()
    cards = {card["title"]: card for card in home["cards"]}
    assert "has more in it than a page shows" in cards["huge"]["fault"] and cards["Garden"]["bytes"] is None
    assert cards["gone"]["fault"] == f"{tmp_path / 'gone'} does not exist; check the path"
    assert home["trash"][0]["title"] == "null"
    for key in list(keys.values())[:-1]:
        assert client.get(f"/api/items/{key}").status_code == 200
    looked = []
    monkeypatch.setattr(folders.os, "scandir", lambda path, real=os.scandir: looked.append(str(path)) or real(path))
    assert client.get("/api/home").json()["cards"] and not {str(huge), "/", "/proc"} & set(looked)
    refused = client.post("/api/projects", json={"title": "x", "path": str(huge)})
    assert refused.status_code == 400 and "no photographs" in refused.json()["fault"]


def test_a_listing_follows_its_folders(tmp_path):
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    (inner / "1.jpg").touch()
    os.utime(inner, (1e9, 1e9))
    for wanted in (["a/b/1.jpg"], ["a/b/1.jpg", "a/b/2.jpg"], ["a/b/2.jpg"]):
        (inner / "2.jpg").touch() if len(wanted) == 2 else (
            inner / "1.jpg"
        ).unlink() if "a/b/1.jpg" not in wanted else 0
        assert list(pictures.files_of(tmp_path)) == wanted == list(pictures.files_of(tmp_path))


def test_names_that_are_no_unicode_are_shown(app, client, tmp_path):
    (tmp_path / "pictures").mkdir()
    for name in (b"caf\xe9.jpg", b"plain.jpg"):
        (tmp_path / "pictures" / os.fsdecode(name)).write_bytes(jpeg())
    key = client.post("/api/projects", json={"title": "", "path": str(tmp_path / "pictures")}).json()["key"]
    found = client.get(f"/api/items/{key}")
    assert found.status_code == 200 and len(found.json()["photographs"]) == 2


# The viewer behind the app's address


def test_the_viewer_is_reached_through_the_app_alone(app, project):
    item = find_item(app.root, project)
    run = item.path / "runs" / "a"
    run.mkdir(parents=True)
    (run / "config.json").write_text("{}")

    def echo(connection) -> None:
        for message in connection:
            connection.send(b"seen " + message)

    def page(connection, request):
        if request.headers.get("Cookie") != address.cookie:
            return connection.respond(403, "no token")
        if "Upgrade" not in request.headers:
            return connection.respond(200, f"viewer at {request.path}")
        return None

    address = child_address()
    with serve_websockets(echo, "127.0.0.1", address.port, process_request=page, subprotocols=["viser-v1"]) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        client = TestClient(build(app), base_url=BASE)
        assert client.get(f"/scene/{project}/a/").status_code == 404  # nobody has opened it
        view = SceneView(address, _Child(), app.root / "log")
        app.views.views[run] = view
        shown = client.get(f"/scene/{project}/a/some/file.js")
        assert (
            shown.text == "viewer at /some/file.js"
            and "frame-ancestors 'self'" in shown.headers["Content-Security-Policy"]
        )
        with client.websocket_connect(f"/scene/{project}/a", subprotocols=["viser-v1"], headers=HOST) as socket:
            socket.send_bytes(b"hello")
            assert socket.receive_bytes() == b"seen hello" and view.connections == 1
            assert socket.accepted_subprotocol == "viser-v1"
        until(lambda: view.connections == 0)
        with pytest.raises(WebSocketDisconnect), client.websocket_connect(f"/scene/{project}/b", headers=HOST):
            pass
        server.shutdown()


class _Child:
    """In place of a viewer's process."""

    def poll(self) -> None:
        return None


def test_an_app_serves_a_folder_alone(tmp_path):
    from lumigraph.app.projects import APP_FOLDER
    from lumigraph.files.locks import lock_folder

    place = tmp_path / APP_FOLDER
    place.mkdir()
    program = "import sys, time, pathlib; from lumigraph.files.locks import lock_folder\n"
    program += f"with lock_folder(pathlib.Path({str(place)!r}), 'served'): print('held', flush=True); time.sleep(30)"
    import subprocess

    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(LumigraphError, match="being served"), lock_folder(place, "served"):
            pass
        other.kill()
