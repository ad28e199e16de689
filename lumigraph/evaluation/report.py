"""Report: a run on one self-contained HTML page with figures, film, curves, contact sheet and settings."""

import base64
import contextlib
import json
import math
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image

from .. import __version__, methods
from ..budget import Budget
from ..color.tags import srgb_bytes
from ..errors import LumigraphError
from ..figures.charts import STYLE as CHARTS
from ..figures.charts import Series, bar_chart, line_chart
from ..files import claim, write_bytes
from ..metrics import scores_of
from ..metrics.rows import last_psnr, of_final_size
from ..readers.pictures import readable
from ..run import Run
from ..run.records import compared_kind
from ..sfm.doctor import grouped
from ..system.progress import clock, short
from ..training.display import extent, pixel_sizes
from ..training.verdict import cameras_moved
from .photographs import SHEET_FILE, examined

THIN_SPACE = "\u202f"
MAX_FILM_BYTES = 12 << 20  # bytes; larger ones are named instead of embedded
STYLE = CHARTS + (Path(__file__).parent / "report.css").read_text("utf-8")


def write_report(run: Run) -> Path:
    """Write RUN/report.html from the run's files: it shows the results of all commands so far."""
    path = claim_report(run)
    evaluation = run.evaluation()
    body = header(run, evaluation) + films(run) + previews(run) + curves(run) + views(run, evaluation) + cameras(run)
    body += photographs(run)
    if (sheet := run.folder / "eval.png").exists():
        body += section("Contact sheet", f"<img class='sheet' src='{jpeg(sheet)}' alt=''>")
    body += settings(run, evaluation)
    write_bytes(path, page(f"{run.title} · {run.method_name}", body, str(run.folder)), "report")
    return path


def claim_report(run: Run, overwrite: bool | None = None) -> Path:
    """RUN/report.html. Raises LumigraphError unless a report may be written there; see `files.claim`."""
    path = run.folder / "report.html"
    claim(path, "report", overwrite)
    return path


def page(title: str, body: str, footer: str) -> bytes:
    """A whole HTML page, with its style inside."""
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<title>{escape(title)}</title>\n'
        f"<style>\n{STYLE}</style>\n</head>\n<body>\n<main>\n{body}</main>\n"
        f"<footer>Lumigraph {escape(__version__)} · {escape(footer)}</footer>\n</body>\n</html>\n"
    ).encode()


def header(run: Run, evaluation: dict[str, Any] | None) -> str:
    figures: list[tuple[str, str, str]] = []
    if run.has_state:
        with contextlib.suppress(LumigraphError):
            count, unit = extent(run.method("cpu"))
            figures.append((f"{count:,}".replace(",", THIN_SPACE), "", unit))
        figures.append((f"{run.model_bytes / 1e6:.3g}", "MB", "model"))
    if run.photographed and len(cameras := run.cameras()["train"]):
        figures.append((pixel_sizes(cameras.size), "pixels", "of a photograph"))
    if run.has_state:
        state = run.state
        lasted = (f"{state.seconds:.0f}", "s") if state.seconds < 1000 else (clock(state.seconds), "min")
        figures.append((*lasted, "of training"))
        figures.append((f"{state.step:,}".replace(",", THIN_SPACE), "", "steps"))
    if (psnr := last_psnr(run.metrics())) is not None:
        figures.append((f"{psnr:.2f}", "dB", "PSNR of training photographs"))
    if evaluation:
        protocol = evaluation["protocol"]
        what = compared_kind(protocol)
        count, split = protocol[what], "held-out" if protocol["split"] == "test" else protocol["split"]
        if what == "shapes" and count == 1:
            split, what = "", "shape"
        for i, score in enumerate(scores_of(evaluation)):
            value = f"{score.value:.{min(score.digits, 3)}f}"
            compared = "" if i else f", {count} {split} {what}".replace("  ", " ")
            figures.append((value, score.unit, score.name + compared))
    if evaluation and "seconds_per_view" in evaluation:
        figures.append((f"{evaluation['seconds_per_view']:.2f}", "s", "to render a view"))
    sentence = f"{run.method_name}, trained on {counted(run)}"
    return heading(run.title, sentence, figures)


def counted(run: Run) -> str:
    """Kind and number of the training inputs of a run."""
    count, one = run.settings.splits.get("train", 0), {"photographs": "photograph", "shapes": "shape"}.get(run.kind)
    return f"{count} {one}{'' if count == 1 else 's'}" if one else f"{run.kind} of {count}"


