"""Gallery: every method on the smallest suitable data, on one page.

OUTPUT/
├── gallery.html    pictures, scores, times, published figures
├── data/           a mesh, a picture and a model of captions, training data of some methods
└── runs/, results.json, results.md    as of every benchmark
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from ... import files, methods
from ...budget import Budget
from ...errors import LumigraphError
from ...evaluation.report import jpeg, page
from ...evaluation.views import file_name
from ...figures import save_picture
from ...metrics import scores_of
from ...opening import open_scene
from ...run import Run
from .cell import Cell, CellSettings, Row, read_rows
from .conduct import STOP_CODES, Launch, conduct, launch, reason
from .published import first_of
from .table import size

PAGE, LOG = "gallery.html", "captions.log"
MESH, PICTURE, CAPTIONS = "data/knot.ply", "data/picture.png", "data/captions"
OBJECT, MOVING = "procedural:still-life,size=160,views=40", "procedural:jelly,size=100,views=60,sweeps=8"
TOYS, CHAIRS = "procedural:toys,count=20,size=48,views=12", "procedural:chairs,count=20,size=48,views=12"
RECORDING = "procedural:room,depth,views=60,size=120"
EVAL_VIEWS = 3
CAPTION_NUMBERS = ("--pictures", "600", "--steps", "300")  # a minute of one processor


@dataclass(frozen=True)
class Showpiece:
    """A method's entry. source: smallest suitable data; idea: its contribution in a line; options: further ones of
    `lumigraph train`; views: training photographs"""

    source: str
    idea: str
    options: tuple[str, ...] = ()
    views: int | None = None


SECTIONS: dict[str, dict[str, Showpiece]] = {
    "Pictures and light fields": {
        "fourier-features": Showpiece(
            PICTURE,
            "A coordinate network learns detail once its input is a set of waves.",
        ),
        "lumigraph": Showpiece(OBJECT, "Photographs blended ray by ray over a rough surface; no training."),
        "view-interpolation": Showpiece(OBJECT, "Neighbouring photographs warped forward by their depth; no training."),
        "deep-appearance": Showpiece(
            "procedural:head", "A code and a view direction give a mesh and its view-dependent texture."
        ),
    },
    "Radiance fields": {
        "nerf": Showpiece(
            OBJECT,
            "Density and colour in the weights of a network, learnt through volume rendering.",
        ),
        "mip-nerf": Showpiece(
            OBJECT,
            "Pixels are cones, so that detail below a pixel fades instead of aliasing.",
        ),
        "nerf-w": Showpiece(
            "procedural:tourists,size=120,views=60", "A code for the light of each photograph, and passers-by apart."
        ),
        "block-nerf": Showpiece(
            "procedural:city,crossings=2,views=60,size=120",
            "A city in blocks that train alone and are blended.",
            options=("--blocks", "1"),
        ),
        "rawnerf": Showpiece(
            "procedural:night,size=100,views=30", "Linear light from noisy mosaics; exposure is chosen later."
        ),
        "regnerf": Showpiece(
            OBJECT,
            "Three photographs, and smooth depth in views that nobody took.",
            views=3,
        ),
    },
    "Grids, tables and Gaussians": {
        "dvgo": Showpiece(OBJECT, "Voxels of density and features."),
        "plenoxels": Showpiece(OBJECT, "Sparse voxels of harmonics, no network."),
        "plenoctrees": Showpiece(OBJECT, "Harmonics baked into an octree."),
        "snerg": Showpiece(
            OBJECT,
            "Baked blocks of voxels, one small network per pixel.",
        ),
        "tensorf": Showpiece(OBJECT, "Voxels as sums of products of planes and lines."),
        "instant-ngp": Showpiece(OBJECT, "Hash tables of many resolutions."),
        "gaussian-splatting": Showpiece(OBJECT, "A cloud of Gaussians, rasterised."),
    },
    "Shape": {
        "occupancy-network": Showpiece(MESH, "A network that classifies points as inside or outside."),
        "deepsdf": Showpiece(MESH, "Signed distance of a point under the code of a shape."),
        "nglod": Showpiece(MESH, "Codes in an octree, with levels of detail."),
        "dvr": Showpiece(OBJECT, "Occupancy and texture from photographs by implicit differentiation."),
        "mesh-fit": Showpiece(OBJECT, "Triangles moved by gradients of a rasteriser, in large steps."),
        "voxel-fit": Showpiece(OBJECT, "Voxels fitted to photographs, the easy start of a mesh."),
        "neus": Showpiece(OBJECT, "A signed distance as a radiance field."),
        "planar-splatting": Showpiece(OBJECT, "Flat Gaussians whose depths agree."),
    },
    "Depth cameras": {
        "tsdf-fusion": Showpiece(RECORDING, "Truncated signed distance averaged in hashed blocks of voxels."),
        "imap": Showpiece(RECORDING, "One network is the map and the tracker."),
        "splat-slam": Showpiece(RECORDING, "Gaussians as the map."),
    },
    "What moves": {
        "nerfies": Showpiece(MOVING, "A field that bends from moment to moment."),
        "nsff": Showpiece(MOVING, "Scene flow between moments."),
        "neural-volumes": Showpiece(
            "procedural:jelly,rig=12,size=80,views=120", "Photographs of a moment become a warped volume."
        ),
        "deformable-splatting": Showpiece(MOVING, "Gaussians moved by planes of space and time."),
        "humannerf": Showpiece("procedural:walker", "A person before one camera, by bones."),
        "articulated-splatting": Showpiece("procedural:walker", "Gaussians on bones, at any pose."),
    },
    "Objects and light": {
        "neural-scene-graph": Showpiece("procedural:traffic,size=120,views=60", "Cars in boxes, with codes."),
        "object-nerf": Showpiece(OBJECT, "A branch for the scene, a branch with a code for each object."),
        "nerfactor": Showpiece(
            "procedural:materials,size=100,views=30", "Shape, albedo, reflectance and light taken apart."
        ),
    },
    "Across scenes": {
        "pixelnerf": Showpiece(TOYS, "Features of photographs at points of a field."),
        "srn": Showpiece(CHAIRS, "A hypernetwork and a learnt ray marcher."),
        "hyp-nerf": Showpiece(TOYS, "A hypernetwork makes the hash table of an object."),
        "eg3d": Showpiece(TOYS, "A generator on three planes, learnt from an adversary."),
    },
    "Imagination": {
        "dream-fields": Showpiece(
            "words:a red cube beside a blue ball", "A field learnt from words.", options=("--guidance", CAPTIONS)
        ),
        "dream-splats": Showpiece(
            "words:a red cube beside a blue ball", "Gaussians learnt from words.", options=("--guidance", CAPTIONS)
        ),
        "gancraft": Showpiece("procedural:blocks", "Block worlds as landscapes, by a network that paints labels."),
    },
}
SHOWPIECES = {name: piece for section in SECTIONS.values() for name, piece in section.items()}


def gallery(
    names: Sequence[str], seconds: float, output: Path, tell: Callable[[str], object] = print, launch: Launch = launch
) -> int:
    """Train and evaluate methods, and write the page. Finished ones are kept. Returns the signal's exit code if one
    stopped it, otherwise 0.

    names: of methods; those without a Showpiece are refused
    seconds: of training of each
    """
    if missing := [name for name in names if name not in SHOWPIECES]:
        raise LumigraphError(f"{', '.join(missing)} has no place in the gallery; name others: {', '.join(SHOWPIECES)}")
    files.claim(output / PAGE, "benchmark")
    cells = [cell_of(name, seconds, output) for name in SHOWPIECES if name in names]
    sources = {SHOWPIECES[name].source for name in names}
    guided = any(CAPTIONS in SHOWPIECES[name].options for name in names)
    if code := prepare(sources, guided, output, tell, launch):
        return code
    if code := conduct(cells, CellSettings(eval_views=EVAL_VIEWS), output, tell, launch):
        return code
    write_gallery(cells, output)
    return 0


def cell_of(name: str, seconds: float, output: Path) -> Cell:
    """Cell of a method's Showpiece. Data files are those of `prepare`."""
    piece = SHOWPIECES[name]
    here = piece.source in (MESH, PICTURE)
    source = str((output / piece.source).resolve()) if here else piece.source
    scene = files.scene_name(piece.source)
    further = tuple(str(output / word) if word == CAPTIONS else word for word in piece.options)
    return Cell(name, scene, source, Budget(None, seconds), views=piece.views, further=further)


