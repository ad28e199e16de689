"""`lumigraph.rasterization` and `lumigraph.gsplat` beside gsplat: parameters, gsplat's own tests, trainings.

    python benchmarks/gsplat_compat.py                              every parameter: accepted, and its largest errors
    python benchmarks/gsplat_compat.py --tests CHECKOUT             gsplat's own tests, from its checkout, on this CPU
    python benchmarks/gsplat_compat.py --data PATH --steps 600      small trainings by strategies, on photographs
    python benchmarks/gsplat_compat.py --own PATH --steps 600       a loop of public functions beside `lumigraph train`
    python benchmarks/gsplat_compat.py ... --publish                also write the figures for `tables.py`

Errors are of pictures, opacities and gradients (of all tensors, of a camera's translation and of absgrad), of the
largest value, against the equations by autograd in float64 (tests/test_rasterization.py). Tests are copied to a
temporary folder, with "cuda" replaced by "cpu" and smaller scenes; see foreign/gsplat_adapted.py.
"""

from __future__ import annotations

import inspect
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import lumigraph
from lumigraph import kernels
from lumigraph.components.clouds.density_control import RefineNumbers
from lumigraph.components.clouds.initialization import initial_cloud
from lumigraph.errors import LumigraphError
from lumigraph.gaussians.rasterization import matrices_of
from lumigraph.gsplat import DefaultStrategy, DensitySteps, MCMCStrategy
from lumigraph.metrics import psnr

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))
import test_rasterization as truth  # noqa: E402

RESULTS = ROOT / "benchmarks" / "results" / "gsplat-cpu.json"
FILES = ("relocation", "strategy", "2dgs", "rasterization", "basic")  # of gsplat's tests
WITHOUT = "not lidar and not contributing"  # lists of contributing Gaussians are not among our names
WAYS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # a value of a parameter, and the equation's
    **{name: ({}, {}) for name in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width",
                                   "height", "absgrad")},
    "near_plane": ({"near_plane": 0.1}, {}),
    "far_plane": ({"far_plane": 1e3}, {}),
    "radius_clip": ({"radius_clip": 0.5}, {}),
    "eps2d": ({"eps2d": 0.05}, {"blur": 0.05}),
    "packed": ({"packed": False}, {}),
    "tile_size": ({"tile_size": 8}, {}),
    "sparse_grad": ({"sparse_grad": True}, {}),
    "rasterize_mode": ({"rasterize_mode": "antialiased"}, {"antialiased": True}),
    "channel_chunk": ({"channel_chunk": 2}, {}),
    "camera_model": ({"camera_model": "fisheye"}, {"model": "fisheye"}),
    "camera_model ortho": ({"camera_model": "ortho"}, {"model": "ortho"}),
    "segmented": ({"segmented": True}, {}),
    "covars": ({"covars": True}, {}),
    "include_last": ({"include_last": True}, {"exclusive": False}),
    "render_mode": ({}, {}),
    "renderer_config": ({"renderer_config": 1}, {}),
}  # fmt: skip
REFUSED: dict[str, Any] = {
    "distributed": True, "with_eval3d": True, "return_normals": True, "rays": torch.zeros(1),
    "ftheta_coeffs": 1, "lidar_coeffs": 1, "external_distortion_coeffs": 1, "rolling_shutter": 1,
    "viewmats_rs": torch.eye(4),
}  # fmt: skip
# Parameters that tests/test_rasterization.py compares in another way than WAYS.
ELSEWHERE = {
    "sh_degree": "orthonormal up to degree 4",
    "backgrounds": "equal to single calls",
    "extra_signals": "equal to a call of their own",
    "extra_signals_sh_degree": "as sh_degree",
    "with_ut": "small Gaussians as without",
    "ut_params": "see with_ut",
    "global_z_order": "with_ut",
    "radial_coeffs": "centres by OpenCV's equation",
    "tangential_coeffs": "centres by OpenCV's equation",
    "thin_prism_coeffs": "gsplat's tests",
}
Row = dict[str, Any]


