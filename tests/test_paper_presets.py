"""The numbers of `--preset paper`, held as literals, the page's section on where a method differs from its paper, and
its tables of options and of sources. `python tests/test_paper_presets.py` writes these tables.

PUBLISHED holds what was copied by hand from a source, `SOURCES` beside a Config names the source of each of its
numbers. A source is the authors' release, by repository and file, or the paper. "After the text" marks numbers that no
release of the authors confirms.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.files.ranges import groups_of, holds, value_of

pytestmark = budget("house", 3)
PAGES = Path(__file__).parent.parent / "docs" / "methods"
FILES = {path.stem for path in Path(methods.__file__).parent.iterdir()}
SHARED_PAGE = PAGES.parent / "training.md"  # options of parts that several methods have
TABLE = re.compile(r"(?<=<!-- options -->\n).*?(?=<!-- end of options -->)", re.DOTALL)
SOURCES = re.compile(r"(?<=<!-- sources -->\n).*?(?=<!-- end of sources -->)", re.DOTALL)
IS_SOURCE = re.compile(r"[\w.-]+/[\w.-]+, \S+|.+ \d{4}, ")  # a release and its file, or authors, year and the place
NAMES = [name for name in methods.available() if name.replace("-", "_") in FILES]  # tiny adds some of the tests' own

WORDS: dict[str, Any] = {
    "guidance.render_width": 168,
    "guidance.crop_share": 154 / 168,
    "guidance.crops_per_view": 8,  # n_local_aug
    "guidance.views_per_step": 8,  # a pose for each of eight devices
    "guidance.min_elevation": 30.0,
    "guidance.max_elevation": 30.0,
    "guidance.camera_distance": 4.0,
    "guidance.focal": 1.2,
    "guidance.transmittance_weight": 0.5,
    "guidance.initial_opacity": 0.5,
    "guidance.final_opacity": 0.1,
    "guidance.opacity_steps": 500,
    "guidance.origin_decay": 0.999,
    "distillation.guidance_scale": 100.0,
    "distillation.min_time": 0.02,
    "distillation.max_time": 0.98,
}

PUBLISHED: dict[str, dict[str, Any]] = {
    "fourier-features": {  # tancik/fourier-feature-networks, 2d_image_regression.ipynb; the scale of Demo.ipynb
        "encoding": "gaussian",
        "scale": 10.0,
        "frequencies": 256,
        "layers": 4,
        "hidden_width": 256,
        "learning_rate": 1e-3,
    },
    "object-nerf": {  # zju3dv/object_nerf, config/default_conf.yml and toy_desk_2.yml
        "field": "network",
        "network.depth": 8,
        "network.skip_layer": 5,  # skips: [4], counted from 0 before the layer
        "network.position_frequencies": 10,
        "network.direction_frequencies": 4,
        "hidden_width": 256,
        "object_layers": 4,
        "object_width": 128,
        "instances": 64,
        "code": 64,
        "rays.coarse_samples": 64,
        "rays.fine_samples": 64,
        "rays.rays_per_step": 2048,
        "object_colour_weight": 1.0,
        "object_opacity_weight": 10.0,
        "outside_weight": 0.05,
        "guided": True,
        "guard_margin": 0.05,  # frustum_bound
        "learning_rate": 1e-3,
    },
    # google-research/dreamfields, config_base.py and config_mq.py; after the text of Poole 2022, section 3
    "dream-fields": WORDS
    | {
        "steps.steps_per_diagonal": 192,  # num_samples, from 4 - sqrt(3) to 4 + sqrt(3)
        "table.sh_bands": 1,  # viewdirs: False
    },
    # dreamgaussian/dreamgaussian, configs/text.yaml
    "dream-splats": WORDS
    | {
        "initial_gaussians": 5000,
        "initial_radius": 0.5,
        "rates.means_lr": 1e-3,
        "rates.final_means_lr": 2e-5,
        "rates.sh_lr": 1e-2,
        "rates.opacities_lr": 0.05,
        "rates.scales_lr": 5e-3,
        "rates.quaternions_lr": 5e-3,
    },
    "imap": {  # after the text of sections 3.1 to 3.4 and 4, which has no release; iterations are ours
        "field": "network",
        "layers": 4,
        "hidden_width": 256,
        "frequency_deviation": 25.0,
        "rays.coarse_samples": 32,
        "rays.fine_samples": 12,
        "tracking.first_estimate": "velocity",
        "descent.tracking_pixels": 200,
        "mapping.window": 5,
        "mapping.pixels_per_frame": 200,
        "mapping.active_sampling": True,
        "mapping.keyframe_share": 0.65,
        "mapping.depth_tolerance": 0.1,
        "terms.colour_weight": 5.0,
        "terms.depth_weight": 1.0,
        "terms.distance_weight": 0.0,
        "learning_rate": 1e-3,  # section 4, of the map
        "mapping.keyframe_pose_rate": 3e-3,  # section 4, of poses
    },
    "splat-slam": {  # spla-tam/SplaTAM, configs/replica/splatam.py; the paper's sections 3.2 to 3.4
        "tracking.first_estimate": "velocity",
        "descent.tracking_iterations": 40,
        "descent.rotation_rate": 2 * 4e-4,  # cam_unnorm_rots, of a quaternion's numbers
        "descent.shift_rate": 2e-3,
        "descent.tracking_silhouette": 0.99,
        "mapping.mapping_iterations": 60,
        "mapping.first_iterations": 60,
        "mapping.window": 24,
        "mapping.keyframe_every": 5,
        "mapping.depth_weight": 1.0,
        "mapping.colour_weight": 0.5,
        "mapping.ssim_weight": 0.2,
        "rates.means_lr": 1e-4,
        "rates.final_means_lr": 1e-4,
        "rates.sh_lr": 2.5e-3 / 0.28209479177387814,  # rgb_colors, of a colour itself
        "rates.opacities_lr": 0.05,
        "rates.scales_lr": 1e-3,
        "frame_side": 0,
    },
    "nerf": {  # bmild/nerf, run_nerf.py, paper_configs/blender_config.txt and llff_config.txt
        "network.depth": 8,
        "network.skip_layer": 5,
        "network.position_frequencies": 10,
        "network.direction_frequencies": 4,
        "hidden_width": 256,
        "rays.coarse_samples": 64,
        "rays.fine_samples": 128,
        "rays.rays_per_step": 4096,  # section 5.3; the release has 1024 for objects
        "learning_rate": 5e-4,
        "final_learning_rate": 5e-5,  # lrate_decay 500: a tenth after 500 000 steps
        "density_noise": 1.0,  # raw_noise_std of captures
        "networks": 2,
        "coarse_loss_weight": 1.0,
        "mask.occupancy_resolution": 0,  # empty space is not skipped
        "transmittance_threshold": 0.0,
    },
    "mip-nerf": {  # google/mipnerf, internal/utils.py and internal/models.py
        "network.depth": 8,
        "network.position_frequencies": 16,
        "network.direction_frequencies": 4,
        "hidden_width": 256,
        "rays.coarse_samples": 128,
        "rays.fine_samples": 128,
        "rays.rays_per_step": 4096,
        "resample_padding": 0.01,
        "coarse_loss_weight": 0.1,
        "learning_rate": 5e-4,
        "final_learning_rate": 5e-6,
        "warmup": 2500 / 1_000_000,
        "mask.occupancy_resolution": 0,
    },
    # princeton-computational-imaging/neural-scene-graphs, example_configs/config_kitti_0006_example_train.txt, main.py
    "neural-scene-graph": {
        "field": "network",
        "network.depth": 8,
        "network.skip_layer": 5,
        "network.position_frequencies": 10,
        "network.direction_frequencies": 4,
        "hidden_width": 256,
        "rays.rays_per_step": 8192,
        "code_width": 256,
        "code_weight": 1e-4,  # latent_balance, of the sum of norms: neural_scene_graph_helper.py, latentReg
        "box_samples": 7,
        "box_scale": 1.9,
        "pose_input": "location",
        "symmetric": False,
        "huber_delta": 1.0,
        "learning_rate": 5e-4,
    },
    "nerf-w": {  # the supplement; samples in rover-xingyu/Ha-NeRF, issue 31; codes, weight in kwea123/nerf_pl
        "field": "network",
        "network.depth": 8,
        "network.position_frequencies": 15,
        "hidden_width": 256,
        "rays.coarse_samples": 512,
        "rays.fine_samples": 512,
        "rays.rays_per_step": 2048,
        "appearance_code": 48,
        "transient_code": 16,
        "transient_layers": 4,
        "transient_width": 128,
        "beta_min": 0.03,
        "transient_weight": 0.01,
        "transient_start": 0.0,
    },
    "nerfies": {  # google/nerfies, configs of defaults, warp_defaults and gpu_vrig_paper; the paper's section 4
        "field": "network",
        "network.depth": 8,
        "network.position_frequencies": 8,
        "hidden_width": 256,
        "rays.coarse_samples": 128,
        "rays.fine_samples": 128,
        "rays.rays_per_step": 6144,
        "appearance_code": 8,
        "learning_rate": 1e-3,
        "final_learning_rate": pytest.approx(
            3.162e-4, rel=1e-3
        ),  # 1e-4 after 500 000 steps, of which 250 000 are taken
        "deformation.motion": "se3",
        "deformation.moment_code": 8,
        "deformation.deformation_frequencies": 8,
        "deformation.deformation_depth": 6,
        "deformation.deformation_width": 128,
        "deformation.deformation_skip": 4,
        "deformation.annealing": 80_000 / 250_000,
        "deformation.elastic_weight": 1e-3,
        "deformation.elastic_until": 50_000 / 250_000,
        "deformation.elastic_scale": 0.03,
        "deformation.background_weight": 1.0,
        "deformation.background_points": 16_384,
        "deformation.slice_dimensions": 0,  # Park 2021a; HyperNeRF has 2
        "deformation.slice_width": 64,
    },
    "nsff": {  # zhengqili/Neural-Scene-Flow-Fields, nsff_exp/configs/config_kid-running.txt and run_nerf.py
        "field": "network",
        "network.depth": 8,
        "network.position_frequencies": 10,
        "network.direction_frequencies": 4,
        "hidden_width": 256,
        "samples": 128,
        "rays_per_step": 1024,
        "learning_rate": 5e-4,
        "static_field": True,
        "flow.neighbours": 2,
        "flow.both_ways": True,
        "flow.max_flow": 1.0,
        "flow.occlusion_weight": 0.1,
        "flow.cycle_weight": 1.0,
        "flow.smooth_weight": 0.1,
        "flow.flow_weight": 0.02,
        "flow.depth_weight": 0.04,
        "flow.prior_interval": 30_000 / 500_000,
    },
    # facebookresearch/neuralvolumes, models/; weights and rate as its experiment's config.py stands in copies of it
    "neural-volumes": {
        "encoder_cameras": 3,
        "encoder_size": 512,  # of 512 x 334, padded to 512 x 384
        "encoder_width": 64,
        "code": 256,
        "volume_resolution": 128,
        "volume_width": 1024,
        "affines": 16,
        "warp_resolution": 32,
        "warp_width": 128,
        "view_dependence": False,
        "samples": 128,  # a step of 2 / 128
        "moments_per_step": 16,
        "rays_per_step": 16 * 128 * 128,
        "divergence_weight": 1e-3,
        "opacity_weight": 0.01,
        "smooth_weight": 0.01,
        "learning_rate": 1e-4,
    },
    "articulated-splatting": {  # brown-ivl/manus, config/model/gaussian/gaussian.yaml
        "sh_degree": 3,
        "ssim_weight": 0.2,
        "adaptive.densify_grad_threshold": 2e-4,
        "refine.refine_every": 100,
    },
    "humannerf": {  # chungyiweng/humannerf, 7389c40: configs/default.yaml; 400 000 steps
        "hidden_width": 256,
        "network.depth": 8,
        "network.position_frequencies": 10,
        "learning_rate": 5e-4,
        "final_learning_rate": 5e-4 * 0.1 ** (400 / 500),  # lrate_decay 500, after 400 000 steps
        "weights.weight_cells": 32,
        "weights.weight_code": 256,
        "weights.weights_lr": 5e-5,
        "bones.pose_correction": "network",
        "bones.pose_depth": 4,
        "bones.pose_width": 256,
        "bones.pose_lr": 5e-5,
        "bones.pose_from": 0.0,
        "nonrigid.nonrigid_depth": 6,
        "nonrigid.nonrigid_width": 128,
        "nonrigid.nonrigid_frequencies": 6,
        "nonrigid.nonrigid_from": 10_000 / 400_000,
        "nonrigid.nonrigid_until": 50_000 / 400_000,
        "nonrigid.nonrigid_lr": 5e-5,
    },
    # hustvl/4DGaussians, 843d5ac: arguments/__init__.py, arguments/dnerf/dnerf_default.py and scene/deformation.py
    "deformable-splatting": {
        "initial_gaussians": 2000,  # random ones, of D-NeRF's scenes
        "ssim_weight": 0.0,
        "motion.plane_resolution": 64,
        "motion.plane_moments": 25,
        "motion.plane_scales": 2,
        "motion.plane_features": 32,
        "motion.motion_width": 64,
        "motion.nodes": 0,
        "motion.all_moments_from": 0.0,
        "motion.still_until": 3000 / 23_000,
        "motion.plane_smoothness": 1e-4,
        "motion.time_smoothness": 0.01,
        "motion.time_sparsity": 1e-4,
        "motion.planes_lr": 1.6e-3,
        "motion.motion_lr": 1.6e-4,
        "motion.final_rate": 0.01,
        "motion.rigidity": 0.0,  # no such term; then no offset is bounded and no Gaussian stands still either
    },
    "block-nerf": {  # after the text of the appendix; codes, penalty and width also in hjxwhy/Block-NeRF
        "field": "network",
        "network.depth": 8,
        "network.position_frequencies": 16,
        "hidden_width": 512,
        "head_layers": 3,
        "head_width": 128,
        "rays.coarse_samples": 256,
        "rays.fine_samples": 512,
        "rays.rays_per_step": 16_384,
        "appearance_code": 32,
        "exposure_frequencies": 4,
        "visibility_layers": 4,
        "visibility_width": 128,
        "learning_rate": 2e-3,
        "final_learning_rate": 2e-5,
        "warmup_steps": 1024,
        "pose_penalty": 1e5,
        "final_pose_penalty": 0.1,
        "coarse_loss_weight": 0.1,
        "huber_delta": 1.0,  # squared
    },
    "regnerf": {  # google-research/google-research, regnerf/configs/llff3.gin and regnerf/internal/configs.py
        "field": "network",
        "network.depth": 8,
        "network.position_frequencies": 16,
        "hidden_width": 256,
        "rays.coarse_samples": 128,
        "rays.fine_samples": 128,
        "rays.rays_per_step": 4096,
        "unseen_patches": 64,  # 4096 rays in patches of 8 x 8
        "depth_weight": 0.1,
        "depth_weight_start": 400.0,
        "depth_settling": 512 / 69_768,
        "annealing": 512 / 69_768,
        "annealing_start": 0.5,  # dtu3.gin
        "forward_annealing_start": 1e-4,
        "density_noise": 1.0,
        "gradient_clip": 0.1,
        "coarse_loss_weight": 0.1,
        "resample_padding": 0.01,
        "learning_rate": 2e-3,
        "final_learning_rate": 2e-5,
        "warmup": 512 / 69_768,
    },
    "rawnerf": {  # google-research/multinerf, internal/train_utils.py: the loss alone
        "epsilon": 1e-3,
        "huber_delta": 0.0,  # squared
        "exposure_scales": True,
    },
    "nerfactor": {  # google/nerfactor, a668dca: nerfactor/config/nerfactor.ini, shape.ini and brdf.ini
        "properties": "network",
        "visibility": "network",
        "reflectance": "learnt",
        "property_layers": 4,  # mlp_depth
        "property_width": 128,  # mlp_width
        "position_frequencies": 10,  # n_freqs_xyz
        "direction_frequencies": 4,  # n_freqs_ldir
        "angle_frequencies": 2,  # brdf.ini, n_freqs
        "code_width": 3,  # brdf.ini, z_dim
        "light_rows": 16,
        "surface_rays": 1024,
        "jitter": 0.01,
        "shape_share": pytest.approx(200 / (200 + 100)),  # epochs of shape.ini and of nerfactor.ini
        "shape_weight": 1.0,  # shape.ini, normal_loss_weight and lvis_loss_weight
        "shape_learning_rate": 1e-2,  # shape.ini
        "normal_weight": 0.1,
        "visibility_weight": 0.1,
        "normal_smoothness": 0.05,
        "visibility_smoothness": 0.05,
        "albedo_smoothness": 0.05,
        "code_smoothness": 0.01,
        "light_variation": 5e-6,
        "learning_rate": 5e-3,
        "final_learning_rate": pytest.approx(4.775e-3, rel=1e-4),  # 0.1 in 500 000 steps, of which 10 000 are taken
        "light_rate": 5e-3,
    },
    "instant-ngp": {  # the paper's table 1, sections 4 and 5.4; NVlabs/instant-ngp, configs/nerf/base.json
        "table.levels": 16,
        "table.features_per_level": 2,
        "table.log2_hashmap_size": 19,
        "table.base_resolution": 16,
        "table.density_layers": 1,
        "table.colour_layers": 2,
        "table.geometry_features": 16,
        "table.sh_bands": 4,
        "hidden_width": 64,
        "learning_rate": 1e-2,
        "huber_delta": 0.1,
        "occupancy.samples_per_step": 1 << 18,
        "occupancy.transmittance_threshold": 1e-4,
        "occupancy.occupancy_resolution": 128,
        "occupancy.occupancy_interval": 16,
        "occupancy.occupancy_decay": 0.95,
        "steps.steps_per_diagonal": 1024,
    },
    "neus": {  # Totoro97/NeuS, confs/wmask.conf, womask.conf, models/fields.py and renderer.py; the paper's section E
        "field": "network",
        "network.depth": 8,
        "network.skip_layer": 4,
        "network.colour_depth": 4,
        "network.position_frequencies": 6,
        "network.direction_frequencies": 4,
        "hidden_width": 256,
        "rays.coarse_samples": 64,
        "rays.fine_samples": 64,
        "rays.rays_per_step": 512,
        "upsampling_rounds": 4,
        "outside_samples": 32,
        "weight_threshold": 0.0,  # all sections
        "eikonal_weight": 0.1,
        "mask_weight": 0.1,
        "curvature_weight": 0.0,
        "cosine_annealing": pytest.approx(50_000 / 300_000),
        "coarse_to_fine": 0.0,
        "learning_rate": 5e-4,
        "final_learning_rate": pytest.approx(0.05 * 5e-4),
        "sharpness_rate": 1.0,
        "warmup": pytest.approx(5000 / 300_000),
        "mask.occupancy_resolution": 0,
    },
    "plenoxels": {  # sxyu/svox2, opt/configs/syn.json and opt/util/config_util.py
        "base_resolution": 256,
        "max_resolution": 512,
        "refine_until": 38_400 / 128_000,
        "step_size": 0.5,
        "initial_density": 0.1,
        "rays_per_step": 5000,
        "density_learning_rate": 30.0,
        "final_density_learning_rate": pytest.approx(1.134, rel=1e-3),  # 0.05 after 250 000 steps; 128 000 are taken
        "harmonics_learning_rate": 1e-2,
        "final_harmonics_learning_rate": pytest.approx(2.042e-4, rel=1e-3),  # 5e-6, as above
        "density_delay": pytest.approx(15_000 / 128_000, rel=0.03),
        "tv_density": 1e-5,
        "tv_harmonics": 1e-3,
        "tv_share": 0.01,
    },
    "plenoctrees": {  # sxyu/plenoctree, nerf_sh/config/blender.conf and nerf_sh/nerf/utils.py; the paper's section 4
        "field": "network",
        "depth": 8,
        "position_frequencies": 10,
        "hidden_width": 256,
        "sh_bands": 4,
        "sparsity_weight": 1e-3,
        "sparsity_length": 0.05,
        "sparsity_points": 10_000,
        "learning_rate": 5e-4,
        "final_learning_rate": 5e-6,
        "octree_depth": 9,
        "leaf_points": 256,
        "weight_threshold": 1e-3,
        "occupancy.transmittance_threshold": 0.01,
    },
    "snerg": {  # google-research/google-research, snerg/configs/blender.yaml and snerg/nerf/utils.py
        "field": "network",
        "hidden_layers": 8,
        "hidden_width": 512,
        "position_frequencies": 10,
        "view_width": 16,
        "sparsity_weight": pytest.approx(1e-4 / 1024, rel=0.03),  # of the mean over a ray's samples; ours is their sum
        "huber_delta": 1.0,  # squared
        "learning_rate": 5e-4,
        "final_learning_rate": 5e-6,
        "voxel_share": 0.0,  # the small network alone is tuned
        "resolution": 1000,
        "block_size": 32,
        "least_alpha": 0.005,
    },
    "dvgo": {  # sunset1995/DirectVoxGO, configs/default.py
        "coarse_voxels": 1_024_000,
        "voxels": 160**3,
        "feature_channels": 12,
        "hidden_width": 128,
        "hidden_layers": 2,
        "coarse_alpha": 1e-6,
        "fine_alpha": 1e-2,
        "coarse_share": 0.2,  # 5000 and 20 000 steps, section 6.1
        "doublings": 4,
        "growing_share": 0.2,
        "box_alpha": 1e-3,
        "step_size": 0.5,
        "weight_threshold": 1e-4,
        "density_learning_rate": 0.1,
        "feature_learning_rate": 0.1,
        "network_learning_rate": 1e-3,
        "coarse_point_weight": 0.1,
        "point_weight": 0.01,
        "coarse_entropy_weight": 0.01,
        "entropy_weight": 0.001,
    },
    "tensorf": {  # apchenstu/TensoRF, configs/lego.txt and opt.py
        "factors": "vm",
        "density_components": 16,
        "appearance_components": 48,
        "initial_resolution": 128,
        "final_resolution": 300,
        "appearance_features": 27,
        "shading": "mlp",
        "hidden_width": 128,
        "feature_frequencies": 2,
        "direction_frequencies": 2,
        "density_scale": 25.0,
        "step_ratio": 0.5,
        "rays_per_step": 4096,
        "weight_threshold": 1e-4,
        "l1_weight": 8e-5,
        "final_l1_weight": 4e-5,
        "learning_rate": 0.02,
        "final_learning_rate": 0.002,
        "network_learning_rate": 1e-3,
    },
    "gaussian-splatting": {  # graphdeco-inria/gaussian-splatting, arguments/__init__.py; the paper's section 5
        "sh_degree": 3,
        "sh_degree_interval": 1000,
        "ssim_weight": 0.2,
        "initialization": "sparse",
        "half_resolution_until": 0.0,
        "strategy": "adaptive",
        "rates.means_lr": 1.6e-4,
        "rates.final_means_lr": 1.6e-6,
        "rates.sh_lr": 2.5e-3,
        "rates.opacities_lr": 0.05,
        "rates.scales_lr": 5e-3,
        "rates.quaternions_lr": 1e-3,
        "rates.most_haste": 1.0,
        "refine.max_gaussians": 0,  # no cap
        "refine.cap_ramp": False,
        "refine.refine_every": 100,
        "refine.refine_from": 500,
        "refine.refine_until": 0.5,
        "adaptive.densify_grad_threshold": 2e-4,
        "adaptive.opacity_reset_interval": 3000,
        "tidying.prune_near": False,
        "tidying.limit_scale": False,
        "tidying.limit_anisotropy": False,
        "tidying.observed_harmonics": False,
        "sparse.few_views": "no",
        "filters.antialiased": False,
        "filters.filter_3d": False,
    },
    "planar-splatting": {  # zju3dv/PGSR, de24f1a: arguments/__init__.py, train.py
        "planes.depth": "mean",
        "planes.normal_weight": 0.015,
        "planes.photometric_weight": 0.15,
        "planes.geometric_weight": 0.03,
        "planes.consistency_from": 7000 / 30_000,
        "planes.patches": 102_400,  # multi_view_sample_num
        "planes.patch_side": 7,  # 2 * multi_view_patch_size + 1
        "planes.near_views": 8,
        "planes.view_angle": 30.0,
        "planes.both_views": True,
        "planes.discs": False,
        "edge_power": 2,  # train.py: image_weight.clamp(0, 1) ** 2
        "planes.flatness_weight": 100.0,  # scale_loss_weight
        "sh_degree": 3,
        "sh_degree_interval": 1000,
        "ssim_weight": 0.2,
        "initialization": "sparse",
        "half_resolution_until": 0.0,
        "rates.means_lr": 1.6e-4,
        "rates.final_means_lr": 1.6e-6,
        "rates.sh_lr": 2.5e-3,
        "rates.opacities_lr": 0.05,
        "rates.scales_lr": 5e-3,
        "rates.quaternions_lr": 1e-3,
        "rates.most_haste": 1.0,
        "refine.max_gaussians": 0,
        "refine.cap_ramp": False,
        "refine.refine_every": 100,
        "refine.refine_from": 500,
        "refine.refine_until": 0.5,
        "adaptive.densify_grad_threshold": 2e-4,
        "adaptive.opacity_reset_interval": 3000,
        "tidying.prune_near": False,
        "tidying.limit_scale": False,
        "tidying.limit_anisotropy": False,
        "tidying.observed_harmonics": False,
    },
    "pixelnerf": {  # sxyu/pixel-nerf, conf/default.conf, conf/default_mv.conf, train/train.py and src/util/args.py
        "hidden_width": 512,
        "blocks": 5,
        "view_blocks": 3,
        "position_frequencies": 6,
        "coarse_samples": 64,
        "fine_samples": 16,  # n_fine less n_fine_depth
        "depth_samples": 16,
        "depth_deviation": 0.01,
        "networks": 2,
        "coarse_loss_weight": 1.0,
        "learning_rate": 1e-4,
        "members_per_step": 4,
        "rays_per_member": 128,
    },
    "mesh-fit": {  # rgl-epfl/large-steps-pytorch, figures/comparison/generate_data.py; the tutorial has lambda 49
        "start": "sphere",
        "smoothness": 19.0,
        "laplacian_weight": 0.0,
        "normal_weight": 0.0,
    },
    "deep-appearance": {  # facebookresearch/multiface, models.py and train.py
        "texture_log2": 10,
        "code": 128,
        "channels": 16,
        "max_channels": 128,
        "view_features": 8,
        "mesh_width": 256,
        "divergence_weight": 0.01,
        "textures_per_step": 16,
        "learning_rate": 3e-4,
    },
    "lumigraph": {  # Buehler 2001 gives no numbers; Gortler 1996, sec. 3.4: the four cameras around a ray
        "blended_views": 4,
    },
    "view-interpolation": {  # Chen and Williams 1993: between two photographs
        "warped_views": 2,
    },
    "tsdf-fusion": {  # niessner/VoxelHashing, DepthSensing/zParametersDefault.txt
        "voxel_size": 0.004,
        "truncation": 5.0,  # 0.02 m
        "truncation_growth": 0.01,
        "max_weight": 255.0,  # s_WeightMax
        "sample_weight": 3.0,  # s_WeightSample, times 1.5 in the shader
        "sensor_span": (0.4, 4.0),  # s_SensorDepthWorldMin and Max
        "weighting": "depth",
        "max_depth": 3.0,
    },
    "voxel-fit": {  # no paper's; voxels, opacity and step of sunset1995/DirectVoxGO, configs/default.py
        "voxels": 160**3,
        "initial_opacity": 1e-2,
        "step_size": 0.5,
    },
    "hyp-nerf": {  # hyp-nerf/HyP-NeRF, nerf/network_fcblock.py
        "table.log2_hashmap_size": 11,
        "table.levels": 16,
        "table.density_layers": 1,
        "table.colour_layers": 2,
        "shape_code": 512,
        "colour_code": 512,
        "code_deviation": 0.01,
        "hyper_width": 512,
        "hyper_layers": 2,
        "hidden_width": 64,
    },
    "deepsdf": {  # facebookresearch/DeepSDF, 48c19b8: examples/chairs/specs.json, train_deep_sdf.py, reconstruct.py
        "depth": 8,
        "hidden_width": 512,
        "skip_layer": 4,
        "octaves": 0,
        "weight_norm": True,
        "dropout": 0.2,
        "code": 256,
        "code_deviation": 0.01,  # section 4.2
        "code_weight": 1e-4,  # CodeRegularizationLambda
        "code_growth": pytest.approx(100 / 2001),  # min(1, epoch / 100), of NumEpochs
        "code_bound": 1.0,  # CodeBound
        "fit_weight": 1e-4,  # of torch.mean(latent.pow(2))
        "fit_learning_rate": 5e-3,
        "code_steps": 800,
        "clamp_distance": 0.1,
        "points_per_shape": 16_384,
        "points.pool_points": 500_000,  # section 5
        "points.near_spread": 0.05,  # src/PreprocessMesh.cpp: variances of 0.0025 and 0.00025
        "points.fine_spread": 0.0158,
        "learning_rate": 5e-4,
        "code_learning_rate": 1e-3,
    },
    "nglod": {  # nv-tlabs/nglod, sdf-net/lib/options.py
        "features": 32,
        "hidden_width": 128,
        "base_level": 2,  # feature-size 4
        "levels": 5,  # num-lods of sdf-net/README.md
        "points.pool_points": 500_000,  # num-samples 100 000 in each of five modes
        "points.near_share": 0.8,  # sample-mode rand near near trace trace
        "points.fine_spread": 0.0,
        "points_per_step": 512,
        "learning_rate": 1e-3,
    },
    "eg3d": {  # NVlabs/eg3d, train.py and training/triplane.py for FFHQ at 512; the paper's sections 4 and 5
        "picture_size": 512,
        "rendering_size": 64,
        "final_rendering_size": 128,
        "growth_start": 25 / 27.5,  # 25 million pictures, then 2.5 million more
        "super_resolution": 4,
        "super_widths": (256, 128),  # SuperresolutionHybrid8XDC
        "field": "planes",
        "plane_size": 256,
        "plane_channels": 32,
        "features": 32,
        "decoder_width": 64,
        "film_width": 256,  # marcoamonteiro/pi-GAN, siren.py
        "film_layers": 8,
        "coarse_samples": 48,
        "fine_samples": 48,
        "density_scale": 1.0,
        "density_shift": -1.0,  # softplus(sigma - 1)
        "code": 512,
        "style": 512,
        "mapping_layers": 2,  # map-depth
        "channel_base": 32_768,
        "channel_most": 512,
        "pictures_per_step": 32,
        "learning_rate": 0.0025,
        "discriminator_rate": 0.002,
        "r1_weight": 1.0,
        "r1_interval": 16,
        "density_weight": 0.25,
        "density_distance": 0.004,
        "density_interval": 4,
        "swap_probability": 0.5,
        "swap_pictures": 1_000_000,
        "blur_deviation": 10.0,
        "blur_pictures": 200_000,
        "average_pictures": 10_000,
    },
    "srn": {  # vsitzmann/scene-representation-networks, srns.py, custom_layers.py, train.py, train_configs/chairs.yml
        "code": 256,
        "code_deviation": 0.01,
        "hyper_layers": 2,  # one hidden layer behind the first one
        "hidden_width": 256,
        "depth": 4,
        "pixel_layers": 5,  # four hidden layers behind the first one
        "march_steps": 10,
        "marcher_state": 16,
        "start": "camera",
        "start_distance": 0.05,
        "start_deviation": 5e-4,
        "members_per_step": 64,
        "rays_per_member": 4096,  # a whole picture of 64 x 64
        "targets": 1,
        "colour_weight": 200.0,
        "depth_weight": 10.0,  # reg_weight 1e-3, times 10 000 in get_regularization_loss
        "code_weight": 1.0,
        "learning_rate": 5e-5,
    },
    "gancraft": {  # NVlabs/imaginaire, configs/projects/gancraft/landscape.yaml, spade/landscapes/lhq.yaml
        "features": 64,  # blk_feat_dim
        "encoded": 24,  # blk_feat_dim less pe_no_pe_feat_dim 40
        "bands": 4,  # pe_lvl_feat
        "hidden_width": 256,
        "output_features": 64,  # final_feat_dim
        "sky_bands": 5,  # pe_lvl_raydir_sky
        "style": 256,  # interm_style_dims
        "style_layers": 5,
        "code": 128,  # style_dims
        "samples_per_block": 8,  # num_samples 24 in sample_depth 3
        "sample_depth": 3.0,
        "density_scale": 0.25,  # dists_scale
        "crop": 256,
        "label_window": 11,  # label_smooth_dia
        "encoder_size": 256,
        "encoder_width": 64,
        "painter_code": 256,
        "painter_width": 128,
        "adversary_width": 128,
        "gan_weight": 0.5,
        "pseudo_gan_weight": 0.5,
        "l2_weight": 10.0,
        "perceptual_weight": 10.0,
        "opacity_weight": 0.0,
        "kl_weight": 0.05,
        "momentum": 0.0,  # adam_beta1
        "learning_rate": 1e-4,
        "corner_learning_rate": 1e-3,  # blk_feats
        "adversary_learning_rate": 4e-4,  # dis_opt
    },
    "dvr": {  # autonomousvision/differentiable_volumetric_rendering, configs/default.yaml, multi_view_reconstruction
        "field": "network",
        "hidden_width": 512,  # im2mesh/dvr/models/decoder.py
        "blocks": 5,
        "threshold": 0.5,  # im2mesh/dvr/models/depth_function.py, as the next three
        "march_steps": 128,
        "first_march_steps": 16,
        "secant_steps": 8,
        "hull_cells": 0,
        "rays_per_step": 2048,
        "colour_weight": 1.0,
        "freespace_weight": 1.0,
        "occupancy_weight": 1.0,
        "depth_weight": 0.0,
        "normal_weight": 0.1,  # lambda_normal of multi_view_reconstruction; default.yaml has 0.05
        "neighbour_distance": 2e-3,  # 1e-3 in a cube half as long, as the next one
        "difference_step": 2e-3,
        "learning_rate": 1e-4,
        "final_learning_rate": 2.5e-5,  # two milestones, a half each
    },
    "occupancy-network": {  # autonomousvision/occupancy_networks, configs/default.yaml and pointcloud/onet.yaml
        "code": 512,
        "picture_size": 224,
        "views": 24,
        "shapes_per_step": 64,
        "cloud_points": 300,
        "points_per_shape": 2048,
        "points.near_share": 0.0,
        "encoder_width": 512,
        "hidden_width": 256,
        "blocks": 5,
        "threshold": 0.2,
        "learning_rate": 1e-4,
    },
}


@pytest.mark.parametrize("name", NAMES)
def test_the_preset_paper_has_the_published_numbers(name):
    config = methods.find(name).preset(torch.device("cuda"))
    found = {path: number_of(config, path) for path in PUBLISHED[name]}
    assert found == PUBLISHED[name]


def number_of(config: Any, path: str) -> Any:
    """An option by its path in a Config, or the constant of its name beside the Config or a part of it."""
    *parts, name = path.split(".")
    for part in parts:
        config = value_of(config, part)
    if holds(config, name):
        return value_of(config, name)
    modules = [vars(sys.modules[type(group).__module__]) for group in groups_of(config)]
    return next(module[name.upper()] for module in modules if name.upper() in module)


def sources_of(name: str) -> dict[str, list[str]]:
    """Names of the numbers of each source, as the method's file has them."""
    held = vars(sys.modules[methods.find(name).__module__]).get("SOURCES", {})
    return {source: names.split() for source, names in held.items()}


