"""Hooks of the site (mkdocs.yml): all pages of methods in its menu; links to what is no page become plain text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#:]+)(?:#[^)]*)?\)")
ALL_METHODS = "methods/*"


def on_config(config: Any) -> Any:
    """Replace ALL_METHODS in the menu by the pages that there are."""
    folder = Path(config.docs_dir)
    pages = sorted(f"methods/{path.name}" for path in (folder / "methods").glob("*.md"))
    for section in config.nav:
        for name, entries in section.items():
            if entries == [ALL_METHODS]:
                section[name] = pages
    return config


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Links to the code, which is not part of the site, become their text."""
    root, here = Path(config.docs_dir).resolve(), Path(page.file.abs_src_path).parent

    def kept(link: re.Match[str]) -> str:
        return link[0] if (here / link[2]).resolve().is_relative_to(root) else link[1]

    return LINK.sub(kept, markdown)
