"""Published results, each with its data, protocol, who measured it, and where it stands: one table for all pages."""

from dataclasses import dataclass
from typing import Any

PSNR, ATE, CHAMFER = "PSNR, dB", "ATE RMSE, cm", "chamfer, mm"
BLENDER, DTU, LLFF, DYCHECK = "Blender, 8 scenes", "DTU, 15 scenes", "LLFF, 8 scenes", "captures of Gao 2022"
WHITE, BLACK = "800x800, white background", "800x800, black background"
MASKED, WHOLE = "background masked out", "every 8th photograph held out, whole pictures"
OTHER_INPUTS, SURFACES = "whole pictures, other input views than RegNeRF's", "surfaces from 49 or 64 photographs"
CO_VISIBLE = "co-visible pixels, a camera that does not jump"
PEOPLE, ONE_VIDEO, ALL_FRAMES = "ZJU-MoCap, 6 people", "novel views, learnt from one camera", "all tracked frames"


@dataclass(frozen=True)
class Published:
    """One published result of a method.

    value:       as printed, in the unit of `metric`
    data:        scenes that it is the mean of, or the one scene
    protocol:    resolution, background, pixels and views that are compared
    measured_by: authors and year of the measurement, who need not be the method's
    source:      publication that prints it
    views:       number of training photographs, where few
    """

    method: str
    value: str
    metric: str
    data: str
    protocol: str
    measured_by: str
    source: str
    views: int | None = None

    @property
    def sentence(self) -> str:
        """The result in a line, with its protocol and who measured it."""
        kind, _, unit = self.metric.rpartition(", ")
        figure = f"{self.value} {unit}" if unit in ("dB", "cm", "mm", "kB") else f"{kind or unit} {self.value}"
        few = f", {self.views} photographs" if self.views else ""
        return f"{figure}: {self.data}{few}, {self.protocol} (measured by {self.measured_by})"


# Results by who measured and where they stand: method, value, metric, data, protocol, and number of photographs where
# few. The result of a method that the gallery shows comes first.
MEASURED: dict[tuple[str, str], list[tuple[Any, ...]]] = {
    ("Tancik et al. 2020", "arXiv 2006.10739"): [
        ("fourier-features", "over 25", PSNR, "natural pictures", "half of the pixels held out; 19 dB without waves"),
    ],
    ("Mildenhall et al. 2020", "arXiv 2003.08934"): [
        ("nerf", "31.01", PSNR, BLENDER, WHITE),
        ("nerf", "32.54", PSNR, "lego", WHITE),
        ("nerf", "33.00", PSNR, "chair", WHITE),
        ("nerf", "25.17", PSNR, "fern", "1008x756"),
    ],
    ("Barron et al. 2021", "arXiv 2103.13415"): [
        ("mip-nerf", "33.09", PSNR, BLENDER, WHITE),
        ("mip-nerf", "35.70", PSNR, "lego", WHITE),
    ],
    ("Niemeyer et al. 2022", "arXiv 2112.00724"): [
        ("mip-nerf", "14.62", PSNR, LLFF, WHOLE, 3),
        ("regnerf", "18.89", PSNR, DTU, MASKED, 3),
        ("regnerf", "19.08", PSNR, LLFF, WHOLE, 3),
        ("mip-nerf", "8.68", PSNR, DTU, MASKED, 3),
    ],
    ("Sun et al. 2022", "arXiv 2111.11215"): [("dvgo", "31.95", PSNR, BLENDER, WHITE)],
    ("Fridovich-Keil et al. 2022", "arXiv 2112.05131"): [("plenoxels", "31.71", PSNR, BLENDER, WHITE)],
    ("Yu et al. 2021", "arXiv 2103.14024"): [("plenoctrees", "31.71", PSNR, BLENDER, WHITE)],
    ("Hedman et al. 2021", "arXiv 2103.14645"): [("snerg", "30.38", PSNR, BLENDER, WHITE)],
    ("Chen et al. 2022", "arXiv 2203.09517"): [
        ("tensorf", "33.14", PSNR, BLENDER, WHITE),
        ("tensorf", "36.46", PSNR, "lego", WHITE),
    ],
    ("Müller et al. 2022", "arXiv 2201.05989"): [
        ("instant-ngp", "33.18", PSNR, BLENDER, BLACK),
        ("instant-ngp", "36.39", PSNR, "lego", BLACK),
    ],
    ("Kerbl et al. 2023", "arXiv 2308.04079"): [
        ("gaussian-splatting", "33.32", PSNR, BLENDER, WHITE),
        ("gaussian-splatting", "35.78", PSNR, "lego", WHITE),
    ],
    ("Takikawa et al. 2021", "arXiv 2101.10994"): [("nglod", "19 to 904", "size, kB", "one shape", "by level")],
    ("Wang et al. 2021", "arXiv 2106.10689"): [("neus", "0.84", CHAMFER, DTU, SURFACES)],
    ("Chen et al. 2024", "arXiv 2406.06521"): [("planar-splatting", "0.47 to 0.53", CHAMFER, DTU, SURFACES)],
    ("Sucar et al. 2021", "arXiv 2103.12352"): [("imap", "4.2", ATE, "TUM RGB-D, 3 sequences", ALL_FRAMES)],
    ("Keetha et al. 2024", "arXiv 2312.02126"): [("splat-slam", "3.35", ATE, "TUM RGB-D, fr1/desk", ALL_FRAMES)],
    ("Gao et al. 2022", "arXiv 2210.13445"): [
        ("nerfies", "20.85", PSNR, DYCHECK, CO_VISIBLE),
        ("nsff", "19.53", PSNR, DYCHECK, CO_VISIBLE),
    ],
    ("Wu et al. 2024", "arXiv 2310.08528"): [("deformable-splatting", "34.05", PSNR, "D-NeRF, 8 scenes", "800x800")],
    ("Hu et al. 2024", "arXiv 2312.02973"): [
        ("humannerf", "30.66", PSNR, PEOPLE, ONE_VIDEO),
        ("articulated-splatting", "31.34", PSNR, PEOPLE, f"{ONE_VIDEO}, by their own Gaussians on bones"),
    ],
    ("Ost et al. 2021", "arXiv 2011.10379"): [("neural-scene-graph", "26", PSNR, "KITTI", "one drive, reconstructed")],
    ("Yu et al. 2021", "arXiv 2012.02190"): [("pixelnerf", "19.33", PSNR, DTU, OTHER_INPUTS, 3)],
    ("Chan et al. 2022", "arXiv 2112.07945"): [("eg3d", "4.70", "FID", "FFHQ", "512x512, 50 000 pictures")],
}
RESULTS = tuple(Published(*(row[:5] + where + row[5:])) for where, rows in MEASURED.items() for row in rows)
FEW_VIEWS = tuple(result for result in RESULTS if result.views)


def first_of(method: str) -> Published | None:
    """The result of a method that stands beside ours, which is of other data; `None` without one."""
    own = [result for result in RESULTS if result.method == method]
    return own[0] if own else None


def of_scene(method: str, scene: str) -> Published | None:
    """PSNR of a scene of this name; `None` if unknown."""
    scene = scene.lower()
    return next((x for x in RESULTS if (x.method, x.data, x.metric) == (method, scene, PSNR)), None)
