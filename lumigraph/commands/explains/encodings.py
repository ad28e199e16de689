"""`lumigraph explain encodings`: what Fourier features do for a network that learns a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ...errors import LumigraphError
from ..common import choose_device, needed, option, scene_name, show


@dataclass(frozen=True)
class Encodings:
    """Fit a network to a picture behind each encoding of its pixels, and over a range of scales.

    Half of the pixels are held out. One page, index.html, shows their PSNR against scale, the spectrum of the neural
    tangent kernel, and the pictures that the networks draw.
    """

    picture: Annotated[Positional[Path], needed("PICTURE")]
    """An image file."""
    output: Annotated[Path | None, option("FOLDER", "explained/PICTURE-encodings")] = None
    """Where the page goes."""
    steps: Annotated[int, option("N")] = 400
    """Of training, for each network."""
    scales: Annotated[tuple[float, ...], option("S S ...")] = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
    """Frequencies in cycles across the picture: the deviation of Gaussian ones, the highest of positional ones."""
    downscale: Annotated[int | None, option("N", "to about 512 pixels")] = None
    """Shrink the picture by a whole number."""
    seed: Annotated[int, option("N")] = 0
    """Of all random choices."""
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        if self.steps < 1:
            raise LumigraphError(f"{self.steps} steps teach nothing; give --steps a number above 0")
        if len(set(self.scales)) < 2 or not all(0 < scale < float("inf") for scale in self.scales):
            raise LumigraphError("A curve over scales needs two or more, all above 0; for example --scales 1 10 100")
        from ...capture import picture
        from ...explain.encodings import compare, write_page

        if not picture.recognises(self.picture):
            raise LumigraphError(f"{self.picture} is no image file; name one picture, as in photograph.png")
        scene = picture.open_picture(self.picture, self.downscale)
        folder = self.output or Path("explained") / f"{scene_name(str(self.picture))}-encodings"
        comparison = compare(scene, tuple(sorted(set(self.scales))), self.steps, self.seed, choose_device(self.device))
        write_page(folder, comparison)
        show(comparison.rows() | {"page": str(folder / "index.html")})
        return 0
