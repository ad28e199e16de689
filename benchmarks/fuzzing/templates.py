"""Small valid files of every kind that is opened, each kind in a home folder of its own.

The tests' own writers and the commands themselves make them.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
from pathlib import Path

import numpy as np
from PIL import Image

TESTS = Path(__file__).resolve().parents[2] / "tests"
sys.path.insert(0, str(TESTS))  # whose writers know every layout

SCENE = "given/scene"  # of whatever home holds a run
HOMES = {  # and what lies in each, beside the photographs
    "run": ("gaussian-splatting",),
    "grid-run": ("instant-ngp",),
    "small-run": ("small",),
    "composition": ("gaussian-splatting", "cloud.ply", "both.json"),
    "camera-path": ("gaussian-splatting", "film.json", "keys.json"),
    "flags": ("gaussian-splatting", "instant-ngp", "cloud.ply", "cloud.spz", "pictures", "photographs", "shapes"),
    "method-flags": ("pictures", "shapes"),
}
SMALL = {
    "gaussian-splatting": ["--initial-gaussians", "150", "--sh-degree", "1"],
    "instant-ngp": "--levels 3 --log2-hashmap-size 9 --max-resolution 32 --hidden-width 16 --samples-per-step 2048 "
    "--occupancy-resolution 16 --steps-per-diagonal 64".split(),
    "nerf": "--depth 2 --skip-layer 1 --hidden-width 16 --coarse-samples 4 --fine-samples 4 --rays-per-step 32".split(),
    "mip-nerf": "--depth 2 --skip-layer 1 --hidden-width 16 --coarse-samples 4 --fine-samples 4 "
    "--rays-per-step 32".split(),
    "fourier-features": "--frequencies 8 --layers 2 --hidden-width 16 --pixels-per-step 64".split(),
}


def write_all(root: Path) -> None:
    """Write every kind. Computes, so that whoever calls this cannot be copied afterwards."""
    import captures

    tiny = captures.Tiny(6)
    for name, write in captures.WRITERS.items():
        write(home(root, name.replace(" ", "-")) / "given", tiny)
    with_layers(home(root, "layers") / "given", tiny)
    write_tum(home(root, "tum") / "given", tiny)
    write_seven_scenes(home(root, "seven-scenes") / "given", tiny)
    write_other_layouts(root)
    write_alone(home(root, "alone") / "given")
    write_shapes(home(root, "shapes") / "given")
    write_pictures(home(root, "pictures") / "given")
    write_photographs(home(root, "photographs") / "given")
    write_video(home(root, "videos") / "given")
    write_runs(root)


def home(root: Path, kind: str) -> Path:
    """A home folder with a stranger's files in it, besides those that a command is given."""
    folder = root / kind
    (folder / "given").mkdir(parents=True)
    for place in ("theirs", "out"):
        (folder / place).mkdir()
        (folder / place / "holiday.jpg").write_bytes(b"photographs of a holiday")
    return folder


def with_layers(folder: Path, tiny: object) -> None:
    """transforms.json that names masks, depth and labels."""
    import captures
    from deep_files import write_exr, write_png16

    captures.write_nerfstudio(folder, tiny)  # type: ignore[arg-type]
    about = json.loads((folder / "transforms.json").read_text())
    height, width = captures.HEIGHT, captures.WIDTH
    for i, frame in enumerate(about["frames"]):
        write_png16(folder / "depth" / f"{i}.png", np.full((height, width), 3000, np.uint16))
        write_exr(folder / "normals" / f"{i}.exr", np.ones((height, width, 3), np.float32) / math.sqrt(3))
        for name, value in (("masks", 255), ("labels", 3)):
            (folder / name).mkdir(exist_ok=True)
            Image.fromarray(np.full((height, width), value, np.uint8)).save(folder / name / f"view_{i:02d}.png")
        frame |= {"depth_file_path": f"depth/{i}.png", "normals_file_path": f"normals/{i}.exr", "time": i / 6}
        frame |= {"labels_file_path": f"labels/view_{i:02d}.png", "mask_path": f"masks/view_{i:02d}.png"}
    about |= {"up": [0.0, 0.0, 1.0], "train_filenames": [f["file_path"] for f in about["frames"][2:]]}
    about |= {"test_filenames": [f["file_path"] for f in about["frames"][:2]]}
    (folder / "transforms.json").write_text(json.dumps(about))


