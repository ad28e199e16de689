"""Occupancy networks: a network says which points are inside of a shape (Mescheder et al. 2019, arXiv 1812.03828)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from ...camera import ring
from ...color.blending import before
from ...components.fields.appearance import fitted
from ...components.sampling.coded_surface import CodedSurface, Evidence
from ...components.sampling.sphere_trace import March
from ...components.training.schedules import falling
from ...components.training.shape_points import PointNumbers, PointPools
from ...datasets.scene import Frame, Photograph
from ...datasets.shapes import HALF_SIDE, PointBatch, Shape, Shapes
from ...datasets.shapes.pictures import picture_of
from ...errors import LumigraphError
from ...files.ranges import Count, Layers, LearningRate, Width, between, changed
from ...method import BaseConfig, seeded
from .networks import VOXELS, OccupancyDecoder, PointEncoder, VoxelEncoder, WholePictureEncoder

Input = Literal["points", "voxels", "picture"]


FIT_LEARNING_RATE = 0.02  # Adam's learning rate of a new code, in deviations of the learnt codes
CLOUD_NOISE = 0.01  # deviation of noise of a cloud's points in training, scene units
VIEWS = 24  # pictures of each shape to learn from, around it, section 4.2
FINAL_LEARNING_RATE = 1e-4  # learning rate at the end of the budget, reached exponentially


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers; where it leaves them open, those of the published code (configs/)."""

    input: Input = "points"  # evidence that a shape is encoded from: a cloud of points, voxels, or one picture
    points: PointNumbers = PointNumbers(pool_points=100_000, near_share=0.0)
    cloud_points: Annotated[int, between(8, 65_536)] = 300  # points of a cloud as input, section 4.3
    bend: Annotated[float, between(0, 0.6)] = 0.0  # largest bend of axes in training, of points alone; more vary shapes
    stretch: Annotated[float, between(0, 2)] = 0.0  # largest |log| of factors of axes in training, likewise
    picture_size: Annotated[int, between(16, 512)] = 224  # pixels a side of a picture as input
    code: Width = 512  # numbers of a code, appendix A; more hold more shapes
    encoder_width: Width = 512  # channels of the encoder, appendix A; wider costs time
    hidden_width: Width = 256  # channels of the decoder, appendix A; wider costs time
    blocks: Layers = 5  # residual blocks of the decoder, appendix A; more cost time
    octaves: Annotated[int, between(0, 16)] = 0  # octaves of waves that encode points; more give finer detail, noise
    threshold: Annotated[float, between(0.001, 0.999)] = 0.2  # probability at the surface, section 3.3; higher: thinner
    members: Count = 4096  # shapes of a collection at most; the code of each is kept
    shapes_per_step: Annotated[int, between(1, 1024)] = 64  # shapes in a step, section 4; more reduce noise
    points_per_shape: Annotated[int, between(1, 1 << 20)] = 2048  # points of each shape in a step, section 3.2
    learning_rate: LearningRate = 1e-4  # Adam's learning rate at first, appendix A
    code_steps: Annotated[int, between(0, 10_000)] = 0  # steps that fit an encoded cloud's code to it; many overfit


SOURCES = {  # of the numbers of `paper`; the others are ours
    "autonomousvision/occupancy_networks, configs/default.yaml (406f794)": "picture_size views",
    "autonomousvision/occupancy_networks, configs/pointcloud/onet.yaml (406f794)": (
        "code shapes_per_step cloud_points points_per_shape encoder_width threshold"
    ),
    "autonomousvision/occupancy_networks, im2mesh/onet/models/decoder.py (406f794)": "hidden_width blocks",
    "autonomousvision/occupancy_networks, scripts/sample_mesh.py (406f794)": "near_share",
    "autonomousvision/occupancy_networks, train.py (406f794)": "learning_rate",
}


PLAIN_SHARE = 0.25  # share of members that stay as they are where the others are warped: their codes are kept
MAX_LOGIT_ERROR = 4.0  # beyond it a point of a cloud does not pull the surface: the decoder has no such part
VALUE_SCALE = 0.02  # scene units for a logit of 1: about how steep occupancy is at a learnt surface
STEP = 0.02  # scene units from one look at a ray to the next
EVALUATED_POINTS = 1 << 14  # points that go through the decoder together, to stay in caches


@dataclass(frozen=True)
class OccupancyLesson:
    """Points of some members, as many of each, and the encoder's input for each member.

    plain: members without a warp
    """

    unit: ClassVar[str] = "points"

    points: PointBatch
    evidence: Float[Tensor, " member *evidence"]
    plain: Bool[Tensor, " member"]

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Warp:
    """x' = scale (x + bend (1 - x^2) / 2) + shift along each axis of each member: augmentation of proportions.

    It is monotone for |x| < 1 / |bend|, so the inside of a shape stays inside.
    """

    bend: Float[Tensor, "member 1 3"]
    scale: Float[Tensor, "member 1 3"]
    shift: Float[Tensor, "member 1 3"]

    @staticmethod
    def drawn(
        box: Float[Tensor, "member 2 3"], bend: Float[Tensor, "member 1 3"], stretch: Float[Tensor, "member 1 3"]
    ) -> Warp:
        """Warp of given bends and factors, with the longest side of each warped box normalised."""
        low, high = (stretch * bent(box, bend)).split(1, 1)
        size = 2 * HALF_SIDE / (high - low).amax(-1, keepdim=True)
        return Warp(bend, size * stretch, -size * (low + high) / 2)

    def __call__(self, points: Float[Tensor, "member point 3"]) -> Float[Tensor, "member point 3"]:
        return self.scale * bent(points, self.bend) + self.shift


