"""`lumigraph eval`: held-out photographs against renderings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from .common import choose_device, needed, option, scene_name, show


@dataclass(frozen=True)
class Eval:
    """Compare a run with photographs that it has not seen.

    Writes RUN/eval.json (per view and mean PSNR and SSIM, the protocol, timings) and RUN/eval.png, a contact sheet of
    photograph, rendering, error and depth. Other splits than test have their names in the files'.
    """

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run."""
    split: Literal["test", "val", "train"] = "test"
    """Which photographs."""
    save_images: bool = False
    """Keep every rendering, as RUN/eval/NAME.png."""
    scene: Annotated[str | None, option("SCENE", "where they were")] = None
    """Where the photographs are now, if they have moved."""
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..run import Run

        run = Run(self.run_folder)
        method = run.method(choose_device(self.device))
        result = evaluate_run(run, method, run.scene(self.scene), self.split, self.save_images)
        protocol = result["protocol"]
        show(
            {
                "PSNR": f"[bold]{result['psnr']:.2f} dB[/bold]",
                "SSIM": f"[bold]{result['ssim']:.4f}[/bold]",
                "views": f"{protocol['views']} of {protocol['split']}, {protocol['resolution']}",
                "rendering": f"{result['seconds_per_view']:.3f} s per view",
                "files": f"{run.folder / self.stem}.json, {run.folder / self.stem}.png",
            }
        )
        return 0

    @property
    def stem(self) -> str:
        return stem(self.split)


def stem(split: str) -> str:
    return "eval" if split == "test" else f"eval-{split}"


def evaluate_run(run: Any, method: Any, scene: Any, split: str = "test", save_images: bool = False) -> dict[str, Any]:
    """Evaluate a Run's Method on its Scene and write the files. Returns what eval.json says."""
    from ..evaluate import evaluate
    from ..figures import save_picture
    from ..files import write_json

    def keep(name: str, rendering: Any) -> None:
        if save_images:
            save_picture(run.folder / "eval" / f"{file_name(name)}.png", rendering.rgb)

    evaluation, state = evaluate(method, scene, split, keep), run.state
    result = evaluation.to_json() | {
        "training_seconds": state.seconds,
        "compile_seconds": state.compile_seconds,
        "steps": state.step,
        "method": run.method_name,
        "scene": run.config["scene"],
        "trained_on": f"{run.config['device']}, {run.config['processor']}",
        "evaluated_on": str(method.device),
        "versions": run.config["versions"],
    }
    title = (
        f"{run.method_name} · {scene_name(run.config['scene']['source'])} · {len(evaluation.views)} {split} views · "
        f"{evaluation.psnr:.2f} dB · SSIM {evaluation.ssim:.3f}"
    )
    save_picture(run.folder / f"{stem(split)}.png", evaluation.contact_sheet(title))
    write_json(run.folder / f"{stem(split)}.json", result)
    return result


def file_name(name: str) -> str:
    """A view's name without folders and ending."""
    return str(Path(name).with_suffix("")).strip("./").replace("/", "-")
