"""Report of `train` and `resume` at the end: result, advice and next commands."""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from ..budget import QUALITIES, Budget
from ..datasets.scene import Scene
from ..datasets.world import BlockWorld
from ..errors import LumigraphError, LumigraphWarning
from ..method import Method, RayMethod
from .common import finding_rows, say, show, typed

if TYPE_CHECKING:
    from ..evaluation.photographs import Examined
    from ..sfm.doctor import Residual

SUGGESTED_SECONDS = (10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0, 7200.0)  # seconds that are suggested
FULL_SIZE_SHARE = 0.45  # share of training below which a trend spans less than its second half
MIN_GROWTH = 2.5  # times the budget so far that a suggestion has at least
MEMORISED_DB = 4.0  # dB by which training photographs are better than held-out ones if they are memorised
WORST_VIEWS = 2  # held-out views that are named
OTHER_METHODS = "instant-ngp", "gaussian-splatting"  # of which the other is suggested for comparison
ABOUT_RESIDUALS = "small renderings, each after a gain and an offset per colour"
NEXT = {"eval": "compare with held-out views", "view": "open in the browser", "export": "make a page to share"}


def show_outcome(run: Any, outcome: Any, method: Method, data: Any, turn: Any = nullcontext) -> None:
    """Print the state of a Run after an Outcome, and the next commands. turn: see `examine`"""
    from ..evaluation.photographs import RESULT_FILE
    from ..evaluation.tracking import tracks
    from ..metrics.rows import last_psnr
    from ..sfm.doctor import FOLDED
    from ..training.verdict import cameras_moved, loss_trend

    if tracks(method):
        return show_tracking(run, outcome, method, data)
    state, budget = outcome.state, Budget.from_json(run.settings.budget)
    besides = f"{state.compile_seconds:.1f} s compiling, {outcome.saving_seconds:.1f} s saving"
    rows = {"run": str(run.folder), "training": f"{state.step} steps in {state.seconds:.1f} s (besides: {besides})"}
    by_photograph = not isinstance(method, RayMethod)
    if state.passes:
        rows["seen"] = seen(state.passes, "photograph" if by_photograph else "pixel")
    if not outcome.finished:
        say(f"Stopped and saved after step {state.step}; go on with: {typed('resume', run.folder)}")
        show(rows)
        return
    metrics = run.metrics()
    trend, psnr = loss_trend(metrics, by_photograph), last_psnr(metrics)
    if psnr is not None:
        rows["PSNR of training photographs"] = f"{psnr:.2f} dB"
    if trend:
        how = f"fell by {100 * trend.fall:.0f} %" if trend.falling else "did not fall any more"
        whole = trend.share > FULL_SIZE_SHARE
        rows["loss"] = f"{how} {'over the second half of training' if whole else 'with photographs at full size'}"
    if isinstance(data, Scene) and (moved := cameras_moved(method, data.cameras[data.splits["train"]])):
        rows["cameras moved by"] = str(moved)
    enough = state.step >= method.steps_for("draft", data)
    more = more_time(run.folder, budget) if enough else typed("resume", run.folder, "--quality", "draft")
    checked, gap = examined(run, method, data, turn), 0.0
    learnt, held_out = ([one.psnr for one in checked.of(split)] for split in ("train", "test"))
    if learnt and held_out and not method.moves_cameras:  # poses of held-out photographs are not learnt
        psnr, other = (sum(some) / len(some) for some in (learnt, held_out))
        beside = "" if method.complete else f", training photographs {psnr:.1f} dB"  # it shows these themselves
        rows["held-out photographs"] = f"{other:.1f} dB{beside} ({ABOUT_RESIDUALS})"
        gap = psnr - other
        warn_below(run, method, checked.of("test"))
    if not method.complete:
        rows["advice"] = advice(trend, enough, more, photographed(run, data))
    if enough and not method.complete and gap > MEMORISED_DB:
        rows["advice"] = memorised(gap, run, method, [one.photograph for one in checked.of("test")])
    if any(finding.fault == FOLDED for finding in checked.findings):
        rows["advice"] = "the cameras may be wrong, which neither time nor photographs mend; find them anew first"
    show(rows | finding_rows(checked.findings, str(run.folder / RESULT_FILE)) | next_commands(run))


def show_tracking(run: Any, outcome: Any, method: Any, data: Any, processor_seconds: float | None = None) -> None:
    """Write the trajectory of a run and print its errors, lost frames and next commands."""
    from ..evaluation.tracking import DRIFT_FILE, PATH_FILE, TRAJECTORY_FILE, Followed, mapping_scores, write_tracking

    state, sequence = outcome.state, method.tracker.sequence(data)
    followed = min(state.step, len(sequence))
    speed = followed / max(state.seconds, 1e-9)
    figures = {"frames_per_second": speed}
    rows = {"run": str(run.folder), "tracking": f"{followed} frames in {state.seconds:.1f} s, {speed:.2f} frames/s"}
    if processor_seconds is not None and followed:
        figures["processor_seconds_per_frame"] = processor_seconds / followed
        rows["tracking"] += f", {processor_seconds / followed:.2f} processor seconds a frame"
    mapped = mapping_scores(method, data) if outcome.finished else []
    found = write_tracking(run, method, data, figures, mapped)
    if not outcome.finished:
        say(f"Stopped and saved after step {state.step}; go on with: {typed('resume', run.folder)}")
    rows["frames followed"] = str(Followed.of(method, data))
    rows["trajectory"] = str(run.folder / TRAJECTORY_FILE)
    rows |= {"path": str(run.folder / PATH_FILE)} if found.map else {}
    rows |= {"loops closed": str(len(found.loops))} if method.tracker.loops is not None else {}
    if (errors := found.errors) is not None:
        rows |= {score.name: str(score) for score in errors.scores}
        rows["drift"] = f"{run.folder / DRIFT_FILE}, {100 * errors.largest:.2f} cm at most in {errors.path:.2f} m"
    rows |= {score.name: str(score) for score in mapped}
    show(rows | (next_commands(run) if outcome.finished else {}))


