"""What lies in a folder, for tests: names in order, without the record of what Lumigraph wrote there."""

from __future__ import annotations

from pathlib import Path

from lumigraph.files.marks import MARKS_FILE


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != MARKS_FILE)
