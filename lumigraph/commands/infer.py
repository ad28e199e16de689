"""`lumigraph infer`: what a prior makes of one scene, from a few photographs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from ..ranges import Count, Downscale
from .common import ReaderOption, choose_device, needed, next_free, option, scene_name, show


@dataclass(frozen=True)
class Infer:
    """Make a run of one scene out of a few of its photographs, by what a prior has learnt across many scenes.

    A prior is a run of a method that learns from a collection: lumigraph train pixelnerf procedural:toys. Nothing is
    learnt here, so it takes seconds. The new run keeps the photographs that it was made of, and evaluates, renders,
    exports and opens in the viewer like any other.
    """

    prior: Annotated[Positional[Path], needed("PRIOR")]
    """Folder of the prior's run."""
    scene: Annotated[Positional[str], needed("SCENE")]
    """A folder of photographs with poses, or procedural:NAME."""
    output: Annotated[Path | None, option("RUN", "runs/SCENE-METHOD-N")] = None
    """New folder for the run."""
    views: Annotated[Count | None, option("N", "as many as the prior looked at while it learnt")] = None
    """Look at so many photographs, spread evenly over the cameras."""
    downscale: Annotated[Downscale | None, option("N", "none, or what suits the photographs")] = None
    """Shrink photographs by a whole number."""
    reader: ReaderOption = None
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..capture import PROCEDURAL, open_dataset, single_image
        from ..capture.photos import is_bare
        from ..dataset import check_kind
        from ..prior import Prior
        from ..run import Run, check_new
        from ..run.inferred import infer
        from ..scene import Scene
        from .outcome import next_commands

        made_by = Run(self.prior)
        prior = Prior.of(made_by.method(choose_device(self.device)), made_by.kind, self.prior)
        name = made_by.method_name
        output = self.output or next_free(f"runs/{scene_name(self.scene)}-{name}")
        check_new(output)
        path = Path(self.scene).expanduser()
        if not self.scene.startswith(PROCEDURAL) and (single_image.recognises(path) or is_bare(path)):
            raise LumigraphError(
                f"{self.scene} holds no poses, and {name} must know where photographs were taken from; "
                f"find them first: lumigraph capture {self.scene}"
            )
        options: dict[str, Any] = {"downscale": self.downscale, "reader": self.reader, "views": self.views}
        scene = open_dataset(self.scene, Scene, **options)
        check_kind(f"infer by {name}", Scene, type(scene), self.scene)
        assert isinstance(scene, Scene)
        if self.views is None and (most := prior.method.evidence_views) is not None:
            options["views"] = min(most, len(scene.splits["train"]))
            scene = open_dataset(self.scene, Scene, **options)
            assert isinstance(scene, Scene)
        run = infer(made_by, prior, scene, output, options)
        rows = {"run": str(run.folder), "made of": f"{len(scene.splits['train'])} photographs"}
        show(rows | {"took": f"{run.state.seconds:.2f} s"} | next_commands(run))
        return 0
