"""Parts: what strokes select of a scene is extracted, deleted, recoloured or moved; a cloud is cleaned or cropped."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from ..camera import Camera, ring
from ..camera.rays import Rendering
from ..composition import PickedCloud, mask_of
from ..composition.floaters import CANDIDATE_COLOUR
from ..datasets.scene import Scene
from ..errors import LumigraphError
from ..exchange import SUFFIXES, names_splats, place_of, write_gaussians
from ..export.loaded import Loaded
from ..export.options import Keeping
from ..figures import Row, contact_sheet, save_picture
from ..files import claim, claim_folder, replacing_folder
from ..gaussians import Gaussians, joined
from ..gaussians.cloud import gone, painted
from ..geometry import Similarity, evenly
from ..large import open_any
from ..method import Method
from ..method.capabilities import HasGaussians, can, needs
from ..run import Opened
from ..run.composition import CompositionPart, relative, write_composition
from ..run.derived import check_output, save_picked
from ..selection import (
    Distilled,
    Selection,
    Strokes,
    describe,
    distil_features,
    feature_network,
    read_segments,
    read_strokes,
)
from ..selection.cutting import cut, motion, tinted
from ..system.progress import track
from .options import CleanOptions, SegmentOptions

SIZE = 400  # pixels of the longer side of the pictures that compare
TINT = (0.1, 1.0, 0.3)  # of the selected part in them
UNKNOWN_STRIPES = 6  # pixels of the hatching where nothing is known
MAX_VIEWS = 60  # photographs whose features are distilled, evenly chosen
MASK_OPACITY = 0.5  # share of a pixel that shows the part, from which on a mask has it


def segment(
    opened: Opened,
    strokes: Sequence[tuple[Path, str]],
    output: Path,
    options: SegmentOptions = SegmentOptions(),
    overwrite: bool | None = None,
    device: torch.device | str = "auto",
) -> tuple[Bool[Tensor, " point"], str, Path]:
    """Select a part by strokes, write the result of the options' action, and a picture of views before and after.

    Returns the mask of the selected points, what these are, and the picture.
    strokes: picture of strokes, and name of the photograph that it was drawn on
    Raises LumigraphError for what has no photographs, and for strokes that select nothing or everything.
    """
    if opened.open_scene is None:
        raise LumigraphError(f"{opened.path} has no photographs to draw strokes on; give a run trained on some")
    method, action = opened.ready(device), options.action
    picture, is_cloud = output.with_name(f"{output.name}.png"), can(method, HasGaussians)
    check_result(opened, output, action, is_cloud, overwrite, [opened.path, *(path for path, _ in strokes)])
    claim(picture, "comparison", overwrite, [opened.path, *(path for path, _ in strokes)])
    scene = opened.open_scene(options.scene)
    drawn = [strokes_of(scene, path, name, options) for path, name in strokes]
    selection = Selection(method, points_of(method, scene, options))
    for one in drawn:
        selection.add(one)
    chosen = selection.chosen()
    if not chosen.any() or chosen.all():
        raise LumigraphError(
            f"The strokes select {'nothing' if not chosen.any() else 'everything'}; draw green strokes along the "
            "part, and red ones on what is beside it"
        )
    cameras = [one.camera for one in drawn] + [scene.cameras[i] for i in some_views(scene, 3)]
    if action == "masks":
        write_masks(output, scene, selection, chosen)
    elif is_cloud:
        write_cloud(opened, output, options, selection, chosen)
    else:
        write_field(opened, output, options, selection, chosen)
    result = None if action == "masks" else output
    sheet = before_and_after(opened, selection, chosen, cameras, result, action == "extract")
    save_picture(picture, sheet, "comparison", ours=picture.parent == output)
    return chosen, "Gaussians" if is_cloud else "voxels", picture


def check_result(
    opened: Opened, output: Path, action: str, is_cloud: bool, overwrite: bool | None, reads: Sequence[Path]
) -> None:
    """Raises LumigraphError unless the result may go to the output."""
    if action == "masks":
        claim_folder(output, "masks")
    elif is_cloud and (names_splats(output) or action in ("extract", "delete")):
        check_output(opened, output, overwrite, reads)
    elif is_cloud:
        raise LumigraphError(f"--action {action} writes a file; --output should end in {', '.join(SUFFIXES)}")
    elif action == "recolour":
        raise LumigraphError(
            "A field's colours cannot be changed in a part of it; convert the run to gaussian-splatting first"
        )
    elif output.suffix.lower() != ".json":
        raise LumigraphError(f"Of a field a part is a composition, so {output} should end in .json; rename it")
    else:
        claim(output, "composition", overwrite, reads)
        claim(mask_file(output), "masks", overwrite, reads)


def strokes_of(scene: Scene, path: Path, name: str, options: SegmentOptions) -> Strokes:
    """Strokes of a file on the photograph of a name, over whole segments if there are any."""
    strokes = read_strokes(path, scene.cameras[scene.find(name)], name)
    return strokes if options.masks is None else strokes.over(read_segments(options.masks, name, strokes.camera))


def points_of(method: Method, scene: Scene, options: SegmentOptions) -> Distilled:
    """The method's points with features of the photographs."""
    photographs = [scene.photograph(i) for i in some_views(scene, MAX_VIEWS)]
    about = describe
    if options.features is not None:
        pictures = [x.before(method.frame.background) for x in photographs[:: max(1, len(photographs) // 8)]]
        about = feature_network(options.features, pictures)
    return distil_features(method, photographs, about)


def write_cloud(
    opened: Opened, output: Path, options: SegmentOptions, selection: Selection, chosen: Bool[Tensor, " point"]
) -> None:
    """Write the result of a cloud: a run of a part of its Gaussians, or a splat file."""
    action, points = options.action, selection.points
    if not names_splats(output):
        keep = (chosen if action == "extract" else ~chosen) & points.is_seen
        save_picked(opened, keep, output, {"removed": {"by strokes": int((~keep).sum())}})
        return
    gaussians = needs(selection.method, HasGaussians).gaussians()
    if action == "recolour":
        made = joined([gaussians.to("cpu")[~chosen], tinted(gaussians.to("cpu")[chosen], options.colour)])
    else:
        pieces = cut(gaussians, chosen, points)
        made = pieces.part if action == "extract" else pieces.rest
        if action == "move":
            place = motion(points.positions[chosen], options.shift, options.turn)
            made = joined([pieces.rest, pieces.part.transformed(place.matrix)])
    write_gaussians(output, made.transformed(opened.frame.to_source.matrix, far=True))


def write_field(
    opened: Opened, output: Path, options: SegmentOptions, selection: Selection, chosen: Bool[Tensor, " point"]
) -> None:
    """Write the result of a field: a composition of it inside and outside a mask of voxels."""
    points, grid = selection.points, selection.points.grid
    assert grid is not None  # of a field
    part, seen = (selection.spread_out(x).view(grid.size).numpy() > 0 for x in (chosen, points.is_seen))
    mask_of(part, seen, grid.lower, grid.edge).write(mask_file(output))
    said = relative(opened.path, output), relative(mask_file(output), output)
    one, frame = Similarity.make(1.0), opened.frame
    inside = [CompositionPart(said[0], one, mask=said[1], keep="inside")]
    outside = [CompositionPart(said[0], one, mask=said[1], keep="outside")]
    parts = {"extract": inside, "delete": outside}.get(options.action)
    if parts is None:
        moved = motion(points.positions[chosen], options.shift, options.turn)
        place = frame.to_source @ moved @ frame.to_source.inverse
        parts = [*outside, CompositionPart(said[0], place, mask=said[1], keep="inside")]
    write_composition(output, parts)


def mask_file(output: Path) -> Path:
    """The file of voxels beside a composition."""
    return output.with_suffix(".mask.safetensors")


def some_views(scene: Scene, count: int) -> Sequence[int]:
    """Numbers of photographs of training, evenly chosen."""
    return [int(i) for i in evenly(scene.splits["train"].tolist(), count)]


def write_masks(folder: Path, scene: Scene, selection: Selection, chosen: Bool[Tensor, " point"]) -> None:
    """A label picture for each photograph: 1 where it shows the part, 0 elsewhere."""
    with replacing_folder(folder, "masks") as partial:
        for i in track(range(len(scene)), "Writing masks", len(scene)):
            shown = selection.mask(scene.cameras[i], chosen) > MASK_OPACITY
            place = (partial / scene.names[i]).with_suffix(".png")
            place.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(shown.numpy().astype(np.uint8)).save(place)


def before_and_after(
    opened: Opened,
    selection: Selection,
    chosen: Bool[Tensor, " point"],
    cameras: Sequence[Camera],
    result: Path | None,
    alone: bool,
) -> Image.Image:
    """A sheet of some views: before, the selection tinted, and the result, hatched where nothing is known of what was
    behind the part. alone: whether the part is all that is left"""
    method = selection.method
    after = None if result is None else open_any(result)
    to_result = None if after is None else after.frame.to_source.inverse @ opened.frame.to_source
    made = None if after is None else after.method(method.device)
    rows = []
    for camera in cameras:
        camera = camera.resized(min(1.0, SIZE / int(camera.size.max())))
        seen = method.render(camera).cpu()
        share = selection.mask(camera, chosen).clamp(0, 1)[..., None]
        marked = (1 - 0.6 * share) * seen.rgb + 0.6 * share * torch.tensor(TINT)
        shown = [seen.rgb, marked]
        if after is not None and made is not None and to_result is not None:
            found: Rendering = made.render(camera.transformed(to_result.matrix)).cpu()
            behind = torch.tensor(opened.frame.background) - torch.tensor(after.frame.background)
            rgb = found.rgb + (1 - found.opacity)[..., None] * behind
            shown.append(hatched(rgb, (seen.opacity > 0.5) & (found.opacity < 0.5) & (not alone)))
        rows.append(Row("", shown))
    columns = ("before", "selected", "result, unknown hatched")[: len(rows[0].pictures)]
    return contact_sheet(opened.title, columns, rows, SIZE)


def hatched(
    rgb: Float[Tensor, "height width 3"], where: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width 3"]:
    """A picture with diagonal stripes at the pixels of a mask."""
    height, width = where.shape
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    stripes = ((rows + columns) // UNKNOWN_STRIPES % 2).float()[..., None].expand(-1, -1, 3)
    return torch.where(where[..., None], 0.35 + 0.3 * stripes, rgb)


def clean(
    opened: Opened,
    output: Path,
    options: CleanOptions = CleanOptions(),
    overwrite: bool | None = None,
    device: torch.device | str = "auto",
) -> tuple[int, dict[str, int], Path]:
    """Write a cloud without floaters, cropped, as a run or a splat file, and a picture that compares.

    Returns the number of its Gaussians before, the numbers of those removed by reason, and the picture.
    """
    check_output(opened, output, overwrite, [opened.path])
    place = place_of(output)
    picture = place.with_name(f"{place.name}.png") if names_splats(output) else output / "clean.png"
    claim(picture, "comparison", overwrite, [opened.path])
    loaded = Loaded.of(opened, device, part=Keeping(**vars(options.part), clean=True, strength=options.strength))
    gaussians = needs(loaded.method, HasGaussians).gaussians()
    reasons = loaded.unwanted(gaussians, loaded.crop)
    which = gone(reasons)
    counts = {reason: count for reason, some in reasons.items() if (count := int(some.sum()))}
    sheet = cleaned_sheet(opened, gaussians, which)  # reads the cameras, so it comes before anything is written
    save_picked(opened, ~which.cpu(), output, {"removed": counts})
    save_picture(picture, sheet, "comparison")
    return len(gaussians), counts, picture


def cleaned_sheet(opened: Opened, gaussians: Gaussians, gone: Bool[Tensor, " gaussian"]) -> Image.Image:
    """A sheet of some views: all Gaussians, the removed ones coloured, those that stay. Two are from afar, where
    floaters show."""
    shown = gaussians, painted(gaussians, gone, CANDIDATE_COLOUR), gaussians[~gone]
    clouds = [PickedCloud(opened.frame, some) for some in shown]
    around = ring(opened.frame.bounds, size=SIZE)
    views = [around[i] for i in evenly(range(len(around)), 3)[:2]]
    if opened.photographed:
        own = opened.cameras()["train"]
        views = [own[i] for i in evenly(range(len(own)), 4)[1:]] + views
    rows = [
        Row("", [cloud.render(camera.resized(min(1.0, SIZE / int(camera.size.max())))).rgb for cloud in clouds])
        for camera in track(views, "Drawing before and after", len(views))
    ]
    return contact_sheet(opened.title, ("before", "removed Gaussians coloured", "after"), rows, SIZE)
