"""Names of gsplat (Ye 2024, arXiv 2409.06765) over Lumigraph's kernels: `import lumigraph.gsplat as gsplat`."""

from ..gaussians.projection import CameraModel, UnscentedTransformParameters
from ..gaussians.rasterization import RasterizeMode, RenderMode, rasterization
from ..gaussians.tile_lists import isect_offset_encode, isect_tiles
from .rendering import rasterization_2dgs
from .stages import (
    fully_fused_projection,
    fully_fused_projection_2dgs,
    fully_fused_projection_with_ut,
    proj,
    quat_scale_to_covar_preci,
    rasterize_to_pixels,
    rasterize_to_pixels_2dgs,
    spherical_harmonics,
    world_to_cam,
)
from .strategy import DefaultStrategy, MCMCStrategy, Strategy
from .tensor_cloud import DensitySteps

__all__ = [
    "CameraModel",
    "DefaultStrategy",
    "DensitySteps",
    "MCMCStrategy",
    "RasterizeMode",
    "RenderMode",
    "Strategy",
    "UnscentedTransformParameters",
    "fully_fused_projection",
    "fully_fused_projection_2dgs",
    "fully_fused_projection_with_ut",
    "isect_offset_encode",
    "isect_tiles",
    "proj",
    "quat_scale_to_covar_preci",
    "rasterization",
    "rasterization_2dgs",
    "rasterize_to_pixels",
    "rasterize_to_pixels_2dgs",
    "spherical_harmonics",
    "world_to_cam",
]
