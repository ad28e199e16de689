"""Khronos' validator of glTF: no errors and no warnings in any kind of .glb that is written.

It is the npm package gltf-validator, run by Node. Without them its tests are skipped, or fail where
LUMIGRAPH_NEEDS_NODE=1: `npm install --prefix FOLDER gltf-validator`, and NODE_PATH=FOLDER/node_modules for the tests.
The tests of unit vectors need neither.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from budgets import budget
from test_exchange import make

from lumigraph.datasets.mesh import Mesh, MeshTexture
from lumigraph.datasets.scene import GeographicOrigin
from lumigraph.exchange import write_gaussians
from lumigraph.export.mesh_file import write_mesh
from lumigraph.export.surface import tangents, vertex_normals

pytestmark = budget("exports", 5)

VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
const read = path => validator.validateBytes(new Uint8Array(fs.readFileSync(path)), { maxIssues: 0 });
Promise.all(process.argv.slice(1).map(read)).then(found => console.log(JSON.stringify(found)));
"""
OF_SPLATS = "MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"  # it lacks KHR_gaussian_splatting
FAR = np.array([500_000.0, 5.2e6, 300.0])


def crumpled() -> tuple[np.ndarray, np.ndarray]:
    """A sheet with two sides, whose normals cancel; a face without area; a vertex without a face."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5], [6, 5, 5], [7, 5, 5], [9, 9, 9]])
    return vertices, np.array([[0, 1, 2], [0, 2, 1], [3, 4, 5]])


def coloured(shift: float | np.ndarray = 0.0) -> Mesh:
    vertices, faces = crumpled()
    return Mesh(vertices + shift, faces, np.tile(np.array([[200, 90, 40]], np.uint8), (len(vertices), 1)))


def painted(normals: bool) -> Mesh:
    """With a texture, where one face has no area and another covers one texel."""
    mesh, picture = coloured(), np.full((16, 16, 3), 128, np.uint8)
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.5, 0.5], [0.5, 0.5], [0.5, 0.5], [0, 0]])
    return Mesh(mesh.vertices, mesh.faces, mesh.colours, MeshTexture(uv, picture, picture if normals else None))


PARIS = GeographicOrigin(48.85, 2.29, 35.0)
KINDS: dict[str, Callable[[Path], object]] = {
    "coloured": lambda path: write_mesh(path, coloured()),
    "lit, upright, on Earth": lambda path: write_mesh(path, coloured(), np.array([0, 1.0, 0]), lit=True, origin=PARIS),
    "far": lambda path: write_mesh(path, coloured(FAR)),
    "with pieces": lambda path: write_mesh(path, coloured(), pieces={"piece": crumpled()}),
    "textured": lambda path: write_mesh(path, painted(normals=False)),
    "textured, with normals": lambda path: write_mesh(path, painted(normals=True), lit=True),
    "splats": lambda path: write_gaussians(path, make(20)),
    "plain splats": lambda path: write_gaussians(path, make(1, 0, antialiased=True)),
}


@pytest.fixture(scope="module")
def reports(tmp_path_factory) -> dict[str, dict]:
    """The validator's report of each kind."""
    node = shutil.which("node")
    found = node and subprocess.run([node, "-e", "require('gltf-validator')"], capture_output=True).returncode == 0
    if not found:
        reason = "Node or its package gltf-validator is not there; NODE_PATH names its folder"
        if os.environ.get("LUMIGRAPH_NEEDS_NODE") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("glb")
    paths = [folder / f"{name}.glb" for name in KINDS]
    for path, write in zip(paths, KINDS.values(), strict=True):
        write(path)
    ran = subprocess.run([node, "-e", VALIDATE, *paths], capture_output=True, text=True, check=True)
    return dict(zip(KINDS, json.loads(ran.stdout), strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_khronos_finds_no_fault(reports, kind):
    issues = [x for x in reports[kind]["issues"]["messages"] if "splats" not in kind or x["code"] not in OF_SPLATS]
    assert not [x for x in issues if x["severity"] < 2], issues
    assert reports[kind]["info"]["totalVertexCount"]


def test_normals_and_tangents_have_length_1():
    """Also where normals cancel, where a face has no area in space or in the picture, and where no face is."""
    mesh = painted(normals=True)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    frame = tangents(mesh.vertices, mesh.faces, mesh.texture.uv, normals)
    for vectors in (normals, frame[:, :3]):
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-12)
    assert np.abs((normals * frame[:, :3]).sum(1)).max() < 1e-12
    np.testing.assert_array_equal(np.abs(normals[:3]), [[0, 0, 1]] * 3)  # one side's of the sheet
