"""A mesh that learns: preconditioned vertices (Nicolet 2021), colours, and remeshing by marching cubes."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.ndimage import binary_dilation, label
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ... import kernels
from ...components.fields.level_set import level_set
from ...components.training.row_optimizers import exchange
from ...datasets.mesh import Mesh
from ...datasets.shapes.triangles import Triangles
from ...method import Part

NEAR_CELLS = 2  # cells around a surface in which its distance is computed; beyond them only the side matters
MAX_GRADIENT = 4.0  # of a vertex, in means of those that have one
BLENDED = 3  # old vertices that give a new one its colour


class Solver:
    """(I + smoothness L)^-1 of a mesh, by sparse Cholesky-like factors. L: combinatorial Laplacian, degree minus
    adjacency"""

    def __init__(self, count: int, faces: Int[np.ndarray, "face 3"], smoothness: float):
        a, b = np.concatenate([faces, faces[:, ::-1]]).ravel(), np.roll(faces, -1, 1)
        b = np.concatenate([b, np.roll(faces[:, ::-1], -1, 1)]).ravel()
        adjacency = sparse.coo_array((np.ones(len(a)), (a, b)), (count, count)).tocsc()
        adjacency.data[:] = 1
        self.laplacian = (sparse.diags_array(adjacency.sum(0)) - adjacency).tocsc()
        self.matrix = (sparse.eye_array(count) + smoothness * self.laplacian).tocsc()
        self.factors = splu(self.matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def __call__(self, right: Tensor) -> Tensor:
        return torch.from_numpy(self.factors.solve(right.detach().cpu().double().numpy())).to(right)

    def __deepcopy__(self, memo: Any) -> Solver:
        return self  # it never changes, and the factors cannot be copied

    def apply(self, x: Tensor) -> Tensor:
        """(I + smoothness L) x."""
        return torch.from_numpy(self.matrix @ x.detach().cpu().double().numpy()).to(x)


class _Smooth(torch.autograd.Function):
    """x = (I + smoothness L)^-1 u. The matrix is symmetric, so gradients take the same way. Their length is limited at
    each vertex first: where a triangle is seen nearly edge-on, the slope of its colours has no bound."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, solver: Solver) -> Tensor:
        ctx.solver = solver
        return solver(u)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        length = grad.norm(dim=-1, keepdim=True)
        limit = MAX_GRADIENT * length[length > 0].mean().nan_to_num()
        return ctx.solver(grad * (limit / length.clamp_min(1e-30)).clamp(max=1.0)), None


class MeshSurface(Part):
    """A mesh with trainable positions and colours of vertices.

    places:  u = (I + smoothness L) x of vertices x (Nicolet 2021, eq. 9)
    colours: of vertices, before the sigmoid
    """

    grows: ClassVar[tuple[str, ...]] = ("places", "colours")

    def __init__(self, mesh: Mesh, smoothness: float):
        super().__init__()
        self.smoothness = smoothness
        self.places, self.colours = (nn.Parameter(torch.zeros(0, 3)) for _ in range(2))
        self.corners = _Corners()
        self.replace(mesh)

    @property
    def faces(self) -> Tensor:
        return self.corners.faces

    def replace(self, mesh: Mesh, optimizers: tuple[torch.optim.Optimizer | None, ...] = (None, None)) -> None:
        """Replace the mesh, with fresh optimizer moments."""
        self.corners.faces = torch.from_numpy(np.ascontiguousarray(mesh.faces)).long().to(self.corners.faces.device)
        places = self.solver.apply(torch.from_numpy(mesh.vertices).float())
        exchange(self, "places", places.contiguous(), optimizers[0])
        colours = torch.from_numpy(mesh.colours).float().div(255).clamp(0.02, 0.98).logit()
        exchange(self, "colours", colours, optimizers[1])

    @property
    def solver(self) -> Solver:
        """Factors of this mesh's matrix, kept until its triangles change."""
        kept = self.__dict__.get("_solver")
        if kept is None or kept[0] is not self.corners.faces:
            faces = self.corners.faces.cpu().numpy()
            kept = self.corners.faces, Solver(int(faces.max()) + 1, faces, self.smoothness), None
            self.__dict__["_solver"] = kept
        return kept[1]

    @property
    def neighbours(self) -> Int[Tensor, "face 3"]:
        solver, kept = self.solver, self.__dict__["_solver"]
        if kept[2] is None:
            self.__dict__["_solver"] = kept = (kept[0], solver, kernels.neighbours(self.corners.faces))
        return kept[2]

    def vertices(self) -> Float[Tensor, "vertex 3"]:
        """x of the learnt u, differentiable."""
        return _Smooth.apply(self.places, self.solver)

    def rgb(self) -> Float[Tensor, "vertex 3"]:
        return self.colours.sigmoid()

    def roughness(self, vertices: Float[Tensor, "vertex 3"]) -> Float[Tensor, ""]:
        """Mean square of L x, over the mean square of edges."""
        laplacian = _product(vertices, self.solver.laplacian)
        a, b, _ = vertices[self.faces].unbind(1)
        return laplacian.square().sum(-1).mean() / (a - b).detach().square().sum(-1).mean()

    def bending(self, normals: Float[Tensor, "face 3"]) -> Float[Tensor, ""]:
        """Mean of 1 - cosine between the unit normals of neighbouring triangles."""
        beyond = self.neighbours
        face, side = (beyond >= 0).nonzero().unbind(-1)
        return (1 - (normals[face] * normals[beyond[face, side].long()]).sum(-1)).mean()

    @torch.no_grad()
    def mesh(self) -> Mesh:
        rgb = (self.rgb() * 255).round().to(torch.uint8)
        return Mesh(self.vertices().cpu().double().numpy(), self.faces.cpu().numpy(), rgb.cpu().numpy())


