"""Capabilities of methods beyond rendering, and a test for one: `can(method, HasDensity)`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ..camera import Camera
from ..camera.rays import Look, Rays, Rendering
from ..datasets.mesh import Mesh
from ..datasets.scene import Photograph
from ..errors import LumigraphError
from ..exchange.baked import Atlas, Octree
from ..exchange.packing import Stored
from ..gaussians import Gaussians
from ..gaussians.moving import MovingGaussians
from .field import Colours, Densities, Directions, Points


class HasDensity(Protocol):
    """Has density."""

    def density(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Density per scene unit at points of the scene."""


class HasField(Protocol):
    """Has density and colour at points, for baking, conversion and composition."""

    def field(self, points: Points, directions: Directions) -> tuple[Densities, Colours]:
        """Density per scene unit, and sRGB-encoded colour seen along unit directions."""


class FromField(Protocol):
    """Can be initialised from another method, instead of from photographs."""

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Initialise from a teacher in the same frame, as far as cameras see it: from its `field` if it has one, else
        from its renderings and its Gaussians. Called instead of `begin`, before the first step. Raises LumigraphError,
        in one sentence, if that is impossible."""


class HasOctree(Protocol):
    """Can be exported as an octree of density and harmonics, for browsers and files."""

    def octree(self, depth: int | None = None) -> Octree:
        """The scene as an octree, in the scene's frame, of at most `depth` levels. Raises LumigraphError while there is
        none yet, and for one that exceeds memory, with the depth that fits."""


class HasAtlas(Protocol):
    """Can be exported as an atlas of diffuse colours and features, for browsers and files."""

    def atlas(self) -> Atlas:
        """The scene as an atlas, in the scene's frame. Raises LumigraphError while there is none yet."""


class HasDistance(Protocol):
    """Has a signed distance."""

    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Signed distance to the nearest surface in scene units, negative inside."""


class HasLevels(Protocol):
    """Has levels of detail, by its control `level`, from 1 up to `levels`."""

    levels: int

    def level_bytes(self, level: int) -> int:
        """Bytes of a level."""


class HasGaussians(Protocol):
    """Is a cloud of Gaussians."""

    def gaussians(self) -> Gaussians:
        """The scene as a cloud, in the scene's frame."""


# Colours at a photograph's trusted pixels, or at random ones of them, seen from where a `PoseRefinement` moves its
# camera, and those of the photograph; differentiable in the pose.
ColourPairs = Callable[[Any, torch.Generator], tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]]


class RefinesPoses(Protocol):
    """Can optimise poses of photographs besides the scene."""

    poses: nn.Module | bool | None  # a `PoseRefinement`; True where the parts have them; None where none was asked for

    def colour_pairs(self, photograph: Photograph) -> ColourPairs:
        """Rendered colours as a function of a photograph's pose, with the photograph's colours. RayMethods have it."""


class HasMotion(Protocol):
    """Has the motion of a dynamic scene."""

    def follow(self, points: Points, start: float, end: float) -> Points:
        """Positions at one time of surface points of another, times in the unit of `Frame.times`."""


class HasMovingGaussians(Protocol):
    """Is a moving cloud of Gaussians."""

    def moving(self, duration: float) -> MovingGaussians:
        """The scene as a moving cloud, in the scene's frame, stretched to a duration in seconds."""


class HasVisibility(Protocol):
    """Has the visibility of points in its training photographs."""

    def visibility(self, points: Points, directions: Directions) -> Float[Tensor, " point"]:
        """Visibility of each point in training photographs along a unit direction, in [0, 1]."""


class HasExposure(Protocol):
    """Has exposures of its training photographs."""

    usual_exposure: float | None  # log2 of their median; None where it is not known


class HasAppearance(Protocol):
    """Renders with an appearance code, which it accepts as evidence."""

    shown_in: Any  # the `Appearance`; of no numbers where none was learnt


class CanPrune(Protocol):
    """Is a cloud of Gaussians that can be pruned during training."""

    def prune(self, keep: Bool[Tensor, " gaussian"]) -> None:
        """Keep those of `gaussians()` in a mask, with their optimizer states."""


class HasMesh(Protocol):
    """Is a mesh, or extracts one better than `export mesh` would."""

    def mesh(self) -> Mesh:
        """The scene as triangles, in the scene's frame."""


