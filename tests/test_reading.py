"""One door for readers: any exception of a parser becomes one sentence; readers that are not behind it are found."""

from __future__ import annotations

import ast
import io
import pickle
import re
import struct
from pathlib import Path

import captures
import numpy as np
import pytest
import tiny
import torch
from budgets import budget
from fuzzing import hostile
from PIL import Image, PngImagePlugin
from test_bodies import write_zju
from test_depth_in import wall_points, write_cloud
from test_neural_scene_graph import write_kitti

import lumigraph
from lumigraph import exchange
from lumigraph.commands.cli import main
from lumigraph.components.guidance.clip_files import read_tensors
from lumigraph.errors import LumigraphError
from lumigraph.files.reading import reading
from lumigraph.opening import open_scene, read_capture
from lumigraph.readers import READERS
from lumigraph.readers.pickled import MAX_VALUES, load_pickled
from lumigraph.readers.surveyed import read_surveyed
from lumigraph.selection.strokes import read_strokes

pytestmark = budget("capture", 10)

PACKAGE = Path(lumigraph.__file__).parent


class PanicException(BaseException):
    """Exception of a library in Rust."""


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (ZeroDivisionError("division by zero"), "f is odd (division by zero); mend it"),
        (KeyError("cams"), "f is odd (KeyError: 'cams'); mend it"),
        (AssertionError(), "f is odd (AssertionError); mend it"),
        (ValueError("x" * 5000), f"f is odd ({'x' * 300}...); mend it"),
        (RecursionError("maximum recursion depth exceeded"), "f is odd (maximum recursion depth exceeded); mend it"),
        (PanicException("capacity overflow"), "f is odd (capacity overflow); mend it"),
        (FileNotFoundError(2, "No such file or directory", "g"), "g does not exist; check the path"),
        (MemoryError(), "f is odd. Memory is short"),
        (LumigraphError("A sentence."), "A sentence."),
    ],
    ids=lambda value: type(value).__name__,
)
def test_whatever_a_parser_raises_becomes_a_sentence(fault, sentence):
    with pytest.raises(LumigraphError) as caught, reading(Path("f"), "is odd", "mend it"):
        raise fault
    assert str(caught.value).startswith(sentence) and caught.value.__cause__ in (fault, None)


def test_ctrl_c_and_warnings_pass():
    for passing in (KeyboardInterrupt(), UserWarning("w")):
        with pytest.raises(type(passing)), reading("f"):
            raise passing


def test_a_fault_of_ours_can_be_found(tmp_path, monkeypatch):
    """LUMIGRAPH_DEBUG=1 raises, and the cause is the line that failed."""
    monkeypatch.setattr(READERS["blender"], "read", broken)
    captures.write_blender(tmp_path, captures.Tiny(3))
    monkeypatch.setenv("LUMIGRAPH_DEBUG", "1")
    with pytest.raises(LumigraphError) as caught:
        main(["info", str(tmp_path)])
    assert isinstance(caught.value.__cause__, OddError)


# Which readers are behind it


class OddError(Exception):
    """No reader expects it."""


def broken(*_: object, **__: object) -> None:
    raise OddError("nobody thought of this")