def heading(title: str, sentence: str, figures: Sequence[tuple[str, str, str]]) -> str:
    """Top of a page. figures: value, unit, and name"""
    cells = "".join(
        f"<div><b>{escape(value)}<small>{escape(unit)}</small></b><span>{escape(label)}</span></div>"
        for value, unit, label in figures
    )
    return f"<header><h1>{escape(title)}</h1><p>{escape(sentence)}</p><div class='figures'>{cells}</div></header>\n"


def films(run: Run) -> str:
    """HTML of the first film in the run's folder, beside its depth."""
    found = [path for path in sorted((run.folder / "renders").glob("*.mp4")) if not path.stem.endswith("-depth")]
    found = sorted(found, key=lambda path: path.stem not in ("orbit", "sweep"))
    if not found:
        return ""
    players = "".join(
        f"<figure><video src='{data_uri(path.read_bytes(), 'video/mp4')}' autoplay loop muted playsinline controls>"
        f"</video><figcaption>{name}</figcaption></figure>"
        for path, name in ((found[0], "colour"), (found[0].with_stem(f"{found[0].stem}-depth"), "depth"))
        if path.exists() and path.stat().st_size < MAX_FILM_BYTES
    )
    names = ", ".join(f"<code>{escape(str(path.relative_to(run.folder)))}</code>" for path in found)
    return section(found[0].stem.capitalize(), f"<div class='row'>{players}</div>", f"Films in the run: {names}")


def previews(run: Run) -> str:
    seconds = {row["step"]: row["seconds"] for row in run.metrics()}
    cells = []
    for step, path in run.previews().items():
        near = min(seconds, key=lambda at: abs(at - step), default=None)
        when = f" · {seconds[near]:.0f} s" if near is not None and abs(near - step) <= 0.1 * step + 10 else ""
        cells.append(f"<figure><img src='{jpeg(path)}' alt=''><figcaption>step {step}{when}</figcaption></figure>")
    if len(cells) < 2:
        return ""
    return section("How the picture came to be", f"<div class='row strip'>{''.join(cells)}</div>")


def curves(run: Run) -> str:
    rows = run.metrics()
    if len(rows) < 3:
        return ""
    seconds, steps = [row["seconds"] for row in rows], [row["step"] for row in rows]
    charts, own = [], methods.colour(run.method_name)
    if any("psnr" in row for row in rows):
        psnr = [row.get("psnr", math.nan) for row in rows]
        full = of_final_size(rows)
        note = f"photographs at full size from step {full[0]['step']} on" if len(full) < len(rows) else ""
        for x, label in ((seconds, "seconds of training"), (steps, "step")):
            charts.append(line_chart([Series("PSNR", x, psnr, own)], label, "PSNR of training batches, dB", note=note))
    names = dict.fromkeys(name for row in rows for name in row["terms"])
    losses = [
        Series(name, steps, [row["terms"].get(name, math.nan) for row in rows], own + i) for i, name in enumerate(names)
    ]
    if losses:
        charts.append(line_chart(losses, "step", "loss", log=True))
    if all("samples" in row["statistics"] for row in rows):
        speed = [
            (b["step"] - a["step"]) * b["statistics"]["samples"] / max(b["seconds"] - a["seconds"], 1e-9)
            for a, b in zip(rows, rows[1:], strict=False)
        ]
        series = Series("samples/s", seconds[1:], speed, own)
        charts.append(line_chart([series], "seconds of training", "samples per second"))
    return section("Curves", side_by_side(charts)) if charts else ""


def side_by_side(charts: Sequence[str]) -> str:
    return f"<div class='charts'>{''.join(f'<figure>{chart}</figure>' for chart in charts)}</div>"


def views(run: Run, evaluation: dict[str, Any] | None) -> str:
    if not evaluation or len(evaluation.get("views", ())) < 2:
        return ""
    scores = evaluation["views"]
    values, own = [view["psnr"] for view in scores], methods.colour(run.method_name)
    chart = bar_chart([view["name"] for view in scores], values, "PSNR, dB", own)
    worst, best = (choose(scores, key=lambda view: view["psnr"]) for choose in (min, max))
    note = (
        f"From {worst['psnr']:.2f} dB ({escape(worst['name'])}) to {best['psnr']:.2f} dB ({escape(best['name'])}); "
        f"the line is the mean. Single values are in <code>eval.json</code>."
    )
    return section("View by view", f"<figure>{chart}</figure>", note)


