"""A run in a notebook: a small interactive page, rendered in seconds, above a still for front ends without frames."""

import base64
import html
import tempfile
import time
from pathlib import Path
from typing import Any

from ..errors import LumigraphError
from ..method.capabilities import HasGaussians, can
from ..run import Opened
from .calls import quietly
from .export import ExportWeb

MAX_PAGE_BYTES = 8e6  # of a page in a notebook's file
MAX_SECONDS = 6.0  # that rendering the pictures of a page may take
MIN_VIEWS, MAX_VIEWS = 12, 48  # of a page of pictures
VIEW_PIXELS, STILL_PIXELS = 320, 400  # longer side of such a picture, and of the still
# The still lies below the frame, and is visible where a front end removes frames.
FRAME = """<div style="position: relative; max-width: 640px; height: 400px; overflow: hidden">
<img alt="still" style="height: 100%" src="data:image/png;base64,{still}">
<iframe title="{title}" sandbox="allow-scripts" allow="fullscreen" srcdoc="{page}"
 style="position: absolute; inset: 0; width: 100%; height: 100%; border: 0"></iframe></div>"""
STILL = '<img alt="still" src="data:image/png;base64,{still}">'


def shown(opened: Opened) -> str:
    """HTML of a run, a splat file or a composition: its page, or a still, and a table of its facts."""
    picture = ""
    try:
        page, still = small_page(opened), base64.b64encode(opened.still(STILL_PIXELS)).decode()
        title = html.escape(opened.title)
        picture = FRAME.format(title=title, page=html.escape(page), still=still) if page else STILL.format(still=still)
    except LumigraphError:  # no state yet, or no method that is installed
        pass
    rows = opened.facts().items()
    cells = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>" for name, value in rows)
    return f"{picture}<table>{cells}</table>"


def small_page(opened: Opened) -> str | None:
    """Page of splats, or of as many views as are rendered in MAX_SECONDS; None if it is too large or too slow."""
    options: dict[str, Any] = {"kind": "splats"}
    if not can(opened.ready(), HasGaussians):
        opened.still(VIEW_PIXELS)  # compiles kernels
        begin = time.monotonic()
        opened.still(VIEW_PIXELS)
        views = min(MAX_VIEWS, int(MAX_SECONDS / (time.monotonic() - begin)))
        if views < MIN_VIEWS:
            return None
        longest = int(opened.cameras()["train"].size.max())
        options = {"kind": "views", "views": views, "size": min(VIEW_PIXELS, longest)}
    with tempfile.TemporaryDirectory(prefix="lumigraph-") as folder:
        page = Path(folder) / "page.html"
        quietly(lambda: ExportWeb(opened.path, page, title=opened.title, **options).of(opened))
        return page.read_text("utf-8") if page.stat().st_size <= MAX_PAGE_BYTES else None