class _Corners(nn.Module):
    """Vertices of triangles, whose number changes apart from that of vertices."""

    grows: ClassVar[tuple[str, ...]] = ("faces",)
    faces: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("faces", torch.zeros(0, 3, dtype=torch.int64))


class _Product(torch.autograd.Function):
    """A x of a constant symmetric sparse matrix."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, matrix: sparse.csc_array) -> Tensor:
        ctx.matrix = matrix
        return torch.from_numpy(matrix @ x.detach().cpu().numpy()).to(x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        return torch.from_numpy(ctx.matrix @ grad.cpu().numpy()).to(grad), None


def _product(x: Tensor, matrix: sparse.csc_array) -> Tensor:
    return _Product.apply(x, matrix)


def face_normals(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Float[Tensor, "face 3"]:
    """Normals of triangles, outward, as long as twice their area."""
    a, b, c = vertices[faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)


def vertex_normals(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> Float[Tensor, "vertex 3"]:
    """Unit normals of vertices: the sum of those around, by area."""
    across = face_normals(vertices, faces)
    total = torch.zeros_like(vertices).index_add(0, faces.reshape(-1), across.repeat_interleave(3, 0))
    return nn.functional.normalize(total, dim=-1)


def remeshed(mesh: Mesh, cells: int) -> Mesh:
    """The same surface remeshed from a grid of its signed distance, with `cells` cells along its longest side:
    triangles of one size, without interior and self-intersecting ones."""
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    cell = float((high - low).max()) / cells
    low = low - 2 * cell
    shape = np.ceil((high - low) / cell).astype(int) + 3
    triangles = Triangles(mesh.vertices[mesh.faces])
    touched = np.zeros(shape, bool)
    for place in _spread(mesh, cell):
        touched[tuple(np.rint((place - low) / cell).astype(int).T)] = True
    near = binary_dilation(touched, iterations=NEAR_CELLS)
    values = np.zeros(shape)
    places = low + cell * np.argwhere(near)
    values[near] = np.where(triangles.winding(places) > 0.5, 1.0, -1.0) * triangles.nearest(places)[0]
    regions, count = label(~near)
    for region in range(1, count + 1):  # of one side each
        first = np.unravel_index(int(np.argmax(regions == region)), shape)
        inside = triangles.winding(low + cell * np.array([first]))[0] > 0.5
        values[regions == region] = NEAR_CELLS * cell if inside else -NEAR_CELLS * cell
    made = level_set(values, low, cell)
    away, nearest = cKDTree(mesh.vertices).query(made.vertices, BLENDED)
    weights = 1 / np.maximum(away, 1e-9)
    colours = (mesh.colours[nearest] * weights[..., None]).sum(1) / weights.sum(1, keepdims=True)
    return Mesh(made.vertices, made.faces, colours.round().astype(np.uint8))


def _spread(mesh: Mesh, cell: float):
    """Points on all triangles, less than a cell apart."""
    corners = mesh.vertices[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(-1)
    parts = np.ceil(longest / cell).astype(int)
    for n in np.unique(parts):
        chosen = corners[parts == n]
        for i in range(n + 1):
            for j in range(n + 1 - i):
                yield (i * chosen[:, 0] + j * chosen[:, 1] + (n - i - j) * chosen[:, 2]) / n