@pytest.mark.parametrize("name", READERS)
def test_every_layout_of_photographs_is_behind_the_door(name, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(READERS[name], "recognises", lambda folder: True)
    monkeypatch.setattr(READERS[name], "read", broken)
    for opened in (read_capture, open_scene):
        with pytest.raises(LumigraphError, match="nobody thought of this"):
            opened(tmp_path, reader=name)
    monkeypatch.setattr(READERS[name], "recognises", broken)
    with pytest.raises(LumigraphError, match="nobody thought of this"):
        open_scene(tmp_path, reader=name)


@pytest.mark.parametrize("suffix", [*exchange.READERS, ".ply", *exchange.FOLDERS])
def test_every_format_of_splats_is_behind_the_door(suffix, tmp_path, monkeypatch):
    path = tmp_path if suffix in exchange.FOLDERS else tmp_path / f"cloud{suffix}"
    (tmp_path / f"cloud{suffix}").write_bytes(b"some")
    monkeypatch.setitem(exchange.READERS, suffix, broken)
    monkeypatch.setattr(exchange, "read_header", broken)
    for layout in exchange.FOLDERS.values():
        monkeypatch.setattr(layout, "read", broken)
        monkeypatch.setattr(layout, "recognises", lambda folder: suffix in exchange.FOLDERS)
    with pytest.raises(LumigraphError, match="nobody thought of this"):
        exchange.read_gaussians(path)


def readers_of(tree: ast.Module) -> dict[str, bool]:
    """Functions of a module that read a path, by name; true for those behind the door, or behind another's."""
    found = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and node.name.split("_")[0] in ("read", "load"):
            first = node.args.args[0].annotation if node.args.args else None
            if first is not None and "Path" in ast.unparse(first):
                found[node.name] = "reads(" in "".join(map(ast.unparse, node.decorator_list)) or any(
                    f"{door}(" in ast.unparse(node) for door in ("reading", "readable", "understood", "read_weights")
                )
    return found


def outside(sources: dict[str, str]) -> list[str]:
    """Readers that another room calls and that are not behind the door. sources: of modules, by name"""
    used: dict[tuple[str, str], str] = {}  # module from outside its room, by module's last name and reader
    for user, source in sources.items():
        for module, names in re.findall(r"from (\S+) import (\([^)]*\)|.*)", source):
            used |= {(module.rpartition(".")[2], name): user for name in re.findall(r"\w+", names) if is_far(module)}
        used |= {call: user for call in re.findall(r"\b(\w+)\.((?:read|load)\w*)\(", source)}
    return [
        f"{name}.{reader}, which {user} calls"
        for name, source in sources.items()
        if name not in TRUSTED and re.search(r"^def (read|load)", source, re.MULTILINE)
        for reader, is_behind in readers_of(ast.parse(source)).items()
        if not is_behind and (user := used.get((name.rpartition(".")[2], reader)))
        if user.split(".")[1] != name.split(".")[1]
    ]


def is_far(module: str) -> bool:
    """True for an import from another folder."""
    return module.startswith("..")


def sources() -> dict[str, str]:
    paths = {path: path.relative_to(PACKAGE.parent).with_suffix("").parts for path in PACKAGE.glob("*/**/*.py")}
    return {".".join(x for x in parts if x != "__init__"): path.read_text("utf-8") for path, parts in paths.items()}


# The door; code; our own notes.
TRUSTED = {"lumigraph.files.atomic", "lumigraph.methods", "lumigraph.lab.benchmark.cell"}


def test_every_reader_that_another_room_calls_is_behind_the_door():
    assert not outside(sources())


def test_a_reader_outside_the_door_is_noticed():
    changed = sources() | {"lumigraph.exchange.bones": "def read_bones(path: Path): return path.read_bytes()"}
    assert any(line.startswith("lumigraph.exchange.bones.read_bones") for line in outside(changed))


# Pickled arrays

VALUES = {
    "K": [np.eye(3), np.asfortranarray(np.arange(6.0).reshape(2, 3))],
    "names": ["Camera_B1/000000.jpg", "é"],
    "kinds": [np.arange(3, dtype=">i4"), np.array([True, False]), np.array(["ab", "c"]), np.zeros(2, np.float16)],
    "numbers": [1, -2, 2.5, None, True, 2**70, np.float32(1.5), np.int64(3), b"\x80", b"", (1, (2,))],
    "empty": np.zeros((0, 3)),
    "objects": np.array([{"ims": ["a"]}], object),
}


class OfPython2(pickle._Pickler):
    """Texts as Python 2 writes them, and NumPy 1's names."""

    def save_text(self, value: str | bytes) -> None:
        data = value.encode("latin-1") if isinstance(value, str) else value
        quoted = b"S'" + data.decode("latin-1").encode("unicode_escape").replace(b"'", b"\\'") + b"'\n"
        self.write(b"T" + struct.pack("<I", len(data)) + data if self.proto else quoted)
        self.memoize(value)

    dispatch = pickle._Pickler.dispatch | {str: save_text, bytes: save_text}


def npy(pickled: bytes) -> bytes:
    """A .npy file of one pickled object."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
    return file.getvalue() + pickled


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and a.dtype.hasobject:
        return same(a.tolist(), b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and bool((a == b).all())
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("numpy1", [True, False])
def test_pickled_arrays_read_back(protocol, numpy1, tmp_path):
    data = pickle.dumps(np.array(VALUES, object), protocol)
    if numpy1:
        for long, short in ((b"multiarray", b"numpy._core.multiarray"), (b"numeric", b"numpy._core.numeric")):
            name, old = short, b"numpy.core." + long
            data = data.replace(bytes([len(name)]) + name, bytes([len(old)]) + old).replace(name, old)
    (tmp_path / "a.npy").write_bytes(npy(data))
    assert same(VALUES, load_pickled(tmp_path / "a.npy"))


@pytest.mark.parametrize("protocol", [0, 1, 2])
def test_pickled_arrays_of_python_2(protocol, tmp_path):
    file, table = io.BytesIO(), np.arange(200.0).reshape(2, 100)[:, ::2]
    OfPython2(file, protocol).dump(np.array({"K": [table], "ims": ["it's a\nname", "\xe9"]}, object))
    data = file.getvalue().replace(b"numpy._core", b"numpy.core")
    assert b"_codecs" not in data
    (tmp_path / "a.npy").write_bytes(npy(data))
    assert same({"K": [table], "ims": ["it's a\nname", "\xe9"]}, load_pickled(tmp_path / "a.npy"))


def dtype_with(state: tuple) -> bytes:
    """An array whose type has a state of somebody else's."""
    dtype = hostile.Described(np.dtype, ("f8", False, True), state)
    array = np._core.multiarray._reconstruct
    return pickle.dumps(hostile.Described(array, (np.ndarray, (0,), b"b"), (1, (3,), dtype, False, bytes(24))), 2)


def multiplied(levels: int) -> bytes:
    found: list = [1.0]
    for _ in range(levels):
        found = [found] * 10
    return pickle.dumps(found)


HOSTILE = {
    "a state that is a pointer": (dtype_with((3, "<", b"AAAAAAAA", ("a",), {"a": 1}, 8, 1, 0)), None),
    "an order that is none": (dtype_with((3, b"AAAAAAAA", None, None, None, 8, 1, 0)), "no type of numbers"),
    "references that multiply": (multiplied(9), f"more than {MAX_VALUES:,} values"),
    "a list within itself": (b"]q\0h\0a.", "within itself"),
    "a dictionary within itself": (b"}q\0X\1\0\0\0ah\0s.", "within itself"),
    "a deep list": (b"]" * 9999 + b"a" * 9998 + b".", "nests deeper"),
    "a call": (b"cos\nsystem\n(S'touch ran'\ntR.", "os.system, which is no array"),
    "a call of a type": (b"cnumpy\nndarray\n(tR.", "calls something else"),
    "an array of references": (pickle.dumps(np.zeros((2, 2), object)), "other items"),
    "structures": (pickle.dumps(np.zeros(2, "f8,i4")), "no type of numbers"),
    "dates": (pickle.dumps(np.zeros(2, "M8[s]")), "no type of numbers"),
    "a set": (pickle.dumps({1, 2}), "opcode EMPTY_SET"),
    "an extension": (b"\x82\x01.", "opcode EXT1"),
    "another object": (b"P12\n.", "opcode PERSID"),
    "a number of many digits": (b"I" + b"9" * 9999 + b"\n.", "digits"),
    "a text that ends early": (b"\x8d" + b"\xff" * 8 + b"abc.", ""),
    "an end": (b"]", "ends early"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_pickles(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pickled, sentence = HOSTILE[case]
    Path("a.npy").write_bytes(npy(pickled))
    if sentence is None:  # only what says the order of bytes is looked at
        assert load_pickled(Path("a.npy")).tolist() == [0, 0, 0]
        return
    with pytest.raises(LumigraphError, match=sentence):
        load_pickled(Path("a.npy"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"]


# Numbers that cannot be


def with_zju(folder: Path, file: str, value: object) -> None:
    """ZJU-MoCap's layout, one of whose files holds something else."""
    write_zju(folder)
    if file.endswith(".png"):
        Image.new("L", (3, 3)).save(folder / file)
    else:
        np.save(folder / file, np.array(value, object) if isinstance(value, dict) else value)


POSE = {"poses": np.zeros((1, 72)), "Rh": np.zeros((1, 3)), "Th": np.zeros((1, 3))}


@pytest.mark.parametrize(
    ("file", "value", "sentence"),
    [
        ("lbs/joints.npy", np.full((24, 3), np.nan), "24 joints of 3 coordinates"),
        ("lbs/joints.npy", np.zeros((24, 3)), "all in one place"),
        ("lbs/joints.npy", np.zeros((9, 3)), "24 joints of 3 coordinates"),
        ("lbs/parents.npy", np.full(24, -7), "a joint comes before its parent"),
        ("lbs/parents.npy", np.arange(24), "a joint comes before its parent"),
        ("lbs/parents.npy", np.full(24, 99), "a joint comes before its parent"),
        ("new_params/0.npy", POSE | {"Th": np.full((1, 3), np.inf)}, "Th has numbers that are not finite"),
        ("new_params/0.npy", POSE | {"poses": np.full((1, 72), 3e307)}, "poses has numbers .* beyond 1e"),
        ("new_params/0.npy", POSE | {"poses": np.zeros((1, 71))}, "does not hold a pose"),
        ("annots.npy", {"cams": {"K": 1}, "ims": []}, "does not hold cameras"),
        ("annots.npy", {"cams": dict.fromkeys("KDRT", [[]]), "ims": [3]}, "does not hold cameras"),
        ("mask/Camera_B1/000000.png", None, "its size is not that of 000000.jpg"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_bodies_that_cannot_be(file, value, sentence, tmp_path):
    with_zju(tmp_path / "zju", file, value)
    with pytest.raises(LumigraphError, match=sentence):
        open_scene(tmp_path / "zju")


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        ("label_02/0006.txt", "1.6 10.0", "1.6 3e307", "too large"),
        ("calib/0006.txt", "-3.0", "3e307", "too large"),
        ("calib/0006.txt", "40 -3.0", "40", "no P2"),
        ("calib/0006.txt", "60 0 40", "0 0 0", "no projection"),
        ("calib/0006.txt", "Tr_imu_velo 1", "Tr_imu_velo 0", "a calibration of rotations"),
        ("oxts/0006.txt", "8.0 100.0 0 0 1.5707963267948966" + " 0" * 24, "8.0", "6 columns"),
        ("oxts/0006.txt", "0.000000000000 8.0", "90 8.0", "latitude"),
        ("oxts/0006.txt", "8.0 100.0", "8.0 1e6", "altitude"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_drives_that_cannot_be_leave_no_run(file, old, new, sentence, tmp_path, capsys):
    write_kitti(tmp_path / "drive", 2)
    path = tmp_path / "drive" / file
    assert old in (text := path.read_text())
    path.write_text(text.replace(old, new))
    assert main(["train", "gaussian-splatting", str(tmp_path / "drive"), "--output", str(tmp_path / "run")]) == 2
    told = capsys.readouterr().err
    assert sentence in told and told.count("lumigraph:") == 1 and not (tmp_path / "run").exists()


# Others


@pytest.mark.parametrize("at", ["points", "chunks", "chunk table", "records"])
def test_inflated_counts_of_lidar_files(at, tmp_path):
    pytest.importorskip("laspy")
    write_cloud(path := tmp_path / "wall.laz", wall_points(200))
    data = bytearray(path.read_bytes())
    begin = struct.unpack_from("<I", data, 96)[0]
    table = struct.unpack_from("<q", data, begin)[0]
    place, kind = {"points": (107, "<I"), "chunks": (table + 4, "<I"), "records": (100, "<I")}.get(at, (begin, "<q"))
    struct.pack_into(kind, data, place, 0xF0000000)
    path.write_bytes(data)
    with pytest.raises(LumigraphError, match=r"wall\.laz cannot be read as a cloud \(.+\); export it once more"):
        read_surveyed(path)


def test_a_text_bomb_in_strokes(tmp_path):
    about = PngImagePlugin.PngInfo()
    for number in range(70):
        about.add_text(f"k{number}", "x" * 1_000_000, zip=True)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png", pnginfo=about)
    with pytest.raises(LumigraphError, match=r"a\.png is no picture that opens"):
        read_strokes(tmp_path / "a.png", tiny.scene().cameras[0], "a view")


def test_weights_that_are_not_finite(tmp_path):
    from safetensors.torch import save_file

    save_file({"a": torch.tensor([1.0, float("nan")])}, tmp_path / "clip.safetensors")
    with pytest.raises(LumigraphError, match="a has numbers that are not finite"):
        read_tensors(tmp_path / "clip.safetensors")
