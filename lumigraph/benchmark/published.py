"""Figures from the literature, to hold ours against. They are not ours, and protocols differ."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """Held-out PSNR in dB of one scene, at what resolution, and who says so."""

    psnr: float
    resolution: str
    source: str


FIGURES: dict[tuple[str, str], Published] = {
    ("nerf", "lego"): Published(32.54, "800x800", "Mildenhall et al. 2020"),
    ("nerf", "chair"): Published(33.00, "800x800", "Mildenhall et al. 2020"),
    ("nerf", "fern"): Published(25.17, "1008x756", "Mildenhall et al. 2020"),
    ("mip-nerf", "lego"): Published(35.70, "800x800", "Barron et al. 2021"),
    ("instant-ngp", "lego"): Published(36.39, "800x800", "Müller et al. 2022, black background"),
    ("gaussian-splatting", "lego"): Published(35.78, "800x800", "Kerbl et al. 2023"),
    ("tensorf", "lego"): Published(36.46, "800x800", "Chen et al. 2022"),
}


@dataclass(frozen=True)
class Few:
    """Held-out PSNR in dB from few photographs, the mean of several scenes; where a figure's source says how many and
    of what.

    views: photographs that were learnt from; None where the source does not say
    """

    method: str
    psnr: float
    views: int | None
    scenes: str
    source: str


STUDY = "a study of few photographs by others, protocol not known"
FEW_VIEW_FIGURES: tuple[Few, ...] = (
    Few("mip-nerf", 14.62, 3, "LLFF", "Niemeyer et al. 2022"),
    Few("regnerf", 19.08, 3, "LLFF", "Niemeyer et al. 2022"),
    Few("mip-nerf", 8.68, 3, "DTU", "Niemeyer et al. 2022"),
    Few("regnerf", 18.89, 3, "DTU", "Niemeyer et al. 2022"),
    Few("pixelnerf", 19.31, 3, "DTU", "Yu et al. 2021"),
    Few("nerf", 24.3, None, "not stated", STUDY),
    Few("pixelnerf", 23.2, None, "not stated", STUDY),
    Few("regnerf", 25.2, None, "not stated", STUDY),
    Few("snerg", 24.0, None, "not stated", STUDY),
)


def published(method: str, scene: str) -> Published | None:
    """Figure of the method's own paper for a scene of this name; `None` if unknown."""
    return FIGURES.get((method, scene.lower()))