@dataclass(frozen=True)
class Options:
    tests: Path | None = None  # a checkout of gsplat
    data: Path | None = None  # photographs with poses and sparse points
    own: Path | None = None  # photographs with poses, without distortion
    steps: int = 600  # of each training
    seeds: tuple[int, ...] = (0, 1, 2)  # of --own
    downscale: int = 8
    strategies: tuple[str, ...] = ("default", "default absgrad", "mcmc", "none")
    seconds: float = 900  # after which gsplat's tests are ended; what has not run is not counted
    publish: bool = False

    def run(self) -> None:
        found: dict[str, Any] = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
        found["parameters"] = [*parameters()]
        if self.tests:
            found["owntests"] = own_tests(self.tests, self.seconds)
        if self.data:
            found["trainings"] = [training(name, self) for name in self.strategies]
        if self.own:
            rows = [own_loop(self.own, self, seed) for seed in self.seeds]
            others = [row for row in found.get("loops", []) if row["scene"] != self.own.name]
            found["loops"] = [*others, *rows]
        print(json.dumps(found, indent=1))
        if self.publish:
            commit = subprocess.check_output(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, text=True).strip()
            found["parameters"] = [row | {k: float(f"{row[k]:.1e}") for k in ("value", "gradient") if k in row}
                                   for row in found["parameters"]]  # fmt: skip
            command = "python benchmarks/gsplat_compat.py"
            found["commands"] = {
                "parameters": [command],
                "owntests": [f"{command} --tests CHECKOUT"],
                "loops": [
                    f"{command} --own {row} --steps {self.steps} --downscale {self.downscale}"
                    for row in dict.fromkeys(row["scene"] for row in found.get("loops", []))
                ],
                "trainings": [f"{command} --data fox --steps {self.steps} --downscale {self.downscale}"],
            }
            found |= {"commit": commit, "machine": f"cpu, {os.cpu_count()} threads"}
            RESULTS.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


def parameters() -> Iterator[Row]:
    """Each parameter of the call with its default, whether it is accepted, and its largest errors."""
    for name, parameter in inspect.signature(lumigraph.rasterization).parameters.items():
        default = "" if parameter.default is inspect.Parameter.empty else repr(parameter.default)
        row = {"parameter": name, "default": default}
        if name in REFUSED:
            yield row | {"accepted": "no", "sentence": sentence({name: REFUSED[name]})}
        elif name in ELSEWHERE:
            yield row | {"accepted": "yes", "check": ELSEWHERE[name]}
        else:
            for way in (x for x in WAYS if x.split()[0] == name):
                yield row | {"accepted": "yes"} | errors(*WAYS[way]) | {"parameter": way}


def sentence(option: Row) -> str:
    """Sentence by which an option is refused."""
    given, (viewmats, Ks) = truth.cloud(), truth.cameras(1)
    try:
        lumigraph.rasterization(**given, viewmats=viewmats, Ks=Ks, width=20, height=16, **option)
    except LumigraphError as refusal:
        return str(refusal)
    raise SystemExit(f"{option} is accepted, and was thought to be refused")


def errors(options: Row, exact: Row) -> Row:
    """Largest errors of values and of gradients, of the largest value of each."""
    options, given, (viewmats, Ks) = dict(options), truth.cloud(), truth.cameras(1)
    if options.get("camera_model") == "ortho":
        Ks[:, [0, 1], [0, 1]] /= 3
    spare: Row = {}
    if options.pop("covars", False):
        axes = truth.to_matrix(given["quats"]) * given["scales"][:, None]
        given = {name: given[name] for name in ("means", "opacities", "colors")} | {"covars": axes @ axes.mT}
        spare = {"quats": None, "scales": None}
    wanted = {name: x.double().requires_grad_() for name, x in given.items()}
    ours = {name: x.clone().requires_grad_() for name, x in given.items()}
    poses, pose = viewmats.clone().requires_grad_(), viewmats[0].double().requires_grad_()
    width, height = truth.SIZE
    sizes = {"Ks": Ks, "width": width, "height": height, "render_mode": "RGB+D", "absgrad": True}
    picture, alpha, info = lumigraph.rasterization(**ours, **spare, viewmats=poses, **sizes, **options)
    spread = torch.zeros(len(given["means"]), 2, dtype=torch.float64)
    values, opacity = truth.exactly(wanted, pose, Ks[0].double(), **exact, spread=spread)
    weight = torch.rand(height, width, 5, generator=torch.Generator().manual_seed(0)).double() - 0.3
    (torch.cat([picture[0], alpha[0]], -1).double() * weight).sum().backward()
    (torch.cat([values, opacity[..., None]], -1) * weight).sum().backward()
    pairs = [(ours[name].grad, wanted[name].grad) for name in given] + [(poses.grad[0, :3, 3], pose.grad[:3, 3])]
    rows = info["means2d"].absgrad
    pairs += [(rows, spread[info["gaussian_ids"]]) if info["gaussian_ids"] is not None else (rows[0], spread)]
    value = max(truth.largest(picture[0], values), truth.largest(alpha[0, ..., 0], opacity))
    return {"value": value, "gradient": max(truth.largest(*pair) for pair in pairs)}