def write_tum(folder: Path, tiny: object) -> None:
    import captures
    import torch
    from deep_files import write_png16

    from lumigraph.geometry import to_quaternion

    tiny.write_images(folder / "rgb")  # type: ignore[attr-defined]
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i, (name, pose) in enumerate(zip(tiny.names, tiny.poses, strict=True)):  # type: ignore[attr-defined]
        write_png16(folder / "depth" / name, np.full((captures.HEIGHT, captures.WIDTH), 15000, np.uint16))
        w, x, y, z = to_quaternion(torch.from_numpy(pose[:3, :3].copy())).tolist()
        lists["rgb"].append(f"{i}.0 rgb/{name}")
        lists["depth"].append(f"{i}.01 depth/{name}")
        lists["groundtruth"].append(" ".join(map(str, [i, *pose[:3, 3], x, y, z, w])))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("# a comment\n" + "\n".join(lines) + "\n")
    (folder / "camera.txt").write_text("60 60 24 18\n")


def write_seven_scenes(folder: Path, tiny: object) -> None:
    import captures
    from deep_files import write_png16

    for i, (picture, pose) in enumerate(zip(tiny.pictures, tiny.poses, strict=True)):  # type: ignore[attr-defined]
        Image.fromarray(picture).save(folder / f"frame-{i:06d}.color.png")
        write_png16(folder / f"frame-{i:06d}.depth.png", np.full((captures.HEIGHT, captures.WIDTH), 3000, np.uint16))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    np.savetxt(folder / "camera-intrinsics.txt", [[60, 0, 24], [0, 60, 18], [0, 0, 1]])


def write_other_layouts(root: Path) -> None:
    """Layouts whose writers are in the tests of their readers, and clouds of a LiDAR beside photographs."""
    import test_bodies
    import test_depth_in
    import test_depth_readers
    import test_neural_scene_graph

    test_bodies.write_zju(given := home(root, "zju") / "given" / "x")
    for path in given.iterdir():
        path.rename(given.parent / path.name)
    given.rmdir()
    test_neural_scene_graph.write_kitti(home(root, "kitti") / "given")
    shutil.rmtree(folder := home(root, "replica") / "given")
    test_depth_readers.write_replica(folder)
    test_depth_readers.write_scannet(home(root, "scannet") / "given")
    test_depth_readers.write_polycam(home(root, "polycam") / "given")
    test_depth_in.write_posed(folder := home(root, "lidar") / "given")
    for suffix in ("laz", "las", "e57"):
        test_depth_in.write_cloud(folder / f"cloud.{suffix}", test_depth_in.wall_points(3000))


def write_alone(folder: Path) -> None:
    """Files that are given to a reader's function."""
    import bodies
    import safetensors.torch
    import test_neural_scene_graph
    import torch

    from lumigraph.composition.voxel_mask import VoxelMask
    from lumigraph.exchange.bones import write_bones
    from lumigraph.exchange.skinned_gltf import read_character
    from lumigraph.readers.tracks import write_tracks

    np.save(folder / "environment.npy", np.ones((8, 16, 3), np.float32))
    strokes = np.zeros((24, 32, 3), np.uint8)
    strokes[3:5], strokes[9:12] = (0, 255, 0), (255, 0, 0)
    Image.fromarray(strokes).save(folder / "strokes.png")
    bodies.write_bar(folder / "character.glb")
    write_bones(folder / "bones.json", read_character(folder / "character.glb").clip(0))
    write_tracks(folder / "tracks.json", (test_neural_scene_graph.drive(),))
    safetensors.torch.save_file({"a": torch.rand(8, 8)}, folder / "weights.safetensors")
    VoxelMask(torch.ones(3, 3, 3).byte(), torch.ones(3, 3, 3).byte(), (0.0, 0.0, 0.0), 0.1).write(
        folder / "mask.safetensors"
    )


def write_shapes(folder: Path) -> None:
    import tiny_shapes
    import trimesh

    tiny_shapes.write(folder)
    for suffix in ("off", "stl", "glb"):
        trimesh.creation.icosphere(subdivisions=1).export(folder / f"other.{suffix}")


