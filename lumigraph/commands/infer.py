"""`lumigraph infer`: reconstruct a scene from a few photographs, or a shape from a scan, with a prior."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.options import DeviceOption, ReaderOption, needed, option
from ..files.ranges import Count, Downscale, Seed
from .common import choose_device, next_free, scene_name, show


@dataclass(frozen=True)
class Infer:
    """Reconstruct a scene from a few photographs, or a shape from a scan, with a trained prior.

    A prior is a run of a method that learns from a collection: lumigraph train pixelnerf procedural:toys. Inference
    takes seconds: pixelnerf encodes the photographs once, hyp-nerf and srn optimise a code for them. The new run stores
    the result, and evaluates, renders, exports and opens in the viewer like any other. With --seed instead of a scene,
    hyp-nerf and srn sample a new object. Priors of shapes (deepsdf, occupancy-network) take a mesh, a cloud of points
    or, as they were trained, one picture.
    """

    prior: Annotated[Positional[Path], needed("PRIOR")]
    """Folder of the prior's run."""
    scene: Annotated[Positional[str | None], option("SCENE", "none, with --seed")] = None
    """A folder of photographs with poses, or procedural:NAME; for a prior of shapes a mesh, a cloud or a picture."""
    seed: Annotated[Seed | None, option("N")] = None
    """Sample a new object instead of a scene; each number gives another one."""
    output: Annotated[Path | None, option("RUN", "runs/SCENE-METHOD-N")] = None
    """New folder for the run."""
    views: Annotated[Count | None, option("N", "the prior's number in training")] = None
    """Number of input photographs, spread evenly over the cameras. If the scene has no more, all are input, and none is
    held out unless the source names its test photographs."""
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce photographs by this whole number; a larger one is faster and loses detail."""
    partial: bool = False
    """The scan shows some sides alone: find its place and size in the whole as well, instead of fitting it to the
    box."""
    reader: ReaderOption = None
    device: DeviceOption = "auto"

    def run(self) -> int:
        from ..method.prior import Prior
        from ..run import Run, check_new
        from ..run.derived import draw
        from .outcome import next_commands

        if (self.scene is None) == (self.seed is None):
            raise LumigraphError("Name a scene, or give --seed for a new object; one of them")
        made_by = Run(self.prior)
        prior = Prior.of(made_by.method(choose_device(self.device)), made_by.kind, self.prior)
        drawn_of = f"{scene_name(made_by.settings.scene.source)}-seed-{self.seed}"
        what = scene_name(self.scene) if self.scene is not None else drawn_of
        output = self.output or next_free(f"runs/{what}-{made_by.method_name}")
        check_new(output)
        if self.seed is None:
            infer = self._completed if prior.of_shapes else self._inferred
            run, of = infer(made_by, prior, output)
        else:
            run, of = draw(made_by, prior, self.seed, output), {"made of": f"seed {self.seed}"}
        commands = next_commands(run) if self.seed is None else next_commands(run, "eval")
        show({"run": str(run.folder)} | of | {"took": f"{run.state.seconds:.2f} s"} | commands)
        return 0

    def _inferred(self, made_by: Any, prior: Any, output: Path) -> tuple[Any, dict[str, str]]:
        """The run of a scene, and rows about it to print."""
        from ..datasets.collection import Collection
        from ..datasets.dataset import check_kind
        from ..datasets.scene import Scene
        from ..opening import PROCEDURAL, kind_of, open_dataset, sources_of
        from ..readers import single_image
        from ..readers.assemble import HOLD_OUT
        from ..run.derived import infer
        from ..sfm.photos import is_bare

        assert self.scene is not None
        name, path = made_by.method_name, Path(self.scene).expanduser()
        if not self.scene.startswith(PROCEDURAL) and (single_image.recognises(path) or is_bare(path)):
            raise LumigraphError(
                f"{self.scene} holds no poses, which {name} needs; find them first: lumigraph capture {self.scene}"
            )
        if kind_of(self.scene, Scene) is Collection:
            raise LumigraphError(
                f"{name} takes one scene, and {self.scene} is a collection; name one of its scenes: "
                f"lumigraph infer {self.prior} {next(iter(sources_of(self.scene).values()))}"
            )
        options: dict[str, Any] = {"downscale": self.downscale, "reader": self.reader}
        scene = open_dataset(self.scene, Scene, **options)
        check_kind(f"infer by {name}", Scene, type(scene), self.scene)
        assert isinstance(scene, Scene)
        most = self.views or prior.method.evidence_views
        if whole := len(scene.cameras) <= (most or HOLD_OUT):
            options["whole"] = True
        if most is not None:
            options["views"] = self.views or min(most, len(scene.cameras if whole else scene.splits["train"]))
        if whole or most is not None:
            scene = open_dataset(self.scene, Scene, **options)
        assert isinstance(scene, Scene)
        run = infer(made_by, prior, scene, output, options)
        count = len(scene.splits["train"])
        rows = {"made of": f"{count} photograph{'' if count == 1 else 's'}"}
        if set(scene.splits["test"].tolist()) <= set(scene.splits["train"].tolist()):
            rows["held out"] = "none, so lumigraph eval scores the input photographs"
        return run, rows

    def _completed(self, made_by: Any, prior: Any, output: Path) -> tuple[Any, dict[str, str]]:
        """The run of a shape, and rows about it to print."""
        from ..datasets.dataset import check_kind
        from ..datasets.scene import Photograph
        from ..datasets.shapes import CUBE, Shapes
        from ..opening import open_dataset
        from ..readers import single_image
        from ..run.derived import Pictured, infer

        assert self.scene is not None
        name, path = made_by.method_name, Path(self.scene).expanduser()
        told = [x for x in ("views", "downscale", "reader") if getattr(self, x) is not None]
        if told:
            raise LumigraphError(f"{name} is a prior of shapes, and --{told[0]} is about photographs; leave it out")
        if single_image.recognises(path):
            if Photograph not in prior.method.takes:
                raise LumigraphError(f"{name} takes a mesh or a cloud of points, and {path} is a picture; name one")
            evidence = single_image.photograph(path)
            data = Pictured(str(path), CUBE)
            return infer(made_by, prior, data, output, {}, evidence), {"made of": "a picture"}
        options = {"partial": True} if self.partial else {}
        shapes = open_dataset(self.scene, Shapes, **options)
        check_kind(f"infer by {name}", Shapes, type(shapes), self.scene)
        return infer(made_by, prior, shapes, output, options), {"made of": "a scan" if self.partial else "a shape"}
