"""`lumigraph capture`: find the camera poses of photographs or a video."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.options import needed, option
from ..sfm.options import MotionOptions
from .common import finding_rows, lines, say, scene_name, show, typed
from .results import Output

MAX_NAMED_GAPS = 2  # gaps around the subject that are named
GENERIC_FOLDERS = "images", "photos", "photographs", "pictures", "input", "frames"  # named after their contents


@dataclass(frozen=True, kw_only=True)
class CaptureCommand(MotionOptions, Output):
    """Find the camera poses of photographs: a folder, a list of files, or a video.

    The result is a folder that this and other programs open: images, sparse/0 (COLMAP), transforms.json, and two
    pictures of the result. Ctrl-C stops; the same command continues.
    """

    what: Annotated[Positional[tuple[Path, ...]], needed("PHOTOS_OR_VIDEO")]
    """A folder of photographs, several image files, or one video."""
    output: Annotated[Path | None, option("SCENE", "scenes/NAME")] = None
    """Folder for the scene."""
    mask_object: bool = False
    """Mask one object in front of a backdrop, so that training learns it alone. Always done where the object was turned
    before a background at rest. Writes object_masks/ and object.png into the scene; check that picture."""

    def run(self) -> int:
        from ..sfm.rig import capture_recorded, capture_rig, is_recorded, is_rig
        from ..system.progress import track

        if not self.what:
            raise LumigraphError("Nothing to capture; name a folder of photographs, image files or a video")
        folder = self.output or scene_folder(self.what)
        first, only, made = self.what[0].expanduser(), len(self.what) == 1, None
        recorded = only and is_recorded(first)
        method = "deformable-splatting" if self.moving and not recorded else "gaussian-splatting"
        onward = typed("train", method, folder)
        if recorded:
            made = capture_recorded(first, folder, self.frames, track)
        elif only and self.moving and is_rig(first):
            made = capture_rig(first, folder, self, track)
        if made is not None:
            rows, said = made
            show(rows | {"scene": str(folder), "next": onward})
            for sentence in said:
                say(f"warning: {sentence}")
            return 0
        show_all(folder, find_cameras(self.what, folder, self), onward, self.mask_object)
        return 0


def show_all(folder: Path, result: dict[str, Any], onward: str | None = None, masked: bool = False) -> None:
    """Print the result, and mask the object if asked or if it was turned before a background at rest."""
    from ..sfm.doctor import TURNING

    turned = any(finding["fault"] == TURNING for finding in result["findings"])
    show_result(folder, result, None if masked or turned else onward)
    try:
        if masked or turned:
            show_masks(folder, onward)
    except LumigraphError as error:
        if masked:
            raise
        show({"next": onward} if onward else {})
        say(f"warning: {error}")


def show_masks(folder: Path, onward: str | None) -> None:
    """Find the object of a scene, unless that was done before: results to stdout, doubts to stderr."""
    from ..readers import choose_reader
    from ..readers.masks import OBJECT_MASKS
    from ..readers.objects import mask_object

    if (folder / OBJECT_MASKS).exists():
        as_they_are = f"{folder / OBJECT_MASKS}, as they are; delete them to have them made anew"
        show({"masks": as_they_are} | ({"next": onward} if onward else {}))
        return
    masked = mask_object(folder, choose_reader(folder).read(folder))
    found = {
        "masks": f"{masked.photographs} in {folder / OBJECT_MASKS}",
        "look at": f"{masked.sheet}: bright is the object, dark is masked",
    }
    show(found | ({"next": onward} if onward else {}))
    for doubt in masked.doubts:
        say(f"warning: {doubt}; look at {masked.sheet}, and correct or delete {folder / OBJECT_MASKS}")


def posed(scene: str) -> str:
    """The scene itself; bare photographs and videos become a folder with poses, by capture."""
    from ..opening import PROCEDURAL
    from ..sfm.photos import is_bare

    path = Path(scene).expanduser()
    if scene.startswith(PROCEDURAL) or not is_bare(path):
        return scene
    folder = scene_folder((path,))
    say(f"{scene} holds no poses; finding them, to {folder}")
    show_all(folder, find_cameras((path,), folder))
    return str(folder)


def scene_folder(what: tuple[Path, ...]) -> Path:
    """scenes/NAME, named after the folder or the video, or for a list of files after their common folder."""
    first = what[0].expanduser().resolve()
    if len(what) > 1 or first.suffix.lower() in (".jpg", ".jpeg", ".png"):
        first = Path(os.path.commonpath([path.expanduser().resolve().parent for path in what]))
    if first.name.lower() in GENERIC_FOLDERS and first.parent.name:
        first = first.parent
    return Path("scenes") / scene_name(str(first.with_suffix("") if first.is_file() else first))


def find_cameras(what: tuple[Path, ...], folder: Path, options: Any = None) -> dict[str, Any]:
    """reconstruct(), with bars; a message after Ctrl-C names the command to continue."""
    from ..sfm.reconstruction import reconstruct
    from ..system.progress import track

    try:
        return reconstruct([path.expanduser() for path in what], folder, options, track)
    except KeyboardInterrupt:
        say(f"What is done is kept in {folder}; the same command goes on from there")
        raise


def show_result(folder: Path, result: dict[str, Any], onward: str | None = None) -> None:
    """Print the result for the photographs and the next command: results to stdout, warnings to stderr."""
    show(rows(folder, result) | ({"next": onward} if onward else {}))
    for sentence in result["warnings"]:
        say(f"warning: {sentence}")


def rows(folder: Path, result: dict[str, Any]) -> dict[str, str]:
    from ..sfm.coverage import use_of
    from ..sfm.doctor import Finding

    placed, others = len(result["registered"]), result["other_models"]
    found = {"photographs": f"{placed} of {result['given']} placed"}
    if others:
        found["photographs"] += f", and apart from them {' and '.join(str(len(names)) for names in others)}"
    found |= finding_rows([Finding(**finding) for finding in result["findings"]], str(folder / "capture.json"))
    if result["duplicates"]:
        repeated = [f"{name} of {other}" for name, other in result["duplicates"].items()]
        found["duplicates"] = lines(repeated, str(folder / "capture.json"))
    found["error"] = f"{result['error']:.2f} pixels"
    found["points"] = f"{result['points']:,}, each in {result['track_length']:.1f} photographs on average"
    found["coverage"] = f"points span {100 * result['filled']:.0f} % of a photograph, on average"
    found["parallax"] = f"{result['angle']:.0f} degrees between the outermost views of a point (median)"
    if coverage := result["coverage"]:
        found["around"] = f"{coverage['degrees']:.0f} of 360 degrees"
        found["around"] += ", from {:.0f} to {:.0f} degrees above the subject".format(*coverage["elevations"])
        gaps = [f"{g['degrees']:.0f} degrees between {' and '.join(g['between'])}" for g in coverage["gaps"]]
        gap = f"no photograph from {', '.join(gaps)}" if len(gaps) <= MAX_NAMED_GAPS else f"{len(gaps)} gaps"
        found["around"] += f"; {gap if gaps else use_of(coverage['degrees'], coverage.get('ends'))}"
    if result["gps"] and result["gps"]["used"]:
        found["place"] = result["gps"]["say"]
    found["time"] = ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in result["seconds"].items())
    found["pictures"] = f"{folder / 'capture.png'}, {folder / 'photographs.png'}"
    return found | {"scene": str(folder)}
