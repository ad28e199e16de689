"""What is tried: for each class a home folder, files of it that are made wrong, and the commands that open them.

An input is its class, its number and a seed: the same three give the same files and the same command.
"""

from __future__ import annotations

import random
import shutil
from dataclasses import dataclass
from pathlib import Path

from . import flags
from .bend import bend
from .functions import FUNCTIONS

TRAIN = "train gaussian-splatting given --steps 1 --output out/new --device cpu --initial-gaussians 100"
SPLATS = "given/cloud"
OF_RUN = ("config.json", "cameras.json", "metrics.jsonl", "eval.json", "eval.png", "eval/*", "report.html", "rays*")
OF_RUN += (
    "checkpoints",
    "checkpoints/*",
    "previews*",
    "renders*",
    "paths*",
    "lock.json",
    "photographs*",
    ".lumigraph",
    "*/.lumigraph",
)
CHANGES = ("resume", "eval", "report", "explain", "render")  # commands that write into the run that they are given


@dataclass(frozen=True)
class Kind:
    """A class of inputs.

    home:     name of the folder that is copied
    files:    patterns of the files in it that are made wrong
    commands: one of them opens these
    share:    of all inputs, beside others'
    """

    home: str
    files: tuple[str, ...]
    commands: tuple[str, ...]
    share: float = 1.0


def scene(home: str, *files: str, share: float = 1.0) -> Kind:
    return Kind(home, files, ("info given",) * 5 + ("info given --downscale 2", TRAIN), share)


def cloud(suffix: str) -> Kind:
    name = f"given/cloud{suffix}"
    to = "ply" if suffix == ".spz" else "spz"
    uses = (f"info {name}",) * 4 + (f"export splats {name} out/new.{to}", f"clean {name} --output out/new{suffix}")
    return Kind(
        f"cloud{suffix}", (f"cloud{suffix}",), (*uses, f"render {name} --frames 1 --size 16 --output out/new.mp4")
    )


def run(name: str, share: float, *files: str) -> Kind:
    folder = f"given/{name}"
    is_grid = name == "instant-ngp"
    uses = (
        f"info {folder}",
        f"info {folder}",
        f"render {folder} --frames 1 --size 16 --output out/new.gif",
        f"eval {folder} --views 1",
        f"report {folder}",
        f"resume {folder} --steps 4",
        f"export web {folder} out/new.html --views 2 --size 16",
        f"export points {folder} out/new.ply --size 16 --views 2",
        f"explain ray {folder} --output out/new.svg" if is_grid else f"export splats {folder} out/new.splat",
    )
    home = {"instant-ngp": "grid-run", "small": "small-run"}.get(name, "run")
    if home == "small-run":
        uses = tuple(use for use in uses if not use.startswith("resume"))
    return Kind(home, tuple(f"{name}/{file}" for file in files), uses, share)


CLOUD, GRID = "gaussian-splatting", "instant-ngp"
PATH = f"render given/{CLOUD} --size 16 --output out/new.mp4 --frames 2 --path"
KINDS: dict[str, Kind] = {
    "blender": scene("blender", "*.json"),
    "transforms.json": scene("instant-ngp", "*.json"),
    "transforms.json with layers": scene("layers", "*.json", "*.json", "sparse.ply", "depth/*", "normals/*", "masks/*"),
    "transforms.json of nerfstudio": scene("nerfstudio", "*.json", "sparse.ply"),
    "TUM": scene("tum", "*.txt", "*.txt", "depth/*.png"),
    "7-Scenes": scene("seven-scenes", "*.txt", "*.txt", "*.depth.png"),
    "COLMAP binary": scene("colmap-binary", "sparse/0/*.bin"),
    "COLMAP text": scene("colmap-text", "sparse/0/*.txt"),
    "LLFF": scene("llff", "*.npy"),
    "pickles": scene("zju", "annots.npy", "annots.npy", "new_params/*.npy"),
    "ZJU-MoCap": scene("zju", "lbs/*.npy", "mask/*/*.png"),
    "KITTI": scene("kitti", "calib/*", "label_02/*", "oxts/*"),
    "Replica": scene("replica", "traj.txt", "cam_params.json", "results/depth*.png"),
    "ScanNet": scene("scannet", "frames/*/*.txt", "frames/depth/*.png"),
    "Polycam": scene("polycam", "keyframes/corrected_cameras/*.json", "keyframes/depth/*.png"),
    "Nerfies": scene("nerfies", "*.json", "camera/*", "*.npy"),
    "NR-NeRF": scene("nr-nerf", "*.json"),
    "laz": Kind("lidar", ("cloud.laz",), (f"{TRAIN} --depth-from given/cloud.laz",)),
    "las": Kind("lidar", ("cloud.las",), (f"{TRAIN} --depth-from given/cloud.las",), 0.5),
    "e57": Kind("lidar", ("cloud.e57",), (f"{TRAIN} --depth-from given/cloud.e57",), 0.5),
    **{f"{name} alone": Kind("alone", (f"{name}.*",), (f"read {name} {{file}}",), 1.5) for name in FUNCTIONS},
    "pictures of a scene": scene("blender", "all/*.png", share=0.5),
    "shapes": Kind("shapes", ("*",), ("info given",)),
    "pictures": Kind(
        "pictures",
        ("*",),
        (*["info {file}"] * 4, "train fourier-features {file} --steps 1 --output out/new --hidden-width 8"),
    ),
    "photographs": Kind("photographs", ("*.jpg",), ("capture given --output out/new",), 0.4),
    "videos": Kind("videos", ("*.mp4",), ("capture {file} --output out/new",), 0.4),
    ".ply": cloud(".ply"),
    ".compressed.ply": cloud(".compressed.ply"),
    ".splat": cloud(".splat"),
    ".spz": cloud(".spz"),
    ".sog": cloud(".sog"),
    ".glb": cloud(".glb"),
    "config.json": run(CLOUD, 1.5, "config.json"),
    "config.json of a grid": run(GRID, 1.5, "config.json"),
    "cameras.json": run(CLOUD, 1.0, "cameras.json"),
    "state.json": run(CLOUD, 0.6, "checkpoints/*/state.json"),
    "metrics.jsonl": run(CLOUD, 0.6, "metrics.jsonl"),
    "eval.json": run(CLOUD, 0.6, "eval.json"),
    "safetensors": run(CLOUD, 0.7, "checkpoints/*/*.safetensors"),
    "safetensors of a grid": run(GRID, 0.7, "checkpoints/*/*.safetensors"),
    "packed weights": run("small", 1.0, "checkpoints/*/weights.packed", "compress.json"),
    "camera path": Kind("camera-path", ("keys.json", "film.json"), (f"{PATH} {{file}}",)),
    "composition": Kind(
        "composition",
        ("both.json",),
        (*["info given/both.json"] * 2, "render given/both.json --frames 1 --size 16 --output out/new.mp4"),
    ),
    "flags": Kind("flags", (), (), 4.0),
    "method-flags": Kind("method-flags", (), (), 3.0),
}