@pytest.mark.parametrize("name", NAMES)
def test_each_published_number_has_one_source(name):
    said = [each for names in sources_of(name).values() for each in names]
    assert sorted(said) == sorted(path.split(".")[-1] for path in PUBLISHED[name])
    assert [source for source in sources_of(name) if not IS_SOURCE.match(source)] == []
    releases = [source for source in sources_of(name) if re.match(r"[\w.-]+/[\w.-]+, \S+\.\w+", source)]
    assert [source for source in releases if not re.search(r" \([0-9a-f]{7}\)", source)] == [], "a file has a commit"


def sources_shown(name: str) -> str:
    """Table of a method's sources with their numbers in the preset `paper`, and of its own numbers without one."""
    config, paths = methods.find(name).Config(), {path.split(".")[-1]: path for path in PUBLISHED[name]}
    rows = [
        (source, [f"`{each}` {value_shown(number_of(config, paths[each]))}" for each in names])
        for source, names in sources_of(name).items()
    ]
    own = [each.name for group in groups_of(config) if not is_shared(group) for each in fields(group)]
    ours = [each for each in own if each not in paths and each != "seed" and not is_dataclass(value_of(config, each))]
    rows += [("reference: no source, ours", [f"`{each}` {value_shown(value_of(config, each))}" for each in ours])]
    table = [f"| {source} | {', '.join(numbers)} |" for source, numbers in rows if numbers]
    return "\n".join(["| source | numbers of `--preset paper` |", "|---|---|", *table]) + "\n"


