"""`lumigraph render`: render films of a trained scene. No photographs are needed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.ranges import Count, FramesPerSecond, Pixels
from .compress import size as file_size
from .options import Animate, DeviceOption, Overwrite, Set, animate, needed, open_method, option
from .results import Film, Reports

# As in `paths`, which help must not import.
PATH_KINDS = ("orbit", "sweep", "spiral", "interpolate", "still", "held-out")
MAX_SIZE, MAX_RAYS_SIZE, AUTO = 1280, 640, "auto"  # pixels by default, of Gaussians and of methods that cast rays
SIZES = f"that of the photographs, at most {MAX_SIZE}, and {MAX_RAYS_SIZE} for methods that cast rays"
CHOSEN = {
    "orbit": "orbit, for the photographs go round",
    "sweep": "sweep, for all cameras have about the same direction; --path orbit goes to and fro",
}


@dataclass(frozen=True)
class Render(Reports):
    """Render a film of a run, a splat file or a composition.

    Paths stay near the positions of the photographs. orbit goes round (or to and fro). sweep is an oval among cameras
    that look the same way, as from a drone. auto is one of these two. spiral goes twice round while rising, interpolate
    passes smoothly through the photographs' cameras, still stays at the one in their middle, held-out visits the test
    photographs' own cameras. A path of your own is a JSON file: keyframes saved in the viewer, or the JSON beside a
    film of the same capture.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of the run, a splat file (.ply, .spz, .sog, .glb, .splat), or a composition (.json)."""
    path: Annotated[str, option("{" + ",".join((AUTO, *PATH_KINDS)) + ",FILE.json}")] = AUTO
    """Camera path: the name of one, or a JSON file."""
    frames: Annotated[Count | None, option("N", "120; for held-out every view; for keyframes by their seconds")] = None
    """Number of frames; more make a longer film."""
    fps: Annotated[FramesPerSecond | None, option("N", "30, or that of the path's file")] = None
    """Frames per second of the film."""
    size: Annotated[Pixels | None, option("PIXELS", SIZES)] = None
    """Longer side of the picture in pixels; larger renders slower."""
    output: Annotated[Path | None, option("FILE", "RUN/renders/PATH.mp4, or renders/FILE/PATH.mp4")] = None
    """The film: .mp4, .gif or .webp. FILE.json, its cameras, is beside it."""
    depth: bool = False
    """Also render a film of depth, FILE-depth."""
    pictures: Annotated[Literal["png", "exr"] | None, option("{png,exr}", "none")] = None
    """Also keep each frame as a picture, in the folder FILE. exr adds linear light with its full range."""
    overwrite: Overwrite = False
    settings: Set = ()
    animated: Animate = ()
    device: DeviceOption = "auto"

    def made(self) -> Film:
        from ..export.film import claim_film, depth_beside, film
        from ..export.video import kind_of
        from ..method.capabilities import HasGaussians, can
        from ..paths import film_cameras, fitting

        flight = None if self.path in (AUTO, *PATH_KINDS) else read_path(self.path, self.fps)
        fps = self.fps or (flight.fps if flight else 30.0)
        reads = [self.source, *([Path(self.path)] if flight else [])]
        if self.output is not None:
            kind_of(self.output, fps)
            claim_film(self.output, self.overwrite, reads, self.depth, self.pictures)
        opened, method, views = open_method(self.source, self.device, self.settings)
        path = fitting(views["train"], opened.frame) if self.path == AUTO else self.path
        output = self.output or opened.renders / f"{Path(path).stem}.mp4"
        kind_of(output, fps)
        claim_film(output, self.overwrite, reads, self.depth, self.pictures)
        most = MAX_SIZE if can(method, HasGaussians) else MAX_RAYS_SIZE
        size = self.size or min(most, int(views["train"].size.max()))
        cameras = film_cameras(views, opened.frame, flight or path, self.frames, size)
        shown = animate(opened, method, self.animated, len(cameras))
        about = film(shown, cameras, output, fps, self.depth, self.pictures)
        width, height = about["size"]
        frames, seconds = about["frames"], about["seconds_per_frame"]
        beside = depth_beside(output) if self.depth else None
        rows = {"film": f"{output}, {file_size(output.stat().st_size)}"}
        rows |= {"path": CHOSEN[path]} if self.path == AUTO else {}
        rows |= {"depth": str(beside)} if beside else {}
        rows |= {"pictures": f"{output.with_suffix('')}/0000.{self.pictures} …"} if self.pictures else {}
        rows |= {"frames": f"{frames} of {width}x{height}, {seconds:.3f} s each"}
        return Film(
            output,
            frames,
            fps,
            (width, height),
            seconds * frames,
            cameras=output.with_suffix(".json"),
            depth=beside,
            pictures=output.with_suffix("") if self.pictures else None,
            rows=rows,
        )


def read_path(name: str, fps: float | None) -> Any:
    """The CameraPath in a file, with other frames per second if given. Raises LumigraphError if it is none."""
    from ..paths.keyframes import CameraPath

    file = Path(name)
    if not file.exists() and not file.suffix:
        raise LumigraphError(f"There is no path called {name!r}; choose {', '.join(PATH_KINDS)}, or a JSON file")
    flight = CameraPath.load(file)
    return replace(flight, fps=fps or flight.fps)
