"""Motion of Gaussians by a small network over plane features of space and time (Wu 2024, section 4.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Annotated, Any, ClassVar

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.functional import normalize

from ...components.clouds.addition import Addition, Step, TrainingViews
from ...components.clouds.cloud import Cloud
from ...components.training.schedules import falling
from ...datasets.scene import Frame
from ...files.ranges import LearningRate, NonNegative, PositiveShare, Share, between
from ...gaussians import Gaussians
from ...geometry import multiply, to_matrix

PAIRS = tuple(combinations(range(4), 2))  # axes of the six planes; 3 is time
TIME = 3
FIRST_MOTION = 1e-4  # largest weight of the last layer at first
NEIGHBOURS = 6  # of a Gaussian or node, that move rigidly with it
CARRIERS = 4  # nodes that carry a Gaussian
PROBED_MOMENTS = 12  # at which one sees whether a Gaussian moves
MIN_DISTANCE = 1e-6  # between neighbours, scene units

Moments = Float[Tensor, " gaussian"] | float


STILL_OFFSET = 0.002  # offset up to which a Gaussian stands still, as a share of the diagonal
RIGID_SAMPLES = 1024  # Gaussians of a step whose neighbours are compared
MAX_OFFSET = 0.5  # largest offset of a Gaussian, as a share of the box's diagonal
PLANE_SMOOTHNESS = 1e-4  # weight of total variation of planes in space
TIME_SPARSITY = 1e-4  # weight of the planes' distance from no motion; higher: more stands still
TOLD_APART = 0.4  # share of the budget from which Gaussians that hardly move stand still; 1: never
PLANE_SCALES = 2  # planes of each pair of axes, each twice as fine in space
MOTION_WIDTH = 64  # channels of the network's hidden layer


@dataclass(frozen=True)
class MotionNumbers:
    """A Config's numbers of the motion; those of the authors' release (Wu 2024)."""

    plane_resolution: Annotated[int, between(4, 1024)] = 64  # cells of the coarsest planes along an axis of space
    plane_moments: Annotated[int, between(2, 1024)] = 25  # cells of the coarsest planes along time; more move faster
    plane_features: Annotated[int, between(1, 128)] = 32  # features of a cell; more hold more motion, and cost time
    nodes: Annotated[int, between(0, 65_536)] = 0  # places that move and carry Gaussians; 0: each moves by itself
    still_until: Share = 3000 / 23_000  # share of the budget in which nothing moves, 3000 steps; later: a better start
    all_moments_from: Share = 0.0  # share of the budget until which moments join, from the middle one on
    time_smoothness: NonNegative = 0.01  # weight of second differences of planes along time; higher: calmer motion
    rigidity: NonNegative = 0.0  # weight of distances to neighbours that change; 0: the release's unbounded motion
    planes_lr: LearningRate = 1.6e-3  # learning rate of the planes at first, times the extent of the cameras
    motion_lr: LearningRate = 1.6e-4  # learning rate of the network at first, likewise
    final_rate: PositiveShare = 0.01  # share of these rates at the end of the budget


class SpaceTimePlanes(nn.Module):
    """Features of points at times: the product of six planes (Fridovich-Keil 2023, eq. 1), scales concatenated. Planes
    of time are one at first, so that nothing depends on it."""

    def __init__(self, numbers: MotionNumbers):
        super().__init__()
        n = numbers
        self.width = n.plane_features * PLANE_SCALES
        self.planes = nn.ParameterList()
        for scale in range(PLANE_SCALES):
            cells = [n.plane_resolution << scale] * 3 + [n.plane_moments]
            for a, b in PAIRS:
                plane = torch.empty(1, n.plane_features, cells[b], cells[a])
                self.planes.append(nn.Parameter(plane.fill_(1.0) if b == TIME else plane.uniform_(0.1, 0.5)))

    def forward(self, places: Float[Tensor, "point 4"]) -> Float[Tensor, "point width"]:
        """places: x, y, z and time in [-1, 1]"""
        scales = []
        for first in range(0, len(self.planes), len(PAIRS)):
            features = torch.ones((), device=places.device)
            for plane, pair in zip(self.planes[first : first + len(PAIRS)], PAIRS, strict=True):
                at = places[None, None, :, list(pair)]
                features = features * F.grid_sample(plane, at, padding_mode="border", align_corners=True)[0, :, 0].T
            scales.append(features)
        return torch.cat(scales, 1)

    def terms(self) -> tuple[Tensor, Tensor, Tensor]:
        """Total variation in space, second differences along time, and distance from ones of planes of time."""
        pairs = PAIRS * (len(self.planes) // len(PAIRS))
        space, calm, moving = [], [], []
        for plane, (_, b) in zip(self.planes, pairs, strict=True):
            space.append(plane.diff(dim=3).square().mean())
            if b == TIME:
                calm.append(plane.diff(n=2, dim=2).square().mean())
                moving.append((plane - 1).abs().mean())
            else:
                space.append(plane.diff(dim=2).square().mean())
        return torch.stack(space).sum(), torch.stack(calm).sum(), torch.stack(moving).sum()


def spread(points: Float[Tensor, "point 3"], count: int) -> Int[Tensor, " chosen"]:
    """Indices of evenly spread points: one in each cell of a grid with at most `count` occupied cells."""
    low, size = points.amin(0), float((points.amax(0) - points.amin(0)).max().clamp_min(MIN_DISTANCE))
    best, cells = torch.zeros(1, dtype=torch.long), 1
    while True:
        key = ((points - low) / size * cells).floor().long()
        _, place = (key * torch.tensor([1, cells + 1, (cells + 1) ** 2])).sum(1).unique(return_inverse=True)
        if (found := int(place.max()) + 1) > count:
            return best
        first = torch.full((found,), len(points)).scatter_reduce(0, place, torch.arange(len(points)), "amin")
        if found == len(points) or cells > len(points):
            return first
        best, cells = first, cells + max(1, cells // 8)


def last_layer(outputs: int) -> nn.Linear:
    """Layer from the hidden one that begins close to zero."""
    last = nn.Linear(MOTION_WIDTH, outputs)
    nn.init.uniform_(last.weight, -FIRST_MOTION, FIRST_MOTION)
    nn.init.zeros_(last.bias)
    return last


def head() -> nn.Sequential:
    """Layers from the common features to one output of three numbers, `scene/deformation.py` of the release."""
    return nn.Sequential(nn.Linear(MOTION_WIDTH, MOTION_WIDTH), nn.ReLU(), last_layer(3))


class PlaneMotion(Addition):
    """Positions, rotations and sizes of Gaussians at a moment, as offsets from the canonical cloud (Wu 2024, eq. 7).

    moves:      which Gaussians move; the others cost nothing
    neighbours: of each Gaussian among those that move, for rigidity; without nodes
    nodes:      places of the nodes, of which the first `node_count` are in use
    links:      of each node to the nodes around it
    carriers:   nodes of each Gaussian, and `shares` of them in its motion
    active:     whether anything moves yet
    extent:     of the cameras, in scene units
    """

    grows: ClassVar[tuple[str, ...]] = ("moves", "neighbours", "carriers", "shares")
    box: Tensor
    moves: Tensor
    neighbours: Tensor
    nodes: Tensor
    links: Tensor
    node_count: Tensor
    carriers: Tensor
    shares: Tensor
    active: Tensor
    extent: Tensor

    def __init__(self, frame: Frame, numbers: MotionNumbers, count: int):
        super().__init__()
        low, high = torch.tensor(frame.bounds)
        self.numbers, self.times = numbers, frame.times
        self.register_buffer("box", torch.stack([low, high]), persistent=False)
        self.diagonal = float((high - low).norm())
        self.planes = SpaceTimePlanes(numbers)
        self.network = nn.Sequential(nn.Linear(self.planes.width, MOTION_WIDTH), nn.ReLU())
        # The release's: a head for each output. With rigidity, one layer for all, as in runs so far.
        self.heads: Any = last_layer(9) if numbers.rigidity else nn.ModuleList(head() for _ in range(3))
        self.register_buffer("moves", torch.ones(count, dtype=torch.bool))
        self.register_buffer("neighbours", torch.arange(count)[:, None].repeat(1, NEIGHBOURS))
        self.register_buffer("nodes", torch.zeros(numbers.nodes, 3))
        self.register_buffer("links", torch.zeros(numbers.nodes, NEIGHBOURS, dtype=torch.long))
        self.register_buffer("node_count", torch.tensor(0))
        self.register_buffer("carriers", torch.zeros(count, CARRIERS, dtype=torch.long))
        self.register_buffer("shares", torch.zeros(count, CARRIERS))
        self.register_buffer("active", torch.tensor(False))
        self.register_buffer("extent", torch.tensor(1.0))

    # The cloud at a moment

    def offsets(
        self, means: Float[Tensor, "gaussian 3"], time: Moments
    ) -> tuple[Float[Tensor, "gaussian 3"], Float[Tensor, "gaussian 4"], Float[Tensor, "gaussian 3"]]:
        """Offsets of positions, rotations as unit quaternions, and factors of sizes, logarithmic."""
        first, last = self.times or (0.0, 1.0)
        share = (torch.as_tensor(time, device=means.device) - first) / (last - first)
        space = 2 * (means - self.box[0]) / (self.box[1] - self.box[0]) - 1
        places = torch.cat([space, (2 * share - 1).expand(len(means))[:, None]], 1)
        hidden = self.network(self.planes(places))
        joint = bool(self.numbers.rigidity)
        position, turn, size = self.heads(hidden).split(3, 1) if joint else (each(hidden) for each in self.heads)
        turn = normalize(torch.cat([torch.ones_like(turn[:, :1]), turn], 1), dim=1)
        bound = MAX_OFFSET * self.diagonal
        return bound * torch.tanh(position / bound) if joint else position, turn, size

    def at(self, cloud: Gaussians, time: float) -> Gaussians:
        """The cloud at a moment; its static Gaussians are those of the canonical one."""
        if not self.active:
            return cloud
        rows = self.moves.nonzero()[:, 0]
        every = len(rows) == len(cloud)
        some = cloud if every else cloud[rows]
        if self.node_count:
            moved = self.carried(some, self.carriers[rows], self.shares[rows], time)
        else:
            offset, turn, size = self.offsets(some.means, time)
            moved = some.means + offset, multiply(turn, some.quaternions), some.log_scales + size
        if not every:
            still = cloud.means, cloud.quaternions, cloud.log_scales
            moved = tuple(x.index_copy(0, rows, y) for x, y in zip(still, moved, strict=True))  # type: ignore[assignment]
        return replace(cloud, means=moved[0], quaternions=moved[1], log_scales=moved[2])

    def carried(
        self,
        some: Gaussians,
        carriers: Int[Tensor, "gaussian carrier"],
        shares: Float[Tensor, "gaussian carrier"],
        time: float,
    ) -> tuple[Float[Tensor, "gaussian 3"], Float[Tensor, "gaussian 4"], Float[Tensor, "gaussian 3"]]:
        """Means, quaternions and log scales of Gaussians skinned to the nodes (Huang 2024, eqs. 5 and 6): m' = sum_k
        w_k (R_k (m - p_k) + p_k + x_k), q' = (sum_k w_k r_k) q."""
        nodes = self.nodes[: int(self.node_count)]
        offset, turn, size = self.offsets(nodes, time)
        rotation = to_matrix(turn)
        shift = nodes + offset - (rotation @ nodes[..., None])[..., 0]
        motions = torch.cat([rotation.flatten(1), shift, turn, size], 1)
        mixed = F.embedding_bag(carriers, motions, per_sample_weights=shares, mode="sum")
        rotation, shift, turn, size = mixed.split((9, 3, 4, 3), 1)
        means = (rotation.view(-1, 3, 3) @ some.means[..., None])[..., 0] + shift
        return means, multiply(normalize(turn, dim=1), some.quaternions), some.log_scales + size

    # Learning

    def begin_cloud(self, cloud: Cloud, views: TrainingViews, chance: torch.Generator) -> None:
        self.extent.copy_(cloud.extent)
        self.follow_cloud(cloud.means.detach())

    @torch.no_grad()
    def follow_cloud(self, means: Float[Tensor, "gaussian 3"], apart: bool = False) -> None:
        """Update the neighbours of moving Gaussians. apart: separate static from moving ones by their offsets; else
        all move"""
        count, device = len(means), means.device
        self.moves = torch.ones(count, dtype=torch.bool, device=device)
        if apart:
            first, last = self.times or (0.0, 1.0)
            moments = torch.linspace(first, last, PROBED_MOMENTS).tolist()
            farthest = torch.stack([self.offsets(means, t)[0].norm(dim=-1) for t in moments]).amax(0)
            self.moves = farthest > STILL_OFFSET * self.diagonal
        self.neighbours = torch.arange(count, device=device)[:, None].repeat(1, NEIGHBOURS)
        rows = self.moves.nonzero()[:, 0]
        self.carriers, self.shares = (x.new_zeros(count, CARRIERS) for x in (self.neighbours, means))
        if self.numbers.nodes:
            self.place_nodes(means, rows)
        if not self.node_count and len(rows) > NEIGHBOURS:
            points = means[rows].cpu().numpy()
            _, nearest = cKDTree(points).query(points, NEIGHBOURS + 1)
            self.neighbours[rows] = rows[torch.from_numpy(nearest[:, 1:]).to(device)]

    def place_nodes(self, means: Float[Tensor, "gaussian 3"], rows: Int[Tensor, " moving"]) -> None:
        """Sample nodes among moving Gaussians, and skin each Gaussian to its nearest nodes, with Gaussian weights of
        the width of their distance."""
        points = means[rows].cpu()
        chosen = spread(points, self.numbers.nodes) if len(points) else rows.cpu()
        count = len(chosen)
        self.node_count.fill_(count if count > max(NEIGHBOURS, CARRIERS) else 0)
        if not self.node_count:
            return
        self.nodes[:count] = points[chosen].to(means.device)
        tree = cKDTree(points[chosen].numpy())
        _, near = tree.query(points[chosen].numpy(), NEIGHBOURS + 1)
        self.links[:count] = torch.from_numpy(near[:, 1:]).to(means.device)
        away, near = tree.query(points.numpy(), CARRIERS)
        away, near = (torch.from_numpy(x).to(means.device) for x in (away, near))
        weight = torch.exp(-2 * (away / away[:, -1:].clamp_min(MIN_DISTANCE)).square()).float()
        self.carriers[rows], self.shares[rows] = near, weight / weight.sum(1, keepdim=True)

    def follow(self, source: Int[Tensor, " gaussian"]) -> None:
        """Follow the cloud. A removed neighbour is replaced by the Gaussian itself, whose loss is zero."""
        own = torch.arange(len(source), device=source.device)
        place = torch.full_like(self.moves, -1, dtype=torch.long).scatter_reduce(0, source, own, "amax")
        left = place[self.neighbours[source]]
        self.moves, self.neighbours = self.moves[source], torch.where(left < 0, own[:, None], left)
        self.carriers, self.shares = self.carriers[source], self.shares[source]

    def before_step(self, method: object, step: int, progress: float) -> None:
        self.active.fill_(progress >= self.numbers.still_until)

    def before_raster(self, step: Step) -> None:
        step.cloud = self.at(step.cloud, step.moment)

    def regularize(self, step: Step) -> None:
        """Smooth planes, and neighbours at fixed places in each other's frame (Luiten 2024, eq. 9)."""
        if not self.active:
            return
        n = self.numbers
        space, calm, moving = self.planes.terms()
        step.terms["planes"] = PLANE_SMOOTHNESS * space + n.time_smoothness * calm + TIME_SPARSITY * moving
        if n.rigidity:
            step.terms["rigidity"] = n.rigidity * self.bending(step.whole, step.moment, step.chance)

    def bending(self, cloud: Gaussians, time: float, chance: torch.Generator) -> Float[Tensor, ""]:
        """Mean squared change of neighbours' offsets in the frames of moving Gaussians, relative to their distance; of
        a random subset, or of all nodes."""
        if self.node_count:
            places, links = (x[: int(self.node_count)] for x in (self.nodes, self.links))
            drawn = torch.arange(len(places), device=places.device)
        else:
            rows, places = self.moves.nonzero()[:, 0], cloud.means.detach()
            if not len(rows):
                return cloud.means.sum() * 0
            drawn = rows[torch.randint(len(rows), (RIGID_SAMPLES,), generator=chance).to(rows.device)]
            links = self.neighbours[drawn]
        both = torch.cat([drawn[:, None], links], 1)
        used, both = both.unique(return_inverse=True)
        offset, turn, _ = self.offsets(places[used], time)
        before, after = (x[both] for x in (places[used], places[used] + offset))
        frame = to_matrix(turn[both[:, 0]])
        apart = before[:, 1:] - before[:, :1]
        change = after[:, 1:] - after[:, :1] - apart @ frame.mT
        near = apart.square().sum(-1).clamp_min(MIN_DISTANCE**2)
        return (change.square().sum(-1) / near).mean()

    def finish(self, step: Step) -> None:
        if step.due:
            apart = bool(self.active and self.numbers.rigidity) and step.progress >= TOLD_APART
            self.follow_cloud(step.learnt.means.detach(), apart)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        n = self.numbers
        network = [*self.network.parameters(), *self.heads.parameters()]
        groups = [
            {"name": "planes", "params": list(self.planes.parameters()), "lr": n.planes_lr},
            {"name": "motion", "params": network, "lr": n.motion_lr},
        ]
        return [torch.optim.Adam(groups, eps=1e-15)]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        n = self.numbers
        return {
            name: float(self.extent) * falling(rate, n.final_rate * rate, progress)
            for name, rate in (("planes", n.planes_lr), ("motion", n.motion_lr))
        }
