"""`lumigraph eval`: score a run on held-out photographs or shapes."""

from dataclasses import dataclass
from typing import Annotated, Any

from ..evaluation.options import EvaluationOptions
from ..files.options import DeviceOption, Overwrite, RunOption, Set, option
from ..system.console import bold
from .common import choose_device
from .results import Evaluation, Reports


@dataclass(frozen=True, kw_only=True)
class Eval(Reports, EvaluationOptions):
    """Compare a run with held-out photographs, or its surface with the training shapes.

    Writes RUN/eval.json (per view and mean PSNR, SSIM and fine detail, also by resolution where there are several, the
    protocol, timings) and RUN/eval.png, a contact sheet of photograph, rendering, error and depth. File names of other
    splits than test contain the split. LPIPS needs weights: torchvision's AlexNet and the LPIPS authors' v0.1/alex.pth.
    Shapes have IoU, chamfer distance and normal consistency instead. A capture that moves is compared by what was held
    out, cameras, moments or both, and where a mask of what moves is known, by that alone as well.
    """

    run_folder: RunOption
    overwrite: Overwrite = False
    scene: Annotated[str | None, option("SCENE", "the path used in training")] = None
    """Path of the training data, if it was moved since training."""
    settings: Set = ()
    device: DeviceOption = "auto"

    def of(self, opened: Any) -> Evaluation:
        from ..evaluation.run import claim_evaluation, evaluate_run, stem
        from ..large import open_run
        from ..metrics import scores_of
        from ..metrics.detail import FineDetail
        from ..metrics.rows import last_psnr
        from ..run import Trained
        from ..run.records import read_evaluation
        from .outcome import beside_training, next_commands

        run = opened if isinstance(opened, Trained) else open_run(self.run_folder)
        claim_evaluation(run, self, self.overwrite)
        method, data = run.method_and_data(choose_device(self.device), self.settings, self.scene, self.split)
        result = evaluate_run(run, method, data, self)
        rows: dict[str, Any] = {score.name: bold(score) for score in scores_of(result)}
        if "detail" in result:
            rows["detail"] = str(FineDetail(**result["detail"]))
        for name, part in (result.get("by_resolution", {}) | result.get("by_held_out", {})).items():
            rows[name] = f"{', '.join(f'{x.name} {x}' for x in scores_of(part))}, {part['views']} views"
        if trivial := result.get("baselines"):
            rows["without training"] = ", ".join(f"{name} {value:.2f}" for name, value in trivial.items())
        if cloud := result.get("cloud"):
            rows["cloud"] = f"{cloud['gaussians']:,} Gaussians, {cloud['needles']:.1%} of them needles"
        if "tracking" in result:
            rows["frames followed"] = result["tracking"]["share"]
        name = run.folder / stem(self.split)
        rows |= compared(result) | {"files": f"{name}.json, {name}.png"}
        learnt = last_psnr(run.metrics())
        if learnt is not None and self.split != "train" and "psnr" in result:
            rows["photographs learnt from"] = beside_training(learnt, result, run, method)
        path = name.with_name(f"{name.name}.json")
        return Evaluation(path, read_evaluation(path), rows=rows | next_commands(run, "eval"))


def compared(result: dict[str, Any]) -> dict[str, str]:
    """Compared views with their size and rendering time, shapes, or renderings of words, as text."""
    from ..run.records import compared_kind

    protocol = result["protocol"]
    what = compared_kind(protocol)
    count, there = protocol[what], protocol["of"]
    some = f"{count} of {protocol['split']}" if count == there else f"{count} of {there} of {protocol['split']}"
    members = f", {protocol['members']} members" if "members" in protocol else ""
    if what != "views":
        return {what: f"{some}{members}"}
    sizes = protocol["resolution"]
    shown = sizes if isinstance(sizes, str) else ", ".join(sizes)
    halves = {"protocol": protocol["halves"]} if protocol.get("halves") else {}
    rendering = {"rendering": f"{result['seconds_per_view']:.3f} s per view"}
    return {what: f"{some}{members}, {shown}"} | halves | rendering
