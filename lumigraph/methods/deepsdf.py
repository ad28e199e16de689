"""DeepSDF: a network gives the signed distance of a point, under the code of a shape (Park 2019, arXiv 1901.05103)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from ..components.fields.appearance import fitted
from ..components.fields.coordinate_network import SkipNetwork
from ..components.fields.encodings import FrequencyEncoding
from ..components.fields.layers import Dense, in_chunks
from ..components.sampling.coded_surface import CodedSurface
from ..components.training.schedules import falling
from ..components.training.shape_points import PointNumbers, PointPools, sampled
from ..datasets.scene import Frame
from ..datasets.shapes import CUBE, HALF_SIDE, PointBatch, Shape, Shapes
from ..errors import LumigraphError
from ..files.ranges import Count, Depth, Layers, LearningRate, Share, Width, between, changed
from ..geometry import Similarity
from ..method import BaseConfig, seeded

Tally = Annotated[int, between(0, 100_000)]


FINAL_SHARE = 1 / 16  # share of both learning rates at the end of the budget
FIT_LEARNING_RATE = 5e-3  # Adam's learning rate of a new code
FIT_WEIGHT = 1e-4  # weight of the new code's mean square, eq. 10; as reconstruct.py has it
CODE_DEVIATION = 0.01  # standard deviation of codes at first, section 4.2
CODE_WEIGHT = 1e-4  # weight of the codes' lengths, not squared as in eq. 9; higher keeps codes near zero
CODE_GROWTH = 100 / 2001  # share of the budget in which this weight grows from zero: epochs of the published code
CODE_BOUND = 1.0  # length of a code at most
CLAMP_DISTANCE = 0.1  # delta of eq. 4, scene units; smaller concentrates on the surface
OFFSET = 0.01  # scene units from a scanned point along its normal, at which the distance is known


@dataclass(frozen=True)
class Config(BaseConfig):
    """The paper's numbers; where it leaves them open, those of the published code (examples/chairs/specs.json)."""

    points: PointNumbers = PointNumbers()
    depth: Depth = 8  # hidden layers, section 4.1; more hold more detail, and cost time
    hidden_width: Width = 512  # channels of hidden layers, section 4.1; wider costs time
    skip_layer: Layers = 4  # layer whose output code and point join again, section 4.1
    octaves: Annotated[int, between(0, 16)] = 0  # octaves of waves that encode the point; more give finer detail, noise
    weight_norm: bool = True  # normalise the weights of hidden layers, section 4.1
    dropout: Share = 0.2  # share of hidden channels that a training step drops; higher: smoother
    code: Width = 256  # numbers of a shape's code, section 6; more hold more shapes
    members: Count = 4096  # shapes of a collection at most; each has a code, so more cost memory
    shapes_per_step: Annotated[int, between(1, 1024)] = 8  # shapes in a step; more reduce noise, and cost time
    points_per_shape: Annotated[int, between(1, 1 << 20)] = 16_384  # points of each shape in a step
    learning_rate: LearningRate = 5e-4  # Adam's learning rate of the network at first
    code_learning_rate: LearningRate = 1e-3  # Adam's learning rate of the codes at first
    # Finding the code of a new shape.
    code_steps: Tally = 800  # steps that fit the code of a new shape, section 6.2; more take longer


SOURCES = {  # of the numbers of `paper`; the others are ours
    "facebookresearch/DeepSDF, examples/chairs/specs.json (48c19b8)": (
        "depth hidden_width skip_layer weight_norm dropout code code_weight code_bound clamp_distance points_per_shape "
        "learning_rate code_learning_rate"
    ),
    "facebookresearch/DeepSDF, networks/deep_sdf_decoder.py (48c19b8)": "octaves",
    "facebookresearch/DeepSDF, train_deep_sdf.py (48c19b8)": "code_growth",
    "facebookresearch/DeepSDF, reconstruct.py (48c19b8)": "fit_weight fit_learning_rate code_steps",
    "facebookresearch/DeepSDF, src/PreprocessMesh.cpp (48c19b8)": "near_spread fine_spread",
    "Park 2019, sections 4.2 and 5": "code_deviation pool_points",
}
FIRST_OUTPUT = 0.03  # deviation of the network's first outputs: beyond delta the clamped error has no gradient
OBSERVED_POINTS = 1 << 14  # points of a new shape that its code is fitted to
MAX_CANDIDATES, MAX_PLACED_CANDIDATES = 64, 16  # learnt codes at most that a fit may begin with; at each place
PLACE_STEP = 0.1  # scene units, and share of the size, that a step of 1 moves a scan in the fit
PLACES, SIZES = (-1.0, 0.0, 1.0), (0.7, 0.85, 1.0)  # of a scan in the whole, at which a fit may begin


