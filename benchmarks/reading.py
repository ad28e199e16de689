"""The reading edition beside the package: lines, processor seconds, quality, and the same work with the kernels.

    python benchmarks/reading.py --publish COMMIT      run all programs, and write results/reading-cpu.json
    python benchmarks/reading.py --operations COMMIT   time single operations on equal inputs, in half a minute
    python benchmarks/reading.py NAME --kernels        run one, with the package's kernels in place of its functions

`ENGINES` names functions of the reading edition, and what computes the same in the package.
`tests/test_reading_edition.py` compares them. Here a whole program runs with them: its pictures and errors must agree,
and its seconds may not.
Seconds are user and system time of the process over two, so other programs beside it count little; those of compiling
kernels and of tracing the photographs are spent in a run ahead of it.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch

from lumigraph import kernels
from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.components.fields.encodings import FourierEncoding, FrequencyEncoding
from lumigraph.components.sampling.sampling import inverse_transform
from lumigraph.gaussians.splatting import view_of
from lumigraph.kernels.factor_grid import Factors
from lumigraph.kernels.hash_encode import HashLevels
from lumigraph.kernels.octree_cells import Tree
from lumigraph.methods.neus.fields import NeuSField
from lumigraph.training.display import machine

ROOT = Path(__file__).parent.parent
FOLDER, RESULTS = ROOT / "lumigraph" / "reading", ROOT / "benchmarks" / "results" / "reading-cpu.json"
NAMES = ("camera volume nerf hashgrid factors surface deform pose bake "
         "microsplat splats stereo tsdf lightfield fourier").split()  # fmt: skip


# The package's functions, called as the reading edition calls its own


def weights(sigma, delta):
    tau = (sigma * delta).flatten()
    starts = torch.arange(len(sigma) + 1) * sigma.shape[1]
    return kernels.composite(tau, tau.detach()[:, None], starts)[2].view(sigma.shape)


def weights_of_alpha(alpha):
    return weights(-torch.log1p(-alpha.clamp(max=1 - 1e-7)), torch.ones_like(alpha))


def encode(p, octaves):
    return FrequencyEncoding(3 if p.shape[-1] == 3 else p.shape[-1], octaves)(p.reshape(-1, p.shape[-1])).view(
        *p.shape[:-1], -1
    )


def hash_encode(points, tables, sizes):
    log2 = max(len(table) for table in tables).bit_length() - 1
    levels = HashLevels(len(tables), tables[0].shape[1], log2, sizes[0], sizes[-1])
    return kernels.hash_encode(points, torch.cat(list(tables)), levels)


def products(points, planes, lines):
    table = [x.permute(1, 2, 0).flatten(0, 1) for x in planes] + [x.t() for x in lines]
    nodes = tuple(x.shape[1] for x in lines)
    return kernels.factor_grid(points, torch.cat(table), Factors("vm", nodes))


def neus_alphas(f, slope, delta, s):
    return 1 - torch.exp(-NeuSField.thickness(SimpleNamespace(annealed=1.0), f, slope, delta, s))


def project(cloud, pose, focal, size):
    lens = Pinhole(torch.full((1, 2), focal), torch.tensor([size]) / 2)
    view = view_of(Camera(pose[None], lens, torch.tensor([size])), 0.1)
    given = cloud["means"], cloud["quaternions"], cloud["log_scales"].exp(), cloud["logits"].sigmoid()
    centres, conics, depths, colours, opacities = kernels.project(*given, cloud["harmonics"], view, bands=2)
    return (centres, conics, opacities, colours), depths


def draw(prints, depths, size, target=None):
    with torch.enable_grad():
        leaves = tuple(x.detach().requires_grad_() for x in prints)
        centres, conics, opacities, colours = leaves
        tiles = kernels.tile(centres, conics, opacities, depths.detach(), size)
        rgb, _, opacity = kernels.rasterize(centres, conics, opacities, colours, depths.detach(), tiles, 0.0)
        picture = rgb + (1 - opacity[..., None])
        if target is not None:
            (picture - target).abs().mean().backward()
    return picture.detach(), tuple(torch.zeros_like(x) if x.grad is None else x.grad for x in leaves)


def draw_flat(cloud, width, height, target=None):
    """`microsplat.draw` by the rasteriser; the order is that of the numbers."""
    from lumigraph.reading import microsplat

    conics = microsplat.conics(cloud["log_scale"], cloud["angle"])
    opacity = 1 / (1 + np.exp(-cloud["logit"]))
    given = [torch.tensor(x, dtype=torch.float32) for x in (cloud["mu"], conics, opacity, cloud["colour"])]
    leaves, depths = tuple(x.requires_grad_() for x in given), torch.ones(len(conics))
    with torch.enable_grad():
        tiles = kernels.tile(leaves[0], leaves[1], leaves[2], depths, (width, height))
        picture = kernels.rasterize(*leaves, depths, tiles, 0.0)[0].view(-1, 3)
        if target is not None:
            (0.5 * (picture - torch.tensor(target, dtype=torch.float32)).square().sum()).backward()
    g_mu, g_conics, g_o, g_colour = (np.zeros(x.shape) if x.grad is None else x.grad.double().numpy() for x in leaves)
    scale, angle = microsplat.conics_gradient(cloud["log_scale"], cloud["angle"], g_conics)
    gradient = {"mu": g_mu, "log_scale": scale, "angle": angle, "logit": g_o * opacity * (1 - opacity)}
    return picture.detach().double().numpy(), gradient | {"colour": g_colour}


def census_costs(left, right, count):
    sides = left.byte(), right.byte()
    everywhere = torch.ones(left.shape, dtype=torch.bool)
    return kernels.census_cost(*sides, everywhere, everywhere, 0, count)


def disparity(costs):
    from lumigraph.reading.stereo import P1, P2

    guide = torch.zeros(costs.shape[:2], dtype=torch.uint8)
    return kernels.semi_global(costs.byte(), guide, torch.full((256,), P2, dtype=torch.uint8), P1, 0)[0]


def fuse(volume, points, depth, rgb, pose, focal):
    """`tsdf.fuse` by blocks of 8^3 voxels, whose corner is the first voxel."""
    from lumigraph.reading import tsdf

    shape = tsdf.voxel_centres()[1]
    blocks = [-(-n // 8) for n in shape]
    flat = torch.cat([volume[0][:, None], volume[1][:, None], volume[2]], 1).view(*shape, 5)
    whole = torch.tensor([1.0, 0, 0, 0, 0]).repeat(*(8 * n for n in blocks), 1)
    whole[: shape[0], : shape[1], : shape[2]] = flat
    parts = whole.view(blocks[0], 8, blocks[1], 8, blocks[2], 8, 5).permute(0, 2, 4, 1, 3, 5, 6)
    places = torch.cartesian_prod(*(torch.arange(n, dtype=torch.int32) for n in blocks))
    shifted = torch.cat([pose[:, :3], (pose[:, 3] - points[0])[:, None]], 1)
    height, width = depth.shape
    lens, trust = torch.tensor([focal, focal, width / 2, height / 2]), torch.ones(height, width)
    numbers = tsdf.VOXEL, tsdf.TRUNCATION, 0.03
    found = kernels.fuse_depth(parts.reshape(-1, 512, 5), places, depth, rgb, trust, shifted, lens, *numbers)
    found = found.view(*blocks, 8, 8, 8, 5).permute(0, 3, 1, 4, 2, 5, 6).reshape(whole.shape)
    found = found[: shape[0], : shape[1], : shape[2]].reshape(-1, 5)
    return found[:, 0], found[:, 1], found[:, 2:]


def draw_octree(children, sigma, k, o, d):
    from lumigraph.reading import bake

    low, side = bake.BOX[0], float((bake.BOX[1] - bake.BOX[0]).max())
    tree = Tree(children.int(), torch.zeros(0, dtype=torch.int32), len(sigma), bake.DEPTH)
    rgb, _, opacity = kernels.octree_march(((o - low) / side).contiguous(), d.contiguous(), tree, sigma * side, k)
    return rgb + (1 - opacity[:, None])


def gamma(v, B):
    return v if B is None else FourierEncoding(B)(v)


HASH = {"hashgrid.encode": hash_encode, "hashgrid.weights": weights}
ENGINES: dict[str, dict[str, Callable[..., Any]]] = {
    "volume": {"volume.weights": weights},
    "nerf": {"nerf.weights": weights, "nerf.encode": encode, "nerf.invert": inverse_transform},
    "hashgrid": HASH,
    "factors": {"factors.products": products, "factors.weights": weights},
    "surface": {"surface.weights": weights_of_alpha, "surface.invert": inverse_transform},
    "deform": HASH | {"deform.weights": weights},
    "pose": HASH,
    "bake": HASH | {"bake.draw": draw_octree},
    "microsplat": {"microsplat.draw": draw_flat},
    "splats": {"splats.project": project, "splats.draw": draw},
    "stereo": {"stereo.census_costs": census_costs, "stereo.disparity": disparity},
    "tsdf": {"tsdf.fuse": fuse},
}


def module(name: str) -> ModuleType:
    return importlib.import_module(f"lumigraph.reading.{name}")


def engaged(name: str) -> None:
    """Put the package's functions in the place of the reading edition's."""
    for place, function in ENGINES[name].items():
        owner, attribute = place.split(".")
        setattr(module(owner), attribute, function)


# The table

KINDS = {"publish": "seconds", "operations": "ms"}  # commands, and a figure that each adds


def measured(name: str, folder: Path, with_kernels: bool) -> tuple[float, str]:
    """Processor seconds over two of one program, and the text that it printed."""
    words = [sys.executable, "-u", __file__, name, *(["--kernels"] if with_kernels else [])]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    printed = subprocess.run(words, cwd=folder, env=environment, check=True, capture_output=True, text=True).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / 2, printed


RESULT = {  # figure of each program in what it prints
    "volume": r"()\n *64 .*?([+-]\d\S+)$", "stereo": r"(depth error) ([\d.]+ %)", "tsdf": r"(40) .*, ([\d.]+) off",
    "lightfield": r"(with depth) +([\d.]+ dB)", "fourier": r"(sigma 8).*?([\d.]+ dB) between",
    "pose": r"(dB before), ([\d.]+ dB) after", "bake": r"(octree) ([\d.]+ dB)", "microsplat": r"(s) +([\d.]+ dB)\n/",
    "surface": r"()([\d.]+) scene units off", "deform": r"(moment).*?([\d.]+ dB) unseen",
}  # fmt: skip


def figure(name: str, printed: str) -> str:
    """The last figure of what a program printed."""
    if name == "camera":
        return "four lenses"
    found = re.findall(RESULT.get(name, r"()([\d.]+ dB)"), printed, re.MULTILINE)
    return found[-1][1] + (" scene units" if name in ("tsdf", "surface") else "")


def inputs(name: str) -> tuple[str, tuple[Any, ...]]:
    """An operation of a program, "file.function", and inputs about as large as the program's own."""
    program = module(name)
    torch.manual_seed(0)
    rays = torch.rand(1024, 96)
    if name == "nerf":
        return "nerf.invert", (rays.sort(1).values, rays[:, 1:], torch.rand(1024, 24).sort(1).values)
    if name in ("volume", "surface"):
        return f"{name}.weights", (rays, 0.1 * rays) if name == "volume" else (0.3 * rays,)
    if name in ("hashgrid", "deform", "pose"):
        sizes = program.resolutions(8, 16, 256) if name == "hashgrid" else module("hashgrid").resolutions(8, 16, 256)
        tables = [torch.randn(min((n + 1) ** 3, 2**15), 2) for n in sizes]
        return "hashgrid.encode", (torch.rand(20_000, 3), tables, sizes)
    if name == "factors":
        return "factors.products", (torch.rand(20_000, 3), *program.factors(16, [96, 96, 48], 1.0))
    if name == "bake":
        place = torch.cartesian_prod(*[torch.arange(64)] * 3)
        cells = place[((place - 31.5).norm(dim=1) < 20) & (place[:, 2] < 32)]
        program.DEPTH = 6
        tree = program.tree(cells, torch.full((len(cells),), 9.0) + cells[:, 0], torch.zeros(len(cells), 4, 3), 6)
        view = module("camera").look_at(torch.tensor([2.0, -2.5, 1.0]), torch.zeros(3))
        return "bake.draw", (*tree, *module("camera").pinhole_rays(torch.zeros(64, 64, 3), view, 100.0))
    if name == "microsplat":
        image = np.random.default_rng(0).random((128, 128, 3))
        return "microsplat.draw", (program.random_cloud(image, 900), 128, 128, image.reshape(-1, 3))
    if name == "splats":
        cloud = {"means": torch.randn(2500, 3) * 0.3, "quaternions": torch.randn(2500, 4)}
        cloud |= {"log_scales": torch.randn(2500, 3) * 0.3 - 3.2, "logits": torch.randn(2500)}
        cloud["harmonics"] = torch.randn(2500, 4, 3) * 0.3
        view = module("camera").look_at(torch.tensor([2.0, -2.5, 1.0]), torch.zeros(3))
        return "splats.draw", (*program.project(cloud, view, 197.0, (128, 128)), (128, 128), torch.rand(128, 128, 3))
    if name == "stereo":
        return "stereo.disparity", (torch.randint(0, 30, (120, 160, 40)),)
    points, shape = program.voxel_centres()
    view = module("camera").look_at(torch.tensor([2.0, -2.5, 1.0]), torch.zeros(3))
    flat = 3 + torch.zeros(128, 128)
    return "tsdf.fuse", (program.empty(len(points)), points, flat, torch.rand(128, 128, 3), view, 197.0)


