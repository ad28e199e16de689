"""Deep appearance: a conditional VAE from mesh and view to mesh and view-dependent texture (Lombardi et al. 2018)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import fast_simplification
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn
from torch.nn.functional import grid_sample, interpolate, leaky_relu, normalize

from .. import kernels
from ..camera import Camera
from ..camera.rays import Rendering
from ..color.blending import over
from ..components.fields.charts import unwrap
from ..components.fields.kept_photographs import Kept
from ..components.fields.mesh_picture import projected
from ..components.image_based.depth import hull_surface, mesh_distance, shape
from ..datasets.mesh import Mesh, MeshTexture
from ..datasets.scene import Frame, Photograph, Scene
from ..errors import LumigraphError
from ..files.ranges import Count, LearningRate, NonNegative, Width, between
from ..method import BaseConfig, Method
from ..method.controls import Control, moment
from ..system.progress import track
from ..system.work import at_work

TRACKED = "vertices"  # of `Scene.about`: a grid (row, column, 3) for each photograph, in the source's frame
HULL_CELLS, HULL_PADDING = 128, 2  # cells of a visual hull along each axis; texels between its charts
MIN_COSINE = 0.15  # between normal and view, up to which a texel is not taken from a photograph
DEPTH_TOLERANCE = 0.02  # of distance, within which a texel is visible
OPAQUE = 0.99  # alpha from which on a pixel's colour is the surface's
MIN_DEVIATION = 1e-3
SLOPE = 0.2  # of leaky ReLUs
FIRST_SIDE = 4  # texels a side, from which the decoder begins
NEAR = 1e-3  # scene units, before which triangles are cut off
TEXTURE_WEIGHT = 1.0  # lambda_T of the loss
MESH_WEIGHT = 1.0  # lambda_M of the loss
VIEW_FEATURES = 8  # of the view's direction (section 4.2)


@dataclass(frozen=True)
class Config(BaseConfig):
    """Numbers of the release, facebookresearch/multiface, models.py and train.py; its codes of 128 are the paper's."""

    texture_log2: Annotated[int, between(4, 10)] = 10  # side of the texture, log2; higher: finer, slower
    code: Count = 128  # numbers of an expression's code
    channels: Width = 16  # of the decoder's finest layer but one; coarser layers have up to 16 times as many
    max_channels: Width = 128  # of any layer
    mesh_width: Width = 256  # of the layer before the mesh
    divergence_weight: NonNegative = 0.01  # lambda_Z
    mesh_rows: Annotated[int, between(5, 512)] = 73  # of the mesh's grid; 7306 vertices are the paper's
    mesh_columns: Annotated[int, between(5, 512)] = 101  # of the mesh's grid
    textures_per_step: Count = 16  # textures of a step; more are steadier, and cost time
    learning_rate: LearningRate = 3e-4  # Adam's learning rate


SOURCES = {  # of the numbers of `paper`; the others are ours
    "facebookresearch/multiface, models.py (db70c1a)": "code channels max_channels view_features mesh_width",
    "facebookresearch/multiface, train.py (db70c1a)": "texture_log2 divergence_weight textures_per_step learning_rate",
}


@dataclass(frozen=True)
class Unwrapped:
    """Photographs as textures.

    rgb:    bytes; 0 where `shown` is False
    shown:  mask of texels visible in the photograph
    view:   unit direction from the mesh's centre to the camera
    moment: number of the expression
    """

    unit: ClassVar[str] = "texels"

    rgb: UInt8[Tensor, "photograph 3 side side"]
    shown: Bool[Tensor, "photograph 1 side side"]
    view: Float[Tensor, "photograph 3"]
    moment: Int[Tensor, " photograph"]

    def __len__(self) -> int:
        return int(self.shown.sum())

    def __getitem__(self, index: Tensor) -> Unwrapped:
        return Unwrapped(self.rgb[index], self.shown[index], self.view[index], self.moment[index])

    def to(self, device: torch.device) -> Unwrapped:
        return Unwrapped(*(x.to(device) for x in (self.rgb, self.shown, self.view, self.moment)))