class HasLooks(Protocol):
    """Marches along rays."""

    def looks(self, rays: Rays) -> list[Look]:
        """Density and colour along rays, one entry for each pass, the composited one last."""


class RendersRays(Protocol):
    """Renders one ray at a time."""

    def render_rays(self, rays: Rays, background: Float[Tensor, "#ray 3"]) -> Rendering:
        """Rendering of each ray over a background colour."""


class CanCompress(Protocol):
    """Can be compressed."""

    def storage(self) -> dict[str, Stored]:
        """Storage of tensors of `state_dict`, by name; others are stored losslessly."""

    def importance(self, camera: Camera) -> dict[str, Float[Tensor, " row"]]:
        """Importance of each row of tensors, by name, in one picture (Li 2023, eq. 4): the sum over pixels of the
        compositing weights that it contributes to."""

    def thin(self, importance: dict[str, Float[Tensor, " row"]], share: float) -> dict[str, Float[Tensor, " kept"]]:
        """Remove the least important rows, a share of all importance together. Returns the others' importance."""


class CanDraw(Protocol):
    """Can generate objects of a category."""

    def draw_object(self, seed: int) -> Any:
        """The method with a generated object, sampled by a seed."""


class HasViewpoint(Protocol):
    """Has a typical viewpoint of its objects."""

    viewpoint: Camera


class DrawsPictures(Protocol):
    """Draws pictures of many objects at once, each through a camera of its own."""

    def pictures(self, cameras: Camera, random: torch.Generator) -> Float[Tensor, "camera height width 3"]:
        """Pictures of random objects. cameras: of one size"""


LACKING = {
    HasDensity: "holds no density at points; what is made of it comes from its renderings instead",
    HasField: "holds no density and colour at points, so it can be neither baked nor converted",
    FromField: "cannot begin as what another method holds; `lumigraph convert --list` says which can",
    HasOctree: "is no octree; `lumigraph convert` makes one of it, as plenoctrees",
    HasAtlas: "is no atlas of baked values; `lumigraph convert` makes one of it, as snerg",
    HasDistance: "holds no distance to surfaces; neus and dvr do, and so do methods that learn from shapes",
    HasLevels: "has no levels of detail; nglod has",
    HasGaussians: "holds no Gaussians, so no splats can be made of it; train gaussian-splatting",
    RefinesPoses: "learns no poses of photographs; give --refine-cameras to a method that can",
    HasMotion: "does not know where points of a surface go; nerfies, nsff and deformable-splatting do",
    HasVisibility: "does not know which places its photographs saw; block-nerf does",
    HasExposure: "knows no exposures of its photographs",
    HasAppearance: "learns no appearance of its photographs; block-nerf does",
    CanPrune: "cannot learn on with fewer Gaussians; write a splat file instead, by an --output that ends in .ply",
    HasMesh: "is no mesh; `lumigraph export mesh` makes one of what it renders",
    CanDraw: "knows scenes by their photographs and draws none of its own; name a scene, or a prior of eg3d",
    CanCompress: "cannot be stored in fewer bytes; methods of grids, hash tables and Gaussians can",
    RendersRays: "renders whole pictures, so single rays have no colour",
    HasMovingGaussians: "holds no Gaussians that move; deformable-splatting does",
    HasViewpoint: "does not know where its objects are usually seen from; eg3d does",
    DrawsPictures: "draws one picture at a time",
    HasLooks: "takes no samples along rays, so there is nothing to draw of one",
}


def can(method: object, capability: type[Any]) -> bool:
    """True if a method, or all of a class, has a capability. Its class must have the functions, since a network may be
    called `field` too. Values must be there and not None; `isinstance` does not find submodules."""
    kind = method if isinstance(method, type) else type(method)
    functions = [name for name in vars(capability) if not name.startswith("_")]
    values = [getattr(method, name, None) for name in capability.__annotations__]
    return all(callable(getattr(kind, name, None)) for name in functions) and all(x is not None for x in values)


def needs(method: object, capability: type[Any]) -> Any:
    """The method itself. Raises LumigraphError, naming the capability, for a method without it."""
    if not can(method, capability):
        raise LumigraphError(f"{type(method).__name__} {LACKING[capability]}")
    return method
