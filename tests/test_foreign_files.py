"""Nobody's files are replaced: whatever lies where a command would write, it stays, and the command says so first."""

from __future__ import annotations

import os
import shutil
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import tiny
import tiny_collection
import torch
from budgets import budget
from listing import names
from PIL import Image

from lumigraph import methods
from lumigraph.commands.cli import COMMANDS, main
from lumigraph.errors import LumigraphError
from lumigraph.files import atomic as files
from lumigraph.files import marks, partials
from lumigraph.method import Method
from lumigraph.methods.plenoctrees.baking import fill
from lumigraph.paths.keyframes import CameraPath, Keyframe
from lumigraph.run import Run, State, build
from lumigraph.sfm.folder import WRITTEN_FILES, claim_results, copy_photographs
from lumigraph.sfm.photos import Photo
from lumigraph.sfm.photos.photo import untracked

pytestmark = budget("runs", 15)

# What each command is told, and all that it would write.
FILM = ("film.mp4", "film-depth.mp4", "film.json", "film/")
WRITES: dict[str, tuple[str, tuple[str, ...]]] = {
    "render": ("render ball --frames 2 --size 16 --depth --pictures png --output film.mp4", FILM),
    "render, where films go": (
        "render ball --frames 2 --size 16 --pictures png",
        ("ball/renders/orbit.json", "ball/renders/orbit/"),
    ),
    "render, a run's own name": ("render ball --frames 2 --size 16 --output ball.gif", ("ball.gif", "ball.json")),
    "export web": ("export web gs page.html", ("page.html",)),
    "export lightfield": ("export lightfield ball grid --grid 2 --size 16", ("grid/",)),
    "export lightfield, a quilt": (
        "export lightfield ball q.png --quilt 2 2 --size 16",
        ("q_qs2x2a1.00.png",),
    ),
    "export probes": (
        "export probes ball lights --counts 2 2 2 --resolution 4 --page lights.html",
        ("lights/", "lights.html"),
    ),
    "export octree": ("export octree octree o.npz", ("o.npz",)),
    "export points": ("export points ball p.ply", ("p.ply",)),
    "export splats": ("export splats gs s.spz", ("s.spz",)),
    "export splats, a folder": ("export splats gs open/meta.json", ("open/",)),
    "export splats, levels of detail": ("export splats gs city --lod", ("city/",)),
    "export snerg": ("export snerg gs atlas", ("atlas/",)),
    "export mesh": ("export mesh ball m.glb", ("m.glb",)),
    "export mesh, with a texture": ("export mesh ball m.obj --texture", ("m.obj", "m.mtl", "m.png", "m-normals.png")),
    "export collision": ("export collision ball c.glb", ("c.glb",)),
    "export panorama": ("export panorama ball sphere.png", ("sphere.png",)),
    "export stereo": ("export stereo ball eyes.jpg", ("eyes.jpg",)),
    "clean": ("clean gs --output some.ply", ("some.ply", "some.ply.png")),
    "clean, to a run": ("clean gs --output fewer", ("fewer/",)),
    "segment": (
        "segment gs --strokes strokes.png --view ball_0 --output part.ply",
        ("part.ply", "part.ply.png"),
    ),
    "segment, a field": (
        "segment ball --strokes strokes.png --view ball_0 --output part.json",
        ("part.json", "part.mask.safetensors", "part.json.png"),
    ),
    "segment, masks": (
        "segment gs --strokes strokes.png --view ball_0 --output labels --action masks",
        ("labels/", "labels.png"),
    ),
    "compress": ("compress gs --output small", ("small/", "small")),
    "convert": ("convert ball plenoxels --output other --steps 1 --distil", ("other/", "other")),
    "compose": ("compose gs gs --output two.json", ("two.json",)),
    "canonicalise": ("canonicalise . --output alike", ("alike/", "alike")),
    "report": ("report ball", ("ball/report.html",)),
    "eval": ("eval ball --scene photographs", ("ball/eval.json", "ball/eval.png")),
    "eval, pictures": ("eval ball --scene photographs --save-images", ("ball/eval/ball_4.png",)),
    "explain ray": ("explain ray ball --output ray.svg", ("ray.svg", "ray.json")),
    "explain lightfield": (
        "explain lightfield ball --size 32 --output told2",
        ("told2/lightfield.png", "told2/lightfield.svg", "told2/lightfield.json"),
    ),
    "explain scattering": (
        "explain scattering --steps 1 --size 8 --output fogged",
        ("fogged/scattering.png", "fogged/lamps.svg", "fogged/phase.svg", "fogged/scattering.json"),
    ),
    "explain activation": ("explain activation --steps 2 --output edge.png", ("edge.png",)),
    "explain encodings": ("explain encodings one.png --output told", ("told/index.html", "told/figures.json")),
    "explain template": (
        "explain template ball --scene photographs --into voxel-grid --seconds 0.2 --views 1 --output moved",
        ("moved/", "moved"),
    ),
    "bench kernels": ("bench kernels --output speed.json", ("speed.json",)),
    "bench step": (
        "bench step voxel-grid photographs --warmup 1 --steps 1 --output step.json --flame step.svg",
        ("step.json", "step.svg"),
    ),
    "bench methods": (
        "bench methods --methods voxel-grid --scenes photographs --output bench --steps 1",
        ("bench/results.json", "bench/results.md", "bench/settings.json", "bench/views.png", "bench/lock.json")
        + ("bench/runs/photographs-voxel-grid-1steps-seed0.log",),
    ),
    "gallery": (
        "gallery --methods instant-ngp --output gallery",
        ("gallery/gallery.html", "gallery/results.json", "gallery/results.md", "gallery/settings.json"),
    ),
    "bench shapes": (
        "bench shapes --methods distance-grid --shapes photographs --output bench --steps 1",
        ("bench/shapes.json", "bench/shapes.md"),
    ),
    "infer": ("infer prior photographs --output found", ("found/", "found", "found/lock.json")),
    "draw": (
        "draw drawing --seeds 0:1 --views 1 --output drawn.png --film drawn.gif --frames 1 --score 2",
        ("drawn.png", "drawn.json", "drawn.gif"),
    ),
    "train": ("train voxel-grid photographs --steps 1 --output learnt", ("learnt/", "learnt", "learnt/lock.json")),
    "train captions": (
        "train captions --pictures 30 --steps 1 --batch 4 --width 4 --embedding 8 --output small",
        ("small/",),
    ),
    "track": (
        "track imap procedural:room,depth,views=300,size=32 --frames 2 --downscale 1 --output found",
        ("found/", "found", "found/lock.json"),
    ),
    "train, in blocks": (
        "train block-nerf photographs --field voxel-grid --blocks 2 --steps 2 --output parts",
        ("parts/", "parts", "parts/lock.json"),
    ),
    "demo": ("demo --seconds 1 --output shown", ("shown/", "shown")),
    "capture": ("capture photographs --output placed", ("placed/",)),
    "depth": ("depth photographs --output deep", ("deep/",)),
    "photo3d": ("photo3d photographs photo.html", ("photo.html",)),
    "jump": ("jump procedural:ring,size=24,views=6 pair.png --size 128", ("pair.png",)),
}
WRITE_NOTHING = {"info", "methods"}
# See the tests of checkpoints, of what is saved in the viewer, and of the app, which makes folders of its own.
WITHIN_RUNS = {"app", "georeference", "resume", "view"}