class Up(nn.Module):
    """Twice as large by a transposed convolution, with a bias of its own at each texel (untied, section 4.2)."""

    def __init__(self, inside: int, outside: int, side: int):
        super().__init__()
        self.spread = nn.ConvTranspose2d(inside, outside, 4, 2, 1, bias=False)
        self.bias = nn.Parameter(torch.zeros(outside, side, side))

    def forward(self, x: Tensor) -> Tensor:
        return self.spread(x) + self.bias


class Networks(nn.Module):
    """Encoder of mean texture and mesh, decoder to mesh, and with the view to a texture.

    numbers: of coordinates of the mesh
    moving:  without, there is one mesh, which the encoder need not know
    """

    def __init__(self, c: Config, numbers: int, moving: bool):
        super().__init__()
        levels = c.texture_log2 - int(math.log2(FIRST_SIDE))
        widths = [min(c.max_channels, c.channels << max(0, levels - 1 - k)) for k in range(levels)]
        down = [3, *reversed(widths)]
        self.down = nn.ModuleList(nn.Conv2d(a, b, 4, 2, 1) for a, b in zip(down[:-1], down[1:], strict=True))
        flat = widths[0] * FIRST_SIDE**2
        self.mesh_in = nn.Linear(numbers, c.mesh_width) if moving else None
        self.to_code = nn.Linear(flat + moving * c.mesh_width, 2 * c.code)
        self.mesh_out = nn.Sequential(
            nn.Linear(c.code, c.mesh_width), nn.LeakyReLU(SLOPE), nn.Linear(c.mesh_width, numbers)
        )
        self.view = nn.Linear(3, VIEW_FEATURES)
        self.first = nn.Linear(c.code + VIEW_FEATURES, flat)
        up = [*widths, 3]
        self.up = nn.ModuleList(
            Up(a, b, FIRST_SIDE << (k + 1)) for k, (a, b) in enumerate(zip(up[:-1], up[1:], strict=True))
        )

    def encode(self, texture: Tensor, mesh: Tensor) -> tuple[Float[Tensor, "row code"], Float[Tensor, "row code"]]:
        """Mean and logarithm of the deviation of the codes of normalised textures and meshes."""
        for layer in self.down:
            texture = leaky_relu(layer(texture), SLOPE)
        hidden = texture.flatten(1)
        if self.mesh_in is not None:
            hidden = torch.cat([hidden, leaky_relu(self.mesh_in(mesh), SLOPE)], -1)
        mean, deviation = self.to_code(hidden).chunk(2, -1)
        return mean, deviation

    def decode(self, code: Float[Tensor, "row code"], view: Float[Tensor, "row 3"]) -> tuple[Tensor, Tensor]:
        """Normalised meshes and textures."""
        seen = leaky_relu(self.view(view), SLOPE)
        x = leaky_relu(self.first(torch.cat([code, seen], -1)), SLOPE)
        x = x.view(len(x), -1, FIRST_SIDE, FIRST_SIDE)
        for layer in self.up[:-1]:
            x = leaky_relu(layer(x), SLOPE)
        return self.mesh_out(code), self.up[-1](x)