@pytest.mark.parametrize("name", NAMES)
def test_its_page_names_the_sources(name):
    written = SOURCES.search(page_of(name).read_text("utf-8"))
    assert written and written[0] == sources_shown(name), f"{name} is stale; run `python tests/test_paper_presets.py`"


@pytest.mark.parametrize("name", NAMES)
def test_the_preset_paper_says_its_memory(name):
    """Training asks for it first: a number of the paper's parts that it misses would end every run."""
    kind = methods.find(name)
    assert kind.further_bytes(tiny.scene().frame, kind.preset(torch.device("cuda")), learning=True) >= 0


@pytest.mark.parametrize("name", NAMES)
def test_its_page_says_where_it_differs(name):
    page = page_of(name).read_text("utf-8")
    sections = re.findall(r"^## Where we differ\n\n(.+?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE)
    assert len(sections) == 1 and len(sections[0]) > 200


# Every option has a sentence in a page: where the page itself says nothing, in a table of the options' comments.


def explained(group: Any) -> Iterator[tuple[str, str]]:
    """Options of a dataclass, and their comments."""
    source = "".join(inspect.getsource(x) for x in type(group).__mro__ if is_dataclass(x))
    for field in fields(group):
        if not is_dataclass(getattr(group, field.name)) and field.name != "seed":
            comment = re.search(rf"(?m)^    {field.name}:.*?  # (.+)$", source)
            assert comment, f"{type(group).__name__}.{field.name} has no comment, which --help and its page show"
            yield field.name, comment[1]


def is_shared(group: Any) -> bool:
    return not type(group).__module__.startswith(methods.__name__)


def row(name: str, *cells: Any) -> str:
    return f"| `--{name.replace('_', '-')}` | {' | '.join(str(x) for x in cells)} |"


def options_of(name: str) -> str:
    """Table of a method's own options that the rest of its page does not name, in the values of both presets."""
    kind, page = methods.find(name), TABLE.sub("", page_of(name).read_text("utf-8"))
    rows = []
    for paper, cpu in zip(groups_of(kind.Config()), groups_of(kind.cpu_preset()), strict=True):
        for option, comment in () if is_shared(paper) else explained(paper):
            if not re.search(rf"--(no-)?{option.replace('_', '-')}\b(?!-)", page):
                rows.append(row(option, *(value_shown(getattr(x, option)) for x in (paper, cpu)), comment))
    return "\n".join(["| option | paper | CPU | what it does |", "|---|---|---|---|", *rows, ""]) if rows else ""


def value_shown(value: Any) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value).strip("()") or "none"