@pytest.fixture(scope="module")
def template(ball_run, ball_folder, tmp_path_factory) -> Path:
    """A folder with four runs, photographs and a picture. Nobody may change it."""
    folder = tmp_path_factory.mktemp("template")
    shutil.copytree(ball_run.folder, folder / "ball")
    shutil.copytree(ball_folder, folder / "photographs")
    gs_run(folder / "gs")
    octree_run(folder / "octree")
    prior_run(folder / "prior")
    prior_run(folder / "drawing", "eg3d")
    Image.new("RGB", (16, 16)).save(folder / "one.png")
    return folder


@pytest.fixture
def home(template, tmp_path, monkeypatch) -> Path:
    """A copy of the template, and the working directory."""
    shutil.copytree(template, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def gs_run(folder: Path) -> Run:
    return run_of(tiny_method("gaussian-splatting"), folder)


def octree_run(folder: Path) -> Run:
    """Eight leaves of nothing."""
    method: Any = tiny_method("plenoctrees")
    fill(method.leaves, torch.arange(8, 16))
    method.teacher = method.teacher_sampler = None
    return run_of(method, folder)


def prior_run(folder: Path, name: str = "tinted-grid") -> Run:
    return run_of(tiny_method(name), folder, tiny_collection.collection())


def tiny_method(name: str) -> Method:
    kind = methods.find(name)
    return build(kind, tiny.scene().frame, kind.smallest(), torch.device("cpu"), 0)


def run_of(method: Method, folder: Path, data: Any = None) -> Run:
    run = Run.create(folder, method, data or tiny.scene())
    run.save(State(), method, method.optimizers(), torch.Generator())
    return run


def everything(home: Path) -> dict[str, str]:
    """What lies in a folder, however deep: sums of files, and where links lead."""
    found = {}
    for path in sorted(home.rglob("*")):
        content = os.readlink(path).encode() if path.is_symlink() else b"" if path.is_dir() else path.read_bytes()
        found[str(path.relative_to(home))] = sha256(content).hexdigest()
    return found


def put_there(place: str, how: str) -> None:
    """Something that somebody else has put to a path."""
    path = Path(place.rstrip("/"))
    path.parent.mkdir(parents=True, exist_ok=True)
    if how == "link":
        Path("precious").write_text("precious")
        path.symlink_to(Path("precious").resolve())
    elif how == "folder":
        path.mkdir()
        (path / "photograph.jpg").write_text("precious")
    else:
        path.write_text("precious")


HOW = "file", "folder", "link"
CASES = [(name, place, how) for name, (_, places) in WRITES.items() for place in places for how in HOW]


@pytest.mark.parametrize(("name", "place", "how"), CASES, ids=[f"{a}: {b} is a {c}" for a, b, c in CASES])
def test_what_others_have_put_there_stays(home, capsys, name, place, how):
    put_there(place, how)
    before = everything(home)
    assert main(WRITES[name][0].split()) == 2
    told = capsys.readouterr()
    assert told.err.startswith("lumigraph: ") and len(told.err.splitlines()) == 1, told.err
    assert place.rstrip("/").split("/")[-1] in told.err or name == "capture", told.err
    assert everything(home) == before


def test_every_command_that_writes_is_in_the_table():
    assert {command.split()[0] for command, _ in WRITES.values()} == set(COMMANDS) - WRITE_NOTHING - WITHIN_RUNS


@pytest.mark.parametrize("name", ["render", "export web", "export splats", "compose", "report", "clean"])
def test_what_it_wrote_itself_is_replaced_until_somebody_changes_it(home, capsys, name):
    command, places = WRITES[name]
    (home / "film.partial").mkdir()
    (home / "film.partial" / "precious").touch()
    assert main(command.split()) == 0
    files._granted.clear()  # as in another process
    assert main(command.split()) == 0
    assert (home / "film.partial" / "precious").exists()
    if places[-1].endswith("/"):
        (home / places[-1] / "notes.txt").write_text("precious")
        files._granted.clear()
        before = everything(home)
        assert main([*command.split(), "--overwrite"]) == 2 and "notes.txt" in capsys.readouterr().err
        assert everything(home) == before
        (home / places[-1] / "notes.txt").unlink()
    with open(home / places[0], "ab") as file:
        file.write(b"\n")
    files._granted.clear()
    before = everything(home)
    assert main(command.split()) == 2 and "--overwrite" in capsys.readouterr().err
    assert everything(home) == before
    assert main([*command.split(), "--overwrite"]) == 0


def test_a_run_is_no_folder_of_pictures(home):
    """Not even one that `clean` has made, every file of which is Lumigraph's."""
    assert main("clean gs --output fewer".split()) == 0
    for run in ("gs", "fewer"):
        before = everything(home)
        assert main(f"render {run} --frames 2 --size 16 --output {run}.mp4 --pictures png --overwrite".split()) == 2
        assert everything(home) == before


def test_a_file_of_another_kind_stays(home):
    """A path that somebody has made in the viewer lies where a film's cameras would go."""
    row = (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)
    CameraPath((Keyframe(row, 40.0, 0.0),)).save(home / "film.json")
    files._granted.clear()
    before = everything(home)
    assert main(WRITES["render"][0].split()) == 2
    assert everything(home) == before


def test_what_a_command_reads_stays_even_where_it_may_overwrite(home, capsys):
    assert main("export splats gs own.ply".split()) == 0
    assert main("compose own.ply gs --output own.json".split()) == 0
    before = everything(home)
    for command in (
        "clean own.ply --output own.ply",
        "export splats own.ply own.ply",
        "export points own.ply own.ply",
        "compose own.json gs --output own.json",
        "render own.json --frames 2 --size 16 --output own.gif",
    ):
        capsys.readouterr()
        assert main([*command.split(), "--overwrite"]) == 2 and "is what the command reads" in capsys.readouterr().err
    assert everything(home) == before


def test_saving_in_the_viewer_replaces_nothing(home):
    from lumigraph.commands.view import saver, subject_of
    from lumigraph.large import open_any

    opened = open_any(home / "gs")
    assert subject_of(opened).part_ending == ""  # a new run, with cameras and background
    save, nothing = saver(opened), {"crop": torch.zeros(len(opened.method().gaussians()), dtype=torch.bool)}
    (home / "mine.ply").write_text("precious")
    with pytest.raises(LumigraphError, match=r"mine\.ply is there already"):
        save("mine.ply", nothing)
    with pytest.raises(LumigraphError, match="photographs is there already"):
        save("photographs", nothing)
    assert (home / "mine.ply").read_text() == "precious" and save("ours.ply", nothing).endswith("ours.ply")
    with pytest.raises(LumigraphError, match="is there already"):
        save("ours.ply", nothing)
    assert subject_of(open_any(home / "ours.ply")).part_ending == ".ply"


def test_what_lies_among_checkpoints_stays(ball_run, tmp_path):
    shutil.copytree(ball_run.folder, tmp_path / "ball")
    run = Run(tmp_path / "ball")
    folder = run.folder / "checkpoints"
    for copy in ("backup", "000001", "000002.partial", "1 (copy)"):
        shutil.copytree(folder / "000060", folder / copy)
    for noted in ("000001", "000002.partial"):
        (folder / noted / "notes.txt").write_text("precious")
    (folder / "000003").symlink_to(tmp_path)
    before = everything(folder)
    method = run.method()
    run.save(State(61, 1.0), method, method.optimizers(), torch.Generator())
    after = everything(folder)
    assert {name: after.get(name) for name in before if not name.startswith("000060")} == {
        name: what for name, what in before.items() if not name.startswith("000060")
    }
    assert run.state.step == 61 and not (folder / "000060").exists()


def test_a_capture_clears_away_its_own_alone(tmp_path):
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    photos.mkdir()
    for name in "ab":
        Image.new("RGB", (8, 8)).save(photos / f"{name}.jpg")
    given = [Photo(f"{name}.jpg", photos / f"{name}.jpg", (8, 8)) for name in "ab"]
    copy_photographs(given, scene / "images", untracked)
    Image.new("RGB", (8, 8)).save(scene / "images" / "mine.jpg")
    copy_photographs(given[:1], scene / "images", untracked)
    assert names(scene / "images") == ["a.jpg", "mine.jpg"]
    claim_results(scene)
    for name in WRITTEN_FILES:
        (scene / name).write_text("precious")
        with pytest.raises(LumigraphError, match="is there already"):
            claim_results(scene)
        (scene / name).unlink()
    (scene / "sparse" / "1").mkdir(parents=True)
    with pytest.raises(LumigraphError, match="something else in it"):
        claim_results(scene)


def test_somebody_elses_record_stays(tmp_path):
    (tmp_path / marks.MARKS_FILE).write_text("precious")
    files.write_bytes(tmp_path / "a", b"1")
    files.write_bytes(tmp_path / "a", b"2")  # by the same process
    files._granted.clear()
    with pytest.raises(LumigraphError, match="is there already"):
        files.write_bytes(tmp_path / "a", b"3")
    assert (tmp_path / marks.MARKS_FILE).read_text() == "precious" and (tmp_path / "a").read_bytes() == b"2"


def test_half_a_line_of_the_record_is_passed_over(tmp_path):
    files.write_bytes(tmp_path / "a", b"1")
    with open(tmp_path / marks.MARKS_FILE, "ab") as record:
        record.write(b'\n{"name": "b", "ki')
    files.write_bytes(tmp_path / "c", b"1")
    assert marks.is_ours(tmp_path / "a", "file") and marks.is_ours(tmp_path / "c", "file")
    (tmp_path / "a").write_bytes(b"2")
    assert not marks.is_ours(tmp_path / "a", "file")


def test_what_came_meanwhile_stays_and_nothing_is_lost(tmp_path):
    path, folder = tmp_path / "film.mp4", tmp_path / "film"
    with pytest.raises(LumigraphError, match=r"film\.mp4 has been changed .* made is .*film-2\.mp4"):
        with files.replacing(path) as new:
            new.write_bytes(b"ours")
            path.write_bytes(b"precious")
    assert path.read_bytes() == b"precious" and (tmp_path / "film-2.mp4").read_bytes() == b"ours"
    with pytest.raises(LumigraphError, match="what was made is"), files.replacing_folder(folder) as new:
        (new / "0.png").write_bytes(b"ours")
        put_there(str(folder), "folder")
    assert names(folder) == ["photograph.jpg"] and names(tmp_path / "film-2") == ["0.png"]


def test_leftovers_of_killed_processes_go_and_others_stay(tmp_path):
    """A name of that form is a leftover only if no living process holds its lock."""
    dead = tmp_path / ".lumigraph-0123456789abcdef.partial"
    dead.mkdir()
    (dead / "half").touch()
    for theirs in ("x.partial", ".lumigraph-mine.partial", ".lumigraph-0123456789ABCDEF.partial"):
        put_there(str(tmp_path / theirs), "folder")
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with partials.partial(tmp_path):
            os.write(writing, b"!")
            signal_never_comes()
    os.read(reading, 1)
    before = set(names(tmp_path))
    partials._swept.clear()
    files.write_bytes(tmp_path / "a", b"1")
    assert set(names(tmp_path)) == {*before, "a"} - {dead.name}
    os.kill(child, 9)
    os.waitpid(child, 0)
    partials._swept.clear()
    files.write_bytes(tmp_path / "a", b"2")
    left = {".lumigraph-0123456789ABCDEF.partial", ".lumigraph-mine.partial", "x.partial"}
    assert set(names(tmp_path)) == {"a", *left}


def signal_never_comes() -> None:
    while True:
        os.read(os.pipe()[0], 1)


@pytest.mark.parametrize("can_swap", [True, False])
def test_a_folder_takes_the_place_of_its_forerunner(tmp_path, monkeypatch, can_swap):
    if not can_swap:
        monkeypatch.setattr(files, "swapped", lambda one, other: False)
    for name in ("first.png", "second.png"):
        with files.replacing_folder(tmp_path / "film", "pictures of a film") as new:
            (new / name).write_bytes(b"picture")
    assert sorted(path.name for path in tmp_path.rglob("*.png")) == ["second.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["film"]
