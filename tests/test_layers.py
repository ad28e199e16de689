"""What is known of each pixel beside its colour: every value to the bit, from memory as from a file, in batch and
photograph, in the house's units."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from captures import FOCAL, HEIGHT, WIDTH, Tiny, write_json, write_ngp, write_nsvf
from deep_files import write_exr, write_png16
from PIL import Image

from lumigraph import synthetic as procedural
from lumigraph.camera.lens import Pinhole
from lumigraph.color.blending import before, over
from lumigraph.datasets.images import ImageStore, Layer, LayerSource, resized
from lumigraph.datasets.scene import Photograph, Scene
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.files.readers import LISTED, NAMES
from lumigraph.opening import open_scene
from lumigraph.readers import READERS, assemble, multiscale
from lumigraph.readers.capture import Capture, PixelPlane, Shot
from lumigraph.synthetic import rendering

WHERE = pytest.mark.parametrize("memory", [None, 0], ids=["memory", "file"])
WALL = -3.0  # the plane x = WALL of the source's frame, which every camera's depth shows


@pytest.fixture(scope="module")
def tiny() -> Tiny:
    return Tiny()


def random(*shape: int, high: int = 65536, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, high, shape).astype(np.uint16)


def depth_of_wall(pose: np.ndarray) -> np.ndarray:
    """Millimetres along the optical axis to the plane x = WALL, 0 where no ray meets it within 60 units."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], -1) @ pose[:3, :3].T
    along = (WALL - pose[0, 3]) / rays[..., 0]
    return np.where((along > 0) & (along < 60), np.rint(1000 * along), 0).astype(np.uint16)


def with_depth(folder: Path, tiny: Tiny, masked: bool = False, **extra) -> Path:
    frames = tiny.frames("images/", ".png")
    for i, (frame, pose) in enumerate(zip(frames, tiny.poses, strict=True)):
        frame["depth_file_path"] = f"depth/{i}.png"
        write_png16(folder / f"depth/{i}.png", depth_of_wall(pose))
        if masked:
            frame["mask_path"] = "mask.png"
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[8:30, 4:40] = 255
    if masked:
        Image.fromarray(mask).save(folder / "mask.png")
    return write_ngp(folder, tiny, frames=frames, **extra)