@dataclass(frozen=True)
class Input:
    """A folder that was made, and a command to run in it.

    bent:    what was done to which file
    patient: whether the command may go on for long because it was asked for much
    ours:    patterns of what it may change
    """

    command: list[str]
    bent: str
    patient: bool
    ours: tuple[str, ...]


def make(kind: str, number: int, seed: int, templates: Path, folder: Path) -> Input:
    """Write the home folder of an input to `folder`, which must not exist.

    A number below 0 is one of the class's commands, -1 the first, with files that are as they should be.
    """
    chance, about = random.Random(f"{seed} {kind} {number}"), KINDS[kind]
    shutil.copytree(templates / about.home, folder, symlinks=True)
    bent, patient = "options", False
    if number < 0:
        command = controls(kind)[-1 - number]
        bent = "nothing"
    elif kind == "flags":
        command, patient = flags.command(chance)
    elif kind == "method-flags":
        command, patient = flags.method_command(chance)
    else:
        files = sorted((folder / "given").glob(chance.choice(about.files)))
        file = chance.choice([path for path in files if path.is_file()])
        bent = f"{file.relative_to(folder)}: {bend(file, chance)}"
        command = chance.choice(about.commands).format(file=file.relative_to(folder)).split()
    if number >= 0 and chance.random() < 0.2:
        beside(folder / "out", chance)
    return Input(command, bent, patient, allowed(command))


def controls(kind: str) -> list[list[str]]:
    """The commands that a class is opened by, each once, which have to go well with nothing made wrong."""
    if kind == "flags":
        return list(flags.COMMANDS.values())
    first = {"camera path": "given/keys.json", "pictures": "given/picture.png", "videos": "given/clip.mp4"}.get(kind)
    first = f"given/{kind.removesuffix(' alone')}{FUNCTIONS[kind.removesuffix(' alone')]}" if "alone" in kind else first
    return [command.format(file=first).split() for command in dict.fromkeys(KINDS[kind].commands)]


def beside(out: Path, chance: random.Random) -> None:
    """Somebody's files where a command might put its own."""
    name = chance.choice(("new", "new.json", "new-depth.mp4", "new.partial.mp4", "new.partial", "new.html", "new.ply"))
    if chance.random() < 0.6:
        (out / name).mkdir()
        (out / name / "holiday.jpg").write_bytes(b"the only copy")
    else:
        (out / name).write_bytes(b"not ours")


def allowed(command: list[str]) -> tuple[str, ...]:
    """Patterns of the paths that a command may change: those of the run that it works on."""
    if command[0] not in CHANGES:
        return ()
    runs = [word for word in command if word.startswith("given/")]
    return tuple(f"{run}/{name}" for run in runs for name in OF_RUN)


def shares(count: int, only: tuple[str, ...] = ()) -> dict[str, int]:
    """So many inputs over the classes, or over some of them."""
    chosen = {name: kind.share for name, kind in KINDS.items() if not only or name in only}
    whole = sum(chosen.values())
    return {name: max(1, round(count * share / whole)) for name, share in chosen.items()}
