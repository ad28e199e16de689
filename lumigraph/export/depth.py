"""Depth maps of photographs as a scene on disk: flat pictures, 16-bit depth, cameras, and a contact sheet."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ..camera import Camera
from ..color.tags import save_srgb
from ..datasets.scene import Scene
from ..depth_maps import DepthMap
from ..depth_maps.multi_view import multi_view_depth, pair_depth
from ..depth_maps.stereo import Disparity, RectifiedPair
from ..errors import LumigraphError
from ..figures import Row, colour_depth, contact_sheet, depth_range, save_picture, to_image
from ..files import replacing_folder, write_json
from ..readers.transforms import OPENCV_FROM_OPENGL
from .options import DepthOptions

MAX_LEVEL = 65534  # of 16 bits; 0 and 65535 stand for unknown depth
SHEET = "depth.png"


def export_depth(scene: Scene, folder: Path, options: DepthOptions = DepthOptions()) -> list[DepthMap]:
    """Write depth maps of the photographs by multi-view stereo, and return them."""
    maps = multi_view_depth(scene, options.size, views=options.views or len(scene))
    write_depth(folder, scene, maps)
    return maps


def export_pair(
    scene: Scene, folder: Path, names: tuple[str, str], options: DepthOptions
) -> tuple[str, float, tuple[int, int], float]:
    """Write the depth of the left one of two photographs, by name or number, by rectification and matching.

    Returns the left one's name, the baseline in units of the capture, the disparities and the share of sure pixels.
    """
    first, second = (scene.find(name) for name in names)
    pair, found = pair_depth(scene, first, second, options.size)
    left = first if bool((pair.left.pose[:, 3] == scene.cameras.position[first]).all()) else second
    seen = pair.depth_map(found, left)
    sure = float(seen.solid[pair.left.trust > 0.5].float().mean())
    write_depth(folder, scene, [seen], pair_sheet(scene.source, names, pair, found))
    begin, count = pair.disparities
    return scene.names[left], pair.baseline * scene.frame.to_source.scale, (begin, begin + count - 1), sure


def write_depth(folder: Path, scene: Scene, maps: Sequence[DepthMap], sheet: Image.Image | None = None) -> None:
    """Write a folder that opens as a scene with a depth layer: images, depth, transforms.json, and a contact sheet.

    Depth is 16-bit distance along rays in units of a MAX_LEVEL-th of the farthest; 0 for unreliable pixels. Poses and
    depth are in the capture's frame. Raises LumigraphError if no pixel is reliable.

    sheet: replaces that of `depth_sheet`
    """
    sure = [seen.depth[seen.solid] for seen in maps]
    if not any(map(len, sure)):
        raise LumigraphError(
            f"No two photographs of {scene.source} agree on the depth of anything; their poses may be wrong, or they "
            "have too little in common"
        )
    unit = float(torch.cat(sure).max()) / MAX_LEVEL
    to_source = scene.frame.to_source
    frames: list[dict[str, Any]] = []
    with replacing_folder(folder, "depth maps") as partial:
        for part in ("images", "depth"):
            (partial / part).mkdir()
        for seen in maps:
            name = f"{Path(scene.names[int(seen.camera.image_index)]).stem}.png"  # type: ignore[arg-type]
            levels = (seen.depth.nan_to_num(0, 0, 0) / unit).round().clamp(0, MAX_LEVEL).numpy()
            Image.fromarray(levels.astype(np.uint16)).save(partial / "depth" / name)
            save_srgb(to_image(seen.rgb), partial / "images" / name)
            frames.append(
                {"file_path": f"images/{name}", "depth_file_path": f"depth/{name}", **about(seen.camera, to_source)}
            )
        scale = {"depth_unit_scale_factor": unit * to_source.scale, "is_euclidean_depth": True}
        write_json(partial / "transforms.json", {"camera_model": "PINHOLE", **scale, "frames": frames}, ours=True)
        save_picture(partial / SHEET, sheet or depth_sheet(scene, maps), ours=True)


def about(camera: Camera, to_source: Any) -> dict[str, Any]:
    """Size, lens and pose of a pinhole camera, as transforms.json has them."""
    pose = np.eye(4)
    pose[:3, :3] = to_source.directions(camera.pose[0, :, :3].T.double()).T.numpy() * OPENCV_FROM_OPENGL
    pose[:3, 3] = to_source.points(camera.position.double())[0].numpy()
    (width, height), focal, centre = camera.size[0].tolist(), camera.lens.focal[0], camera.lens.centre[0]  # type: ignore[attr-defined]
    numbers = dict(zip(("fl_x", "fl_y", "cx", "cy"), [*focal.tolist(), *centre.tolist()], strict=True))
    return {"w": width, "h": height, **numbers, "transform_matrix": pose.tolist()}


def depth_sheet(scene: Scene, maps: Sequence[DepthMap]) -> Image.Image:
    """Photographs beside their depth, labelled with the share of reliable pixels."""
    within = depth_range(torch.cat([x.depth.flatten() for x in maps]), torch.cat([x.opacity.flatten() for x in maps]))
    rows = []
    for seen in maps:
        name = scene.names[int(seen.camera.image_index)]  # type: ignore[arg-type]
        label = f"{name}: {100 * float(seen.solid.float().mean()):.0f} % sure"
        depth = colour_depth(seen.surface_depth.nan_to_num(torch.inf), seen.opacity, within)
        rows.append(Row(label, [seen.rgb, depth]))
    return contact_sheet(f"Depth of {scene.source}", ["photograph", "depth"], rows)


def pair_sheet(source: str, names: tuple[str, str], pair: RectifiedPair, found: Disparity) -> Image.Image:
    """Both rectified pictures, the left one's filled disparity, and its reliable pixels."""
    z = pair.z(found.values)
    trusted = (pair.left.trust > 0.5).float()
    within = depth_range(z, trusted)
    depth = [colour_depth(z, opacity, within) for opacity in (trusted, found.sure.float())]
    titles = ["left, rectified", "right, rectified", "disparity, filled", "sure disparity"]
    row = Row(f"{names[0]} and {names[1]}", [pair.left.rgb, pair.right.rgb, *depth])
    return contact_sheet(f"Stereo of {source}", titles, [row])
