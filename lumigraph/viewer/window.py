"""The browser's window: the scene's name as the tab's title, and a panel that begins folded where the window is small.

viser sets neither, so a hidden picture does, which fails to load and says so to a line of JavaScript.
"""

from __future__ import annotations

import json
from html import escape
from typing import Any

NARROW_WINDOW_PIXELS = 576  # pixels: viser's panel is a sheet at the bottom of windows up to this width

# A click on the sheet's handle folds it; what is clicked is the text of the title, inside the handle. The mark keeps it
# from folding again when somebody opens it, for that makes the picture anew.
SCRIPT = """
document.title = {title};
const sheet = this.closest(".mantine-Paper-root");
if (innerWidth <= {narrow} && sheet && !window.sheetFolded) {{
  window.sheetFolded = true;
  const texts = [...sheet.querySelectorAll("*")].filter((part) => part.childElementCount === 0);
  texts.find((part) => part.textContent === {title})?.click();
}}
"""


def prepare(gui: Any, title: str) -> None:
    """Name the tab after the scene, and fold the panel of small windows once. gui: viser's, of the server."""
    script = SCRIPT.format(title=json.dumps(title), narrow=NARROW_WINDOW_PIXELS)
    gui.add_html(f'<img hidden alt="" src="data:," onerror="{escape(script)}">', order=1e9)