def pixels_of(scene: Scene, batch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, row and column of each ray, by projecting it again."""
    image = batch.rays.image_index
    xy, _ = scene.cameras.project(batch.rays.at(torch.full((len(batch),), 2.0)), image)
    column, row = xy.floor().long().unbind(-1)
    return image.numpy(), row.numpy(), column.numpy()


@WHERE
@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
def test_positions_lead_to_every_value(memory, masked, tmp_path, generator):
    sizes = [(7, 5), (40, 30), (13, 64)]
    pictures = [random(h, w, 3, high=256).astype(np.uint8) for w, h in sizes]
    masks = [np.random.default_rng(i).random((h, w)) < 0.5 for i, (w, h) in enumerate(sizes)] if masked else None
    images = ImageStore.from_arrays(pictures, masks)
    if memory == 0:
        from test_scene import pictures as sources

        images = ImageStore.load(sources(pictures, masks), memory=0, cache=tmp_path)
    values = [random(h, w, 3, seed=i) for i, (w, h) in enumerate(sizes)]
    sources_of = [LayerSource(lambda i=i: values[i], f"values {i}") for i in range(3)]
    layer = Layer(images, sources_of, np.dtype(np.uint16), 3, "sRGB", 1 / 65535)
    choice = torch.tensor([0, 2])
    drawn = images.draw(2000, choice, generator, positions=True)
    assert drawn.position is not None
    found = layer.gathered(drawn.position, choice)
    x, y = drawn.xy.long().unbind(-1)
    expected = np.stack([values[i][v, u] for i, u, v in zip(drawn.image.tolist(), x, y, strict=True)])
    assert np.array_equal(found, expected)
    assert all(np.array_equal(layer.stored(i), values[i]) for i in range(3))
    if memory == 0:  # the file is there for the next to ask, and is never written to again
        again = Layer(images, [LayerSource(pytest.fail, f"values {i}") for i in range(3)], layer.dtype, 3, "sRGB")
        assert np.array_equal(again.stored(1), values[1])
        other = Layer(images, [LayerSource(lambda: values[0], "other"), None, None], np.dtype(np.float32), 3, "plain")
        assert np.array_equal(other.stored(0), values[0]) and np.isnan(other.stored(2)).all() and len(other) == 1


def test_a_layer_is_read_when_it_is_asked_for_and_counts_as_memory(tmp_path):
    reads: list[int] = []

    def read(i: int) -> np.ndarray:
        reads.append(i)
        return np.full((4, 6), i, np.float32)

    pictures = [np.zeros((4, 6, 3), np.uint8)] * 3
    images = ImageStore.from_arrays(pictures)
    images._memory, images.cache = 3 * 24 * 4 + 1, tmp_path
    first, second = (
        Layer(images, [LayerSource(lambda i=i: read(i)) for i in range(3)], np.dtype(np.float32), 1, "plain")
        for _ in range(2)
    )
    assert (first.stored(1) == 1).all() and (first.stored(1) == 1).all() and reads == [1]
    first.gathered(torch.tensor([0]), torch.tensor([0, 1]))
    assert sorted(reads) == [0, 1]
    assert (second.stored(2) == 2).all() and isinstance(second._values, np.memmap)  # no memory is left for it
    assert not isinstance(first._values, np.memmap) and not list(tmp_path.iterdir())  # a nameless file goes at once


@pytest.mark.parametrize(("memory", "channels"), [(None, 1), (None, 3), (0, 3), (0, 4)])
def test_a_scene_of_16_bits_opens_with_all_of_them(memory, channels, tiny, tmp_path, generator):
    write_ngp(tmp_path / "scene", tiny)
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    values = [random(*shape, seed=i) for i in range(tiny.count)]
    for name, picture in zip(tiny.names, values, strict=True):
        write_png16(tmp_path / "scene/images" / name, picture)
    colours = [np.repeat(v[..., None], 3, -1) if channels == 1 else v for v in values]
    scene = open_scene(tmp_path / "scene", memory=memory, cache=tmp_path / "cache")
    assert list(scene.layers) == ["colours"] and scene.images.shuffled == (memory == 0)
    for i in (0, 7):
        assert np.array_equal(scene.layers["colours"].stored(i), colours[i])
        seen = scene.photograph(i, layers=["colours"]).extra["colours"]
        assert torch.equal((seen.double() * 65535).round(), torch.from_numpy(colours[i].astype(np.float64)))
        assert np.array_equal(scene.images[i], np.rint(colours[i] / 257).astype(np.uint8))  # in eight bits as well
    batch = scene.sample_rays(500, generator, layers=["colours"])
    expected = np.stack(colours)[pixels_of(scene, batch)].astype(np.float64)
    assert torch.equal((batch.extra["colours"].double() * 65535).round(), torch.from_numpy(expected))
    assert (batch.extra["colours"][:, :3] - batch.rgb).abs().max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize(("memory", "dtype"), [(None, np.float16), (0, np.float32)])
def test_exr_keeps_its_light(memory, dtype, tiny, tmp_path, generator):
    names = [f"view_{i}.exr" for i in range(tiny.count)]
    light = [(8 * np.random.default_rng(i).random((HEIGHT, WIDTH, 3)) ** 4).astype(dtype) for i in range(tiny.count)]
    frames = [{**f, "file_path": f"images/{n}"} for f, n in zip(tiny.frames("", ".png"), names, strict=True)]
    for name, values in zip(names, light, strict=True):
        write_exr(tmp_path / "scene/images" / name, values)
    about = {"fl_x": FOCAL, "aabb_scale": 4, "frames": frames}
    write_json(tmp_path / "scene/transforms.json", about)
    scene = open_scene(tmp_path / "scene", memory=memory, cache=tmp_path / "cache")
    assert list(scene.layers) == ["raw"] and scene.layers["raw"].dtype == dtype
    assert all(np.array_equal(scene.layers["raw"].stored(i), light[i]) for i in range(tiny.count))
    batch = scene.sample_rays(500, generator, layers=["raw"])
    assert torch.equal(batch.extra["raw"], torch.from_numpy(np.stack(light)[pixels_of(scene, batch)]).float())
    light_1 = light[1].astype(np.float64).clip(1e-9, 1)
    encoded = np.where(light_1 < 0.0031308, 12.92 * light_1, 1.055 * light_1 ** (1 / 2.4) - 0.055)
    assert np.abs(scene.images[1].numpy() - 255 * encoded).max() < 0.501
    half = open_scene(tmp_path / "scene", downscale=2)
    means = light[2].astype(np.float64).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean((1, 3))
    np.testing.assert_allclose(half.layers["raw"].stored(2), means, rtol=2e-3)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("channels", [1, 3])
def test_tiff_keeps_its_bits_and_is_turned(dtype, channels, tiny, tmp_path):
    stored = random(WIDTH, HEIGHT, channels)[..., slice(None) if channels > 1 else 0].astype(dtype)  # on its side
    names = [f"view_{i}.tif" for i in range(tiny.count)]
    frames = [{**f, "file_path": f"images/{n}"} for f, n in zip(tiny.frames("", ".png"), names, strict=True)]
    write_ngp(tmp_path, tiny, frames=frames)
    for name in names:
        kind = "rgb" if channels == 3 else "minisblack"
        tifffile.imwrite(tmp_path / "images" / name, stored, photometric=kind, extratags=[(274, "H", 1, 6, True)])
    scene = open_scene(tmp_path)
    ((name, layer),) = scene.layers.items()
    assert name == ("raw" if dtype == np.float32 else "colours")
    upright = np.rot90(stored, -1)
    assert np.array_equal(layer.stored(3), upright if channels == 3 else np.repeat(upright[..., None], 3, -1))


def test_light_in_16_bits_is_raw(tiny, tmp_path):
    write_ngp(tmp_path, tiny)
    for i, name in enumerate(tiny.names):
        write_png16(tmp_path / "images" / name, random(HEIGHT, WIDTH, 3, seed=i), gamma=100_000)
    scene = open_scene(tmp_path)
    assert list(scene.layers) == ["raw"] and np.array_equal(scene.layers["raw"].stored(4), random(36, 48, 3, seed=4))
    light = scene.photograph(4, layers=["raw"]).extra["raw"]
    assert (light - torch.from_numpy(random(36, 48, 3, seed=4) / 65535).float()).abs().max() < 1e-6


def test_premultiplied_light_comes_straight(tiny, tmp_path):
    light = np.zeros((16, 16, 4), np.float32)
    light[..., :3], light[..., 3] = 0.25, 0.5
    light[0, 0] = 0
    write_exr(tmp_path / "one.exr", light)
    scene = open_scene(tmp_path / "one.exr")  # a picture alone, in eight bits
    assert scene.images[0][5, 5].tolist() == [188, 188, 188, 128] and scene.images[0][0, 0, 3] == 0


@pytest.mark.parametrize(("memory", "masked"), [(None, False), (0, True)], ids=["whole", "in a file, masked"])
def test_a_scene_with_depth_opens_with_all_values(memory, masked, tiny, tmp_path, generator):
    folder = with_depth(tmp_path / "scene", tiny, masked)
    scene = open_scene(folder, memory=memory, cache=tmp_path / "cache")
    stored = np.stack([depth_of_wall(pose) for pose in tiny.poses])
    assert all(np.array_equal(scene.layers["depth"].stored(i), stored[i]) for i in range(10))
    unit = scene.frame.to_source.scale
    for i in (1, 6):
        photograph = scene.photograph(i, layers=["depth"])
        depth = photograph.extra["depth"].double()
        assert torch.equal(depth.isnan(), torch.from_numpy(stored[i] == 0))
        camera = photograph.camera
        rays = camera.rays(camera.pixels())
        along = (rays.directions @ camera.forward[0]).view(HEIGHT, WIDTH).double()
        back = (depth * along * unit * 1000).round().nan_to_num(0)
        assert torch.equal(back, torch.from_numpy(stored[i].astype(np.float64)))  # every number, to the bit
        points = rays.at(depth.float().reshape(-1))
        points = points @ torch.tensor(scene.frame.source_from_scene)[:3, :3].T
        points = points + torch.tensor(scene.frame.source_from_scene)[:3, 3]
        assert (points[:, 0] - WALL).nan_to_num(0).abs().max() < 0.06  # a millimetre, seen at a grazing angle
    batch = scene.sample_rays(400, generator, layers=["depth"])
    assert np.array_equal(batch.extra["depth"].isnan().numpy(), stored[pixels_of(scene, batch)] == 0)
    image, row, column = pixels_of(scene, batch)
    assert not masked or ((row >= 8) & (row < 30) & (column >= 4) & (column < 40)).all()
    photographs = [scene.photograph(i, layers=["depth"]).extra["depth"] for i in range(10)]
    expected = torch.stack([photographs[i][v, u] for i, v, u in zip(image, row, column, strict=True)])
    torch.testing.assert_close(batch.extra["depth"], expected, equal_nan=True, rtol=1e-6, atol=0)
    assert scene.sample_rays(9, generator).extra == {} and batch.to("cpu").extra.keys() == {"depth"}


def test_depth_is_picked_and_not_averaged(tiny, tmp_path):
    half = open_scene(with_depth(tmp_path, tiny), downscale=2)
    for i in range(10):
        whole, found = depth_of_wall(tiny.poses[i]), half.layers["depth"].stored(i)
        squares = whole.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).swapaxes(1, 2).reshape(HEIGHT // 2, WIDTH // 2, 4)
        assert (found[..., None] == squares).any(-1).all()  # one of the four, never a mixture
        assert np.array_equal(found > 0, (squares > 0).any(-1))  # known wherever one of them is
        centre = squares[..., 3]
        assert np.array_equal(found[centre > 0], centre[centre > 0])
    scales = multiscale(open_scene(tmp_path), 2)
    assert np.array_equal(scales.layers["depth"].stored(13), half.layers["depth"].stored(3))
    reduced = open_scene(tmp_path).photograph(3, layers=["depth"]).reduced(2).extra["depth"]
    assert torch.equal(reduced.isnan(), torch.from_numpy(half.layers["depth"].stored(3) == 0))


def test_units_of_depth_are_what_the_file_says(tiny, tmp_path):
    plain = open_scene(with_depth(tmp_path / "a", tiny)).photograph(2, layers=["depth"]).extra["depth"]
    double = open_scene(with_depth(tmp_path / "b", tiny, depth_unit_scale_factor=2e-3))
    torch.testing.assert_close(double.photograph(2, layers=["depth"]).extra["depth"], 2 * plain, equal_nan=True)
    along = open_scene(with_depth(tmp_path / "c", tiny, is_euclidean_depth=True))
    photograph = along.photograph(2, layers=["depth"])
    camera = photograph.camera
    cosine = (camera.rays(camera.pixels()).directions @ camera.forward[0]).view(HEIGHT, WIDTH)
    torch.testing.assert_close(photograph.extra["depth"] / cosine, plain, equal_nan=True, rtol=1e-5, atol=0)


def test_what_a_frame_names_is_read_and_what_is_gone_is_said(tiny, tmp_path):
    frames = tiny.frames("images/", ".png")
    labels = random(HEIGHT, WIDTH, high=40).astype(np.uint8)
    Image.fromarray(labels).save(tmp_path / "labels.png")
    np.save(tmp_path / "depth.npy", np.full((HEIGHT // 2, WIDTH // 2), 2000.0))
    write_exr(tmp_path / "far.exr", np.full((HEIGHT, WIDTH, 3), 1e10, np.float32))
    for frame in frames:
        frame["depth_file_path"] = "depth.npy"
    frames[1] |= {"semantics_path": "labels.png", "exposure": 0.5, "boxes": [[1, 2, 3, 4], [5, 6, 7, 8]]}
    frames[2] |= {"labels_file_path": "labels_of_2.png", "boxes": [[9, 9, 9, 9]], "time": 0.25}
    write_ngp(tmp_path, tiny, frames=frames)
    with pytest.warns(LumigraphWarning, match=r"labels_of_2\.png"):
        scene = open_scene(tmp_path)
    assert len(scene.layers["labels"]) == 1 and len(scene.layers["depth"]) == 10
    known, other = (scene.photograph(i, layers=["labels", "depth"]).extra for i in (1, 2))
    assert torch.equal(known["labels"], torch.from_numpy(labels.astype(np.int64))) and (other["labels"] == -1).all()
    centre = known["depth"][HEIGHT // 2, WIDTH // 2] * scene.frame.to_source.scale
    assert known["depth"].shape == (HEIGHT, WIDTH) and abs(float(centre) - 2) < 1e-3  # enlarged by its nearest pixels
    assert scene.about["exposure"].isnan().sum() == 9 and scene.about["exposure"][1] == 0.5
    assert scene.about["boxes"].shape == (10, 2, 4) and scene.about["boxes"][2, 0].tolist() == [9, 9, 9, 9]
    assert scene.about["time"][2] == 0.25 and scene.about["time"][0].isnan()
    for frame in frames:
        frame["depth_file_path"] = "far.exr"
    write_ngp(tmp_path / "far", tiny, frames=[{**f, "depth_file_path": "../far.exr"} for f in tiny.frames("images/")])
    assert open_scene(tmp_path / "far").photograph(0, layers=["depth"]).extra["depth"].isinf().all()


def test_faults_of_layers_are_told(tiny, tmp_path):
    frames = [{**f, "depth_file_path": "depth.png"} for f in tiny.frames("images/", ".png")]
    write_ngp(tmp_path, tiny, frames=frames)
    write_png16(tmp_path / "depth.png", random(20, 20))
    scene = open_scene(tmp_path)
    with pytest.raises(LumigraphError, match=r"depth\.png.*its shape 20x20 is not the photograph's 48x36"):
        scene.photograph(0, layers=["depth"])
    with pytest.raises(LumigraphError, match="no flow beside its photographs, only depth"):
        scene.photograph(0, layers=["flow"])
    Image.fromarray(random(HEIGHT, WIDTH, 3, high=256).astype(np.uint8)).save(tmp_path / "depth.png")
    with pytest.raises(LumigraphError, match=r"depth\.png.*one number to a pixel"):
        open_scene(tmp_path).photograph(0, layers=["depth"])
    (tmp_path / "depth.png").write_bytes(b"no picture")
    with pytest.raises(LumigraphError, match=r"depth\.png cannot be read as an image"):
        open_scene(tmp_path)
    write_ngp(tmp_path / "mixed", tiny)
    write_png16(tmp_path / "mixed/images" / tiny.names[0], random(HEIGHT, WIDTH, 3))
    with pytest.warns(LumigraphWarning, match="colours is there for 1 of 10 photographs only"):
        assert not open_scene(tmp_path / "mixed").layers
    lens = Pinhole(torch.tensor([[FOCAL, FOCAL]]), torch.tensor([[24.0, 18.0]]))
    shots = [
        Shot(n, p[:3], lens, None, image, planes={"flow": PixelPlane(np.zeros((36, 48, 2 + i % 2)), "pixels")})
        for i, (n, p, image) in enumerate(zip(tiny.names, tiny.poses, tiny.pictures, strict=True))
    ]
    with pytest.raises(LumigraphError, match="flow of view_01.png is of another kind than that of view_00.png"):
        assemble(Capture("made", shots))


def test_tum(tiny, tmp_path):
    rgb, depth, truth = ["# colour images"], ["# depth maps"], ["# trajectory"]
    stored = [random(HEIGHT, WIDTH, seed=i) for i in range(10)]
    for i, pose in enumerate(tiny.poses):
        moment = 1305031102.175304 + 0.1 * i
        rgb.append(f"{moment:.6f} rgb/{i}.png")
        depth.append(f"{moment + 0.004:.6f} depth/{i}.png")
        if i != 9:
            truth.append(f"{moment - 0.003:.4f} " + " ".join(f"{x:.9f}" for x in (*pose[:3, 3], *quaternion(pose))))
        write_png16(tmp_path / f"depth/{i}.png", stored[i])
        (tmp_path / "rgb").mkdir(exist_ok=True)
        Image.fromarray(tiny.pictures[i]).resize((640, 480), Image.Resampling.NEAREST).save(tmp_path / f"rgb/{i}.png")
    for name, lines in (("rgb", rgb), ("depth", depth), ("groundtruth", truth)):
        (tmp_path / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "camera.txt").write_text("500 510 319.5 239.5\n")
    scene = open_scene(tmp_path)
    assert len(scene) == 9 and scene.cameras.lens.focal[0].tolist() == [500, 510]  # the last has no pose of its moment
    assert scene.cameras.lens.centre[0].tolist() == [320, 240]
    assert scene.about["time"].shape == (9,)
    back = scene.cameras.transformed(torch.tensor(scene.frame.source_from_scene))
    torch.testing.assert_close(back.pose[4], torch.from_numpy(tiny.poses[4][:3]).float(), atol=1e-4, rtol=0)
    layer = scene.layers["depth"]
    assert np.array_equal(layer.stored(4)[::13, ::13], resized(stored[4], (640, 480), "z-depth")[::13, ::13])
    middle = float(scene.photograph(4, layers=["depth"]).extra["depth"][240, 320]) * scene.frame.to_source.scale
    assert abs(middle - layer.stored(4)[240, 320] / 5000) < 2e-5
    (tmp_path / "camera.txt").write_text("500 510\n")
    with pytest.raises(LumigraphError, match=r"camera\.txt is no camera"):
        open_scene(tmp_path)
    (tmp_path / "groundtruth.txt").write_text("1 2 3\n")
    with pytest.raises(LumigraphError, match=r"groundtruth\.txt holds '1 2 3'"):
        open_scene(tmp_path)


def quaternion(pose: np.ndarray) -> list[float]:
    from lumigraph.geometry import to_quaternion

    w, x, y, z = to_quaternion(torch.from_numpy(pose[:3, :3].copy())).tolist()
    return [x, y, z, w]


def test_seven_scenes(tiny, tmp_path):
    stored = [depth_of_wall(pose) for pose in tiny.poses]
    for i, pose in enumerate(tiny.poses):
        Image.fromarray(tiny.pictures[i]).save(tmp_path / f"frame-{i:06d}.color.png")
        write_png16(tmp_path / f"frame-{i:06d}.depth.png", stored[i])
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", pose if i != 7 else np.full((4, 4), -np.inf))
    np.savetxt(tmp_path / "camera-intrinsics.txt", [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    scene = open_scene(tmp_path)
    assert len(scene) == 9 and "frame-000007.color.png" not in scene.names
    assert np.array_equal(scene.layers["depth"].stored(8), stored[9])
    assert scene.points is not None and len(scene.points) > 1000  # what depth says of where things are
    matrix = torch.tensor(scene.frame.source_from_scene)
    on_wall = scene.points @ matrix[:3, :3].T + matrix[:3, 3]
    assert (on_wall[:, 0] - WALL).abs().max() < 0.06
    first = tiny.pictures[0].reshape(-1, 3).tolist()
    assert scene.point_colours is not None and scene.point_colours[0].tolist() in first
    (tmp_path / "frame-000003.pose.txt").write_text("1 2 3")
    with pytest.raises(LumigraphError, match=r"frame-000003\.pose\.txt holds no 4x4 matrix"):
        open_scene(tmp_path)


def test_pictures_poses_and_a_pinhole_in_text_files(tiny, tmp_path):
    """Layouts of SRN, of NSVF and of NeRF++, with a camera for each picture and a folder for each split."""
    scene = open_scene(write_nsvf(tmp_path / "nsvf", tiny))
    assert len(scene.splits["test"]) == len(tiny.poses) // 2 and scene.names[0].startswith("rgb/0_")
    plus = write_nsvf(tmp_path / "plus", tiny, split=False)
    other = tmp_path / "other"
    for i, pose in enumerate(sorted((plus / "pose").iterdir())):
        part = other / ("test" if i == 3 else "train")
        for kind, text in (
            ("pose", pose.read_text()),
            ("intrinsics", f"{FOCAL} 0 {WIDTH / 2} 0 0 {FOCAL} {HEIGHT / 2}"),
        ):
            (part / kind).mkdir(parents=True, exist_ok=True)
            (part / kind / pose.name).write_text(text + (" 0 0 0 1 0 0 0 0 1" if kind == "intrinsics" else ""))
        (part / "rgb").mkdir(exist_ok=True)
        (plus / "rgb" / f"{pose.stem}.png").rename(part / "rgb" / f"{pose.stem}.png")
    found = open_scene(other)
    assert len(found) == len(scene) == len(tiny.poses) and len(found.splits["test"]) == 1
    for one in (scene, found):
        matrix = one.frame.source_from_scene
        for i, name in enumerate(one.names):
            number = int("".join(x for x in name.rpartition("/")[2].partition(".")[0][-4:] if x.isdigit()))
            centre = one.cameras.pose[i, :3, 3].double() @ torch.as_tensor(matrix)[:3, :3].T.double()
            centre = centre + torch.as_tensor(matrix)[:3, 3]
            np.testing.assert_allclose(centre, tiny.poses[number][:3, 3], atol=1e-4)
            assert one.cameras.lens[i].focal[0].tolist() == pytest.approx([FOCAL, FOCAL])
    (other / "test" / "intrinsics").rename(other / "test" / "k")
    (other / "train" / "intrinsics" / next((other / "train" / "pose").iterdir()).name).write_text("1 2")
    with pytest.raises(LumigraphError, match="holds neither a matrix of 4x4 or 3x3 nor f cx cy"):
        open_scene(other)


def test_procedural_scenes_give_all_they_know_to_those_who_ask(tmp_path, monkeypatch, generator):
    traced = []
    real = rendering.trace
    monkeypatch.setattr(procedural, "trace", lambda *a, **k: traced.append(1) or real(*a, **k))
    scene = open_scene("procedural:still-life,size=24,views=4,seed=2")
    assert set(scene.layers) == {"depth", "normals", "labels", "albedo"} and not traced
    scene.sample_rays(10, generator)
    assert not traced
    stage = procedural.scenes.stage("still-life", size=24, views=4, seed=2)
    truth = rendering.render(stage.world, stage.cameras["train"][1])
    index = int(scene.splits["train"][1])
    found = scene.photograph(index, layers=list(scene.layers)).extra
    assert len(traced) == 4  # of this photograph alone
    assert torch.equal(found["labels"], truth.extra["ids"]) and torch.equal(found["normals"], truth.extra["normals"])
    assert torch.equal(found["albedo"], truth.extra["albedo"]) and scene.layers["labels"].names == tuple(
        stage.world.names
    )
    torch.testing.assert_close(found["depth"] * scene.frame.to_source.scale, truth.depth, rtol=1e-5, atol=0)
    assert found["depth"].isinf().any()
    procedural.write_blender(stage, tmp_path / "toys")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = open_scene(tmp_path / "toys")
    seen = again.photograph(int(again.splits["train"][1]), layers=["depth", "labels", "normals"])
    assert torch.equal(seen.extra["labels"], truth.extra["ids"])
    assert np.array_equal(again.layers["depth"].stored(int(again.splits["train"][1])), truth.depth.numpy())
    torch.testing.assert_close(seen.extra["depth"] * again.frame.to_source.scale, truth.depth, rtol=1e-5, atol=0)
    turn = torch.tensor(again.frame.source_from_scene)[:3, :3] / again.frame.to_source.scale
    torch.testing.assert_close(seen.extra["normals"] @ turn.T, truth.extra["normals"], rtol=0, atol=1e-5)


def test_photographs_reduce_their_layers():
    camera = open_scene("procedural:still-life,size=24,views=2").cameras[0]
    labels = torch.arange(24 * 24).view(24, 24)
    depth = torch.where(labels % 2 == 1, torch.nan, labels.float())
    light = torch.rand(24, 24, 3)
    light[0, 0] = torch.nan
    flow = torch.full((24, 24, 2), 6.0)
    whole = Photograph(camera, torch.rand(24, 24, 3), None, None)
    extra = {"labels": labels, "depth": depth, "raw": light, "flow": flow}
    found = replace(whole, extra=extra).reduced(3).extra
    assert torch.equal(found["labels"], labels[1::3, 1::3])  # a square of three has a pixel in its middle
    known = ~depth[1::3, 1::3].isnan()
    assert torch.equal(found["depth"][known], depth[1::3, 1::3][known]) and not found["depth"].isnan().any()
    assert ((found["depth"] - found["labels"]).abs()[~known] <= 24).all() and (found["flow"] == 2).all()
    squares = light.view(8, 3, 8, 3, 3).nanmean((1, 3))
    torch.testing.assert_close(found["raw"], squares, rtol=1e-5, atol=1e-6)


def test_alpha_weighs_averages():
    values = np.zeros((2, 2, 4), np.uint16)
    values[0, 0], values[1, 1] = (60000, 30000, 0, 65535), (10000, 0, 0, 0)
    assert resized(values, (1, 1), "sRGB").tolist() == [[[60000, 30000, 0, 16384]]]
    assert resized(values.astype(np.float32), (1, 1), "linear premultiplied").tolist() == [[[17500, 7500, 0, 16383.75]]]


def test_alpha_over_a_background_means_one_thing():
    rgb, alpha, behind = torch.rand(5, 3), torch.rand(5), torch.rand(3)
    expected = alpha[:, None] * rgb + (1 - alpha[:, None]) * behind
    torch.testing.assert_close(before(rgb, alpha, behind), expected)
    torch.testing.assert_close(before(rgb, alpha, tuple(behind.tolist())), expected)
    torch.testing.assert_close(over(alpha[:, None] * rgb, alpha, behind), expected)
    assert before(rgb, None, behind) is rgb


def test_every_reader_is_listed_once():
    assert tuple(READERS) == NAMES and LISTED.endswith(f" or {NAMES[-1]}")
    for reader in READERS.values():
        assert reader.EXPECTED_FILES and callable(reader.recognises) and callable(reader.read)
