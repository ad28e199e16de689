"""Volumes of web pages: an octree or an atlas, or a field converted to an octree first."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from ...errors import LumigraphError

INTO = "plenoctrees"


def is_baked(method: Any) -> bool:
    from ...method.capabilities import HasAtlas, HasOctree, can

    return can(method, HasOctree) or can(method, HasAtlas)


def browsable(method: Any, degree: int = 3) -> tuple[Any, str]:
    """A baked method's volume for browsers, and its description. degree: largest degree of an octree's harmonics"""
    from ...exchange.baked.browser import atlas_for_browser, octree_for_browser
    from ...method.capabilities import HasAtlas, HasOctree, can, needs

    if can(method, HasOctree):
        volume = octree_for_browser(method.octree(), degree)
        return volume, f"{volume.settings['leaves']:,} leaves of an octree, harmonics of degree {volume.degree}"
    volume = atlas_for_browser(needs(method, HasAtlas).atlas())
    return volume, f"{volume.settings['blocks']:,} blocks of {volume.settings['block']}^3 voxels"


def can_be_baked(opened: Any, method: Any) -> bool:
    """True if a method's field can be converted to an octree, which supports objects only."""
    from ...derive.conversion import check, way
    from ...methods import find

    try:
        check(opened, find(INTO))
    except LumigraphError:
        return False
    return not opened.frame.is_open and way(type(method), find(INTO)) == "field"


def converted(opened: Any, seconds: float, device: Any) -> tuple[Any, str]:
    """The opened method converted to an octree, and the cost as text. seconds: training time after initialisation"""
    from ...derive.conversion import ConversionTarget, convert
    from ...run import open_any

    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="lumigraph-") as folder:
        made = convert(opened, INTO, Path(folder) / INTO, ConversionTarget(seconds=seconds), device, show=True)
        method = open_any(Path(folder) / INTO).method(device)
    return method, f"{time.monotonic() - begin:.0f} s, {made.psnr:.1f} dB to {made.teacher.method}"