def prepare(sources: set[str], guided: bool, output: Path, tell: Callable[[str], object], launch: Launch) -> int:
    """Make the data of methods that train on files, unless they exist. Returns the exit code."""
    if MESH in sources and not (output / MESH).exists():
        import trimesh

        knot = trimesh.creation.torus(0.7, 0.25, 64, 32)
        (output / MESH).parent.mkdir(parents=True, exist_ok=True)
        files.write_bytes(output / MESH, knot.export(file_type="ply"), "benchmark")
    if PICTURE in sources and not (output / PICTURE).exists():
        (output / PICTURE).parent.mkdir(parents=True, exist_ok=True)
        scene = open_scene(OBJECT)
        save_picture(output / PICTURE, scene.photograph(0).before(scene.frame.background), "benchmark")
    if guided and not (output / CAPTIONS).exists():
        tell("A model of captions, for the methods that learn from words")
        code = launch(["train", "captions", *CAPTION_NUMBERS, "--output", str(output / CAPTIONS)], output / LOG)
        if code in STOP_CODES:
            return code
        if code:
            raise LumigraphError(f"the model of captions could not be trained: {reason(output / LOG, code)}")
    return 0


def write_gallery(cells: Sequence[Cell], output: Path) -> None:
    """Write the page of these cells, whatever else the output has."""
    rows = read_rows(output)
    found = {cell.method: rows[f"runs/{cell.name}"] for cell in cells if f"runs/{cell.name}" in rows}
    body = "<header><h1>Gallery</h1><p>Every method on the smallest data that it is meant for</p></header>"
    for title, section in SECTIONS.items():
        if cards := "".join(card(name, piece, found[name], output) for name, piece in section.items() if name in found):
            body += f"<section><h2>{escape(title)}</h2><div class='gallery'>{cards}</div></section>"
    trained = sorted({row["trained_on"] for row in found.values() if not row["failed"]})
    load = f"load {os.getloadavg()[2]:.1f} over a quarter of an hour" if hasattr(os, "getloadavg") else ""
    files.write_bytes(output / PAGE, page("Gallery", body, " · ".join(filter(None, [*trained, load]))), "benchmark")


