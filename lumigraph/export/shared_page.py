"""A page of a trained scene: Gaussians as splats, octrees and atlases as volumes, the rest as pictures or a mesh."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..camera import Camera
from ..errors import LumigraphError
from ..exchange.baked import Browsable, atlas_for_browser, octree_for_browser
from ..figures import hex_colour
from ..geometry import Vector
from ..method import Method
from ..method.capabilities import HasAtlas, HasGaussians, HasOctree, can, needs
from ..paths.opening import Opening, opening_of_scene
from .loaded import Loaded
from .mesh import extract_mesh
from .options import MeshOptions, PageOptions
from .page import backdrop, mesh_page, moving_page, splats_page, views_page, volume_page

MAX_FACES = 300_000  # triangles of a mesh in a page, about 4 MB


Page = tuple[str, dict[str, int]]  # contents in words and in numbers


def export_page(
    loaded: Loaded, path: Path, options: PageOptions = PageOptions(), octree: Callable[[], Method] | None = None
) -> Page:
    """Write what is loaded as one HTML file.

    octree: makes an octree of it for a volume; None where it has none
    Raises LumigraphError for options that it cannot have.
    """
    background, cameras, kind = background_of(options), loaded.cameras["train"], kind_of(loaded, options, octree)
    if kind == "volume":
        loaded = replace(loaded, method=baked(loaded, octree))
    still = loaded.still
    behind = backdrop(still.method, cameras) if kind != "views" and not loaded.part.crops else None
    title = options.title or loaded.opened.title
    opening = opening_of_scene(title, cameras, loaded.frame, background, behind)
    if kind == "splats":
        return page_of_splats(loaded, path, options, opening)
    return page_of_still(kind, still, cameras, path, options, opening)


def page_of_splats(loaded: Loaded, path: Path, options: PageOptions, opening: Opening) -> Page:
    """Write Gaussians as splats, and all moments of those that move."""
    if loaded.moves:
        moving = loaded.moving(options.duration)
        moving_page(path, moving, opening)
        still = len(moving) - moving.moving
        held = f"{still:,} Gaussians that stand still, {moving.moving:,} spans of those that move"
        return held, {"still": still, "moving": moving.moving}
    gaussians = loaded.gaussians()
    splats_page(path, gaussians, opening)
    return Page(f"{len(gaussians):,} Gaussians, harmonics of degree {gaussians.degree}", {"gaussians": len(gaussians)})


def page_of_still(
    kind: str, loaded: Loaded, cameras: Camera, path: Path, options: PageOptions, opening: Opening
) -> Page:
    """Write a volume, pictures or a mesh of one moment."""
    if kind == "volume":
        volume, held = browsable(loaded.method, options.degree)
        volume_page(path, volume, opening)
        return held, {name: volume.settings[name] for name in ("leaves", "blocks") if name in volume.settings}
    if kind == "views":
        views_page(path, loaded.kept_method(), cameras, opening, options)
        return f"{options.views} views", {"views": options.views}
    mesh = extract_mesh(loaded.without_floaters(), cameras, MeshOptions(faces=MAX_FACES), loaded.crop)
    mesh_page(path, mesh, opening)
    return f"{len(mesh.faces):,} triangles", {"triangles": len(mesh.faces)}


def kind_of(loaded: Loaded, options: PageOptions, octree: object) -> str:
    """Kind of page: that of the options, or the first that what is loaded can have."""
    if options.kind != "auto":
        return options.kind
    if can(loaded.method, HasGaussians):
        return "splats"
    if loaded.part.crops:
        return "views"
    return "volume" if is_baked(loaded.method) or (not loaded.method.settings and octree) else "views"


def baked(loaded: Loaded, octree: Callable[[], Method] | None) -> Method:
    """Method whose volume browsers show. Raises LumigraphError where there is none."""
    if loaded.part.crops:
        raise LumigraphError("A volume is shown as a whole; leave out --box and --sphere, or give --as views")
    if is_baked(loaded.method):
        return loaded.method
    if loaded.method.settings:
        raise LumigraphError("A conversion has no controls; leave out --set, or give --as views")
    if octree is None:
        raise LumigraphError(f"{loaded.opened.path} cannot become an octree; give --as views")
    return octree()


def background_of(options: PageOptions) -> Vector | None:
    """Colour of --background in [0, 1]; None where none is given. Raises LumigraphError for what is no colour."""
    if options.background is None:
        return None
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", options.background):
        raise LumigraphError(f"{options.background!r} is no colour; give --background one such as '#101114'")
    red, green, blue = hex_colour(options.background).tolist()
    return red, green, blue


def is_baked(method: Method) -> bool:
    """True for methods whose volume browsers show."""
    return can(method, HasOctree) or can(method, HasAtlas)


def browsable(method: Method, degree: int = 3) -> tuple[Browsable, str]:
    """A baked method's volume for browsers, and its description. degree: largest degree of an octree's harmonics"""
    if can(method, HasOctree):
        volume = octree_for_browser(needs(method, HasOctree).octree(), degree)
        return volume, f"{volume.settings['leaves']:,} leaves of an octree, harmonics of degree {volume.degree}"
    volume = atlas_for_browser(needs(method, HasAtlas).atlas())
    return volume, f"{volume.settings['blocks']:,} blocks of {volume.settings['block']}^3 voxels"