def milliseconds(function: Callable[..., Any], *given: Any) -> float:
    """Processor time of one call, the least of three after one."""
    found = []
    with torch.no_grad():
        for _ in range(4):
            begin = time.process_time()
            function(*given)
            found.append(1000 * (time.process_time() - begin))
    return min(found[1:])


def operations(commit: str, names: list[str]) -> None:
    """Time one operation of each program with the program's own function and with the package's, on equal inputs."""
    for name in names:
        place, given = inputs(name)
        owner, attribute = place.split(".")
        own = getattr(module(owner), attribute)
        row = {"operation": place, "ms": milliseconds(own, *given)}
        row["kernel_ms"] = milliseconds(ENGINES[name].get(place) or HASH[place], *given)
        print(name, row, flush=True)
        write(commit, name, row)


def write(commit: str, name: str, row: dict[str, Any]) -> None:
    """Add figures of one program to the results; those of others stay."""
    rows = {row["name"]: row for row in json.loads(RESULTS.read_text("utf-8"))["cells"]} if RESULTS.exists() else {}
    lines = len((FOLDER / f"{name}.py").read_text("utf-8").splitlines())
    rows[name] = rows.get(name, {}) | {"name": name, "lines": lines} | row
    seen = {key for one in rows.values() for key in one}
    found = {
        "commit": commit,
        "machine": machine(torch.device("cpu")),
        "cells": [rows[x] for x in NAMES if x in rows],
    }
    found["commands"] = [f"python benchmarks/reading.py --{x} COMMIT" for x, key in KINDS.items() if key in seen]
    RESULTS.write_text(json.dumps(found, indent=1) + "\n", "utf-8")


def publish(commit: str, names: list[str]) -> None:
    """Run programs, with and without kernels, and write their rows."""
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            seconds, printed = measured(name, Path(folder), False)
            row: dict[str, Any] = {"seconds": round(seconds, 1), "figure": figure(name, printed)}
            if name in ENGINES:
                with_kernels, printed = measured(name, Path(folder), True)
                row |= {"kernel_seconds": round(with_kernels, 1), "kernel_figure": figure(name, printed)}
        print(name, row, flush=True)
        write(commit, name, row)


def main(words: list[str]) -> None:
    if words[:1] == ["--publish"]:
        publish(words[1], words[2:] or list(NAMES))
        return
    if words[:1] == ["--operations"]:
        operations(words[1], words[2:] or list(ENGINES))
        return
    if words[1:] == ["--kernels"]:
        engaged(words[0])
    module(words[0]).main()


if __name__ == "__main__":
    main(sys.argv[1:])
