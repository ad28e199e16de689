"""The page of `lumigraph explain encodings`: two charts, a sheet of pictures, and their explanation."""

from collections.abc import Iterable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from ...evaluation.report import heading, jpeg, page, section
from ...figures import Row, contact_sheet, save_picture
from ...figures.charts import Series, line_chart, standalone
from ...files import claim, write_bytes, write_json
from .encodings import SCALED_ENCODINGS, EncodingComparison, EncodingFit

CROP, ENLARGEMENT = 96, 3  # pixels a side of the picture's middle, and how many times larger the sheet shows them
CELL = CROP * ENLARGEMENT
MIN_EIGENVALUE = 1e-10  # eigenvalue that is drawn, as a share of the trace


def write_page(folder: Path, comparison: EncodingComparison) -> None:
    """Write index.html, self-contained; and separately scales.svg, spectrum.svg, comparison.png, figures.json."""
    scales, spectrum, sheet = scale_chart(comparison), spectrum_chart(comparison), folder / "comparison.png"
    save_picture(sheet, comparison_sheet(comparison), "figure")
    write_bytes(folder / "scales.svg", standalone(scales), "figure")
    write_bytes(folder / "spectrum.svg", standalone(spectrum), "figure")
    write_json(folder / "figures.json", comparison.to_json(), "figure")
    name = Path(comparison.source).name
    sections = [
        header(name, comparison),
        section("What the scale does", side_by_side((scales, about_scales(comparison)), (spectrum, ABOUT_SPECTRUM))),
        section("What they draw", f"<img class='sheet' src='{jpeg(sheet)}' alt=''>", ABOUT_PICTURES),
    ]
    write_bytes(folder / "index.html", page(f"{name} · encodings", "".join(sections), comparison.source), "figure")


def claim_page(folder: Path, overwrite: bool | None = None, reads: Iterable[Path] = ()) -> None:
    """Raise LumigraphError unless all outputs of `write_page` may be written; see `files.claim`."""
    for name in ("index.html", "scales.svg", "spectrum.svg", "comparison.png", "figures.json"):
        claim(folder / name, "figure", overwrite, reads)


def header(name: str, comparison: EncodingComparison) -> str:
    height, width = comparison.picture.shape[:2]
    sentence = (
        f"One network behind four encodings of where a pixel is: {comparison.steps} steps on half of "
        f"{width}x{height} pixels, scored on the rest"
    )
    return heading(name, sentence, [(f"{fit.held_out:.1f}", "dB", fit.name) for fit in comparison.leading])


def side_by_side(*charts: tuple[str, str]) -> str:
    """Charts, each with a caption below."""
    figures = (f"<figure>{chart}<figcaption>{caption}</figcaption></figure>" for chart, caption in charts)
    return f"<div class='charts'>{''.join(figures)}</div>"


def scale_chart(comparison: EncodingComparison) -> str:
    """PSNR over scales; an encoding without one is a horizontal line."""
    scales = [fit.scale for fit in comparison.of("gaussian") if fit.scale is not None]
    series = []
    for encoding in SCALED_ENCODINGS:
        fits = comparison.of(encoding)
        series.append(Series(f"{encoding}, held out", scales, [fit.held_out for fit in fits]))
        series.append(Series(f"{encoding}, learnt", scales, [fit.learnt for fit in fits]))
    for fit in (comparison.best("basic"), comparison.best("none")):
        series.append(Series(f"{fit.name}, held out", scales, [fit.held_out] * len(scales)))
    return line_chart(series, "scale, cycles across the picture", "PSNR, dB", log_x=True, marks=True, smoothed=False)


def spectrum_chart(comparison: EncodingComparison) -> str:
    """Eigenvalues in falling order, above rounding errors."""
    series = []
    for fit in select_fits(comparison):
        values = [value for value in fit.eigenvalues.tolist() if value > MIN_EIGENVALUE]
        series.append(Series(fit.name, range(1, len(values) + 1), values))
    return line_chart(
        series, "eigenvalue, by rank", "tangent kernel, share of the trace", log=True, log_x=True, smoothed=False
    )


def comparison_sheet(comparison: EncodingComparison):
    """The picture and the networks' reconstructions: whole, and a magnified centre."""
    fits = select_fits(comparison)
    pictures = [comparison.picture, *(fit.rgb.clamp(0, 1) for fit in fits)]
    columns = ["picture", *(f"{fit.name} · {fit.held_out:.2f} dB" for fit in fits)]
    rows = [Row("whole", pictures), Row(f"the middle, {ENLARGEMENT} times larger", [middle(p) for p in pictures])]
    height, width = comparison.picture.shape[:2]
    title = f"{Path(comparison.source).name} · {width}x{height} · {comparison.steps} steps · PSNR of held-out pixels"
    return contact_sheet(title, columns, rows, CELL)


def select_fits(comparison: EncodingComparison) -> list[EncodingFit]:
    """Best fit of each encoding, and Gaussian ones of the smallest and the largest scale."""
    smallest, *_, largest = comparison.of("gaussian")
    *others, best = comparison.leading
    return [
        *others,
        *sorted({fit.scale: fit for fit in (smallest, best, largest)}.values(), key=lambda f: f.scale or 0),
    ]


def middle(picture: Float[Tensor, "height width 3"]) -> Float[Tensor, "tall wide 3"]:
    """A magnified square at the centre, without interpolation."""
    top, left = (max(0, (size - CROP) // 2) for size in picture.shape[:2])
    crop = picture[top : top + CROP, left : left + CROP]
    return torch.repeat_interleave(torch.repeat_interleave(crop, ENLARGEMENT, 0), ENLARGEMENT, 1)


def about_scales(comparison: EncodingComparison) -> str:
    best = comparison.best("gaussian")
    where = "inside of the range" if comparison.peak_inside else "at the end of the range; give other --scales"
    return (
        f"The scale is the frequency up to which the encoding has waves: the larger it is, the closer together two "
        f"places may be that the network can tell apart. At a small scale it cannot follow the picture, and learns "
        f"neither half of the pixels. At a large one it learns each pixel by itself, and the held-out ones between "
        f"them are noise. Gaussian features are best at {best.scale:g} cycles across the "
        f"picture, {where}; they win {comparison.gain:.2f} dB over no encoding. Positional features spread their "
        f"frequencies evenly in octaves up to the scale, along the axes alone."
    )


ABOUT_PICTURES = (
    "The layers and the steps are the same for all. Without an encoding the network draws a smooth wash. At the best "
    "scale it draws detail; far beyond it, pixels that were not learnt are noise."
)
ABOUT_SPECTRUM = (
    "The tangent kernel says how far a step on one pixel moves another. What lies along one of its eigenvectors is "
    "learnt at a rate in proportion to the eigenvalue. Without an encoding eigenvalues fall steeply, so that detail is "
    "out of reach. The larger the scale, the more level they are, until pixels say nothing of their neighbours. Each "
    "curve is the exact kernel of one network before its first step, between the points of a grid."
)
