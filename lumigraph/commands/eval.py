"""`lumigraph eval`: held-out photographs against renderings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional

from .common import choose_device, needed, option, scene_name, show


@dataclass(frozen=True)
class Eval:
    """Compare a run with photographs that it has not seen.

    Writes RUN/eval.json (per view and mean PSNR and SSIM, also by resolution where there are several, the protocol,
    timings) and RUN/eval.png, a contact sheet of photograph, rendering, error and depth. Other splits than test have
    their names in the files'. LPIPS is measured where you have the weights: torchvision's AlexNet and the LPIPS
    authors' v0.1/alex.pth.
    """

    run_folder: Annotated[Positional[Path], needed("RUN")]
    """Folder of the run."""
    split: Literal["test", "val", "train"] = "test"
    """Which photographs."""
    views: Annotated[int | None, option("N", "all")] = None
    """Compare so many of them only, evenly spread."""
    lpips: Annotated[tuple[Path, ...], option("FILE", "those in LUMIGRAPH_LPIPS, if any")] = ()
    """Files with the weights of LPIPS, .pth or .safetensors."""
    save_images: bool = False
    """Keep every rendering, as RUN/eval/NAME.png."""
    scene: Annotated[str | None, option("SCENE", "where they were")] = None
    """Where the photographs are now, if they have moved."""
    device: Annotated[str, option("NAME")] = "auto"
    """auto, cpu, cuda, cuda:1."""

    def run(self) -> int:
        from ..run import Run

        run, lpips = Run(self.run_folder), chosen_lpips(self.lpips)
        method = run.method(choose_device(self.device))
        scene = run.scene(self.scene)
        result = evaluate_run(run, method, scene, self.split, self.save_images, self.views, lpips)
        protocol = result["protocol"]
        rows = {"PSNR": f"[bold]{result['psnr']:.2f} dB[/bold]", "SSIM": f"[bold]{result['ssim']:.4f}[/bold]"}
        if lpips:
            rows["LPIPS"] = f"[bold]{result['lpips']:.4f}[/bold]"
        for size, part in result.get("by_resolution", {}).items():
            rows[size] = f"{part['psnr']:.2f} dB, SSIM {part['ssim']:.4f}, {part['views']} views"
        show(
            rows
            | {
                "views": f"{counted_views(protocol)}, {resolutions(protocol)}",
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


def chosen_lpips(given: Sequence[Path]) -> Any:
    """LPIPS with the weights that an option or the environment names; None if neither does."""
    from ..lpips import load_lpips, named_files

    paths = named_files(given)
    return load_lpips(paths) if paths else None


def counted_views(protocol: dict[str, Any]) -> str:
    """How many views were compared, of how many."""
    views, there = protocol["views"], protocol["of"]
    return f"{views} of {protocol['split']}" if views == there else f"{views} of {there} of {protocol['split']}"


def resolutions(protocol: dict[str, Any]) -> str:
    sizes = protocol["resolution"]
    return sizes if isinstance(sizes, str) else ", ".join(sizes)


def evaluate_run(
    run: Any,
    method: Any,
    scene: Any,
    split: str = "test",
    save_images: bool = False,
    views: int | None = None,
    lpips: Any = None,
) -> dict[str, Any]:
    """Evaluate a Run's Method on its Scene and write the files. Returns what eval.json says."""
    from ..evaluate import evaluate, file_name
    from ..figures import save_picture
    from ..files import write_json

    def keep(name: str, rendering: Any) -> None:
        if save_images:
            save_picture(run.folder / "eval" / f"{file_name(name)}.png", rendering.rgb)

    evaluation, state = evaluate(method, scene, split, keep, views, lpips), run.state
    result = evaluation.to_json() | {
        "training_seconds": state.seconds,
        "compile_seconds": state.compile_seconds,
        "peak_memory": state.peak_memory,
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