def card(name: str, piece: Showpiece, row: Row, output: Path) -> str:
    """A method's picture, idea and figures."""
    lines = [f"<b>{escape(name)}</b>", escape(methods.summary(name)), escape(piece.idea)]
    picture = ""
    if row["failed"]:
        lines.append(f"failed: {escape(row['failed'])}")
    else:
        score = [f"{one.name} {one}" for one in scores_of(row)[:1]]
        views = f" from {row['train_views']} views" if row.get("train_views") else ""
        spent = f"{row['steps']} steps in {row['training_seconds']:.0f} s{views}, {size(row['model_bytes'])}"
        lines.append(" · ".join([*score, spent]))
        if path := picture_of(row, output):
            picture = f"<img src='{jpeg(path)}' alt='{escape(name)}'>"
    if known := first_of(name):
        lines.append(f"published, of other data: {escape(known.sentence)}")
    text = "".join(f"<p>{line}</p>" for line in lines)
    return f"<figure>{picture}<figcaption>{text}<code>{escape(row['command'])}</code></figcaption></figure>"


def picture_of(row: Row, output: Path) -> Path | None:
    """Stored rendering of a held-out view, else the latest training preview."""
    run = output / row["run"]
    if "shown" in row and (path := run / "eval" / f"{file_name(row['shown']['name'])}.png").exists():
        return path
    previews = Run(run).previews()
    return previews[max(previews)] if previews else None
