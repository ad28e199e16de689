"""The app's page in a real browser, with a quick command in place of ours."""

from __future__ import annotations

import os
import re
import shutil
import threading
from collections import Counter, namedtuple
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import uvicorn
from accessible import faults_of
from app_uploads import UPLOAD_NAMED
from app_walk import drop
from budgets import budget
from PIL import Image
from test_app import PROGRAM, jpeg
from waiting import until

from lumigraph.app import uploads
from lumigraph.app.projects import items, new_project
from lumigraph.app.server import Announcing, App, build
from lumigraph.viewer.address import Address, free_port

pytestmark = budget("exports", 10)


@pytest.fixture
def served(tmp_path):
    """An app that a browser can reach, at the beginning of its folder's life."""
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "scenes-here").mkdir()
    address = Address("127.0.0.1", free_port("127.0.0.1", 0) or 0)
    program = ["-S", str(tmp_path / "program.py")]
    app = App(tmp_path / "scenes-here", address, program)
    opened = threading.Event()
    config = uvicorn.Config(build(app), port=address.port, log_level="error", ws="websockets-sansio")
    server = Announcing(config, opened.set)
    thread = threading.Thread(target=server.run)
    thread.start()
    assert opened.wait(20)
    yield app
    server.should_exit = True
    thread.join(20)


def test_photographs_are_dropped_made_and_a_failure_is_told(served, page, faults, tmp_path):
    photographs = tmp_path / "garden"
    photographs.mkdir()
    for i in range(3):
        (photographs / f"{i}.jpg").write_bytes(jpeg(i, (160, 120)))
    page.goto(served.address.url)
    assert page.get_by_role("heading", name="Drop photographs").is_visible()
    drop(page, [photographs])
    page.wait_for_url("**/#garden")
    page.get_by_role("list", name="Photographs").get_by_role("button").nth(2).wait_for()
    page.get_by_text("3 photographs").wait_for()  # the advice: more of them

    (served.root / "go").touch()
    (served.root / "fault").write_text("no two of 3 show the same things; take 20 or more")
    page.keyboard.press("Tab")  # everything is reached by the keyboard
    make = page.get_by_role("button", name="Make the scene")
    make.focus()
    page.keyboard.press("Enter")
    page.get_by_role("alert").filter(has_text="no two of 3 show the same things").wait_for()
    assert page.get_by_role("button", name="Use the other mapper").is_visible()

    page.reload()
    page.get_by_role("alert").filter(has_text="no two of 3 show the same things").wait_for()
    page.get_by_role("link", name="All scenes").click()
    card = page.get_by_role("listitem").filter(has_text="garden")
    card.get_by_text("failed").wait_for()
    card.get_by_label("More for garden").click()
    card.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Undo").click()
    card.get_by_role("link", name=re.compile("Open garden")).wait_for()
    assert faults == []


def test_refused_uploads_are_sentences_on_the_page(served, page, faults, tmp_path, monkeypatch):
    photographs = tmp_path / "garden"
    photographs.mkdir()
    (photographs / "good.jpg").write_bytes(jpeg(0, (160, 120)))
    (photographs / "text.jpg").write_text("no photograph")
    page.goto(served.address.url)
    page.get_by_role("heading", name="Drop photographs").wait_for()  # until then nobody listens
    drop(page, [photographs])
    page.get_by_role("alert").get_by_text("text.jpg is no photograph that can be read").wait_for()
    page.get_by_role("button", name="good.jpg").wait_for()
    page.evaluate(UPLOAD_NAMED, ["garden", ["../up.jpg", "/etc/up.jpg"]])
    page.get_by_role("alert").get_by_text("../up.jpg leads out of the folder of photographs").wait_for()
    assert not list(tmp_path.rglob("up.jpg")) and not list(served.root.rglob("*.part"))

    usage = namedtuple("Usage", "total used free")
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda place: usage(1 << 40, 1 << 40, 1000))
        (tmp_path / "late.jpg").write_bytes(jpeg(1, (160, 120)))
        drop(page, [tmp_path / "late.jpg"])
        page.get_by_text("is full; free some space, and the upload goes on").wait_for()
    page.get_by_role("button", name="late.jpg").wait_for()
    assert all("status of 40" in one or "status of 507" in one for one in faults)