def write_pictures(folder: Path) -> None:
    """One picture of each kind of file."""
    from deep_files import write_exr, write_png16

    y, x = np.mgrid[:24, :32]
    colours = np.stack([8 * x, 10 * y, 0 * x + 99], -1).astype(np.uint8)
    for suffix in ("png", "jpg", "webp", "bmp", "tiff"):
        Image.fromarray(colours).save(folder / f"picture.{suffix}")
    write_png16(folder / "deep.png", colours.astype(np.uint16) * 256)
    write_exr(folder / "light.exr", colours.astype(np.float32) / 255)


def write_photographs(folder: Path) -> None:
    """Without poses, as cameras write them."""
    about = Image.Exif()
    about[0x010F], about[0x0112] = "A maker", 6  # make, orientation
    about.get_ifd(0x8769)[0x920A] = 35.0  # focal length
    folder.mkdir(exist_ok=True)
    for i in range(4):
        picture = np.random.default_rng(i).integers(0, 256, (18, 24, 3), dtype=np.uint8)
        Image.fromarray(picture).resize((96, 72)).save(folder / f"IMG_{i}.jpg", exif=about)


def write_video(folder: Path) -> None:
    import av

    with av.open(str(folder / "clip.mp4"), "w") as film:
        stream = film.add_stream("libx264", rate=10, options={"preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(12):
            picture = np.random.default_rng(i).integers(0, 255, (48, 64, 3), dtype=np.uint8)
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
        film.mux(stream.encode())


def write_runs(root: Path) -> None:
    """Runs of two methods with all that commands leave in them, and what is made of them."""
    from lumigraph.exchange import SUFFIXES

    made, photographs = root / "made", root / "blender" / "given"
    made.mkdir()
    for method in ("gaussian-splatting", "instant-ngp"):
        run = made / method
        must("train", method, photographs, "--steps", "2", "--output", run, "--device", "cpu", *SMALL[method])
        must("eval", run, "--views", "1")
        config = run / "config.json"
        config.write_text(config.read_text().replace(str(photographs.resolve()), SCENE))
    cloud = made / "gaussian-splatting"
    must("compress", cloud, "--output", made / "small", "--steps", "2", "--views", "1", "--scene", photographs)
    for suffix in SUFFIXES:
        must("export", "splats", cloud, made / f"cloud{suffix}")
        shutil.copy(made / f"cloud{suffix}", home(root, f"cloud{suffix}") / "given")
    must("compose", cloud, made / "cloud.ply", "--output", made / "both.json", "--at", "0", "0", "0")
    must("render", cloud, "--frames", "2", "--size", "16", "--output", made / "film.mp4")
    write_path(made / "keys.json")
    for kind, names in HOMES.items():
        given = home(root, kind) / "given"
        for name in names:
            place = root / name / "given" if name in ("pictures", "photographs", "shapes") else made / name
            (shutil.copytree if place.is_dir() else shutil.copy)(place, given / name)
        shutil.copytree(photographs, given / "scene")
        for run in (given / name for name in names if (given / name / "config.json").exists()):
            (run / "holiday.jpg").write_bytes(b"more of the holiday")


def write_path(file: Path) -> None:
    """A flight through two keyframes."""
    from lumigraph.paths.keyframes import CameraPath, Keyframe

    def pose(x: float) -> tuple[tuple[float, float, float, float], ...]:
        return ((1.0, 0.0, 0.0, x), (0.0, 0.0, 1.0, -3.0), (0.0, -1.0, 0.0, 0.0))

    CameraPath((Keyframe(pose(0.0), 50.0, 0.0), Keyframe(pose(0.5), 60.0, 0.1))).save(file)  # type: ignore[arg-type]


def must(*command: object) -> None:
    """Run a command that has to go well."""
    from lumigraph.commands.cli import main

    if code := main([str(word) for word in command]):
        raise RuntimeError(f"lumigraph {' '.join(map(str, command))} ended with {code}")


def prepared(root: Path, notes: Path) -> None:
    """Have all of it written by a copy of this process."""
    from .watched import Limits, watch

    ended = watch(lambda: write_all(root) or 0, root, notes, Limits(seconds=580))
    if ended.code:
        raise RuntimeError(f"the files to begin with could not be made: {ended.said[-3000:]}")