def own_tests(checkout: Path, seconds: float) -> list[Row]:
    """Outcomes of gsplat's own tests, counted by function."""
    with tempfile.TemporaryDirectory() as folder:
        copy, outcomes = Path(folder), Path(folder) / "outcomes.json"
        for name in ("gsplat", "tests", "assets"):
            shutil.copytree(checkout / name, copy / name)
        for file in [*(copy / "tests").rglob("*.py"), copy / "gsplat" / "_helper.py"]:
            text = file.read_text("utf-8").replace("cuda:0", "cpu").replace('"cuda"', '"cpu"')
            text = text.replace("[10_000],  # N", "[200],  # N").replace("300, 200\n", "75, 50\n")
            text = text.replace("focal = 300.0", "focal = 75.0").replace("W, H = 640, 480", "W, H = 96, 80")
            file.write_text(text.replace("    N = 1000\n", "    N = 60\n"), "utf-8")
        around = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "benchmarks" / "foreign"), folder]),
            "LUMIGRAPH_OUTCOMES": str(outcomes),
            "OMP_NUM_THREADS": "1",  # tensors are small
        }
        files = [f"tests/test_{name}.py" for name in FILES]
        words = ["-m", "pytest", "-p", "gsplat_adapted", "--noconftest", "-q", "--tb=no", "-k", WITHOUT, *files]
        try:
            subprocess.run([sys.executable, *words], cwd=copy, env=around, timeout=seconds, check=False)
        except subprocess.TimeoutExpired:
            print(f"The tests are ended after {seconds:g} s")
        found = json.loads(outcomes.read_text("utf-8"))
    return counted(found)


def counted(found: dict[str, list[str]]) -> list[Row]:
    """Outcomes by test function, and the reason of the first that failed or was refused."""
    rows: dict[str, Counter[str]] = {}
    reasons: dict[str, str] = {}
    for test, (kind, reason) in found.items():
        name = test.split("[")[0].removeprefix("tests/").replace(".py::", " ")
        rows.setdefault(name, Counter())[kind] += 1
        if kind in ("failed", "refused"):
            reasons.setdefault(name, reason)
    return [{"test": name, **count, "reason": reasons.get(name, "")} for name, count in rows.items()]


