"""Options of methods that `--help` shows; `--help-all` shows the others too."""

from dataclasses import fields, is_dataclass
from typing import Any

from .. import methods
from ..files.ranges import groups_of

HELP_ALL = "--help-all"
MAX_SHOWN = 14  # options of a method in --help

# What people set: how large the model is, how much a step costs, what is learnt besides, and what a capture calls for.
MAIN_OPTIONS = frozenset(
    """
    antialiased appearance appearance_code beta beta_min close_loops coarse_samples coarse_voxels code contact_distance
    contraction density depth_source depth_weight discs epsilon exposure exposure_correction factors features few_views
    field final_rendering_size final_resolution first_estimate frame_side guidance_scale guided half_resolution_until
    hidden_width initial_gaussians initial_resolution initialization input landscapes landscapes_per_step learning_rate
    light log2_hashmap_size mapping_iterations march_steps max_gaussians max_resolution members moments_per_step motion
    neighbours networks nodes nonrigid_width objects octree_depth open_final_resolution open_max_resolution
    outside_samples painter_width photometric_weight picture_size pictures_per_step plane_resolution plane_size
    points_per_shape pose_correction pose_smoothing properties rays_per_member rays_per_step refine_cameras
    refine_tracks reflectance render_width rendering_size residual_masks resolution rigidity robust samples_per_step
    seed sh_degree shading shape_code shapes_per_step slice_dimensions source_views sparsity start static_field
    step_size strategy track tracking_iterations transient_code unseen_patches view_dependence view_prompts view_width
    views_per_step volume_resolution voxel_share voxels weight_cells window
    """.split()
)


def option_names(config: Any) -> list[str]:
    """Names of all options of a Config."""
    return [x.name for group in groups_of(config) for x in fields(group) if not is_dataclass(getattr(group, x.name))]


def hidden_options(config: Any) -> frozenset[str]:
    """Options that --help leaves out; none of a method with few, or from elsewhere."""
    names, ours = option_names(config), type(config).__module__.startswith(methods.__name__)
    return frozenset(names) - MAIN_OPTIONS if ours and len(names) > MAX_SHOWN else frozenset()
