"""Nodes of a scene graph: poses of boxes over time, their learnt corrections, and where rays cross the boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ...camera.rays import Rays, Samples
from ...components.training.schedules import falling
from ...datasets.tracks import MAX_TIME_ERROR, BoxTrack, GraphNode
from ...geometry import to_matrix
from ...method import Part
from ...volume import packed

FALL = 0.1  # of the corrections' learning rate, that is left of it at the end of the budget
TRACK_LEARNING_RATE = 1e-3  # of the corrections of tracks, in radians and shares of a box's length
TRACK_PRIOR = 0.01  # weight of corrections squared
TRACK_SMOOTHNESS = 1.0  # weight of changes of a correction from a moment to the next, squared


@dataclass(frozen=True)
class NodeNumbers:
    """A Config's numbers of the nodes' corrections."""

    refine_tracks: bool = False  # learn a small turn and shift of each box at each moment, beside the given ones


@dataclass(frozen=True)
class Poses:
    """Poses of all nodes at moments.

    rotation, position: from a box's axes to the scene's
    present:            whether a node is there
    """

    rotation: Float[Tensor, "node moment 3 3"]
    position: Float[Tensor, "node moment 3"]
    present: Bool[Tensor, "node moment"]


class PoseTable:
    """Given poses of nodes at their moments, and a pose between two of them.

    own: row of the corrections that hold for each node; -1 for none
    """

    def __init__(self, nodes: Sequence[GraphNode], tracks: Sequence[BoxTrack], device: torch.device | str = "cpu"):
        rows = {track.name: i for i, track in enumerate(tracks)}
        keys = max([1, *(len(node.track.times) for node in nodes)])
        count = len(nodes)
        self.own = torch.tensor([rows.get(node.own, -1) for node in nodes], dtype=torch.long)
        self.counts = torch.tensor([len(node.track.times) for node in nodes], dtype=torch.long)
        self.times = torch.full((count, keys), torch.inf)
        self.positions, self.quaternions = torch.zeros(count, keys, 3), torch.zeros(count, keys, 4)
        self.size = torch.tensor([node.track.size for node in nodes]).view(count, 3)
        for i, node in enumerate(nodes):
            n = len(node.track.times)
            self.times[i, :n] = torch.tensor(node.track.times)
            self.positions[i, :n] = torch.tensor(node.track.positions)
            quaternions = nn.functional.normalize(torch.tensor(node.track.rotations, dtype=torch.float64), dim=-1)
            turns_back = (quaternions[1:] * quaternions[:-1]).sum(-1) < 0  # of q and -q, the one nearer to the last
            signs = torch.where(turns_back, -1.0, 1.0).cumprod(0)
            quaternions[1:] *= signs[:, None]
            self.quaternions[i, :n] = quaternions.float()
        for name, value in vars(self).items():
            setattr(self, name, value.to(device))

    def at(self, times: Float[Tensor, " moment"], twist: Float[Tensor, "track key 6"] | None = None) -> Poses:
        """Poses at times. twist: corrections, a rotation about the scene's axes in radians and a translation in lengths
        of the box, at the given times"""
        nodes, last = len(self.size), self.counts[:, None] - 1
        t = times.expand(nodes, -1).contiguous()
        upper = torch.minimum(torch.searchsorted(self.times, t, right=True).clamp_min(1), last.clamp_min(0))
        lower = (upper - 1).clamp_min(0)
        begin, end = self.times.gather(1, lower), self.times.gather(1, upper)
        share = ((t - begin) / (end - begin).clamp_min(1e-9)).clamp(0, 1)[..., None]

        def between(keys: Float[Tensor, "node key n"]) -> Float[Tensor, "node moment n"]:
            first, last = (keys.gather(1, i[..., None].expand(-1, -1, keys.shape[-1])) for i in (lower, upper))
            return torch.lerp(first, last, share)

        position = between(self.positions)
        rotation = to_matrix(between(self.quaternions).flatten(0, 1)).view(nodes, len(times), 3, 3)
        if twist is not None:
            own = twist[self.own.clamp_min(0)] * (self.own >= 0)[:, None, None]
            pad = self.times.shape[1] - own.shape[1]
            turn, shift = between(nn.functional.pad(own, (0, 0, 0, max(pad, 0)))[:, : self.times.shape[1]]).split(3, -1)
            rotation = exponential(turn) @ rotation
            position = position + shift * self.size[:, None, :1]
        slack = MAX_TIME_ERROR * t.abs().clamp_min(1)
        first, latest = self.times[:, :1], self.times.gather(1, last)
        present = ((t >= first - slack) & (t <= latest + slack)) | (last == 0)
        return Poses(rotation, position, present)


def exponential(omega: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Rotation by an angle and about an axis (Rodrigues); differentiable at zero as well."""
    eye = torch.eye(3, device=omega.device)
    cross = torch.linalg.cross(omega[..., None, :].expand(*omega.shape, 3), eye.expand(*omega.shape, 3)).mT
    angle = omega.square().sum(-1).clamp_min(1e-12).sqrt()[..., None, None]
    return eye + angle.sin() / angle * cross + (1 - angle.cos()) / angle.square() * (cross @ cross)