class DeepAppearance(Method):
    """Codes of expressions, decoded to a mesh and, with the direction of the view, to its texture."""

    Config = Config
    mean_texture: Tensor
    mean_mesh: Tensor
    deviations: Tensor  # of textures and of meshes
    faces: Tensor
    beside: Tensor
    networks: Networks

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        side, vertices = 1 << c.texture_log2, c.mesh_rows * c.mesh_columns
        self.register_buffer("mean_texture", torch.zeros(3, side, side))
        self.register_buffer("mean_mesh", torch.zeros(vertices, 3))
        self.register_buffer("deviations", torch.ones(2))
        self.times, self.meshes = Kept(torch.empty(0)), Kept(torch.empty(0, vertices, 3))
        self.textures = Kept(torch.empty(0, 3, side, side, dtype=torch.uint8))
        self.networks = Networks(c, 3 * vertices, frame.times is not None)
        faces, self.uv = grid_faces(c.mesh_rows, c.mesh_columns)
        self.register_buffer("faces", faces, persistent=False)
        self.register_buffer("solid", faces, persistent=False)
        self.register_buffer("beside", kernels.neighbours(faces), persistent=False)
        self.hull = Kept(torch.empty(0, 15))
        self._unwrapped: Unwrapped | None = None
        self._codes: Tensor | None = None

    @classmethod
    def cpu_preset(cls) -> Any:
        """Textures of 128 texels, and a hundredth of the paper's weights."""
        return Config(texture_log2=7, code=16, channels=16, max_channels=64, mesh_rows=49, mesh_columns=65,
            mesh_width=64, textures_per_step=8, learning_rate=2e-3)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        """Textures of 32 texels."""
        return Config(texture_log2=5, code=4, channels=8, max_channels=16, mesh_rows=13, mesh_columns=17, mesh_width=8,
            textures_per_step=9, learning_rate=1e-2, divergence_weight=1e-3)  # fmt: skip

    # Learning

    def compile_begin(self) -> None:
        """For kernel compilation on a copy: one empty photograph instead of the textures of `begin`."""
        super().compile_begin()
        self.meshes.rows = self.mean_mesh[None]
        self.textures.rows = self.mean_texture.byte()[None]
        shown = torch.zeros(1, 1, *self.mean_texture.shape[1:], dtype=torch.bool)
        self._unwrapped = Unwrapped(self.textures.rows.cpu(), shown, torch.eye(1, 3), torch.zeros(1, dtype=torch.long))

    def begin(self, data: Scene, seconds: float = math.inf) -> None:
        super().begin(data, seconds)
        times, number = moments_of(data)
        first = [int((number == k).nonzero()[0, 0]) for k in range(len(times))]
        if TRACKED in data.about:
            grids = tracked_meshes(data, self.config.mesh_rows, self.config.mesh_columns)
            self.meshes.rows = grids[first].flatten(1, 2).to(self.device)
        else:
            self.hull.rows = charted_hull(data, len(self.faces), 1 << self.config.texture_log2).to(self.device)
            self._lay_hull()
            middle = self.hull.rows[:, :9].reshape(-1, 3).mean(0)
            self.meshes.rows = middle.expand(1, len(self.mean_mesh), 3).contiguous()  # the networks learn no mesh
        self.times.rows = times.to(self.device)
        seen = self._unwrap(data)
        rgb, shown = seen.rgb.float() / 255, seen.shown.float()
        mean = (rgb * shown).sum(0) / shown.sum(0).clamp_min(1)
        everywhere = (rgb * shown).sum((0, 2, 3)) / shown.sum().clamp_min(1)
        mean = torch.where(shown.sum(0) > 0, mean, everywhere[:, None, None])
        per_moment = []
        for k in range(len(times)):
            own, its = rgb[number == k], shown[number == k]
            total = its.sum(0)
            per_moment.append(torch.where(total > 0, (own * its).sum(0) / total.clamp_min(1), mean))
        self.textures.rows = torch.stack(per_moment).mul(255).round().byte().to(self.device)
        self.mean_texture.copy_(mean)
        self.mean_mesh.copy_(self.meshes.rows.mean(0))
        deviation = ((rgb - mean).square() * shown).sum() / (3 * shown.sum()).clamp_min(1)
        spread = (self.meshes.rows - self.mean_mesh).square().mean()
        self.deviations.copy_(torch.stack([deviation.cpu(), spread.cpu()]).sqrt().clamp_min(MIN_DEVIATION))

    def _lay_hull(self) -> None:
        """Take faces, texture coordinates and neighbours from the kept hull. `faces` share no vertex; `solid` are they
        with one vertex at each place, for `kernels.antialias`."""
        if rows := len(self.hull.rows):
            corners = self.hull.rows[:, :9].reshape(-1, 3)
            number, place = torch.arange(3 * rows, device=self.device), corners.unique(dim=0, return_inverse=True)[1]
            self.faces, self.solid = number.view(-1, 3), number.clone().scatter(0, place, number)[place].view(-1, 3)
            self.uv, self.beside = self.hull.rows[:, 9:].reshape(-1, 2).cpu(), kernels.neighbours(self.solid)

    def placed(self, mesh: Float[Tensor, "vertex 3"]) -> Float[Tensor, "corner 3"]:
        """Vertices of `faces`: of a moment's mesh, or of the hull of what stays still."""
        return self.hull.rows[:, :9].reshape(-1, 3) if len(self.hull.rows) else mesh

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Load tensors. Older runs of still objects have a grid about the middle of the hull instead."""
        found = super().load_state_dict({"hull.rows": self.hull.rows[:0], **state_dict}, strict, assign)
        self._lay_hull()
        return found

    def _unwrap(self, data: Scene) -> Unwrapped:
        """The training photographs as textures, kept; made again where a run is resumed."""
        if self._unwrapped is None:
            _, number = moments_of(data)
            faces, parts = self.faces.cpu(), []
            meshes = [self.placed(mesh).cpu() for mesh in self.meshes.rows]
            texels = [texel_places(mesh, faces, self.uv, 1 << self.config.texture_log2) for mesh in meshes]
            train = data.splits["train"].tolist()
            for k, i in track(enumerate(train), "Unwrapping photographs", len(train)):
                photograph, moment = data.photograph(i), int(number[k])
                rgb, shown = unwrapped(photograph, meshes[moment], faces, *texels[moment])
                view = normalize(photograph.camera.position[0] - self.meshes.rows[moment].mean(0).cpu(), dim=-1)
                parts.append((rgb, shown, view))
            rgb, shown, view = (torch.stack(x) for x in zip(*parts, strict=True))
            self._unwrapped = Unwrapped(rgb, shown, view, number)
        return self._unwrapped

    def batch(self, data: Scene, generator: torch.Generator) -> Unwrapped:
        seen = self._unwrap(data)
        chosen = torch.randperm(len(seen.moment), generator=generator)[: self.config.textures_per_step]
        return seen[chosen].to(self.device)

    def loss(self, batch: Unwrapped, step: int) -> dict[str, Tensor]:
        """Squared errors of texels that were seen and of meshes, and the divergence of codes from the normal
        distribution (section 4.3), all per number."""
        c, networks = self.config, self.networks
        self._codes = None
        target = self._normal_texture(batch.rgb)
        mesh = self._normal_mesh(self.meshes.rows[batch.moment])
        mean, log_deviation = networks.encode(self._normal_texture(self.textures.rows[batch.moment]), mesh)
        noise = torch.randn(mean.shape, generator=self.random(step)).to(mean)
        found_mesh, texture = networks.decode(mean + log_deviation.exp() * noise, batch.view)
        shown = batch.shown.float()
        error = ((texture - target).square() * shown).sum() / (3 * shown.sum()).clamp_min(1)
        divergence = 0.5 * (mean.square() + (2 * log_deviation).exp() - 1) - log_deviation
        self.figures = {"mse": float(error.detach() * self.deviations[0] ** 2)}
        return {
            "texture": TEXTURE_WEIGHT * error,
            "mesh": MESH_WEIGHT * (found_mesh - mesh).square().mean(),
            "divergence": c.divergence_weight * divergence.mean(),
        }

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [torch.optim.Adam(self.networks.parameters(), lr=self.config.learning_rate)]

    def learning_rate(self, step: int, progress: float) -> float:
        """Falling along a cosine to a hundredth."""
        return self.config.learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress)))

    def _normal_texture(self, rgb: UInt8[Tensor, "row 3 side side"]) -> Float[Tensor, "row 3 side side"]:
        return (rgb.float() / 255 - self.mean_texture) / self.deviations[0]

    def _normal_mesh(self, mesh: Float[Tensor, "row vertex 3"]) -> Float[Tensor, "row number"]:
        return ((mesh - self.mean_mesh) / self.deviations[1]).flatten(1)

    # Rendering

    @property
    def controls(self) -> tuple[Control, ...]:
        """The moment, of a face that moves."""
        return (*super().controls, *([moment(self.frame.times)] if self.frame.times else []))

    def code_at(self, time: float) -> Float[Tensor, "1 code"]:
        """Code of a moment: between those of the two expressions around it."""
        if self._codes is None:
            textures, meshes = self._normal_texture(self.textures.rows), self._normal_mesh(self.meshes.rows)
            self._codes, _ = self.networks.encode(textures, meshes)
        times = self.times.rows
        if len(times) == 1:
            return self._codes
        i = int(torch.searchsorted(times, torch.tensor(time, device=times.device)).clamp(1, len(times) - 1))
        share = ((time - times[i - 1]) / (times[i] - times[i - 1])).clamp(0, 1)
        return torch.lerp(self._codes[i - 1], self._codes[i], share)[None]

    def decoded(self, camera: Camera) -> tuple[Float[Tensor, "vertex 3"], Float[Tensor, "3 side side"]]:
        """Mesh and texture as a camera sees them, at its moment or that of the control."""
        told = self.settings.get("time", None if camera.time is None else float(camera.time[0]))
        code = self.code_at(float((self.frame.times or (0.0,))[0] if told is None else told))
        middle = self.mean_mesh.mean(0)
        view = normalize(camera.position - middle, dim=-1)
        mesh, texture = self.networks.decode(code, view)
        vertices = self.placed(mesh.view(-1, 3) * self.deviations[1] + self.mean_mesh)
        return vertices, texture[0] * self.deviations[0] + self.mean_texture

    @at_work()
    @torch.no_grad()
    def render(self, camera: Camera) -> Rendering:
        camera = camera.to(self.device)
        if not len(self.times.rows):
            height, width = shape(camera)
            empty = torch.zeros(height, width, device=self.device)
            return Rendering(self.background.expand(height, width, 3).clone(), empty + torch.inf, empty)
        return textured(*self.decoded(camera), self.faces, self.solid, self.beside, self.uv, camera, self.background)

    @torch.no_grad()
    def mesh(self) -> Mesh:
        """The mesh of the first moment, with its mean texture."""
        first = self.placed(self.meshes.rows[0]).cpu()
        texture = self.mean_texture.cpu().movedim(0, -1)
        colours = sampled(self.mean_texture.cpu(), self.uv).clamp(0, 1).mul(255).round().byte()
        picture = MeshTexture(self.uv.numpy(), (texture.clamp(0, 1) * 255).round().byte().numpy())
        faces = self.faces.cpu().long().numpy()
        return Mesh(first.double().numpy(), faces, colours.numpy(), picture)


def textured(
    vertices: Float[Tensor, "vertex 3"],
    texture: Float[Tensor, "3 side side"],
    faces: Int[Tensor, "face 3"],
    solid: Int[Tensor, "face 3"],
    beside: Int[Tensor, "face 3"],
    uv: Float[Tensor, "vertex 2"],
    camera: Camera,
    background: Float[Tensor, "1 3"],
) -> Rendering:
    """A textured mesh in one camera, its silhouette antialiased.

    solid: the faces joined across seams of the texture;  beside: their `kernels.neighbours`
    """
    height, width = shape(camera)
    corners = projected(vertices, camera)
    found_uv, depth, found = kernels.rasterize_mesh(corners, uv.to(vertices), faces, (width, height), NEAR)
    seen = (found >= 0)[..., None]
    rgb = sampled(texture, found_uv.view(-1, 2)).view(height, width, 3).clamp(0, 1) * seen
    values = torch.cat([rgb, seen.float()], -1)
    values = kernels.antialias(values, depth, found, corners, solid, beside)
    opacity = values[..., 3].clamp(0, 1)
    along = (camera.rays(camera.pixels()).directions @ camera.forward[0]).view(height, width).clamp_min(1e-3)
    away = torch.where(found >= 0, depth / along, torch.inf)
    return Rendering(over(values[..., :3], opacity, background[0]), away, opacity)


def sampled(texture: Float[Tensor, "channel side _"], uv: Float[Tensor, "point 2"]) -> Float[Tensor, "point channel"]:
    """A texture at places from (0, 0), its upper left corner, to (1, 1)."""
    at = (2 * uv - 1)[None, None].to(texture)
    return grid_sample(texture[None], at, padding_mode="border", align_corners=False)[0, :, 0].T


def grid_faces(rows: int, columns: int) -> tuple[Int[Tensor, "face 3"], Float[Tensor, "vertex 2"]]:
    """Triangles of a grid, anticlockwise from outside, and where its vertices are on the texture."""
    index = torch.arange(rows * columns).view(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = torch.stack([torch.stack([a, c, b], -1), torch.stack([b, c, d], -1)], 2).view(-1, 3)
    v, u = torch.meshgrid(torch.linspace(0, 1, rows), torch.linspace(0, 1, columns), indexing="ij")
    return faces, torch.stack([u, v], -1).view(-1, 2)


def moments_of(data: Scene) -> tuple[Float[Tensor, " moment"], Int[Tensor, " photograph"]]:
    """Moments of the training photographs in order, and each one's number; one moment where nothing moves."""
    train = data.splits["train"]
    if data.cameras.time is None or TRACKED not in data.about:
        return torch.zeros(1), torch.zeros(len(train), dtype=torch.int64)
    times, number = data.cameras.time[train].unique(return_inverse=True)
    return times, number


