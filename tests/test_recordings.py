"""Recordings of depth cameras and of rigs, as apps and benchmarks write them: cameras, moments, depth and splits."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
from budgets import budget
from captures import FOCAL, HEIGHT, WIDTH, Tiny, write_json, write_llff
from PIL import Image
from scipy.spatial.transform import Rotation

from lumigraph.camera.lens import Fisheye
from lumigraph.errors import LumigraphError
from lumigraph.opening import open_scene, read_capture
from lumigraph.readers import choose_reader, rig
from lumigraph.sfm import rig as sfm_rig

pytestmark = budget("capture", 5)
CAMERAS, MOMENTS = 4, 3
MATRIX = [[FOCAL, 0, 24], [0, FOCAL, 18], [0, 0, 1]]


@pytest.fixture(scope="module")
def tiny() -> Tiny:
    return Tiny(count=6)


def save(tiny: Tiny, number: int, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(tiny.pictures[number]).save(path)


def film(path: Path, frames: int = 4) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for i in range(frames):
            grey = np.full((HEIGHT, WIDTH, 3), 40 * i, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(grey, format="rgb24")))
        container.mux(stream.encode())


def write_table(folder: Path, tiny: Tiny) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "poses_bounds.npy", np.load(write_llff(folder / "other", tiny) / "poses_bounds.npy")[:CAMERAS])


def neural_3d_video(folder: Path, tiny: Tiny, place: str = "cam{:02}/images/{:04}.png") -> None:
    write_table(folder, tiny)
    for camera in range(CAMERAS):
        for moment in range(MOMENTS):
            save(tiny, camera, folder / place.format(camera, moment))


def immersive(folder: Path, tiny: Tiny) -> None:
    models = []
    for camera in range(CAMERAS):
        pose, name = tiny.poses[camera], f"camera_{camera + 1:04}"
        turn = Rotation.from_matrix(pose[:3, :3].T).as_rotvec().tolist()
        about = {"name": name, "position": pose[:3, 3].tolist(), "orientation": turn, "projection_type": "fisheye"}
        about |= {"width": WIDTH, "height": HEIGHT, "focal_length": FOCAL, "principal_point": [24.0, 18.0]}
        models.append(about | {"radial_distortion": [0.1, 0.01, 0.0]})
        for moment in range(MOMENTS):
            save(tiny, camera, folder / name / f"{moment}.png")
    write_json(folder / "models.json", models)


def easymocap(folder: Path, tiny: Tiny) -> None:
    intrinsics, extrinsics = ["%YAML:1.0", "---"], ["%YAML:1.0", "---"]

    def add(lines: list[str], name: str, values: np.ndarray) -> None:
        rows, columns = np.atleast_2d(values).shape
        head = f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
        lines.append(f"{head}   data: [{', '.join(map(str, np.ravel(values).tolist()))}]")

    for camera in range(CAMERAS):
        matrix = np.linalg.inv(tiny.poses[camera])
        add(intrinsics, f"K_{camera:02}", np.array(MATRIX))
        add(intrinsics, f"dist_{camera:02}", np.zeros(5))
        add(extrinsics, f"R_{camera:02}", Rotation.from_matrix(matrix[:3, :3]).as_rotvec())
        add(extrinsics, f"T_{camera:02}", matrix[:3, 3])
        for moment in range(MOMENTS):
            save(tiny, camera, folder / "images" / f"{camera:02}" / f"{moment:06}.jpg")
    (folder / "intri.yml").write_text("\n".join(intrinsics))
    (folder / "extri.yml").write_text("\n".join(extrinsics))


def technicolor(folder: Path, tiny: Tiny) -> None:
    lines = ["f u0 v0 ar sk d1 d2 qw qx qy qz tx ty tz"]
    for camera in range(CAMERAS):
        matrix = np.linalg.inv(tiny.poses[camera])
        x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        lines.append(" ".join(map(str, [FOCAL, 24, 18, 1, 0, 0, 0, w, x, y, z, *matrix[:3, 3]])))
        for moment in range(MOMENTS):
            save(tiny, camera, folder / f"Train_undist_{moment:05}_{camera:02}.png")
    (folder / "cameras_parameters.txt").write_text("\n".join(lines))


def panoptic(folder: Path, tiny: Tiny) -> None:
    for split, cameras in (("train", range(1, CAMERAS)), ("test", range(1))):
        said = {"w": WIDTH, "h": HEIGHT, "fn": [], "k": [], "w2c": [], "cam_id": []}
        for moment in range(MOMENTS):
            said["fn"].append([f"{camera}/{moment:06}.jpg" for camera in cameras])
            said["k"].append([MATRIX] * len(cameras))
            said["w2c"].append([np.linalg.inv(tiny.poses[camera]).tolist() for camera in cameras])
            for camera in cameras:
                save(tiny, camera, folder / "ims" / f"{camera}" / f"{moment:06}.jpg")
        write_json(folder / f"{split}_meta.json", said)


@pytest.mark.parametrize("write", [neural_3d_video, immersive, easymocap, technicolor, panoptic])
def test_rigs_of_benchmarks_have_cameras_moments_and_a_held_out_camera(write, tiny, tmp_path):
    write(tmp_path, tiny)
    assert choose_reader(tmp_path) is rig
    found = read_capture(tmp_path)
    assert len(found.shots) == CAMERAS * MOMENTS and {shot.time for shot in found.shots} == {0.0, 1.0, 2.0}
    for shot in found.shots:
        camera = next(i for i in range(CAMERAS) if np.allclose(tiny.poses[i][:3], shot.pose, atol=1e-5))
        assert np.allclose(shot.lens.focal, FOCAL) and np.allclose(shot.lens.centre, [24, 18])
        with Image.open(shot.image[1]) as image:
            assert abs(float(np.asarray(image)[..., 2].mean()) - 10 * camera) < 3, "the camera's own picture"
        assert isinstance(shot.lens, Fisheye) == (write is immersive)
        if write is not easymocap and write is not technicolor:
            assert shot.split == ("test" if camera == 0 else "train")
    assert open_scene(tmp_path).frame.times == (0.0, 2.0)


def test_a_table_of_another_number_of_cameras_is_refused(tiny, tmp_path):
    neural_3d_video(tmp_path, tiny)
    save(tiny, 0, tmp_path / "cam09" / "0000.png")
    with pytest.raises(LumigraphError, match="4 cameras, and there are 5"):
        read_capture(tmp_path)


@pytest.mark.parametrize("kind", ["table", "easymocap"])
def test_films_of_a_rig_get_the_published_poses(kind, tiny, tmp_path):
    if kind == "table":
        write_table(tmp_path, tiny)
    else:
        easymocap(tmp_path / "whole", tiny)
        for name in ("intri.yml", "extri.yml"):
            (tmp_path / "whole" / name).rename(tmp_path / name)
    for camera in range(CAMERAS):
        film(tmp_path / ("" if kind == "table" else "videos") / f"{'cam' if kind == 'table' else ''}{camera:02}.mp4")
    with pytest.raises(LumigraphError, match="4 films of cameras whose poses are in .*--moving"):
        read_capture(tmp_path)
    assert sfm_rig.is_rig(tmp_path)
    sfm_rig.capture_rig(tmp_path, tmp_path / "scene", sfm_rig.MotionOptions(frames=2, moving=True))
    shots = read_capture(tmp_path / "scene").shots
    assert len(shots) == 2 * CAMERAS
    assert all(any(np.allclose(shot.pose, pose[:3], atol=1e-5) for pose in tiny.poses) for shot in shots)


def test_other_views_of_a_moving_scene_are_named(tiny, tmp_path):
    write_llff(tmp_path, tiny)
    (tmp_path / "mv_images").mkdir()
    found = read_capture(tmp_path)
    assert [shot.time for shot in found.shots] == [0, 1, 2, 3, 4, 5] and "mv_images" in found.notes[0]


# One moving camera


@pytest.mark.parametrize("inside", [True, False])
def test_odometry_of_kitti(inside, tiny, tmp_path):
    folder = tmp_path / "sequences" / "07"
    for i in range(6):
        save(tiny, i, folder / "image_2" / f"{i:06}.png")
    projections = [f"P{i}: 60 0 24 {-6.0 * i} 0 60 18 0 0 0 1 0" for i in range(4)]
    (folder / "calib.txt").write_text("\n".join(projections))
    (folder / "times.txt").write_text("\n".join(f"{0.1 * i:e}" for i in range(6)))
    poses = folder / "poses.txt" if inside else tmp_path / "poses" / "07.txt"
    poses.parent.mkdir(exist_ok=True)
    poses.write_text("\n".join(" ".join(map(str, pose[:3].ravel())) for pose in tiny.poses))
    shots = read_capture(folder).shots
    assert [shot.time for shot in shots] == pytest.approx([0.1 * i for i in range(6)])
    for shot, pose in zip(shots, tiny.poses, strict=True):
        np.testing.assert_allclose(shot.pose[:, :3], pose[:3, :3], atol=1e-9)
        np.testing.assert_allclose(shot.pose[:, 3], pose[:3, 3] + 0.2 * pose[:3, 0], atol=1e-9)  # 12 / 60 to the right


def stray(folder: Path, tiny: Tiny, header: bool, suffix: str) -> None:
    film(folder / "rgb.mp4", 6)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"] if header else []
    for i, pose in enumerate(tiny.poses):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        rows.append(", ".join(map(str, ([0.1 * i, i] if header else []) + numbers)))
        depth, sure = np.full((18, 24), 2000, np.uint16), np.full((18, 24), 2, np.uint8)
        sure[:9] = 0
        for kind, values in (("depth", depth), ("confidence", sure)):
            (folder / kind).mkdir(exist_ok=True)
            path = folder / kind / f"{i:06}.png"
            np.save(path.with_suffix(".npy"), values) if kind == "depth" and suffix == ".npy" else Image.fromarray(
                values
            ).save(path)
    (folder / "odometry.csv").write_text("\n".join(rows))
    np.savetxt(folder / "camera_matrix.csv", MATRIX, delimiter=",")


@pytest.mark.parametrize(("header", "suffix"), [(True, ".png"), (False, ".npy")])
def test_recordings_of_stray_scanner(header, suffix, tiny, tmp_path):
    stray(tmp_path / "scan", tiny, header, suffix)
    with pytest.raises(LumigraphError, match="lumigraph capture"):
        read_capture(tmp_path / "scan")
    assert sfm_rig.is_recorded(tmp_path / "scan")
    sfm_rig.capture_recorded(tmp_path / "scan", tmp_path / "scene", 3)
    scene = open_scene(tmp_path / "scene")
    shots = read_capture(tmp_path / "scene").shots
    assert [shot.name for shot in shots] == ["rgb/000000", "rgb/000002", "rgb/000005"]
    for shot, number in zip(shots, (0, 2, 5), strict=True):
        np.testing.assert_allclose(shot.pose, tiny.poses[number][:3], atol=1e-9)
        with Image.open(shot.image[1]) as image:
            assert abs(float(np.asarray(image).mean()) - 40 * number) < 6
    values = shots[0].planes["depth"].values()
    assert values[0, 0] == 0 and values[-1, 0] == 2000 and "depth" in scene.layers


def recorded(folder: Path, tiny: Tiny, colour: str, depth: str) -> Path:
    for i in range(6):
        save(tiny, i, folder / colour.format(i))
        path = folder / depth.format(i)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.full((HEIGHT, WIDTH), 2000 + i, np.uint16)).save(path)
    return folder


LAYOUTS = [
    ("color/{}.png", "depth/{}.png"),
    ("rgb/{:.4f}1.png", "depth/{:.4f}3.png"),
    ("image/a{:03}.png", "depth/b{:03}.png"),
    ("frame-{:06}.color.png", "frame-{:06}.depth.png"),
]


@pytest.mark.parametrize(("colour", "depth"), LAYOUTS)
def test_colours_and_depth_without_poses_are_for_tracking(colour, depth, tiny, tmp_path):
    recorded(tmp_path, tiny, colour, depth)
    with pytest.raises(LumigraphError, match=r"write .*camera\.txt with fx fy cx cy.*lumigraph track"):
        read_capture(tmp_path)
    (tmp_path / "camera.txt").write_text(f"{FOCAL} {FOCAL} 23.5 17.5 5000")
    with pytest.raises(LumigraphError, match="lumigraph track splat-slam"):
        open_scene(tmp_path)
    scene = open_scene(tmp_path, unposed={})
    assert "true_pose" not in scene.about and len(scene.names) == 6
    for i, shot in enumerate(read_capture(tmp_path).shots):
        plane = shot.planes["depth"]
        assert plane.scale == pytest.approx(1 / 5000) and np.allclose(shot.lens.centre, [24, 18])
        with Image.open(plane.values) as image:
            assert int(np.asarray(image)[0, 0]) == 2000 + i


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("intrinsic/intrinsic_color.txt", "60 0 23.5 0\n0 60 17.5 0\n0 0 1 0\n0 0 0 1\n"),
        ("K.txt", "60,0,23.5\n0,60,17.5\n0,0,1"),
        ("camera_intrinsic.json", json.dumps({"intrinsic_matrix": [60, 0, 0, 0, 60, 0, 23.5, 17.5, 1]})),
        ("intrinsics.json", json.dumps({"fx": 60, "fy": 60, "ppx": 23.5, "ppy": 17.5, "depth_scale": 1000})),
        ("cam_params.json", json.dumps({"camera": {"fx": 60, "fy": 60, "cx": 23.5, "cy": 17.5, "scale": 1000}})),
    ],
)
def test_cameras_of_recordings(name, text, tiny, tmp_path):
    recorded(tmp_path, tiny, *LAYOUTS[0])
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    shot = read_capture(tmp_path).shots[0]
    assert np.allclose(shot.lens.focal, 60) and np.allclose(shot.lens.centre, [24, 18])
    assert shot.planes["depth"].scale == pytest.approx(1e-3)
