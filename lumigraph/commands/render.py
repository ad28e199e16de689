"""`lumigraph render`: render films of a trained scene. No photographs are needed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..export.options import AUTO, FilmOptions
from ..files.options import Animate, DeviceOption, Overwrite, Set, needed, option
from .compress import size as file_size
from .results import Film, Output, Reports

CHOSEN = {
    "orbit": "orbit, for the photographs go round",
    "sweep": "sweep, for all cameras have about the same direction; --path orbit goes to and fro",
}


@dataclass(frozen=True, kw_only=True)
class Render(Reports, FilmOptions, Output):
    """Render a film of a run, a splat file or a composition.

    Paths stay near the positions of the photographs. orbit goes round (or to and fro). sweep is an oval among cameras
    that look the same way, as from a drone. auto is one of these two. spiral goes twice round while rising, interpolate
    passes smoothly through the photographs' cameras, still stays at the one in their middle, held-out visits the test
    photographs' own cameras. A path of your own is a JSON file: keyframes saved in the viewer, or the JSON beside a
    film of the same capture.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of the run, a splat file (.ply, .spz, .sog, .glb, .splat), or a composition (.json)."""
    output: Annotated[Path | None, option("FILE", "RUN/renders/PATH.mp4, or renders/FILE/PATH.mp4")] = None
    """The film: .mp4, .gif or .webp. FILE.json, its cameras, is beside it."""
    overwrite: Overwrite = False
    settings: Set = ()
    animated: Animate = ()
    device: DeviceOption = "auto"

    def of(self, opened: Any) -> Film:
        from ..export.film import depth_beside, read_path, render_film

        read_path(self)  # before the method is loaded
        output, path, about = render_film(self.loaded(opened), self.output, self, self.animated, self.overwrite)
        frames, (width, height), seconds = about["frames"], about["size"], about["seconds_per_frame"]
        depth, pictures = depth_beside(output) if self.depth else None, output.with_suffix("")
        rows = {"film": f"{output}, {file_size(output.stat().st_size)}"}
        rows |= {"path": CHOSEN[path]} if self.path == AUTO else {}
        rows |= {"depth": str(depth)} if depth else {}
        rows |= {"pictures": f"{pictures}/0000.{self.pictures} …"} if self.pictures else {}
        rows |= {"frames": f"{frames} of {width}x{height}, {seconds:.3f} s each"}
        return Film(
            output,
            frames,
            about["fps"],
            (width, height),
            seconds * frames,
            cameras=output.with_suffix(".json"),
            depth=depth,
            pictures=pictures if self.pictures else None,
            rows=rows,
        )
