"""`lumigraph georeference`: the frame of exports by control points."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.options import DeviceOption, PhotographsOption, RunOption, needed
from .common import choose_device, show


@dataclass(frozen=True)
class GeoreferenceCommand:
    """Lead the exports of a run onto control points: scale, rotation and offset, by least squares.

    POINTS is a table with a line for each pixel that shows a measured place: image, u, v, x, y, z, between commas,
    semicolons or tabs; u and v count pixels of the photograph from its upper left corner. At least three places, not on
    a line; each is best shown by two photographs or more, else the model's depth places it. Residuals are printed, and
    the run remembers the frame for all exports. --scale-by of an export replaces it.
    """

    run_folder: RunOption
    points: Annotated[Positional[Path], needed("POINTS")]
    """Table of control points."""
    scene: PhotographsOption = None
    device: DeviceOption = "auto"

    def run(self) -> int:
        from ..evaluation.control_points import georeferenced, read_control_points
        from ..large import open_run

        opened, points = open_run(self.run_folder), read_control_points(self.points)
        if opened.open_scene is None:
            raise LumigraphError(f"{self.run_folder} was not trained on photographs, which control points are seen in")
        found = georeferenced(
            points, opened.open_scene(self.scene), opened.ready(choose_device(self.device)), self.points
        )
        opened.set_world(found.world_from_source)
        rows = {
            " ".join(f"{x:.3f}" for x in point.place): f"{residual[0]:+.4f} {residual[1]:+.4f} {residual[2]:+.4f}"
            for point, residual in zip(found.points, found.residuals, strict=True)
        }
        show(
            rows
            | {"residual": f"{found.rms:.4f}, root of the mean square", "scale": f"{found.world_from_source.scale:.8g}"}
            | (
                {"by depth": f"{found.by_depth} of {len(points)}, which one photograph alone shows"}
                if found.by_depth
                else {}
            )
            | {"saved": f"{opened.path}: the frame of its exports"}
        )
        return 0
