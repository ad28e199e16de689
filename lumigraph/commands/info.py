"""`lumigraph info`: what a run, a folder of photographs or a splat file is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from tyro.conf import Positional

from .common import Reader, needed, option

LONG = 4096  # letters; a tree cuts its lines where the console ends, and folders have long names


@dataclass(frozen=True)
class Info:
    """Say what a run, a scene or a splat file holds."""

    what: Annotated[Positional[str], needed("RUN_OR_SCENE")]
    """Folder of a run, folder of photographs, a picture, procedural:NAME, or a splat file."""
    downscale: Annotated[int | None, option("N", "none, or what suits the photographs")] = None
    """Shrink a scene's photographs by a whole number."""
    reader: Annotated[Reader | None, option("NAME", "found by looking into the folder")] = None
    """Layout of a scene's folder: transforms, blender, colmap or llff."""

    def run(self) -> int:
        from ..capture import open_scene
        from ..describe import cloud_tree, run_tree, scene_tree
        from ..exchange import is_splat_file, read_gaussians

        if (Path(self.what) / "config.json").exists():
            from ..run import Run

            tree = run_tree(Run(self.what))
        elif is_splat_file(self.what):
            tree = cloud_tree(self.what, read_gaussians(self.what))
        else:
            tree = scene_tree(open_scene(self.what, downscale=self.downscale, reader=self.reader))
        Console(highlight=False, width=LONG, soft_wrap=True).print(tree)
        return 0