def photographs(folder: Path, names: Sequence[str], seed: int = 0) -> list[Path]:
    """Small pictures, all different and of one size in bytes."""
    folder.mkdir()
    for i, name in enumerate(names):
        Image.fromarray(np.full((30, 40), seed + i, np.uint8)).save(folder / name, "BMP")
    return [folder / name for name in names]


def contents(*places: Path) -> Counter[bytes]:
    """Files, and all files below folders, hidden ones too, by content."""
    files = [path for place in places for path in ([place] if place.is_file() else place.rglob("*")) if path.is_file()]
    return Counter(path.read_bytes() for path in files)


@pytest.fixture
def garden(served, page) -> Path:
    """Folder of uploads of a new project, whose page is open."""
    item = new_project(served.root, "Garden")
    page.goto(f"{served.address.url}/#{item.key}")
    page.get_by_text("Drop photographs, a folder").wait_for()
    return item.photographs


DONE = """async () => {
  const state = (await import("/static/uploads.js")).stateOf("Garden");
  const { done } = state;
  state.done = 0;
  return done;
}"""


def sent(page, count: int = 1) -> None:
    """Wait until so many files of a drop are sent or refused."""
    left = [count]

    def is_done() -> bool:
        left[0] -= page.evaluate(DONE)
        return left[0] <= 0

    until(is_done)