def training(name: str, options: Options) -> Row:
    """A small training by one of gsplat's strategies, and its PSNR on held-out photographs."""
    assert options.data is not None
    scene = lumigraph.open_scene(options.data, downscale=options.downscale)
    if scene.points is None:
        raise SystemExit(f"{options.data} has no sparse points to begin at")
    random = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    cameras, Ks, undistorted = pinholes(scene)
    params, optimizers = begun(scene)
    extent = float((scene.cameras.position - scene.cameras.position.mean(0)).norm(dim=-1).max())
    when = {"refine_start_iter": options.steps // 6, "refine_stop_iter": options.steps * 3 // 4,
            "refine_every": max(options.steps // 20, 1)}  # fmt: skip
    absolute = "absgrad" in name
    strategy: Any = {"mcmc": lambda: MCMCStrategy(cap_max=40_000, **when), "none": lambda: None}.get(
        name, lambda: DefaultStrategy(absgrad=absolute, grow_grad2d=8e-4 if absolute else 2e-4, **when)
    )()
    state: Any = {}
    if strategy is not None:
        state = strategy.initialize_state(*([extent] if isinstance(strategy, DefaultStrategy) else []))
        strategy.check_sanity(params, optimizers)
    train, begin = scene.splits["train"], time.process_time()
    for step in range(options.steps):
        i = int(train[torch.randint(len(train), (), generator=random)])
        target = undistorted(i)
        picture, _, info = seen(params, cameras[i : i + 1], Ks[i : i + 1], target, absolute)
        if isinstance(strategy, DefaultStrategy):
            strategy.step_pre_backward(params, optimizers, state, step, info)
        ssim, l1 = kernels.photometric(picture[0], target)
        (0.8 * l1 + 0.2 * (1 - ssim)).backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if isinstance(strategy, DefaultStrategy):
            strategy.step_post_backward(params, optimizers, state, step, info, packed=True)
        elif strategy is not None:
            strategy.step_post_backward(
                params, optimizers, state, step, info, lr=optimizers["means"].param_groups[0]["lr"]
            )
    seconds, scores = time.process_time() - begin, []
    with torch.no_grad():
        for i in scene.splits["test"].tolist():
            target = undistorted(i)
            picture, _, _ = seen(params, cameras[i : i + 1], Ks[i : i + 1], target, False)
            scores.append(psnr(picture[0].clamp(0, 1), target))
    return {"strategy": name, "steps": options.steps, "psnr": sum(scores) / len(scores), "views": len(scores),
            "gaussians": len(params["means"]), "seconds": seconds, "scene": options.data.name,
            "size": f"{target.shape[1]} x {target.shape[0]}"}  # fmt: skip


def own_loop(path: Path, options: Options, seed: int) -> Row:
    """PSNR on held-out photographs of a loop of public functions with `DensitySteps`, and of `train` at equal steps."""
    cap, steps, until = 20_000, options.steps, 0.75
    scene = lumigraph.open_scene(path, downscale=options.downscale)
    train, test, random = scene.splits["train"], scene.splits["test"][:12], torch.Generator().manual_seed(seed)
    viewmats, Ks = matrices_of(scene.cameras)
    has_alpha = scene.frame.has_alpha
    beyond = torch.full((1, 3), 1.0 if has_alpha else 0.0)

    start = initial_cloud(scene, "sparse", 10_000, cap, 3, random)
    rates = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 0.05, "sh0": 2.5e-3, "shN": 2.5e-3 / 20}
    values = {"means": start.means, "quats": start.quaternions, "scales": start.log_scales,
              "opacities": start.opacities, "sh0": start.harmonics[:, :1], "shN": start.harmonics[:, 1:]}  # fmt: skip
    params = {name: torch.nn.Parameter(value.clone()) for name, value in values.items()}
    optimizers = {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}
    away = scene.cameras[train].position
    extent = 1.1 * float((away - away.mean(0)).norm(dim=-1).max())
    strategy = DensitySteps(steps, cap, "error", RefineNumbers(cap_ramp=True, refine_until=until))
    state = strategy.initialize_state(len(start), extent, seed)

    def picture(i: int, background: torch.Tensor, bands: int, **further: Any) -> tuple[torch.Tensor, Any]:
        height, width, _ = scene.photograph(i).rgb.shape
        rgb, _, info = lumigraph.rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            torch.cat([params["sh0"], params["shN"]], 1), viewmats[i : i + 1], Ks[i : i + 1], width, height,
            sh_degree=bands, backgrounds=background, near_plane=0.1 * scene.frame.near, **further)  # fmt: skip
        return rgb[0], info

    order: list[int] = []
    for step in range(steps):
        order = order or train[torch.randperm(len(train), generator=random)].tolist()
        i, share = order.pop(), step / steps
        behind = torch.rand(1, 3, generator=random) if has_alpha else beyond
        target = scene.photograph(i).before(behind[0])
        optimizers["means"].param_groups[0]["lr"] = extent * 1.6e-4 * 0.01**share
        explained = torch.zeros(len(params["means"]), requires_grad=True)
        rgb, info = picture(i, behind, min(3, int(8 * share)), extra_signals=explained[:, None])
        target = torch.where(trusted(scene.photograph(i)), target, rgb.detach())
        ssim, l1 = kernels.photometric(rgb, target)
        error = (rgb - target).detach().abs().mean(-1)
        loss = 0.8 * l1 + 0.2 * (1 - ssim) + (info["render_extra_signals"][0, ..., 0] * error / error.numel()).sum()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        info["explained"] = explained
        strategy.step(params, optimizers, state, step + 1, info)
    with tempfile.TemporaryDirectory() as folder:
        model = lumigraph.train(path, "gaussian-splatting", Path(folder) / "run", preset="paper", strategy="error",
            steps=steps, downscale=options.downscale, seed=seed, max_gaussians=cap, cap_ramp=True, refine_until=until,
            initial_gaussians=10_000)  # fmt: skip
        with torch.no_grad():
            truth = [(i, scene.photograph(i).before(beyond[0]), trusted(scene.photograph(i))) for i in test.tolist()]
            theirs = [
                psnr(model.render(scene.cameras[i]).rgb[kept[..., 0]].clamp(0, 1), rgb[kept[..., 0]])
                for i, rgb, kept in truth
            ]
            ours = [
                psnr(picture(i, beyond, 3)[0][kept[..., 0]].clamp(0, 1), rgb[kept[..., 0]]) for i, rgb, kept in truth
            ]
    return {"scene": path.name, "steps": steps, "seed": seed, "own": sum(ours) / len(ours),
            "train": sum(theirs) / len(theirs), "gaussians": len(params["means"]), "views": len(ours)}  # fmt: skip


