"""Depth maps of methods, sensors and multi-view stereo: back-projection, visibility, TSDF fusion.

A `DepthMap` is one camera and, for each pixel, the distance along its ray to the first surface, in scene units:
infinity for empty space, NaN for unmeasured. `DepthMap.of_rendering` and `render_depth_maps` make them from a method,
`DepthMap.measured` from a sensor, a depth file or multi-view stereo.
"""

from ..system import kernel_cache as kernel_cache
from .depth_map import DEPTH_EDGE as DEPTH_EDGE
from .depth_map import TSDF as TSDF
from .depth_map import DepthMap as DepthMap
from .depth_map import SurfacePoints as SurfacePoints
from .depth_map import Tolerance as Tolerance
from .depth_map import agreed as agreed
from .depth_map import back_project as back_project
from .depth_map import free as free
from .depth_map import fused_colours as fused_colours
from .depth_map import hidden as hidden
from .depth_map import measurements as measurements
from .depth_map import render_depth_maps as render_depth_maps
from .depth_map import surface_points as surface_points
from .sensor import release_weight as release_weight
from .sensor import sensor_faults as sensor_faults
from .sensor import trust_of as trust_of
from .voxel_blocks import VoxelBlocks as VoxelBlocks