def test_the_page_and_the_app_hash_alike(garden, page, tmp_path):
    for size in (1, 63, 64, 65, 128, (4 << 20) - 1, 4 << 20, (4 << 20) + 7):
        (tmp_path / "file").write_bytes(data := bytes(range(256)) * (1 + size // 256))
        os.truncate(tmp_path / "file", size)
        hashed = page.evaluate(
            "async ([size, length]) => (await import('/static/hash.js'))"
            ".hashOf(new File([Uint8Array.from({ length }, (_, i) => i % 256).subarray(0, size)], 'x'))",
            [size, len(data)],
        )
        assert hashed == uploads.hash_of(tmp_path / "file"), size


def test_photographs_of_one_name_and_size_all_stay(garden, page, faults, tmp_path):
    given = [photographs(tmp_path / str(i), ["image.bmp"], i)[0] for i in range(3)]
    for file in [*given, *given]:  # the second time they are there already
        drop(page, [file])
        sent(page)
    assert contents(garden) == contents(*given)
    page.get_by_role("button", name="image-3.bmp").wait_for()
    assert faults == []


def test_photographs_of_one_name_are_left_out_apart(garden, page, faults, tmp_path):
    given = [photographs(tmp_path / str(i), ["image.bmp"], i)[0] for i in range(2)]
    for file in given:
        drop(page, [file])
        page.get_by_role("button", name="image.bmp").click()
        page.get_by_role("button", name="Leave it out").click()
        page.get_by_role("button", name="image.bmp").wait_for(state="detached")
    assert contents(garden.parent / "left-out") == contents(*given) and faults == []


def test_two_tabs_that_send_the_same_photographs_give_each_once(garden, served, page, tmp_path):
    given = photographs(tmp_path / "given", [f"{i}.bmp" for i in range(20)])
    other = page.context.new_page()
    other.goto(page.url)
    other.get_by_text("Drop photographs, a folder").wait_for()
    for tab in (page, other):
        drop(tab, given)
    for tab in (page, other):
        sent(tab, len(given))
    assert contents(garden) == contents(*given)


def test_many_small_photographs_need_one_listing(garden, page, faults, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(uploads, "listed", lambda folder, real=uploads.listed: asked.append(folder) or real(folder))
    given = photographs(tmp_path / "given", [f"{i}.bmp" for i in range(40)])
    drop(page, given)
    sent(page, len(given))
    assert contents(garden) == contents(*given) and len(asked) == 1 and faults == []


def test_names_that_cannot_be_read_become_safe_ones(garden, page, faults):
    names = ['say "cheese".bmp', "tab\there.bmp", "x" * 250 + ".bmp", "con.bmp", "ångström/né.bmp"]
    size = len(photographs(garden.parent / "given", ["a.bmp"])[0].read_bytes())
    data = list((garden.parent / "given" / "a.bmp").read_bytes())
    page.evaluate(
        "async ([names, data]) => (await import('/static/uploads.js')).upload('Garden',"
        " names.map((name) => ({ name, file: new File([new Uint8Array(data)], 'x') })))",
        [names, data],
    )
    sent(page, len(names))
    there = {path.relative_to(garden).as_posix() for path in garden.rglob("*.bmp")}
    assert there == {"say -cheese-.bmp", "tab here.bmp", "x" * 176 + ".bmp", "_con.bmp", "ångström/né.bmp"}
    assert all((garden / name).stat().st_size == size for name in there) and faults == []


def test_the_page_is_labelled_and_fits_a_phone(served, page, faults):
    page.set_viewport_size({"width": 360, "height": 740})
    page.goto(served.address.url)
    page.get_by_role("heading", name="Drop photographs").wait_for()
    unnamed = page.eval_on_selector_all(
        "button, a, input, select, summary",
        "all => all.filter(one => !(one.ariaLabel || (one.closest('label') || one).textContent.trim())).length",
    )
    assert unnamed == 0
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.emulate_media(color_scheme="dark")
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.emulate_media(color_scheme="light")
    assert dark != page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert faults == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_is_seen_named_and_reached_by_the_keyboard(served, page, faults, scheme):
    page.emulate_media(color_scheme=scheme)
    item = new_project(served.root, "Garden")
    for i in range(3):
        (item.photographs / f"{i}.jpg").write_bytes(jpeg(i, (160, 120)))
    page.goto(served.address.url)
    page.get_by_label("More for Garden").click()
    assert faults_of(page) == []
    page.goto(f"{served.address.url}/#{item.key}")
    page.get_by_text("3 photographs").wait_for()
    page.get_by_text("Advanced").click()
    assert faults_of(page) == []
    page.evaluate("""() => {
      const worse = new CSSStyleSheet();
      worse.replaceSync(".faint { color: #777 } * { outline: none !important }");
      document.adoptedStyleSheets = [worse];
    }""")
    found = faults_of(page)
    assert any("contrast" in one for one in found) and any("focus" in one for one in found)
    assert faults == []


def test_a_scene_is_shown_as_its_page(served, page, faults):
    """Made at the first look; the viewer is behind another tab."""
    page.goto(served.address.url)
    page.get_by_role("button", name="See an example").click()
    page.get_by_text("Opening the scene").wait_for()
    (item,) = items(served.root)
    (served.root / "go").touch()
    page.frame_locator("iframe").get_by_text("made").wait_for()
    assert page.get_by_role("tab", name="Edit").is_visible()
    assert page.get_by_role("link", name="Download Web page").is_visible()
    page.reload()
    page.frame_locator("iframe").get_by_text("made").wait_for()
    assert (item.path / "calls.txt").read_text().count("export web") == 1 and faults == []


def test_a_title_of_any_length_fits_and_is_changed_beside_the_scene(served, page, faults):
    item = new_project(served.root, "W" * 120)
    for i in range(2):
        (item.photographs / f"{i}.jpg").write_bytes(jpeg(i, (160, 120)))
    page.set_viewport_size({"width": 360, "height": 740})
    page.goto(served.address.url)
    page.get_by_role("link", name="Open W").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")

    page.goto(f"{served.address.url}/#{item.key}")
    make = page.get_by_role("button", name="Add photographs: 3 are the least")
    make.wait_for()
    assert make.is_disabled()
    (item.photographs / "2.jpg").write_bytes(jpeg(2, (160, 120)))
    page.get_by_role("button", name="Make the scene").wait_for()
    assert re.search(r"about \d+ (s|min)", page.get_by_role("radiogroup", name="Quality").inner_text())
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.get_by_role("button", name="2.jpg").click()
    page.get_by_role("dialog", name="2.jpg").wait_for()
    page.keyboard.press("ArrowRight")
    page.get_by_role("dialog", name="0.jpg").wait_for()
    page.keyboard.press("Escape")
    page.get_by_role("button", name="Rename").click()
    page.get_by_label("New name").fill("Short")
    page.keyboard.press("Enter")
    page.get_by_role("heading", name="Short").wait_for()
    assert item.record.title == "Short" and faults == []
