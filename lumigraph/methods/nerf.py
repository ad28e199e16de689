"""NeRF: a scene held in the weights of a coordinate network (Mildenhall et al. 2020, arXiv 2003.08934)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch.nn.functional import softplus

from ..camera import Camera
from ..components.fields.coordinate_field import CoordinateField, NetworkNumbers
from ..components.fields.spaces import space_of
from ..components.fields.teacher import POINTS_PER_RAY, distil, teacher_of
from ..components.sampling.hierarchical_sampler import CPU_NETWORK, TINY_NETWORK, HierarchicalSampler, RayNumbers
from ..components.sampling.occupancy import MaskNumbers
from ..components.sampling.samplers import sampling_bytes
from ..components.training.pose_refinement import PoseNumbers, poses_for
from ..components.training.schedules import exponential_decay
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..files.ranges import LearningRate, NonNegative, Share, Width, between, changed
from ..method import BaseConfig, FieldMethod
from ..method.depth import DepthNumbers

DENSITY_NOISE = 1.0  # deviation of noise on captures' raw density in training, appendix A


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers, with where it gives them; then numbers that save time and keep the mathematics."""

    network: NetworkNumbers = NetworkNumbers()
    rays: RayNumbers = RayNumbers()
    mask: MaskNumbers = MaskNumbers()
    poses: PoseNumbers = PoseNumbers()
    measured: DepthNumbers = DepthNumbers()
    hidden_width: Width = 256  # channels of a layer, appendix A; wider holds more detail, and costs time
    learning_rate: LearningRate = 5e-4  # Adam's learning rate at first, section 5.3; higher: faster, may diverge
    final_learning_rate: LearningRate = 5e-5  # learning rate at the end of the budget, section 5.3
    networks: Annotated[int, between(1, 2)] = 2  # networks: 2, one for each pass, or 1 for both, which is faster
    coarse_loss_weight: NonNegative = 1.0  # weight of the coarse colours, eq. 6; 0, with one network: it only guides
    transmittance_threshold: Share = 0.0  # transmittance at which a ray terminates; higher is faster, less exact
    warmup: Share = 0.0  # share of the budget in which the learning rate rises; 0: none

    def check(self) -> None:
        """Raises LumigraphError for numbers that contradict each other."""
        if self.networks == 2 and not self.coarse_loss_weight:
            raise LumigraphError(
                "The first of two networks learns from --coarse-loss-weight alone, so --networks 2 with "
                "--coarse-loss-weight 0 cannot be; give --networks 1, or a weight above 0"
            )


SOURCES = {  # of the numbers of `paper`; the others are ours
    "bmild/nerf, run_nerf.py (14c5556)": (
        "depth skip_layer position_frequencies direction_frequencies hidden_width networks coarse_loss_weight"
    ),
    "bmild/nerf, paper_configs/blender_config.txt (14c5556)": (
        "coarse_samples fine_samples learning_rate final_learning_rate"
    ),
    "bmild/nerf, paper_configs/llff_config.txt (14c5556)": "density_noise",
    "Mildenhall 2020, section 5.3": "rays_per_step",
    "bmild/nerf, run_nerf.py (14c5556), which has no such step": "occupancy_resolution transmittance_threshold",
}


class NeRF(FieldMethod):
    """Coarse samples evenly along each ray, fine ones where the coarse ones found density (section 5.2)."""

    Config, further_bytes, learning_rate = Config, staticmethod(sampling_bytes), exponential_decay  # section 5.3
    network: CoordinateField
    sampler: HierarchicalSampler

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        space = space_of(frame)
        self.poses = poses_for(frame, c.poses)
        noise = DENSITY_NOISE if space.is_open else 0.0
        joining = self.poses.weights if self.poses else None
        self.network = CoordinateField(c.network, c.hidden_width, space, joining=joining, noise=noise)
        if c.networks == 2:
            self.network.coarse = CoordinateField(c.network, c.hidden_width, space, joining=joining, noise=noise)
        passes = c.coarse_loss_weight > 0, c.transmittance_threshold
        self.sampler = HierarchicalSampler(space, c.rays, c.mask, *passes)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller network for both passes, evaluated where something is."""
        return changed(Config(**CPU_NETWORK), depth=6, skip_layer=3, networks=1, transmittance_threshold=1e-3)

    @classmethod
    def smallest(cls) -> Any:
        """The paper's two networks, tiny, and a grid of what is empty: every part, within some twenty quick steps."""
        c = Config(**TINY_NETWORK, transmittance_threshold=1e-3)
        return changed(c, depth=3, skip_layer=2, position_frequencies=5)

    def from_field(self, teacher: Any, cameras: Camera) -> None:
        """Both networks alike, taught at points by the teacher."""
        known, c, chance, network = teacher_of(teacher, cameras), self.config, self.random(3), self.network
        self.sampler.begin_from(known, chance)
        optimizer = torch.optim.Adam(network.network.parameters(), c.learning_rate, eps=1e-7)
        usual, network.activation = network.activation, softplus  # negative outputs must learn as well
        distil(network, known, network.space, [optimizer], POINTS_PER_RAY * c.rays.rays_per_step, chance, self.device)
        network.activation = usual
        if network.coarse:
            network.coarse.network.load_state_dict(network.network.state_dict())

    def optimizers(self) -> list[torch.optim.Optimizer]:
        return [*self.network.optimizers_at(self.config.learning_rate), *super().optimizers()]
