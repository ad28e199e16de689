"""A real browser for tests: the system's Chromium, without a window, drawing WebGL in software.

All tests share one browser and each gets a page of its own; they come last (`conftest`), for asyncio.run() is refused
while playwright is about. A test asks for the fixture `page`, and for
`faults` to see what went wrong in it; other windows, such as a phone's, come from `chromium.new_context(...)`.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

NAMES = "chromium", "chromium-browser", "google-chrome"
SIZE = {"width": 800, "height": 600}
PATIENCE = 60_000  # ms; at a load of 8 to 12 a click took more than 20 s, twice
ARGUMENTS = [
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-dev-shm-usage",
    "--force-color-profile=srgb",
    "--hide-scrollbars",
]


def find_chromium() -> str | None:
    """The environment's CHROMIUM, else the first of the usual names."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A playwright Browser. Without Chromium tests are skipped, or fail where LUMIGRAPH_NEEDS_BROWSER=1."""
    program = find_chromium()
    if program is None:
        reason = f"no browser: none of {', '.join(NAMES)} is installed, and CHROMIUM names none"
        if os.environ.get("LUMIGRAPH_NEEDS_BROWSER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=ARGUMENTS)  # headless, without a sandbox
        yield browser
        browser.close()


@pytest.fixture
def page(chromium: Any) -> Iterator[Any]:
    """A playwright Page of 800x600 pixels in a context of its own."""
    context = chromium.new_context(viewport=SIZE)
    context.set_default_timeout(PATIENCE)
    yield context.new_page()
    context.close()


@pytest.fixture
def faults(page: Any) -> list[str]:
    """What the page complains of, as it comes: errors on the console, and exceptions that nobody caught."""
    return listen(page)


def listen(page: Any) -> list[str]:
    """`faults` for a page that a test opened itself."""
    found: list[str] = []
    page.on("console", lambda message: found.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: found.append(str(error)))
    return found
