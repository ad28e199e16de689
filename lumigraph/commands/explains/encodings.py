"""`lumigraph explain encodings`: the effect of Fourier features on a network that fits a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from ...errors import LumigraphError
from ...files.ranges import Downscale, Seed, Steps, between
from ..common import Overwrite, choose_device, needed, option, scene_name, show


@dataclass(frozen=True)
class ExplainEncodings:
    """Fit a network to a picture with each encoding of its pixels, over a range of scales.

    Half of the pixels are held out. One page, index.html, shows their PSNR against scale, the spectrum of the neural
    tangent kernel, and the networks' pictures.
    """

    picture: Annotated[Positional[Path], needed("PICTURE")]
    """An image file."""
    output: Annotated[Path | None, option("FOLDER", "explained/PICTURE-encodings")] = None
    """Folder of the page."""
    overwrite: Overwrite = False
    steps: Annotated[Steps, option("N")] = 500
    """Training steps for each network."""
    scales: Annotated[tuple[Annotated[float, between(1e-6, 1e6)], ...], option("S S ...")] = (
        1.0,
        2.0,
        4.0,
        8.0,
        16.0,
        32.0,
        64.0,
        128.0,
    )
    """Scales to compare, in cycles across the picture: deviation of Gaussian, highest of positional frequencies."""
    downscale: Annotated[Downscale | None, option("N", "to about 512 pixels")] = None
    """Reduce the picture by this whole number; a larger one is faster."""
    seed: Annotated[Seed, option("N")] = 0
    """Seed of all random choices."""
    device: Annotated[str, option("NAME")] = "auto"
    """Device to compute on: auto (a GPU if there is one), cpu, cuda, cuda:1."""

    def run(self) -> int:
        if len(set(self.scales)) < 2:
            raise LumigraphError("A curve over scales needs two or more of them; for example --scales 1 10 100")
        from dataclasses import replace

        from ...capture import open_scene, single_image
        from ...explain.encodings import compare
        from ...explain.encodings_page import claim_page, write_page
        from ...methods.fourier_features import FourierFeatures
        from ...system.progress import counting

        if not single_image.recognises(self.picture.expanduser()):
            raise LumigraphError(f"{self.picture} is no image file; name one picture, as in photograph.png")
        folder = self.output or Path("explained") / f"{scene_name(str(self.picture))}-encodings"
        claim_page(folder, self.overwrite, [self.picture.expanduser()])
        device = choose_device(self.device)
        scene = open_scene(self.picture, self.downscale)
        config = replace(FourierFeatures.preset(device), seed=self.seed)
        comparison = compare(scene, tuple(sorted(set(self.scales))), self.steps, device, config)
        with counting("Drawing the page"):
            write_page(folder, comparison)
        show({fit.name: f"{fit.held_out:.2f} dB" for fit in comparison.leading} | {"page": str(folder / "index.html")})
        return 0
