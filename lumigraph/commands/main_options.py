"""Options of methods that `--help` shows; `--help-all` shows the others too."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from .. import methods

HELP_ALL = "--help-all"
MAX_SHOWN = 14  # options of a method in --help

# What people set: how large the model is, how much a step costs, what is learnt besides, and what a capture calls for.
MAIN_OPTIONS = frozenset(
    """
    adversary_width affines antialiased appearance appearance_code appearance_components background_size
    bend beta beta_min blocks box_samples centred class_log2_hashmap_size close_loops cloud_points coarse_samples
    coarse_to_fine coarse_voxels code code_steps colour_code contact_distance contraction crop crops_per_view
    curvature_weight denoise_steps density density_components depth_source depth_weight discs doublings dropout
    elastic_weight encoder_size encoder_weights epsilon exposure exposure_correction factors feature_channels
    features few_views field final_opacity final_rendering_size final_resolution first_estimate focal frame_side
    grid_resolution guard_margin guidance_scale guided half_resolution_until hidden_width hull_cells hyper_width
    initial_gaussians initial_resolution initialization input landscapes landscapes_per_step learning_rate light
    light_rows log2_hashmap_size mapping_iterations march_steps max_flow max_gaussians max_resolution members
    members_per_step moments_per_step motion neighbours networks nodes nonrigid_frequencies nonrigid_width objects
    octree_depth opacity_weight open_final_resolution open_max_resolution outside_samples painter_width
    photometric_weight picture_size pictures_per_step plane_moments plane_resolution plane_size points_per_shape
    pose_correction pose_smoothing properties rays_per_member rays_per_step refine_cameras refine_tracks
    reflectance render_width rendering_size residual_masks resolution rigidity robust samples_per_block
    samples_per_step seed sh_degree shading shape_code shapes_per_step slice_dimensions source_views sparsity
    sparsity_weight start static_field step_ratio step_size strategy stretch super_resolution symmetric track
    tracking_iterations transient_code transient_start transmittance_weight tune_steps unseen_patches
    view_dependence view_prompts view_width views_per_step volume_resolution voxel_share voxels
    warp_resolution weight_cells window
    """.split()
)


def groups_of(config: Any) -> Iterator[Any]:
    """A Config, and the groups of options within it."""
    yield config
    for field in fields(config):
        if is_dataclass(inner := getattr(config, field.name)):
            yield from groups_of(inner)


def option_names(config: Any) -> list[str]:
    """Names of all options of a Config."""
    return [x.name for group in groups_of(config) for x in fields(group) if not is_dataclass(getattr(group, x.name))]


def hidden_options(config: Any) -> frozenset[str]:
    """Options that --help leaves out; none of a method with few, or from elsewhere."""
    names, ours = option_names(config), type(config).__module__.startswith(methods.__name__)
    return frozenset(names) - MAIN_OPTIONS if ours and len(names) > MAX_SHOWN else frozenset()
