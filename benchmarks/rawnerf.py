"""RawNeRF beside what else could be made of noisy raw photographs, against the light that there was without noise.

    python benchmarks/rawnerf.py --scene procedural:night,size=200,views=60 --seconds 300

Of each held-out view: RawNeRF's rendering; that of the same field learnt for as long from the developed 8-bit pictures
(instant-ngp); the view's own noisy raw photograph, developed; and the same denoised by the best of several filters and
strengths (scikit-image: non-local means of stabilised mosaics, non-local means and total variation of
developed pictures), picked with the truth at hand. All are compared by `evaluate.light`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Float
from scipy.ndimage import convolve
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle
from torch import Tensor

from lumigraph.camera.rays import Rendering
from lumigraph.components.training.development import decoded, encoded
from lumigraph.datasets.scene import Scene
from lumigraph.evaluation.views import LIGHT_LAYER, in_light
from lumigraph.figures import Row, contact_sheet, save_picture
from lumigraph.files import write_json
from lumigraph.methods import find
from lumigraph.metrics import psnr, ssim_map
from lumigraph.opening import open_scene
from lumigraph.readers.raw.photo import demosaiced
from lumigraph.run import build
from lumigraph.synthetic.sensor import BLACK_LEVEL, DN_PER_PHOTON, READ_NOISE, WHITE_LEVEL
from lumigraph.system.signals import go_on_unless
from lumigraph.training import fit

STRENGTHS = 0.6, 1.0, 1.5, 2.2  # of a filter, about its noise
COLUMNS = ["rawnerf", "same field, 8-bit pictures", "denoised photograph", "noisy photograph"]


@dataclasses.dataclass(frozen=True)
class Options:
    scene: str = "procedural:night,size=200,views=60"
    seconds: float | None = None  # of learning, for each of both fields
    steps: int | None = None  # instead of seconds
    views: int = 8  # held-out ones to compare
    device: str = "cuda" if torch.cuda.is_available() else "cpu"
    picture: Path | None = None  # a contact sheet
    output: Path | None = None  # also write the figures there, as JSON


def main(options: Options) -> None:
    scene = open_scene(options.scene)
    chosen = scene.splits["test"][: options.views].tolist()
    device = torch.device(options.device)
    methods = {"rawnerf": "rawnerf", "same field, 8-bit pictures": "instant-ngp"}
    seen: dict[str, list[Rendering]] = {}
    truths = [scene.photograph(index, (LIGHT_LAYER,)).extra[LIGHT_LAYER] for index in chosen]
    seen["noisy photograph"] = [as_seen(developed(scene, index)) for index in chosen]
    seen["denoised photograph"] = [best(scene, i, truth) for i, truth in zip(chosen, truths, strict=True)]
    for name, kind in methods.items():
        method = build(find(kind), scene.frame, find(kind).preset(device), device, 0)
        go_on_unless(fit(method, scene, seconds=options.seconds, steps=options.steps, show=False).signal)
        method.eval()
        seen[name] = [method.render(scene.cameras[index]).cpu() for index in chosen]
    figures = {name: scores(seen[name], truths) for name in COLUMNS}
    for name, (likeness, structure) in figures.items():
        print(f"{name:28} {likeness:6.2f} dB   SSIM {structure:.3f}")
    if options.picture:
        rows = []
        for k, index in enumerate(chosen):
            pairs = [in_light(seen[name][k], truths[k]) for name in COLUMNS]
            rows.append(Row(scene.names[index], [pairs[0][1], *(rgb for rgb, _ in pairs)]))
        save_picture(options.picture, contact_sheet(options.scene, ["light without noise", *COLUMNS], rows))
    if options.output:
        write_json(options.output, {name: {"psnr": a, "ssim": b} for name, (a, b) in figures.items()})


def scores(seen: list[Rendering], truths: list[Tensor]) -> tuple[float, float]:
    """Mean PSNR and SSIM over views."""
    pairs = [in_light(one, truth) for one, truth in zip(seen, truths, strict=True)]
    return (
        float(np.mean([psnr(*pair) for pair in pairs])),
        float(np.mean([float(ssim_map(*pair).mean()) for pair in pairs])),
    )


def as_seen(light: Float[np.ndarray, "height width 3"]) -> Rendering:
    """Linear sRGB as if it had been rendered."""
    found = torch.from_numpy(np.ascontiguousarray(light, np.float32))
    return Rendering(encoded(found.clamp(0, 1)), found[..., 0], found[..., 0], {LIGHT_LAYER: found})


def developed(scene: Scene, index: int, mosaic: np.ndarray | None = None) -> Float[np.ndarray, "height width 3"]:
    """Linear sRGB of a photograph's mosaic, or of another one in its place."""
    shot = scene.photograph(index, ("mosaic", "filter"))
    filters = shot.extra["filter"].numpy()
    gains = scene.about["white_balance"][index].numpy()
    light = (shot.extra["mosaic"].numpy() if mosaic is None else mosaic) * gains[filters]
    pattern = tuple(map(tuple, filters[:2, :2].tolist()))
    rgb = demosaiced(light.astype(np.float32), pattern) @ scene.about["srgb_from_camera"][index].numpy().T  # type: ignore[arg-type]
    return rgb * float(scene.about["brightness"][index])


