"""Every export with its options, as the viewer's tab Export offers them."""

import inspect
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Literal, get_args, get_origin

from ..errors import LumigraphError
from ..files.ranges import hints
from ..system.children import start_python
from .export import What

ENDINGS = {"mesh": ".glb", "octree": ".npz", "panorama": ".jpg", "points": ".ply", "snerg": "", "splats": ".spz"}
ENDINGS |= {"collision": ".glb", "lightfield": "", "probes": "", "stereo": ".jpg", "web": ".html"}
ELSEWHERE = "source", "output", "overwrite", "scene", "part", "settings", "device"  # which the viewer sets otherwise
PRIVATE = "origin"  # a switch that is off in the viewer, whose files are often passed on; on the command line it is on


def export_menu(opened: Any, method: Any, settings: Sequence[str], device: str) -> Any:
    """The viewer's Exporter of an opened run or file.

    settings: of --set; device: of --device
    """
    from ..camera.crop import CropBox
    from ..method.capabilities import HasAtlas, HasGaussians, HasOctree, can
    from ..viewer.shared import CROPPED_MAX_SCALE, Exporter, ExportFormat

    needs: dict[str, Any] = {"splats": HasGaussians, "octree": HasOctree, "snerg": HasAtlas}
    kinds = {marks.name: kind for kind, marks in map(get_args, get_args(What))}
    kinds = {name: kind for name, kind in kinds.items() if name not in needs or can(method, needs[name])}
    kinds = {"web": kinds.pop("web"), **kinds}  # the usual one first
    formats = {
        name: ExportFormat(ENDINGS[name], inspect.cleandoc(kind.__doc__).partition("\n")[0], tuple(options_of(kind)))
        for name, kind in kinds.items()
    }

    def command(name: str, file: str, values: Mapping[str, str | bool], request: Any) -> list[str]:
        place = opened.path.absolute()  # for a child in another folder
        words = ["lumigraph", "export", name, str(place), str(place.parent / file)]
        for option in formats[name].options:
            default = option.default or option.name == PRIVATE
            words += typed_option(option.name, values[option.name], default)
        if "part" in hints(kinds[name]):
            crop = request.crop
            if isinstance(crop, CropBox):
                words += ["--box", *(f"{x:.6f}" for x in (*crop.lower, *crop.upper))]
            elif crop is not None:
                words += ["--sphere", *(f"{x:.6f}" for x in (*crop.middle, crop.radius))]
            if crop is not None and can(method, HasGaussians):
                words.append(f"--max-scale={CROPPED_MAX_SCALE:g}")
            if request.cleaned:
                words.append(f"--strength={request.strength:g}")
        if "settings" in hints(kinds[name]):
            chosen = [*settings, *(f"{key}={value}" for key, value in request.settings)]
            words += [word for text in chosen for word in ("--set", text)]
        if "device" in hints(kinds[name]) and device != "auto":
            words += ["--device", device]
        return words

    return Exporter(formats, command, run_export)


def options_of(kind: type) -> Iterator[Any]:
    """Options of an export's command in the viewer, including those of nested dataclasses."""
    from ..viewer.shared import ExportOption

    said = hints(kind)
    for field in fields(kind):
        if field.name in ELSEWHERE:
            continue
        if is_dataclass(field.default):
            yield from options_of(type(field.default))
            continue
        marks = [mark for mark in get_args(said[field.name])[1:] if hasattr(mark, "help_behavior_hint")]
        name = next((mark.name for mark in marks if mark.name), field.name).replace("_", "-")
        hint = next((str(mark.help_behavior_hint) for mark in marks if mark.help_behavior_hint), "")
        if isinstance(field.default, bool):
            yield ExportOption(name, field.default and name != PRIVATE, hint=hint)
            continue
        choices = list(choices_of(said[field.name]))
        default = str(field.default) if field.default is not None else "default" if choices else ""
        yield ExportOption(name, default, tuple(dict.fromkeys([default, *choices])) if choices else (), hint)


def choices_of(hint: Any) -> Iterator[str]:
    """The values of each Literal in an annotation."""
    if get_origin(hint) is Literal:
        yield from get_args(hint)
    else:
        for inner in get_args(hint):
            yield from choices_of(inner)


def typed_option(name: str, value: str | bool, default: str | bool) -> list[str]:
    """Words of an option on the command line; none for its default. A browser's text stays the value of that option."""
    if value == default or value == "":
        return []
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    numbers = value.split()
    if len(numbers) > 1 and all(number.removeprefix("-").replace(".", "", 1).isdigit() for number in numbers):
        return [f"--{name}", *numbers]
    return [f"--{name}={value}"]


def run_export(command: list[str], report: Callable[[str], None]) -> str:
    """Run a command line in a separate process, without blocking the viewer; returns its output.

    report: called with each line of progress
    Raises LumigraphError with its last line if it fails.
    """
    report("Exporting ...")
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with start_python(["-m", *command], text=True, **pipes) as process:
        assert process.stdout is not None and process.stderr is not None
        last = ""
        for line in process.stderr:
            if line.strip():
                last = line.strip()
                report(last)
        said = process.stdout.read()
    if process.returncode:
        raise LumigraphError(last.removeprefix("lumigraph: ") or "The export was ended; try it again")
    return said