def shared_options() -> str:
    """Table of the options of parts that several methods have."""
    found = {
        type(group): group for name in NAMES for group in groups_of(methods.find(name).Config()) if is_shared(group)
    }
    rows = {row(*pair) for group in found.values() for pair in explained(group)}
    return "\n".join(["| option | what it does |", "|---|---|", *sorted(rows)]) + "\n"


def page_of(name: str) -> Path:
    return PAGES / f"{name.replace('-', '_')}.md"


TABLES = {SHARED_PAGE: shared_options} | {page_of(name): partial(options_of, name) for name in NAMES}


@pytest.mark.parametrize("page", TABLES, ids=lambda page: page.stem)
def test_every_option_has_a_sentence_in_a_page(page):
    written = TABLE.search(page.read_text("utf-8"))
    assert (written[0] if written else "") == TABLES[page](), (
        f"{page} is stale; run `python tests/test_paper_presets.py`"
    )


if __name__ == "__main__":
    for page, table in TABLES.items():
        page.write_text(TABLE.sub(lambda _, table=table: table(), page.read_text("utf-8")), "utf-8")
    for page, name in {page_of(name): name for name in NAMES}.items():
        page.write_text(SOURCES.sub(lambda _, name=name: sources_shown(name), page.read_text("utf-8")), "utf-8")