class Dropout(nn.Module):
    """Inverted dropout by a generator that a step sets, so that a resumed run drops the same channels."""

    def __init__(self, share: float):
        super().__init__()
        self.share = share
        self.generator: torch.Generator | None = None

    def forward(self, x: Float[Tensor, "sample channel"]) -> Float[Tensor, "sample channel"]:
        if self.generator is None or not self.share:
            return x
        kept = torch.rand(x.shape, generator=self.generator).to(x.device) >= self.share
        return x * kept / (1 - self.share)


class Decoder(SkipNetwork):
    """f_theta(z, x): hidden layers with weight normalisation, ReLU and dropout, then a tanh (section 4.1)."""

    def __init__(self, config: Config):
        c = config
        encoding = FrequencyEncoding(3, c.octaves)

        def layer(inputs: int, outputs: int, relu: bool) -> nn.Module:
            dense = Dense(inputs, outputs, relu, exact=True)
            return nn.Sequential(weight_norm(dense) if c.weight_norm else dense, Dropout(c.dropout))

        super().__init__(c.code + encoding.width, c.depth, c.hidden_width, c.skip_layer, layer)  # type: ignore[arg-type]
        self.encoding, self.last = encoding, Dense(c.hidden_width, 1, exact=True)
        nn.init.normal_(self.last.weight, std=FIRST_OUTPUT / math.sqrt(c.hidden_width))

    def forward(self, code: Float[Tensor, "point code"], points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        joined = torch.cat([code, self.encoding(points)], -1)
        return self.last(self.trunk(joined, self.last))[:, 0].tanh()

    def drop_by(self, generator: torch.Generator | None) -> None:
        """Drop channels at random from now on; None ends that."""
        for module in self.modules():
            if isinstance(module, Dropout):
                module.generator = generator


class DeepSDF(CodedSurface):
    """Learns a code for each shape of Shapes and a decoder of codes to signed distance; `given` a new shape, or a
    partial scan of it, it fits the code."""

    Config = Config
    taken_kinds = ("mesh", "half scan")

    def __init__(self, frame: Frame, config: Any = None):
        c = config or Config()
        super().__init__(frame, c)
        with seeded(c.seed):
            self.decoder = Decoder(c)
        self.pools = PointPools("deepsdf", c.points, c.seed)

    @classmethod
    def cpu_preset(cls) -> Any:
        """A smaller network that takes waves, without dropout and weight normalisation."""
        return changed(Config(), pool_points=80_000, depth=6, hidden_width=128, skip_layer=3, octaves=4,
            weight_norm=False, dropout=0.0, code=64, members=256, shapes_per_step=4, points_per_shape=1024,
            learning_rate=2e-3, code_learning_rate=4e-3, code_steps=300)  # fmt: skip

    @classmethod
    def smallest(cls) -> Any:
        return changed(Config(), pool_points=4096, depth=2, hidden_width=16, skip_layer=1, octaves=1, code=4, members=4,
            shapes_per_step=1, points_per_shape=256, learning_rate=1e-2, code_steps=20, dropout=0.05)  # fmt: skip

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Activations that a step keeps for its gradients."""
        points = config.shapes_per_step * config.points_per_shape
        return 4 * points * config.depth * config.hidden_width * learning

    # Learning

    def begin(self, data: Shapes, seconds: float = math.inf) -> None:
        self.codes.check_room(len(data), data.source)
        self.codes.begin(data.splits["train"], CODE_DEVIATION, self.random(1))

    def steps_per_pass(self, data: Shapes) -> float:
        return len(data.splits["train"]) / self.config.shapes_per_step

    def batch(self, data: Shapes, generator: torch.Generator) -> PointBatch:  # type: ignore[override]
        c = self.config
        return self.pools.lesson(data, c.shapes_per_step, c.points_per_shape, generator, balanced=True).to(self.device)

    def loss(self, batch: PointBatch, step: int) -> dict[str, Tensor]:  # type: ignore[override]
        """The error of clamped distances (eq. 4), and the prior of codes (eq. 9, as train_deep_sdf.py weights it)."""
        codes = self.codes(batch.member)
        self.decoder.drop_by(self.random(step))
        error = self._error(codes, batch.points, batch.signed)
        self.decoder.drop_by(None)
        self.figures = {"distance error": float(error.detach())}
        return {
            "distance": error,
            "code": min(1.0, self.progress / CODE_GROWTH) * CODE_WEIGHT * codes.norm(dim=-1).mean(),
        }

    @torch.no_grad()
    def after_step(self, step: int) -> None:
        super().after_step(step)
        self.codes.rows.renorm_(2, 0, CODE_BOUND)

    def _error(
        self, codes: Float[Tensor, "point code"], points: Float[Tensor, "point 3"], distance: Float[Tensor, " point"]
    ) -> Float[Tensor, ""]:
        """Mean |clamp(f(z, x), delta) - clamp(s, delta)| (eq. 4)."""
        delta = CLAMP_DISTANCE
        return (self._clamped(codes, points) - distance.clamp(-delta, delta)).abs().mean()

    def _clamped(self, codes: Float[Tensor, "point code"], points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        delta = CLAMP_DISTANCE
        return in_chunks(lambda z, x: (self.decoder(z, x),), codes, points)[0].clamp(-delta, delta)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        c = self.config
        codes: dict[str, Any] = {"params": [self.codes.rows], "name": "codes"}
        return [torch.optim.Adam([{"params": [*self.decoder.parameters()]}, codes], c.learning_rate, foreach=True)]

    def learning_rate(self, step: int, progress: float) -> dict[str, float]:
        c = self.config
        rates = {"": c.learning_rate, "codes": c.code_learning_rate}
        return {name: falling(rate, FINAL_SHARE * rate, progress) for name, rate in rates.items()}

    # Shapes

    def distance(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, " point"]:
        """Signed distance of the instance that is shown, clamped to delta."""
        return self._clamped(self.code[None].expand(len(points), -1), points)

    # A new shape

    def _observed(self, shape: Shape) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Samples of points and their signed distance from a new shape. Raises LumigraphError for points without
        normals."""
        generator = self.random(2)
        if not shape.is_cloud:
            numbers = replace(self.config.points, pool_points=OBSERVED_POINTS)
            found = sampled(shape, numbers, "deepsdf", generator)
            return found.points.to(self.device), found.signed.to(self.device)
        scan = shape.surface(OBSERVED_POINTS // 2, generator)
        if scan.normals is None:
            raise LumigraphError(
                f"{shape.name} has points without normals, so nothing says on which side of them it is solid; "
                "write the normals into its .ply as nx, ny, nz"
            )
        off = OFFSET * scan.normals
        points, ahead = torch.cat([scan.points + off, scan.points - off]), torch.full((len(off),), OFFSET)
        return points.to(self.device), torch.cat([ahead, -ahead]).to(self.device)

    def find(self, evidence: Any) -> Float[Tensor, " code"]:
        """The code that agrees best with a mesh, a cloud of points with normals, or a scan of some sides (eq. 10)."""
        shape: Shape = evidence
        c, width = self.config, self.config.code
        points, distance = self._observed(shape)
        generator = self.random(3)

        def error(unknown: Float[Tensor, " unknown"], count: int = c.points_per_shape) -> Tensor:
            code, place = unknown.split([width, 4])
            scale, shift = placed(place if shape.partial else 0 * place)
            some = torch.randint(len(points), (count,), generator=generator).to(self.device)
            moved = scale * points[some] + shift
            off = self._error(code.expand(count, -1), moved, scale * distance[some])
            return off / scale + FIT_WEIGHT * code.square().mean()  # in units of the scan, or it would shrink

        with torch.no_grad():
            start = self._start(shape, partial(error, count=256))
        unknown = fitted(start, error, c.code_steps, FIT_LEARNING_RATE)
        code, place = unknown.split([width, 4])
        scale, shift = placed(place if shape.partial else 0 * place)
        if shape.partial:
            whole = Similarity.make(float(scale), None, shift.cpu().double())
            back = (shape.frame.to_source @ whole.inverse).rows
            self.frame = replace(shape.frame, bounds=CUBE.bounds, source_from_scene=back)
        return code

    def _start(self, shape: Shape, error: Any) -> Float[Tensor, " unknown"]:
        """Initial code, learnt or average, and pose of a scan with the smallest error on a new shape."""
        known = self.codes.rows.detach()[self.codes.learnt]
        most = MAX_PLACED_CANDIDATES if shape.partial else MAX_CANDIDATES
        some = torch.randperm(len(known), generator=self.random(4))[:most]
        codes = torch.cat([self.codes.average[None], known[some.to(known.device)]])
        places = codes.new_zeros(1, 4)
        if shape.partial:
            grid = torch.cartesian_prod(*[torch.tensor(PLACES)] * 3, torch.tensor(SIZES))
            half = torch.from_numpy(shape.mesh.vertices).abs().amax(0).float()
            shift = grid[:, :3] * (HALF_SIDE - grid[:, 3:] * half).clamp_min(0)  # to the sides that the whole reaches
            places = (torch.cat([shift, grid[:, 3:].log()], -1) / PLACE_STEP).to(codes)
        tried = [torch.cat([code, place]) for place in places for code in codes]
        return tried[int(torch.stack([error(one) for one in tried]).argmin())]


def placed(place: Float[Tensor, " 4"]) -> tuple[Tensor, Tensor]:
    """Scale and shift from a scan to the whole shape, from the optimised parameters."""
    return (PLACE_STEP * place[3]).exp(), PLACE_STEP * place[:3]