def trusted(photograph: Any) -> torch.Tensor:
    """Mask of the pixels that are learnt and compared, (height, width, 1)."""
    whole = torch.ones(photograph.rgb.shape[:2], dtype=torch.bool)
    return (whole if photograph.mask is None else photograph.mask)[..., None]


def seen(params: Any, viewmats: Any, Ks: Any, target: Any, absolute: bool) -> tuple[Any, Any, Any]:
    height, width, _ = target.shape
    shapes = params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
    colours = torch.cat([params["sh0"], params["shN"]], 1)
    return lumigraph.rasterization(*shapes, colours, viewmats, Ks, width, height, sh_degree=1, absgrad=absolute)


def pinholes(scene: Any) -> tuple[Any, Any, Any]:
    """Matrices of all cameras without distortion, and a function of photographs as these see them."""
    import dataclasses

    from lumigraph.camera.lens import Pinhole

    lens = scene.cameras.lens
    plain = Pinhole(lens.focal, lens.centre)
    straight = dataclasses.replace(scene.cameras, lens=plain)
    pictures: dict[int, Any] = {}

    def photograph(i: int) -> Any:
        if i not in pictures:
            found = scene.photograph(i)
            height, width, _ = found.rgb.shape
            camera = straight[i]
            pixels, _ = scene.cameras[i].lens.project(camera.lens.unproject(camera.pixels()))
            grid = (pixels / torch.tensor([width, height]) * 2 - 1).view(1, height, width, 2)
            bent = torch.nn.functional.grid_sample(found.rgb.movedim(-1, 0)[None], grid, align_corners=False,
                                                   padding_mode="border")  # fmt: skip
            pictures[i] = bent[0].movedim(0, -1).contiguous()
        return pictures[i]

    viewmats, Ks = matrices_of(straight)
    return viewmats, Ks, photograph


def begun(scene: Any) -> tuple[Any, Any]:
    """Gaussians at the sparse points, and an optimizer of each tensor."""
    points, colours = scene.points, scene.point_colours.float() / 255
    points, colours = points[:4000], colours[:4000]
    nearest = torch.cdist(points, points).topk(4, largest=False).values[:, 1:].mean(-1).clamp(1e-4, 0.1)
    count = len(nearest)
    start = {
        "means": points.clone(),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "scales": nearest.log()[:, None].repeat(1, 3),
        "opacities": torch.full((count,), 0.1).logit(),
        "sh0": ((colours - 0.5) / 0.28209479)[:, None],
        "shN": torch.zeros(count, 3, 3),
    }
    rates = {"means": 1e-3, "quats": 2e-3, "scales": 1e-2, "opacities": 5e-2, "sh0": 1e-2, "shN": 5e-4}
    params = {name: torch.nn.Parameter(x.float()) for name, x in start.items()}
    return params, {name: torch.optim.Adam([params[name]], lr=rate, eps=1e-15) for name, rate in rates.items()}


if __name__ == "__main__":
    import tyro

    tyro.cli(Options, description=__doc__).run()
