"""Camera paths of films: automatic ones, and curves through keyframes."""

from ..camera import Camera
from ..datasets.scene import Frame
from ..errors import LumigraphError
from .automatic import PATHS as PATHS
from .automatic import Surroundings as Surroundings
from .automatic import angle_of_view as angle_of_view
from .automatic import camera_path as camera_path
from .automatic import film_size as film_size
from .automatic import fitting as fitting
from .keyframes import CameraPath

DEFAULT_SIZE = 480  # pixels of a film by default
DEFAULT_FRAMES = 120  # of a film along a path without a length


def film_cameras(
    cameras: dict[str, Camera], frame: Frame, path: str | CameraPath, frames: int | None = None, size: int | None = None
) -> Camera:
    """Cameras of a film, one for each frame.

    cameras: of the photographs by split, as `Run.cameras` gives them; frame: theirs
    path:   name of one (`export/options.py`), or a CameraPath
    frames: None for the default of the path: 120, every held-out view, as long as keyframes last
    size:   longer side; None as the photographs, up to a limit
    Raises LumigraphError for held-out views if there are none, or of several sizes.
    """
    if path != "held-out":
        train = cameras["train"]
        shape = film_size(train, size or min(DEFAULT_SIZE, int(train.size[0].max())))
        if isinstance(path, str):
            return camera_path(path, train, frame, DEFAULT_FRAMES if frames is None else frames, shape)
        return path.cameras(frame, shape, frames)
    views = cameras.get("test")
    if views is None or not len(views):
        raise LumigraphError("There are no held-out views here; choose another --path")
    if len(views.size.unique(dim=0)) > 1:
        raise LumigraphError("The held-out views are of several sizes, which no film holds; choose another --path")
    longest = size or min(DEFAULT_SIZE, int(views.size.max()))
    return views[: frames or len(views)].resized(longest / int(views.size.max()))
