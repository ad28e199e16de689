"""PLY files of all kinds give the same rows; damaged ones give a sentence, and allocate nothing that is not there."""

from __future__ import annotations

import random
import tracemalloc

import numpy as np
import pytest
from budgets import budget
from ply_files import KINDS, ply_file

from lumigraph.errors import LumigraphError
from lumigraph.files.ply import columns, read_header, read_rows, write_rows
from lumigraph.readers.meshes import read_mesh, read_shape
from lumigraph.readers.points import read_ply

pytestmark = budget("exports", 4)

CORNERS = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (2.0, 1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 3.0)]
COLOURS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (10, 20, 30), (7, 8, 9)]
VERTEX = ("vertex", {"x": "float", "y": "float32", "z": "double", "red": "uchar", "green": "uint8", "blue": "uchar"},
          [(*place, *colour) for place, colour in zip(CORNERS, COLOURS, strict=True)])  # fmt: skip
TRIANGLES = ("face", {"vertex_indices": "list uchar int"}, [([0, 1, 2],), ([2, 3, 4],)])
POLYGONS = ("face", {"quality": "float", "vertex_index": "list uint int32", "red": "uchar", "green": "uchar",
                     "blue": "uchar"}, [(0.5, [0, 1, 2, 3], 1, 2, 3), (0.25, [2, 3, 4], 4, 5, 6)])  # fmt: skip
EDGES = ("edge", {"vertex1": "int", "vertex2": "int"}, [(0, 1), (1, 2), (2, 0)])
EXTRA = ["comment an é", "obj_info num_cols 5", "comment   two  words "]


@pytest.mark.parametrize("order", KINDS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("gap", [" ", "  \t"])
@pytest.mark.parametrize("faces", [TRIANGLES, POLYGONS], ids=["triangles", "polygons"])
def test_rows_of_any_file(tmp_path, order, end, gap, faces):
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file([faces, VERTEX, EDGES], order, end, gap, EXTRA))
    header = read_header(path)
    assert header.counts == {"face": 2, "vertex": 5, "edge": 3} and header.properties["edge"] == ["vertex1", "vertex2"]
    assert [" ".join(line.split()) for line in header.comments] == ["an é", "two words"]
    rows = read_rows(path, ["edge", "vertex", "absent"])
    assert [*rows] == ["vertex", "edge"] and rows["edge"].tolist() == EDGES[2]
    assert np.array_equal(columns(rows["vertex"], "xyz", np.float64), CORNERS)
    name = [*faces[1]][faces is POLYGONS]
    assert [list(x) for x in read_rows(path, ["face"])["face"][name]] == [row[faces is POLYGONS] for row in faces[2]]


@pytest.mark.parametrize("order", KINDS)
def test_meshes_and_points_of_any_file(tmp_path, order):
    path = tmp_path / "a.ply"
    path.write_bytes(ply_file([VERTEX, POLYGONS], order, "\r\n"))
    mesh = read_mesh(path)
    assert mesh.faces.tolist() == [[2, 3, 4], [0, 1, 2], [0, 2, 3]]
    assert np.array_equal(mesh.vertices, CORNERS) and np.array_equal(mesh.colours, COLOURS)
    for colours, kind in (([[c / 255 for c in row] for row in COLOURS], "float"), (COLOURS, "int")):
        types = dict.fromkeys("xyz", "double") | dict.fromkeys(["red", "green", "blue"], kind) | {"sightings": "ushort"}
        rows = [(*place, *colour, 3 + i) for i, (place, colour) in enumerate(zip(CORNERS, colours, strict=True))]
        path.write_bytes(ply_file([("vertex", types, rows), ("face", {"vertex_indices": "list uchar int"}, [])], order))
        points = read_ply(path)
        assert np.array_equal(points.points, CORNERS) and points.sightings.tolist() == [3, 4, 5, 6, 7]
        assert np.array_equal(points.point_colours, COLOURS)
        assert np.array_equal(read_mesh(path).colours, COLOURS) and not len(read_mesh(path).faces)
    normals = dict.fromkeys(["x", "y", "z", "nx", "ny", "nz"], "float")
    path.write_bytes(ply_file([("vertex", normals, [(*place, 0.0, 2.0, 0.0) for place in CORNERS])], order))
    assert read_shape(path, "a").normals is not None


