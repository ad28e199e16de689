"""`lumigraph render`: films of a trained scene. No photographs are needed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from .common import check_film, choose_device, needed, open_run, option, show

LONGEST = 480  # pixels of a film, if nobody asks for more
PATHS = ("orbit", "spiral", "interpolate", "held-out")


@dataclass(frozen=True)
class Render:
    """Fly a camera through a run or a splat file: colour and depth, as films and as pictures.

    Paths keep to where the photographs were taken from. orbit goes round (or to and fro), spiral twice round while
    rising, interpolate passes smoothly through photographs' places, held-out visits the test photographs' own cameras.
    A path of your own is a JSON file: keyframes saved in the viewer, or what lies beside a film of the same capture.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of the run, or a splat file: .ply, .compressed.ply, .spz, .splat."""
    path: Annotated[str, option("{" + ",".join(PATHS) + ",FILE.json}")] = "orbit"
    """Where the camera goes."""
    frames: Annotated[int | None, option("N", "120; every held-out view; as long as keyframes say")] = None
    """Length in frames."""
    fps: Annotated[float | None, option("N", "30, or what the path's file says")] = None
    """Frames per second."""
    size: Annotated[int | None, option("PIXELS", f"that of the photographs, at most {LONGEST}")] = None
    """Longer side of the picture."""
    output: Annotated[Path | None, option("FILE", "RUN/renders/PATH.mp4, or renders/FILE/PATH.mp4")] = None
    """The film: .mp4, .gif or .webp. Depth (FILE-depth), FILE.json and the folder FILE of pictures go beside it."""
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..export.film import film
        from ..export.video import kind_of

        check_film(self.frames, 30.0 if self.fps is None else self.fps, self.size)
        flight = None if self.path in PATHS else read_path(self.path, self.fps)
        fps = self.fps or (flight.fps if flight else 30.0)
        run = open_run(self.source)
        output = self.output or run.renders / f"{Path(self.path).stem}.mp4"
        kind_of(output, fps)
        if flight and output.with_suffix(".json").resolve() == Path(self.path).resolve():
            raise LumigraphError(f"{self.path} would be replaced by what goes beside the film; give another --output")
        cameras = film_cameras(run, flight or self.path, self.frames, self.size)
        method = run.method(choose_device(self.device))
        about = film(method, cameras, output, fps)
        width, height = about["size"]
        show(
            {
                "film": str(output),
                "depth": str(output.with_stem(f"{output.stem}-depth")),
                "pictures": f"{output.with_suffix('')}/0000.png …",
                "frames": f"{about['frames']} of {width}x{height}, {about['seconds_per_frame']:.3f} s each",
            }
        )
        return 0


def read_path(name: str, fps: float | None) -> Any:
    """The CameraPath in a file, at another speed of frames if asked. Raises LumigraphError if it is none."""
    from ..keyframes import CameraPath

    file = Path(name)
    if not file.exists() and not file.suffix:
        raise LumigraphError(f"There is no path called {name!r}; choose {', '.join(PATHS)}, or a JSON file")
    flight = CameraPath.load(file)
    return replace(flight, fps=fps or flight.fps)


def film_cameras(run: Any, path: Any, frames: int | None, size: int | None) -> Any:
    """The cameras of a film of a Run, one for each frame.

    path: one of PATHS, or a CameraPath
    size: longer side; None as the photographs, up to a limit
    """
    from ..paths import camera_path, film_size

    cameras = run.cameras()
    if path != "held-out":
        train = cameras["train"]
        longest = size or min(LONGEST, int(train.size[0].max()))
        shape = film_size(train, longest)
        if isinstance(path, str):
            return camera_path(path, train, run.frame, 120 if frames is None else frames, shape)
        return path.cameras(run.frame, shape, frames)
    views = cameras.get("test")
    if views is None or not len(views):
        raise LumigraphError("There are no held-out views here; choose another --path")
    if len(views.size.unique(dim=0)) > 1:
        raise LumigraphError("The held-out views are of several sizes, which no film holds; choose another --path")
    longest = size or min(LONGEST, int(views.size.max()))
    return views[: frames or len(views)].resized(longest / int(views.size.max()))
