"""`lumigraph depth`: depth maps of photographs by multi-view stereo, or of a pair by stereo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files.ranges import Downscale, between
from .common import lines, show, typed
from .options import ReaderOption, needed, option

if TYPE_CHECKING:
    from ..datasets.scene import Scene

LOW_SURE_SHARE = 0.3
LOW_SHARE = " (little: walls without texture, or too little in common; trust only the sure pixels)"
Views = Annotated[int, between(2, 100_000)]


@dataclass(frozen=True)
class Depth:
    """Find the depth of every photograph by comparing it with its neighbours (multi-view stereo, PatchMatch).

    The result is a folder that opens as a scene: undistorted pictures, 16-bit depth of the pixels on which neighbours
    agree, transforms.json, and a contact sheet, depth.png.
    """

    scene: Annotated[Positional[str], needed("SCENE")]
    """Folder of photographs with poses, or procedural:NAME."""
    output: Annotated[Path, needed("FOLDER")]
    """Folder for the depth maps."""
    size: Annotated[int, between(50, 4000), option("PIXELS")] = 400
    """Longer side of the depth maps, about; twice as large takes four times as long."""
    views: Annotated[Views | None, option("N", "all")] = None
    """Number of photographs, spread evenly."""
    pair: Annotated[tuple[str, str] | None, option("A B", "none")] = None
    """Compare only these two photographs (names or numbers): rectification and semi-global matching, in a second."""
    downscale: Annotated[Downscale | None, option("N", "to 1100 pixels, if it has over 1320")] = None
    """Reduce the photographs by this whole number before reading."""
    reader: ReaderOption = None

    def run(self) -> int:
        from ..depth_maps.multi_view import multi_view_depth
        from ..export.depth import SHEET, write_depth
        from ..files import claim_folder
        from ..opening import open_scene

        claim_folder(self.output, "depth maps")
        scene = open_scene(self.scene, self.downscale, self.reader, whole=True)
        if self.pair:
            return self.compare(scene, self.pair)
        maps = multi_view_depth(scene, self.size, views=self.views or len(scene))
        write_depth(self.output, scene, maps)
        shares = [float(seen.solid.float().mean()) for seen in maps]
        by_photograph = [
            f"{scene.names[int(seen.camera.image_index)]}: {100 * share:.0f} %"  # type: ignore[arg-type]
            for seen, share in zip(maps, shares, strict=True)
        ]
        show(
            {
                "photographs": str(len(maps)),
                "sure pixels": f"{100 * sum(shares) / len(shares):.0f} %",
                "of each": lines(by_photograph, str(self.output / SHEET)),
                "depth": str(self.output / "depth"),
                "picture": str(self.output / SHEET),
                "next": typed("train", "gaussian-splatting", self.scene),
            }
        )
        return 0

    def compare(self, scene: Scene, names: tuple[str, str]) -> int:
        from ..depth_maps.multi_view import pair_depth
        from ..export.depth import SHEET, pair_sheet, write_depth

        first, second = (number_of(scene, name) for name in names)
        pair, found = pair_depth(scene, first, second, self.size)
        left = first if bool((pair.left.pose[:, 3] == scene.cameras.position[first]).all()) else second
        seen = pair.depth_map(found, left)
        trusted = pair.left.trust > 0.5
        share = float(seen.solid[trusted].float().mean())
        write_depth(self.output, scene, [seen], pair_sheet(str(self.scene), names, pair, found))
        begin, count = pair.disparities
        show(
            {
                "left": scene.names[left],
                "baseline": f"{pair.baseline * scene.frame.to_source.scale:.4g} units of the capture",
                "disparities": f"{begin} to {begin + count - 1} pixels",
                "sure pixels": f"{100 * share:.0f} %" + LOW_SHARE * (share < LOW_SURE_SHARE),
                "depth": str(self.output / "depth"),
                "picture": str(self.output / SHEET),
            }
        )
        return 0


def number_of(scene: Scene, name: str) -> int:
    """Number of a photograph from its name, with or without its ending, or its number."""
    names = list(scene.names)
    stems = [Path(one).stem for one in names]
    if name in names or name in stems:
        return names.index(name) if name in names else stems.index(name)
    if name.isdecimal() and int(name) < len(names):
        return int(name)
    last = len(names) - 1
    raise LumigraphError(f"{scene.source} has no photograph {name}; give two names, or two numbers up to {last}")