def bent(points: Float[Tensor, "member point 3"], bend: Float[Tensor, "member 1 3"]) -> Float[Tensor, "member point 3"]:
    return points + bend * (1 - points.square()) / 2


class OccupancyNetwork(CodedSurface):
    """Learns to encode evidence of a shape, and the occupancy of points under the code."""

    Config = Config
    accepts = (Shapes, Photograph)
    march = March(max_steps=256, min_step=STEP, max_step=STEP)

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        encoders = {"points": PointEncoder, "voxels": VoxelEncoder, "picture": WholePictureEncoder}
        with seeded(c.seed):
            self.encoder = encoders[c.input](c.code, c.encoder_width)
            self.decoder = OccupancyDecoder(c.code, c.hidden_width, c.blocks, c.octaves)
        self.codes.rows.requires_grad_(False)  # encoded, not learnt
        self.pools = PointPools("occupancy-network", c.points, c.seed)
        self._evidence: dict[int, Tensor] = {}  # voxels or pictures of members, by number

    @classmethod
    def cpu_preset(cls) -> Any:
        """Smaller networks, points close to the surface too, waves, and warped members."""
        return changed(Config(), pool_points=80_000, near_share=0.6, picture_size=64, code=128, encoder_width=64,
            hidden_width=64, octaves=3, threshold=0.5, members=256, shapes_per_step=16, points_per_shape=256,
            learning_rate=2e-3, bend=0.4, stretch=0.3, code_steps=30)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        return changed(Config(), pool_points=4096, near_share=0.5, cloud_points=32, code=4, encoder_width=8,
            hidden_width=8, blocks=1, octaves=1, threshold=0.5, members=4, shapes_per_step=1, points_per_shape=512,
            learning_rate=6e-2)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations that a step keeps for its gradients."""
        points = config.shapes_per_step * config.points_per_shape
        return 4 * points * 4 * config.blocks * config.hidden_width * learning

    # Learning

    def begin(self, data: Shapes, seconds: float = math.inf) -> None:
        self.codes.check_room(len(data), data.source)

    def steps_per_pass(self, data: Shapes) -> float:
        return len(data.splits["train"]) / self.config.shapes_per_step

    def batch(self, data: Shapes, generator: torch.Generator) -> OccupancyLesson:  # type: ignore[override]
        c, many = self.config, len(data.splits["train"]) > 1
        count = c.points_per_shape if many else c.points_per_shape * c.shapes_per_step  # a single one is encoded once
        points = self.pools.lesson(data, c.shapes_per_step if many else 1, count, generator)
        members = points.member[::count].tolist()
        evidence = torch.stack([self._evidence_of(data.members[i], i, generator) for i in members])
        plain = torch.rand(len(members), generator=generator) < PLAIN_SHARE
        if c.input != "points" or not many or not (c.bend or c.stretch):
            plain = torch.ones_like(plain)
        if c.input == "points":
            warp = self._warp([data.members[i] for i in members], plain, generator)
            moved = warp(points.points.view(len(members), -1, 3)).flatten(0, 1)
            points, evidence = replace(points, points=moved, distance=None), warp(evidence)
            evidence = evidence + CLOUD_NOISE * torch.randn(evidence.shape, generator=generator)
        return OccupancyLesson(points.to(self.device), evidence.to(self.device), plain.to(self.device))

    def _warp(self, shapes: list[Shape], plain: Bool[Tensor, " member"], generator: torch.Generator) -> Warp:
        """A random warp of each member, none for those that stay plain."""
        box = torch.stack(
            [torch.from_numpy(np.stack([x.mesh.vertices.min(0), x.mesh.vertices.max(0)])) for x in shapes]
        )
        warped = ~plain[:, None, None] * (2 * torch.rand(2, len(shapes), 1, 3, generator=generator) - 1)
        return Warp.drawn(box.float(), self.config.bend * warped[0], (self.config.stretch * warped[1]).exp())

    def _evidence_of(self, shape: Shape, member: int, generator: torch.Generator) -> Float[Tensor, "*evidence"]:
        """The encoder's input for a training member in a step."""
        c = self.config
        if c.input == "points":
            return shape.surface(c.cloud_points, generator).points
        if member not in self._evidence:
            self._evidence[member] = voxels_of(shape) if c.input == "voxels" else self._pictures(shape, member)
        known = self._evidence[member]
        return known if c.input == "voxels" else known[int(torch.randint(len(known), (), generator=generator))]

    def _pictures(self, shape: Shape, member: int) -> Float[Tensor, "view height width"]:
        cameras = ring(shape.frame.bounds, size=self.config.picture_size, count=VIEWS)
        shots = [picture_of(shape, cameras[i], self.random(1000 + member)) for i in range(len(cameras))]
        return torch.stack([grey(shot) for shot in shots])

    def loss(self, batch: OccupancyLesson, step: int) -> dict[str, Tensor]:  # type: ignore[override]
        """Cross-entropy of occupancy (eq. 3)."""
        points = batch.points
        assert points.occupancy is not None
        codes = self.encoder(batch.evidence)
        shape = len(codes), -1
        logits = self.decoder(points.points.view(*shape, 3), codes)
        with torch.no_grad():
            self.codes.rows[points.member.view(shape)[batch.plain, 0]] = codes[batch.plain]
            self.figures = {"wrong": float(((logits > 0) != (points.occupancy.view(shape) > 0.5)).float().mean())}
        return {"occupancy": F.binary_cross_entropy_with_logits(logits, points.occupancy.view(shape))}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        learnt = [*self.encoder.parameters(), *self.decoder.parameters()]
        return [torch.optim.Adam(learnt, self.config.learning_rate, foreach=True)]

    def learning_rate(self, step: int, progress: float) -> float:
        return falling(self.config.learning_rate, FINAL_LEARNING_RATE, progress)

    # Shapes

    def logits(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Logit of the probability that points are inside of the current instance."""
        code = self.code[None]
        return torch.cat([self.decoder(part[None], code)[0] for part in points.split(EVALUATED_POINTS)])

    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Logit of the threshold minus that of points, scaled as if occupancy had slope 1 / VALUE_SCALE: sign and zero
        level of a distance, but not its length."""
        return VALUE_SCALE * (self._level - self.logits(points))

    @property
    def _level(self) -> float:
        """Logit of the threshold."""
        return math.log(self.config.threshold / (1 - self.config.threshold))

    # A new shape

    @property
    def taken_kinds(self) -> tuple[Evidence, ...]:  # type: ignore[override]
        kinds: dict[Input, tuple[Evidence, ...]] = {"points": ("points",), "voxels": ("mesh",), "picture": ("picture",)}
        return kinds[self.config.input]

    @torch.no_grad()
    def find(self, evidence: Any) -> Float[Tensor, " code"]:
        """The code of a cloud or mesh, or of a picture, which is rendered from a mesh as in training.

        Raises LumigraphError for evidence of another kind than the training's.
        """
        c = self.config
        if c.input == "picture":
            if not isinstance(evidence, Photograph):
                if evidence.is_cloud:
                    raise LumigraphError(
                        f"This run of occupancy-network learnt from pictures, and {evidence.name} is a cloud of "
                        "points; name a picture, or train with --input points"
                    )
                camera = ring(evidence.frame.bounds, size=c.picture_size)[1]
                evidence = picture_of(evidence, camera, self.random(2))
            encoded = F.interpolate(grey(evidence)[None, None], (c.picture_size,) * 2, mode="area")[0]
            return self.encoder(encoded.to(self.device))[0]
        if isinstance(evidence, Photograph):
            raise LumigraphError(
                f"This run of occupancy-network learnt from {c.input}, and a picture was named; name a mesh or a cloud "
                "of points, or train with --input picture"
            )
        if c.input == "voxels":
            return self.encoder(voxels_of(evidence)[None].to(self.device))[0]
        cloud = evidence.surface(c.cloud_points, self.random(2)).points.to(self.device)
        return self._through(cloud, self.encoder(cloud[None])[0])

    def _through(self, cloud: Float[Tensor, "point 3"], code: Float[Tensor, " code"]) -> Float[Tensor, " code"]:
        """The encoded code optimised so that the surface passes through a cloud: the threshold's logit at its points.

        A cloud has no points in empty space, so the fit ends after few steps.
        """
        learnt = self.codes.rows[self.codes.learnt]
        if len(learnt) < 2 or not self.config.code_steps:
            return code
        deviation = learnt.std(0)

        def error(off: Float[Tensor, " code"]) -> Tensor:
            logits = self.decoder(cloud[None], (code + deviation * off)[None])
            return (logits - self._level).abs().clamp_max(MAX_LOGIT_ERROR).mean()

        c = self.config
        return code + deviation * fitted(torch.zeros_like(code), error, c.code_steps, FIT_LEARNING_RATE)


def voxels_of(shape: Shape) -> Float[Tensor, "x y z"]:
    """Occupancy of voxels in [-1, 1]^3. Raises LumigraphError for a cloud, which has none."""
    if shape.is_cloud:
        raise LumigraphError(
            f"{shape.name} has points and no faces, so its voxels are unknown; name a mesh, or train with "
            "--input points"
        )
    middle = (torch.arange(VOXELS) + 0.5) * (2 / VOXELS) - 1
    return shape.inside(torch.cartesian_prod(middle, middle, middle)).float().view(VOXELS, VOXELS, VOXELS)


def grey(picture: Photograph) -> Float[Tensor, "height width"]:
    """A picture before white, in grey."""
    return before(picture.rgb, picture.alpha, (1.0, 1.0, 1.0)).mean(-1)