def best(scene: Scene, index: int, truth: Tensor) -> Rendering:
    """The denoised photograph that is nearest to the truth."""
    found = [as_seen(light) for light in denoised(scene, index)]
    return max(found, key=lambda seen: psnr(*in_light(seen, truth)))


def denoised(scene: Scene, index: int) -> Iterator[np.ndarray]:
    """Linear sRGB of one photograph, denoised in various ways and strengths."""
    patches = {"patch_size": 5, "patch_distance": 9, "fast_mode": True, "channel_axis": -1}
    mosaic = scene.photograph(index, ("mosaic",)).extra["mosaic"].numpy()
    stable = stabilised(mosaic)
    phases = [np.s_[i::2, j::2] for i in range(2) for j in range(2)]
    stacked = np.stack([stable[phase] for phase in phases], -1)
    picture = encoded(torch.from_numpy(developed(scene, index)).clamp(0, 1)).numpy()
    sigma = noise_of(picture)
    for strength in STRENGTHS:
        clean = np.empty_like(mosaic)
        for phase, plane in zip(
            phases, np.moveaxis(denoise_nl_means(stacked, h=strength, sigma=1, **patches), -1, 0), strict=True
        ):
            clean[phase] = plane
        yield developed(scene, index, linear(clean))
        for found in (
            denoise_nl_means(picture, h=strength * sigma, sigma=sigma, **patches),
            denoise_tv_chambolle(picture, weight=strength * sigma, channel_axis=-1),
        ):
            yield decoded(torch.from_numpy(found.astype(np.float32)).clamp(0, 1)).numpy()


def noise_of(picture: np.ndarray) -> float:
    """The standard deviation of a picture's noise (Immerkær 1996): what a mask that sees no planes leaves of it."""
    mask = np.outer([1, -2, 1], [1, -2, 1])[..., None]
    return float(np.sqrt(np.pi / 2) / 6 * np.abs(convolve(picture, mask)).mean())


def stabilised(mosaic: np.ndarray) -> np.ndarray:
    """Light as numbers whose noise has a deviation of 1 everywhere (generalised Anscombe transform, Starck 1998)."""
    numbers = mosaic * (WHITE_LEVEL - BLACK_LEVEL)
    return (
        2 / DN_PER_PHOTON * np.sqrt(np.maximum(DN_PER_PHOTON * numbers + 3 / 8 * DN_PER_PHOTON**2 + READ_NOISE**2, 0))
    )


def linear(stable: np.ndarray) -> np.ndarray:
    """Back to light."""
    return (
        ((DN_PER_PHOTON * stable / 2) ** 2 - 3 / 8 * DN_PER_PHOTON**2 - READ_NOISE**2)
        / DN_PER_PHOTON
        / (WHITE_LEVEL - BLACK_LEVEL)
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
