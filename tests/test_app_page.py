"""The app's page in a real browser, with a quick command in place of ours."""

from __future__ import annotations

import re
import shutil
import threading
from collections import namedtuple

import pytest
import uvicorn
from app_uploads import UPLOAD_NAMED
from app_walk import drop
from budgets import budget
from test_app import PROGRAM, jpeg

from lumigraph.app.server import Announcing, App, build
from lumigraph.viewer.address import Address, free_port

pytestmark = budget("exports", 8)


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
    drop(page, [photographs])
    page.get_by_role("alert").get_by_text("text.jpg is no photograph that can be read").wait_for()
    page.get_by_role("button", name="good.jpg").wait_for()
    page.evaluate(UPLOAD_NAMED, ["garden", ["../up.jpg", "/etc/up.jpg"]])
    page.get_by_role("alert").get_by_text("'../up.jpg' cannot be the name of a photograph here").wait_for()
    assert not list(tmp_path.rglob("up.jpg"))

    usage = namedtuple("Usage", "total used free")
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda place: usage(1 << 40, 1 << 40, 1000))
        (tmp_path / "late.jpg").write_bytes(jpeg(1, (160, 120)))
        drop(page, [tmp_path / "late.jpg"])
        page.get_by_text("is full; free some space, and the upload goes on").wait_for()
    page.get_by_role("button", name="late.jpg").wait_for()
    assert all("status of 40" in one or "status of 507" in one for one in faults)


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
