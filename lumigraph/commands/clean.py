"""`lumigraph clean`: remove floaters from a cloud of Gaussians, or crop it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional

from ..errors import LumigraphError
from ..files import claim
from ..files.ranges import Share
from .common import choose_device, show
from .options import Cropping, Overwrite, needed, option, photographers

SIZE = 400  # pixels of the longer side of the pictures that compare


@dataclass(frozen=True)
class Clean:
    """Remove floaters from a trained cloud of Gaussians, or crop it to a box or a sphere.

    The result is a new run, which opens, renders and resumes, or a splat file, if --output ends like one. The source
    does not change. A picture beside the result shows the cloud with the removed Gaussians coloured, and afterwards.
    To crop without removing floaters, give --strength 0 with --box or --sphere.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file, or a composition."""
    output: Annotated[Path, needed("NEW")]
    """New folder for a run, or new file: .ply, .compressed.ply, .spz, .splat, .sog, .glb."""
    overwrite: Overwrite = False
    strength: Annotated[Share | None, option("SHARE", "0.4")] = None
    """Remove Gaussians with a floater score above 1 - strength; a larger value removes more, 0 none."""
    part: OmitArgPrefixes[Cropping] = Cropping()
    device: Annotated[str, option("NAME")] = "auto"
    """Device for the pictures: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..composition.floaters import STRENGTH, floaters
        from ..exchange import names_splats, place_of
        from ..figures import save_picture
        from ..gaussians.cloud import gone, unwanted
        from ..large import open_any
        from ..method.capabilities import HasGaussians, needs
        from ..run.derived import check_output, save_picked

        opened, device = open_any(self.source), choose_device(self.device)
        check_output(opened, self.output, self.overwrite, [self.source])
        place = place_of(self.output)
        beside = place.with_name(f"{place.name}.png")
        picture = beside if names_splats(self.output) else self.output / "clean.png"
        claim(picture, "comparison", self.overwrite, [self.source])
        method = opened.ready(device)
        gaussians = needs(method, HasGaussians).gaussians()
        strength = STRENGTH if self.strength is None else self.strength
        floating = floaters(gaussians, photographers(opened, method), opened.frame, strength)
        reasons = unwanted(gaussians, self.part.crop(opened.frame), floating=floating)
        which = gone(reasons)
        if len(gaussians) and which.all():
            raise LumigraphError(
                "No Gaussian is left; give --box or --sphere where the scene is (`lumigraph info` shows its bounds), "
                "or a smaller --strength"
            )
        counts = {reason: count for reason, some in reasons.items() if (count := int(some.sum()))}
        sheet = before_and_after(opened, gaussians, which)  # reads the cameras, so it comes before anything is written
        save_picked(opened, ~which.cpu(), self.output, {"removed": counts})
        save_picture(picture, sheet, "comparison")
        show(
            {"Gaussians": f"{int((~which).sum()):,} of {len(gaussians):,} stay"}
            | {reason: f"{count:,} went" for reason, count in counts.items()}
            | {"saved": str(self.output), "picture": str(picture), "next": f"lumigraph view {self.output}"}
        )
        return 0


def before_and_after(opened: Any, gaussians: Any, gone: Any) -> Any:
    """A sheet of some views: all Gaussians, the removed ones coloured, those that stay. Two are from afar, where
    floaters show."""
    from ..camera import ring
    from ..composition import PickedCloud
    from ..composition.floaters import CANDIDATE_COLOUR
    from ..figures import Row, contact_sheet
    from ..gaussians.cloud import painted
    from ..geometry import evenly
    from ..system.progress import track

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