def tracked_meshes(data: Scene, rows: int, columns: int) -> Float[Tensor, "photograph rows columns 3"]:
    """The tracked mesh of each training photograph, in the scene's frame."""
    given = data.about[TRACKED][data.splits["train"]].float()
    moved = data.frame.to_source.inverse.points(given.reshape(-1, 3).double()).view(given.shape).float()
    grid = interpolate(moved.movedim(-1, 1), (rows, columns), mode="bilinear", align_corners=True)
    return grid.movedim(1, -1).contiguous()


def charted_hull(data: Scene, count: int, side: int) -> Float[Tensor, "face 15"]:
    """Triangles of the visual hull, about `count`: places of three corners, then these in a texture of `side` texels a
    side. Raises LumigraphError without a hull."""
    if (hull := hull_surface(data, HULL_CELLS)) is None:
        raise LumigraphError(
            f"{data.source} has neither tracked meshes (`vertices` of each photograph, as procedural:head) nor one "
            "object with alpha that stays still, so there is no surface to put a texture on; give --masks, or train "
            "another method"
        )
    vertices, faces = hull.vertices, hull.faces.astype(np.int32)
    if len(faces) > count:
        vertices, faces = fast_simplification.simplify(vertices, faces, target_count=count)[:2]
    original, charts, uv = unwrap(vertices, faces, side, HULL_PADDING)
    rows = [vertices[original][charts].reshape(-1, 9), uv[charts].reshape(-1, 6)]
    return torch.from_numpy(np.concatenate(rows, 1)).float()


