"""`lumigraph explain ray`: density and weights of a method along one ray."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from ...errors import LumigraphError
from ...files.ranges import between
from ..common import Overwrite, choose_device, needed, option, say, show
from ..controls import Set, tell

Place = Annotated[int, between(0, 1_000_000)]  # along one side of a picture


@dataclass(frozen=True)
class ExplainRay:
    """Draw density, transmittance, weights, samples and accumulated colour along the ray of a pixel.

    One figure, which opens in a browser; its numbers are beside it as JSON. It includes the photograph's own colour if
    the photographs are available.
    """

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run."""
    pixel: Annotated[tuple[Place, Place] | None, option("X Y", "the middle of the picture")] = None
    """Column and row of the pixel, from 0 0 at the upper left."""
    view: Annotated[str, option("NAME_OR_NUMBER")] = "0"
    """Photograph of the split: its name, or its number from 0."""
    split: Literal["test", "val", "train"] = "test"
    """Split of the photograph."""
    output: Annotated[Path | None, option("FILE.svg", "RUN/rays/VIEW-X-Y.svg")] = None
    """File of the figure."""
    overwrite: Overwrite = False
    scene: Annotated[str | None, option("SCENE", "the path used in training")] = None
    """Path of the photographs, if they were moved since training."""
    settings: Set = ()
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        if self.output and self.output.suffix != ".svg":
            raise LumigraphError(f"{self.output} does not say that it is a figure; give --output a name ending in .svg")
        from ...evaluation import file_name
        from ...explain.ray import along_ray
        from ...explain.ray_figure import ray_figure
        from ...figures.charts import standalone
        from ...files import claim, write_bytes, write_json
        from ...run import Run
        from ...system.progress import counting

        run = Run(self.run_folder)
        name, camera = find_view(run, self.split, self.view)
        x, y = pixel = self.pixel or tuple((camera.size[0] // 2).tolist())
        output = self.output or run.folder / "rays" / f"{file_name(name)}-{x}-{y}.svg"
        for file in (output, output.with_suffix(".json")):
            claim(file, "figure", self.overwrite)
        method = tell(run, run.method(choose_device(self.device)), self.settings)
        camera = method.refined(camera)
        with counting("Looking along the ray"):
            sight = along_ray(method, camera, pixel)
        sight = sight.beside(self._photograph(run, name))
        title = f"{run.method_name}: pixel ({x}, {y}) of {name}"
        write_bytes(output, standalone(ray_figure(sight, title)), "figure")
        about = {"run": str(run.folder), "method": run.method_name, "view": name, "split": self.split}
        about |= {"controls": method.settings} if method.settings else {}
        write_json(output.with_suffix(".json"), about | sight.to_json(), "figure")
        show(sight.rows() | {"files": f"{output}, {output.with_suffix('.json')}"})
        return 0

    def _photograph(self, run: Any, name: str) -> Any:
        """The photograph before the run's background, or None if it is gone and nobody said where to."""
        try:
            scene = run.scene(self.scene)
            photograph = scene.photograph(scene.names.index(name))
        except LumigraphError as error:
            if self.scene:
                raise
            say(f"The figure does without the photograph: {error}")
            return None
        return photograph.before(run.frame.background)


def find_view(run: Any, split: str, view: str) -> tuple[str, Any]:
    """Name and Camera of a photograph, by its name or number in a split of a Run. LumigraphError if there is none."""
    names = run.view_names().get(split, [])
    if not names:
        raise LumigraphError(f"{run.folder} has no views in the split {split!r}; choose another --split")
    number = names.index(view) if view in names else int(view) if view.isdecimal() else len(names)
    if number >= len(names):
        raise LumigraphError(
            f"There is no view {view!r} in the split {split!r} of {run.folder}; give --view a number from 0 to "
            f"{len(names) - 1}, or a name such as {names[0]}"
        )
    return names[number], run.cameras()[split][number]
