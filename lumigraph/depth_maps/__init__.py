"""Depth maps of methods, sensors and plane sweeps: back-projection, visibility, TSDF fusion.

A `DepthMap` is one camera and, for each pixel, the distance along its ray to the first surface, in scene units:
infinity where nothing is, NaN where nobody measured. Three ways lead to one:

    DepthMap.of_rendering(camera, method.render(camera), background)   of a method
    DepthMap.measured(camera, depth, rgb)                              of a sensor, a depth file or a plane sweep
    render_depth_maps(method.render, cameras, background)              a list, of a method and evenly chosen cameras

One map answers `points()` (surface points with colours and normals), `compare(points)` (visible, hidden, or outside)
and `sees(points)`. Several maps give `surface_points`, `hidden`, `free`, `fused_colours`, and the `TSDF`, a function of
points of which marching cubes takes the zero level. A `Tolerance` is a length that may grow with the distance.
"""

from .depth_map import DEPTH_EDGE as DEPTH_EDGE
from .depth_map import Comparison as Comparison
from .depth_map import DepthMap as DepthMap
from .depth_map import SurfacePoints as SurfacePoints
from .depth_map import Tolerance as Tolerance
from .depth_map import back_project as back_project
from .fusion import TSDF as TSDF
from .fusion import fused_colours as fused_colours
from .multi_view import free as free
from .multi_view import hidden as hidden
from .multi_view import render_depth_maps as render_depth_maps
from .multi_view import surface_points as surface_points
