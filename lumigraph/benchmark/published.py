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


def published(method: str, scene: str) -> Published | None:
    """What the method's own paper reports of a scene of this name; None if nothing is known here."""
    return FIGURES.get((method, scene.lower()))