def texel_places(
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    uv: Float[Tensor, "vertex 2"],
    side: int,
) -> tuple[Float[Tensor, "side side 3"], Float[Tensor, "side side 3"]]:
    """Place and unit normal of each texel on a mesh. Texels between charts are those of the nearest one, for lookups
    across its edge."""
    plane = torch.cat([uv * side, torch.ones_like(uv[:, :1])], -1)
    places, _, found = kernels.rasterize_mesh(plane, vertices, faces, (side, side))
    row, column = torch.from_numpy(
        distance_transform_edt((found < 0).numpy(), return_distances=False, return_indices=True)
    )
    a, b, c = vertices[faces].unbind(1)
    normals = normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    return places[row.long(), column.long()], normals[found[row.long(), column.long()].long()]


def unwrapped(
    photograph: Photograph,
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    place: Float[Tensor, "side side 3"],
    normal: Float[Tensor, "side side 3"],
) -> tuple[UInt8[Tensor, "3 side side"], Bool[Tensor, "1 side side"]]:
    """A photograph as the texture of a mesh: colours of the texels that it shows, and which these are.

    place, normal: of texels, see `texel_places`
    """
    camera, side = photograph.camera, len(place)
    to_camera = camera.position[0] - place
    away = to_camera.norm(dim=-1)
    facing = (normal * to_camera).sum(-1) / away
    pixels, valid = camera.project(place.view(-1, 3))
    distance = mesh_distance(vertices, faces.int(), camera)
    height, width = shape(camera)
    column, row = pixels.nan_to_num().floor().long().unbind(-1)
    inside = valid & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    first = distance[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    shares = pixels / camera.size[0]
    alpha = torch.ones(height, width) if photograph.alpha is None else photograph.alpha
    if photograph.mask is not None:
        alpha = alpha * photograph.mask
    values = sampled(torch.cat([photograph.rgb, alpha[..., None]], -1).movedim(-1, 0), shares)
    shown = inside & (away.flatten() < (1 + DEPTH_TOLERANCE) * first) & (values[:, 3] > OPAQUE)
    shown = shown.view(side, side) & (facing > MIN_COSINE)
    rgb = (values[:, :3].view(side, side, 3) * shown[..., None]).clamp(0, 1).mul(255).round().byte()
    return rgb.movedim(-1, 0).contiguous(), shown[None]