class TrackCorrections(Part):
    """Corrections of the given poses, 0 at first: a turn about the scene's axes and a shift in lengths of the box."""

    def __init__(self, tracks: Sequence[BoxTrack], numbers: NodeNumbers):
        super().__init__()
        self.numbers = numbers
        keys = max([1, *(len(track.times) for track in tracks)])
        self.twist = nn.Parameter(torch.zeros(len(tracks), keys, 6)) if numbers.refine_tracks else None

    def terms(self) -> dict[str, Tensor]:
        """The prior to the given poses, and the smoothness of corrections."""
        if self.twist is None:
            return {}
        change = self.twist.diff(dim=1)
        prior = TRACK_PRIOR * self.twist.square().mean()
        return {"tracks": prior + TRACK_SMOOTHNESS * change.square().sum() / self.twist.numel()}

    def optimizers(self) -> list[torch.optim.Optimizer]:
        if self.twist is None:
            return []
        group = {"params": [self.twist], "name": "tracks"}
        return [torch.optim.Adam([group], TRACK_LEARNING_RATE)]

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        if self.twist is None:
            return {}
        return {"tracks": falling(1.0, FALL, progress) * TRACK_LEARNING_RATE}


@dataclass(frozen=True)
class BoxStretches:
    """Stretches of rays inside boxes, by ray and then by distance.

    ray, node:           of each stretch
    enter, leave:        distances along the ray, scene units
    origins, directions: of the ray in the box's axes, scene units
    pose:                numbers of the box's pose, that colour depends on
    """

    ray: Int[Tensor, " stretch"]
    node: Int[Tensor, " stretch"]
    enter: Float[Tensor, " stretch"]
    leave: Float[Tensor, " stretch"]
    origins: Float[Tensor, "stretch 3"]
    directions: Float[Tensor, "stretch 3"]
    heading: Float[Tensor, "stretch 3"]
    location: Float[Tensor, "stretch 3"]

    def __len__(self) -> int:
        return len(self.ray)

    def __getitem__(self, index: Tensor) -> BoxStretches:
        """The stretches that a mask or an index picks."""
        return BoxStretches(*(value[index] for value in vars(self).values()))

    @property
    def rank(self) -> Int[Tensor, " stretch"]:
        """Place of each stretch among those of its ray, 0 for the first."""
        number = torch.arange(len(self.ray), device=self.ray.device)
        first = torch.searchsorted(self.ray, self.ray)
        return number - first

    def at(self, shares: Float[Tensor, "#stretch sample"]) -> Float[Tensor, "stretch sample"]:
        """Distances at shares of each stretch."""
        return torch.lerp(self.enter[:, None], self.leave[:, None], shares)

    def samples(self, rays: int, count: int) -> Samples:
        """Even samples of stretches on different rays. rays: number of all rays; count: of each stretch"""
        edges = self.at(torch.linspace(0, 1, count + 1, device=self.enter.device)[None])
        counts = torch.zeros(rays, dtype=torch.long, device=self.ray.device)
        counts[self.ray] = count
        return Samples(edges[:, :-1].flatten(), edges[:, 1:].flatten(), packed(counts))


def crossings(
    rays: Rays,
    times: Float[Tensor, " ray"],
    table: PoseTable,
    twist: Float[Tensor, "track key 6"] | None,
    scale: float,
    near: float,
) -> BoxStretches:
    """Stretches of rays in the boxes of their moments (section 4.2; the slab test of Kay and Kajiya 1986).

    scale: factor on the boxes' sizes
    near:  distance at which rays begin
    """
    moments, moment = times.unique(return_inverse=True)
    poses = table.at(moments, twist)
    with torch.no_grad():
        rotation, position = poses.rotation[:, moment], poses.position[:, moment]
        half = 0.5 * scale * table.size[:, None]
        origins = torch.einsum("nrij,nri->nrj", rotation, rays.origins - position) / half
        directions = torch.einsum("nrij,ri->nrj", rotation, rays.directions) / half
        inverse = 1 / torch.where(directions.abs() < 1e-9, 1e-9, directions)
        a, b = (-1 - origins) * inverse, (1 - origins) * inverse
        enter, leave = torch.minimum(a, b).amax(-1).clamp_min(near), torch.maximum(a, b).amin(-1)
        ray, node = ((leave > enter) & poses.present[:, moment]).T.nonzero().unbind(-1)
        begin, end = enter[node, ray], leave[node, ray]
        order = begin.argsort(stable=True)
        order = order[ray[order].argsort(stable=True)]
        ray, node, begin, end = ray[order], node[order], begin[order], end[order]
    rotation, position = poses.rotation[node, moment[ray]], poses.position[node, moment[ray]]
    local = torch.einsum("sij,si->sj", rotation, rays.origins[ray] - position)
    direction = torch.einsum("sij,si->sj", rotation, rays.directions[ray])
    return BoxStretches(ray, node, begin, end, local, direction, rotation[:, :, 0], position)


def inside(points: Float[Tensor, "point 3"], poses: Poses, size: Float[Tensor, "node 3"], scale: float) -> Any:
    """Points inside boxes at one moment: numbers of point and node, and coordinates in the box, in [-1, 1]."""
    local = torch.einsum("nij,npi->npj", poses.rotation[:, 0], points - poses.position[:, :1])
    local = local / (0.5 * scale * size[:, None])
    node, point = ((local.abs() <= 1).all(-1) & poses.present).nonzero().unbind(-1)
    return point, node, local[node, point]
