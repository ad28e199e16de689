"""The scenes of live.md: a program that trains and exports them, once, and the hook that copies them into the site."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

PAGES = {  # method, scene, seconds of training
    "splats": ("gaussian-splatting", "procedural:still-life", 60),
    "moving": ("deformable-splatting", "procedural:jelly,sweeps=12", 90),
    "volume": ("instant-ngp", "procedural:still-life", 60),
}


FOLDER = Path(__file__).parent.parent / "build" / "pages"


def on_post_build(config: Any, **_: Any) -> None:
    """Copy the scenes that were made beside the pages of the site."""
    live = Path(config.site_dir) / "live"
    live.mkdir(parents=True, exist_ok=True)
    for page in FOLDER.glob("*.html"):
        shutil.copy(page, live)


def make() -> None:
    """Train and export the scenes that are missing."""
    for name, (method, scene, seconds) in PAGES.items():
        page, run = FOLDER / f"{name}.html", FOLDER / name
        if page.exists():
            continue
        if not run.exists():
            lumigraph("train", method, scene, "--seconds", str(seconds), "--output", str(run))
        lumigraph("export", "web", str(run), str(page))


def lumigraph(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "lumigraph", *words], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    make()