def cameras(run: Run) -> str:
    """Displacement of each camera, where the method refines poses."""
    if not (run.has_state and run.settings.config.get("refine_cameras")):
        return ""
    moved = cameras_moved(run.method("cpu"), run.cameras()["train"])
    if moved is None or len(names := run.view_names()["train"]) < 2:
        return ""
    own = methods.colour(run.method_name)
    charts = (
        bar_chart(names, moved.turned.tolist(), "turned, degrees", own, "degrees"),
        bar_chart(names, moved.shifted.tolist(), "shifted, % of the extent", own, "%"),
    )
    note = f"Against all of them together: {moved}. The lines are means."
    return section("How far cameras moved", side_by_side(charts), note)


def photographs(run: Run) -> str:
    """The five worst photographs with rendering and difference, and all findings, where the run was examined."""
    if (checked := examined(run)) is None or not (shown := run.folder / SHEET_FILE).exists():
        return ""
    lines = "".join(
        f"<li><b>{escape(fault)}</b>: {escape(sentence)}</li>"
        for fault, sentences in grouped(checked.findings).items()
        for sentence in sentences
    )
    body = f"<img class='sheet' src='{jpeg(shown)}' alt=''>" + (f"<ul>{lines}</ul>" if lines else "")
    note = "" if lines else "No photograph differs from the others by more than chance."
    return section("Photographs to look at", body, note)


def settings(run: Run, evaluation: dict[str, Any] | None) -> str:
    said, frame = run.settings, run.frame
    inputs = {"shapes": "shapes", "a collection": "members"}.get(run.kind, "photographs")
    about = {
        "scene": said.scene.source,
        inputs: ", ".join(f"{count} {name}" for name, count in said.splits.items()),
        **{name: value for name, value in said.scene.options.items() if value is not None},
        "bounds": " to ".join("(" + ", ".join(f"{x:.3g}" for x in corner) + ")" for corner in frame.bounds),
        "half-extent": f"{frame.reach:g} scene units",
        "near": f"{frame.near:.3g}",
        "background": ", ".join(f"{x:g}" for x in frame.background),
        "budget": str(Budget.from_json(said.budget)) if said.budget else "unknown",
        "seed": said.seed,
    }
    tables = [table("Scene", about), table(said.method, said.config)]
    timings = {"trained on": f"{said.device}, {said.processor}"}
    if run.has_state:
        state = run.state
        timings |= {"training": f"{state.seconds:.1f} s", "compiling, beside": f"{state.compile_seconds:.1f} s"}
        timings["per step"] = f"{1000 * state.seconds / max(state.step, 1):.1f} ms"
    rows = [row for row in run.metrics() if "samples" in row["statistics"]]
    if rows:
        timings["samples per step, at the end"] = short(rows[-1]["statistics"]["samples"])
    if evaluation:
        if "seconds_per_view" in evaluation:
            timings["rendering"] = f"{evaluation['seconds_per_view']:.3f} s per view, on {evaluation['evaluated_on']}"
        tables.append(table("Protocol", evaluation["protocol"]))
    tables += [table("Time", timings), table("Made with", said.versions)]
    return section("Settings", f"<div class='tables'>{''.join(tables)}</div>")


def section(title: str, body: str, note: str = "") -> str:
    return f"<section><h2>{escape(title)}</h2>{body}{f'<p class=note>{note}</p>' if note else ''}</section>\n"


def table(title: str, rows: dict[str, Any]) -> str:
    cells = "".join(
        f"<tr><th>{escape(name.replace('_', ' '))}</th><td>{escape(plain(x))}</td></tr>" for name, x in rows.items()
    )
    return f"<table><caption>{escape(title)}</caption>{cells}</table>"


def plain(value: Any) -> str:
    match value:
        case None:
            return "none"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:g}"
        case dict() | list():
            return json.dumps(value)
    return str(value)


def jpeg(path: Path) -> str:
    """A picture as a JPEG small enough to embed in a page."""
    with readable(path), Image.open(path) as image:
        return data_uri(srgb_bytes(image.convert("RGB"), "JPEG", quality=90, optimize=True), "image/jpeg")


def data_uri(data: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
