"""`lumigraph segment`: select a part of a scene by strokes on a photograph; extract, delete, recolour or move it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, UseAppendAction

from ..errors import LumigraphError
from ..files import claim
from ..files.ranges import Coordinate, Share, between
from .common import choose_device, show
from .options import Overwrite, PhotographsOption, needed, option

SIZE = 400  # pixels of the longer side of the pictures that compare
TINT = (0.1, 1.0, 0.3)  # of the selected part in them
UNKNOWN_STRIPES = 6  # pixels of the hatching where nothing is known
MAX_VIEWS = 60  # photographs whose features are distilled, evenly chosen
MASK_OPACITY = 0.5  # share of a pixel that shows the part, from which on a mask has it
Action = Literal["extract", "delete", "recolour", "move", "masks"]


@dataclass(frozen=True)
class Segment:
    """Select a part of a trained scene by strokes, and extract, delete, recolour or move it.

    A stroke is drawn on a photograph of the run, in a PNG of its size: plain green is wanted, plain red unwanted, and
    all else says nothing. Surfaces that no photograph shows are grey in the result. A picture beside it shows the
    selection and the result.
    """

    source: Annotated[Positional[Path], needed("RUN")]
    """Folder of a run that was trained on photographs."""
    strokes: UseAppendAction[Annotated[tuple[Path, ...], needed("PNG")]]
    """Picture of strokes: green is wanted, red unwanted. Can be given several times, each with its --view."""
    view: UseAppendAction[Annotated[tuple[str, ...], needed("NAME")]]
    """Photograph that the strokes were drawn on, by its name."""
    output: Annotated[Path, needed("NEW")]
    """The new file: for Gaussians a splat file such as .ply (with extract and delete also a folder, a run), for a field
    a composition (.json); with --action masks a folder."""
    action: Action = "extract"
    """extract: the part alone; delete: all else; recolour: the part in another colour; move: the part elsewhere;
    masks: a label picture for each photograph, 1 on the part, to train object-nerf on."""
    colour: Annotated[tuple[Share, Share, Share], option("R G B")] = (0.85, 0.15, 0.1)
    """New mean colour with --action recolour, each number in [0, 1]."""
    shift: Annotated[tuple[Coordinate, Coordinate, Coordinate], option("X Y Z")] = (0.0, 0.0, 0.0)
    """Displacement with --action move, in scene units."""
    turn: Annotated[float, between(-1e6, 1e6), option("DEGREES")] = 0.0
    """Rotation about the vertical with --action move, counterclockwise from above."""
    features: Annotated[Path | None, option("FILE", "the descriptors of Lumigraph")] = None
    """Feature network: .onnx, or .safetensors with the weights of a plain convolutional network."""
    masks: Annotated[Path | None, option("FOLDER", "none")] = None
    """Segments of a segmenter, a picture of whole numbers for each --view: a stroke takes the segments it crosses."""
    scene: PhotographsOption = None
    overwrite: Overwrite = False
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..figures import save_picture
        from ..large import open_any
        from ..method.capabilities import HasGaussians, can
        from ..selection import Selection

        if len(self.strokes) != len(self.view) or not self.strokes:
            raise LumigraphError(
                "Each --strokes needs the --view that it was drawn on; give as many of one as the other"
            )
        opened, device = open_any(self.source), choose_device(self.device)
        if opened.open_scene is None:
            raise LumigraphError(f"{self.source} has no photographs to draw strokes on; give a run trained on some")
        method = opened.method(device)
        is_cloud = can(method, HasGaussians)
        self._check(opened, is_cloud)
        scene = opened.open_scene(self.scene)
        drawn = [self._drawn(scene, path, name) for path, name in zip(self.strokes, self.view, strict=True)]
        selection = Selection(method, self._points(method, scene))
        for strokes in drawn:
            selection.add(strokes)
        chosen = selection.chosen()
        if not chosen.any() or chosen.all():
            raise LumigraphError(
                f"The strokes select {'nothing' if not chosen.any() else 'everything'}; draw green strokes along the "
                "part, and red ones on what is beside it"
            )
        cameras = [strokes.camera for strokes in drawn] + [scene.cameras[i] for i in some_views(scene, 3)]
        if self.action == "masks":
            write_masks(self.output, scene, selection, chosen)
        elif is_cloud:
            self._write_cloud(opened, method, selection, chosen)
        else:
            self._write_field(opened, selection, chosen)
        result = None if self.action == "masks" else self.output
        sheet = before_and_after(opened, method, selection, chosen, cameras, result, self.action == "extract")
        save_picture(self._picture, sheet, "comparison", ours=self._picture.parent == self.output)
        kind = "Gaussians" if is_cloud else "voxels"
        rows = {kind: f"{int(chosen.sum()):,} of {len(chosen):,} selected", "saved": str(self.output)}
        show(rows | {"picture": str(self._picture)})
        return 0

    @property
    def _picture(self) -> Path:
        return self.output.with_name(f"{self.output.name}.png")

    def _check(self, opened: Any, is_cloud: bool) -> None:
        """Raises LumigraphError unless the result can be written to the output."""
        from ..exchange import SUFFIXES, names_splats
        from ..files import claim_folder
        from ..run.derived import check_output

        reads = [self.source, *self.strokes]
        if self.action == "masks":
            claim_folder(self.output, "masks")
        elif is_cloud and (names_splats(self.output) or self.action in ("extract", "delete")):
            check_output(opened, self.output, self.overwrite, reads)
        elif is_cloud:
            raise LumigraphError(f"--action {self.action} writes a file; --output should end in {', '.join(SUFFIXES)}")
        elif self.action == "recolour":
            raise LumigraphError(
                "A field's colours cannot be changed in a part of it; convert the run to gaussian-splatting first"
            )
        elif self.output.suffix.lower() != ".json":
            raise LumigraphError(f"Of a field a part is a composition, so {self.output} should end in .json; rename it")
        else:
            claim(self.output, "composition", self.overwrite, reads)
            claim(mask_file(self.output), "masks", self.overwrite, reads)
        claim(self._picture, "comparison", self.overwrite, reads)

    def _drawn(self, scene: Any, path: Path, name: str) -> Any:
        """Strokes from a file on the photograph of a name, over whole segments if there are any."""
        from ..selection import read_segments, read_strokes

        number = numbered(scene, name)
        strokes = read_strokes(path, scene.cameras[number], name)
        return strokes if self.masks is None else strokes.over(read_segments(self.masks, name, strokes.camera))

    def _points(self, method: Any, scene: Any) -> Any:
        """The method's points with features of the photographs."""
        from ..selection import describe, distil_features, feature_network

        photographs = [scene.photograph(i) for i in some_views(scene, MAX_VIEWS)]
        about = describe
        if self.features is not None:
            pictures = [x.before(method.frame.background) for x in photographs[:: max(1, len(photographs) // 8)]]
            about = feature_network(self.features, pictures)
        return distil_features(method, photographs, about)

    def _write_cloud(self, opened: Any, method: Any, selection: Any, chosen: Any) -> None:
        from ..exchange import names_splats, write_gaussians
        from ..gaussians import joined
        from ..run.derived import save_picked
        from ..selection.cutting import cut, motion, tinted

        if not names_splats(self.output):
            keep = (chosen if self.action == "extract" else ~chosen) & selection.points.is_seen
            save_picked(opened, keep, self.output, {"removed": {"by strokes": int((~keep).sum())}})
            return
        pieces = cut(method.gaussians(), chosen, selection.points)
        if self.action == "move":
            place = motion(selection.points.positions[chosen], self.shift, self.turn)
            made = joined([pieces.rest, pieces.part.transformed(place.matrix)])
        elif self.action == "recolour":
            made = joined(
                [method.gaussians().to("cpu")[~chosen], tinted(method.gaussians().to("cpu")[chosen], self.colour)]
            )
        else:
            made = pieces.part if self.action == "extract" else pieces.rest
        write_gaussians(self.output, made.transformed(opened.frame.to_source.matrix))

    def _write_field(self, opened: Any, selection: Any, chosen: Any) -> None:
        from ..composition import mask_of
        from ..geometry import Similarity
        from ..run.composition import CompositionPart, relative, write_composition
        from ..selection.cutting import motion

        points, grid = selection.points, selection.points.grid
        part, seen = (selection.spread_out(x).view(grid.size).numpy() > 0 for x in (chosen, points.is_seen))
        mask_of(part, seen, grid.lower, grid.edge).write(mask_file(self.output))
        said = relative(self.source, self.output), relative(mask_file(self.output), self.output)
        one, frame = Similarity.make(1.0), opened.frame
        inside = [CompositionPart(said[0], one, mask=said[1], keep="inside")]
        outside = [CompositionPart(said[0], one, mask=said[1], keep="outside")]
        parts = {"extract": inside, "delete": outside}.get(self.action)
        if parts is None:
            place = frame.to_source @ motion(points.positions[chosen], self.shift, self.turn) @ frame.to_source.inverse
            parts = [*outside, CompositionPart(said[0], place, mask=said[1], keep="inside")]
        write_composition(self.output, parts)


def mask_file(output: Path) -> Path:
    """The file of voxels beside a composition."""
    return output.with_suffix(".mask.safetensors")


def some_views(scene: Any, count: int) -> Sequence[int]:
    """Numbers of photographs of training, evenly chosen."""
    from ..geometry import evenly

    return [int(i) for i in evenly(scene.splits["train"].tolist(), count)]


def numbered(scene: Any, name: str) -> int:
    """Number of a photograph from its name, with or without its folder and ending."""
    stems = [Path(x).stem for x in scene.names]
    for names in (scene.names, [Path(x).name for x in scene.names], stems):
        if names.count(name) == 1:
            return int(names.index(name))
    shown = ", ".join([*scene.names[:4], "..."] if len(scene.names) > 4 else scene.names)
    raise LumigraphError(f"{scene.source} has no photograph {name!r}; there are {shown}")


def write_masks(folder: Path, scene: Any, selection: Any, chosen: Any) -> None:
    """Write a label picture for each photograph: 1 where the part is visible, 0 elsewhere."""
    import numpy as np
    from PIL import Image

    from ..files import replacing_folder
    from ..system.progress import track

    with replacing_folder(folder, "masks") as partial:
        for i in track(range(len(scene)), "Writing masks", len(scene)):
            shown = selection.mask(scene.cameras[i], chosen) > MASK_OPACITY
            place = (partial / scene.names[i]).with_suffix(".png")
            place.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(shown.numpy().astype(np.uint8)).save(place)


def before_and_after(
    opened: Any, method: Any, selection: Any, chosen: Any, cameras: Sequence[Any], result: Path | None, alone: bool
) -> Any:
    """A sheet of some views: before, the selection tinted, and the result, with unseen regions behind the part hatched.
    alone: whether only the part remains"""
    import torch

    from ..camera.rays import Rendering
    from ..figures import Row, contact_sheet
    from ..large import open_any

    after = None if result is None else open_any(result)
    to_result = None if after is None else after.frame.to_source.inverse @ opened.frame.to_source
    made = None if after is None else after.method(method.device)
    rows = []
    for camera in cameras:
        camera = camera.resized(min(1.0, SIZE / int(camera.size.max())))
        seen = method.render(camera).cpu()
        share = selection.mask(camera, chosen).clamp(0, 1)[..., None]
        tinted = (1 - 0.6 * share) * seen.rgb + 0.6 * share * torch.tensor(TINT)
        shown = [seen.rgb, tinted]
        if after is not None and made is not None and to_result is not None:
            found: Rendering = made.render(camera.transformed(to_result.matrix)).cpu()
            behind = torch.tensor(opened.frame.background) - torch.tensor(after.frame.background)
            rgb = found.rgb + (1 - found.opacity)[..., None] * behind
            shown.append(hatched(rgb, (seen.opacity > 0.5) & (found.opacity < 0.5) & (not alone)))
        rows.append(Row("", shown))
    columns = ("before", "selected", "result, unknown hatched")[: len(rows[0].pictures)]
    return contact_sheet(opened.title, columns, rows, SIZE)


def hatched(rgb: Any, where: Any) -> Any:
    """A picture with diagonal stripes at the pixels of a mask."""
    import torch

    height, width = where.shape
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    stripes = ((rows + columns) // UNKNOWN_STRIPES % 2).float()[..., None].expand(-1, -1, 3)
    return torch.where(where[..., None], 0.35 + 0.3 * stripes, rgb)