def examined(run: Any, method: Method, data: Any, turn: Any) -> Examined:
    """Findings on the photographs of a run, which are written into it; a fault of their files is a warning."""
    from ..evaluation.photographs import Examined, examine

    try:
        compared = isinstance(data, Scene) and not issubclass(method.learns_from, BlockWorld)
        return examine(run, method, data, turn) if compared else Examined()
    except LumigraphError as fault:
        say(f"warning: the photographs could not be examined: {fault}")
        return Examined()


def warn_below(run: Any, method: Method, held_out: Sequence[Residual]) -> None:
    """Warn where renderings of held-out photographs are worse than trivial stand-ins."""
    from ..evaluation.baseline import below

    means = {name: statistics.fmean(one.baselines[name] for one in held_out) for name in held_out[0].baselines}
    if sentence := below(
        run.folder, "dB at held-out photographs", statistics.fmean(one.psnr for one in held_out), means
    ):
        warnings.warn(sentence, LumigraphWarning, stacklevel=2)


def memorised(gap: float, run: Any, method: Method, worst: Sequence[str]) -> str:
    """Advice in one sentence for a run with worse held-out than training photographs: active priors and the next step.

    gap:   PSNR of training photographs minus that of held-out ones, dB
    worst: names of held-out photographs, lowest PSNR first
    """
    from ..sfm.doctor import label

    priors = [name for part in method.parts for name in part.few_view_priors]
    applied = f"although priors were on ({', '.join(priors)})" if priors else "and no prior for few photographs was on"
    near = f", first from near {' and '.join(map(label, worst[:WORST_VIEWS]))}" if worst else ""
    steps = [f"more photographs help more than time{near}"]
    groups = [run.settings.config, *(x for x in run.settings.config.values() if isinstance(x, dict))]
    if not priors and any(group.get("few_views") in ("auto", "no") for group in groups):
        steps.append("try --few-views yes")
    other = next(name for name in OTHER_METHODS if name != run.method_name)
    steps.append(f"compare: {typed('train', other, run.settings.scene.source)}")
    text = f"held-out photographs are {gap:.1f} dB worse: it has memorised the others"
    return f"{text}, {applied}; {'; '.join(steps)}"


def beside_training(learnt: float, result: dict[str, Any], run: Any, method: Method) -> str:
    """PSNR of the training photographs as text, and the meaning of a gap to held-out ones. result: of an evaluation"""
    text, gap = f"{learnt:.2f} dB while training", learnt - result["psnr"]
    if gap > MEMORISED_DB:
        worst = sorted(result.get("views", []), key=lambda view: view["psnr"])
        text += f": {memorised(gap, run, method, [view['name'] for view in worst])}"
    return text


def seen(passes: float, what: str) -> str:
    """Mean number of uses of each photograph or pixel in training, as text."""
    if passes >= 1:
        return f"each {what} {passes:.{0 if passes >= 10 else 1}f} times"
    return f"one {what} in {1 / passes:.{0 if passes < 0.1 else 1}f}"


def advice(trend: Any, enough: bool, more: str, photographed: bool) -> str:
    """Advice in one sentence: more time or more photographs.

    trend:  of the loss, see `verdict.loss_trend`
    enough: whether there were as many steps as a draft has
    more:   the command that trains for longer
    photographed: whether photographs could be added
    """
    if trend and trend.falling:
        return f"it was still getting better, so more time will help: {more}"
    if not enough:
        return f"it has had fewer steps than a draft needs, so more time will help: {more}"
    if trend is None:
        return f"it is unknown whether more time would help; to try: {more}"
    settled = "more photographs would help more than time" if photographed else "time changes little"
    return f"it has settled; {settled}"


def photographed(run: Any, data: Any) -> bool:
    """True if a run was trained on photographs of a place, to which some could be added."""
    return run.photographed and len(data.splits["train"]) > 1 and not data.source.startswith("procedural:")


def more_time(folder: Any, budget: Budget) -> str:
    """Command that extends a finished run, by the next larger budget of its kind."""
    longer: list[str]
    if budget.quality in QUALITIES[:-1]:
        longer = ["--quality", QUALITIES[QUALITIES.index(budget.quality) + 1]]
    elif budget.steps is not None:
        digits = 10 ** (int(math.log10(3 * budget.steps)) - 1) if budget.steps > 3 else 1
        longer = ["--steps", str(math.ceil(3 * budget.steps / digits) * digits)]
    else:
        fitting = [total for total in SUGGESTED_SECONDS if total >= MIN_GROWTH * budget.total]
        longer = ["--seconds", f"{fitting[0] if fitting else 2 * budget.total:g}"]
    return typed("resume", folder, *longer)


def next_commands(run: Any, *but: str) -> dict[str, str]:
    """Next commands, with the run's own path. but: commands to leave out."""
    page = run.folder / f"{run.title}.html"
    commands = {"eval": typed("eval", run.folder), "view": typed("view", run.folder)}
    commands["export"] = typed("export", "web", run.folder, page)
    return {NEXT[name]: command for name, command in commands.items() if name not in but}