@pytest.mark.parametrize("order", KINDS)
def test_vertices_with_lists_of_different_lengths(tmp_path, order):
    types = {"x": "float", "seen": "list uchar ushort", "y": "float", "z": "float"}
    rows = [(float(i), [*range(i)], 1.0, 2.0) for i in range(4)]
    (tmp_path / "a.ply").write_bytes(ply_file([("vertex", types, rows)], order))
    assert read_ply(tmp_path / "a.ply").points.tolist() == [[i, 1, 2] for i in range(4)]
    assert [list(x) for x in read_rows(tmp_path / "a.ply", ["vertex"])["vertex"]["seen"]] == [row[1] for row in rows]


def test_writing_is_read_back(tmp_path):
    kinds = ["i1", "u1", "<i2", ">u2", "<i4", ">u4", "<i8", "<f2", ">f4", "<f8"]
    rows = np.zeros(3, [(f"p{i}", kind) for i, kind in enumerate(kinds)])
    for i in range(len(kinds)):
        rows[f"p{i}"] = 7 * i - 3 * (kinds[i][-2] != "u"), 1, 2
    write_rows(tmp_path / "a.ply", "points", {"vertex": rows, "none": rows[:0]}, ["a word"])
    found = read_rows(tmp_path / "a.ply", ["vertex", "none"])
    assert found["vertex"].tolist() == rows.tolist() and len(found["none"]) == 0
    assert read_header(tmp_path / "a.ply").comments == ["a word"]


FACE = (
    "element vertex 1\nproperty float x\nproperty float y\nproperty float z\nelement face {}\nproperty list {} int i\n"
)


@pytest.mark.parametrize(
    ("head", "body"),
    [
        (FACE.format(1, "int"), bytes(12) + b"\xff\xff\xff\xff" + bytes(40)),
        (FACE.format(1, "int"), bytes(12) + b"\xff\xff\xff\x7f" + bytes(40)),
        (FACE.format(2, "uint"), bytes(12) + b"\xff\xff\xff\xff" + bytes(40)),
        (FACE.format(3, "uint64"), bytes(12) + b"\xff" * 8 + bytes(40)),
        (FACE.format(1, "float"), bytes(60)),
        (FACE.format(1, "half"), bytes(60)),
        (FACE.format(99, "uchar"), bytes(60)),
        (FACE.format(10**18, "uchar"), bytes(60)),
        (FACE.format(2, "uchar"), bytes(12) + b"\x01" + bytes(4) + b"\x09" + bytes(8)),
        ("element vertex 9\n", bytes(60)),
        ("element vertex 1\nelement vertex 1\nproperty float x\n", bytes(60)),
        ("property float x\nelement vertex 1\nproperty float x\n", bytes(60)),
        ("element vertex 1\nproperty list float x\n", bytes(60)),
        ("element vertex 1\nproperty float\n", bytes(60)),
        ("element vertex one\nproperty float x\n", bytes(60)),
        ("elemént vertex 1\nproperty float x\n", bytes(60)),
        ("element vertex 1\nproperty list uchar float x\nproperty float y\nproperty float z\n", bytes(60)),
    ],
)
def test_hostile_files_give_a_sentence(tmp_path, head, body):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\n" + head.encode() + b"end_header\n" + body)
    for read in (read_ply, read_mesh):
        tracemalloc.start()
        with pytest.raises(LumigraphError) as caught:
            read_rows(path, ["vertex", "face"])
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
        tracemalloc.stop()
        assert "a.ply" in str(caught.value) and "\n" not in str(caught.value) and "; " in str(caught.value)


LISTS = ["3 1 2\n", "-1 1\n", "2 1 2 3\n", "99999999999999999999 1\n", "1 é\n", "\n\n      \n"]


@pytest.mark.parametrize("body", [*(f"0 0 0\n{row}" for row in LISTS), "0 0\n0 2 1 1\n"])
def test_hostile_text_gives_a_sentence(tmp_path, body):
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\n" + FACE.format(1, "uchar") + "end_header\n" + body)
    with pytest.raises(LumigraphError, match=r"a\.ply cannot be read"):
        read_rows(tmp_path / "a.ply", ["face"])


def test_damaged_files_give_rows_or_a_sentence(tmp_path):
    """300 files with changed, lost and repeated bytes."""
    chance, path = random.Random(1), tmp_path / "a.ply"
    good = [ply_file([VERTEX, POLYGONS, EDGES], order, extra=EXTRA) for order in KINDS]
    refused = 0
    for number in range(300):
        data = bytearray(good[number % 3])
        for _ in range(chance.randint(1, 4)):
            at = chance.randrange(len(data))
            data[at : at + chance.randint(0, 4)] = chance.randbytes(chance.randint(0, 4))
        path.write_bytes(data)
        try:
            read_rows(path, ["vertex", "face", "edge"])
        except LumigraphError as fault:
            refused += 1
            assert "\n" not in str(fault)
    assert 100 < refused < 300
