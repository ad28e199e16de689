"""Instances: an identity code of each Gaussian, learnt from masks by the same rasteriser (Ye 2024, Gaussian Grouping,
arXiv 2312.00732), by which instances are removed, moved, copied or shown alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, log_softmax

from ...components.clouds.addition import Addition, Step, TrainingViews
from ...components.clouds.cloud import Cloud
from ...components.instances import ALONE, LABELS, check_labels, edit_controls, edit_of, labels_of, layers_of
from ...components.training.row_optimizers import exchange
from ...datasets.scene import Photograph, Scene
from ...exchange.packing import Stored
from ...files.ranges import LearningRate, Share, Steps, between
from ...gaussians import Gaussians, joined
from ...gaussians.splatting import Splatted, splat, view_of
from ...method.controls import Configured, Control

CHANNELS = 4  # numbers that one pass of the rasteriser composites: three colours and a depth
FIRST_DEVIATION = 0.1  # of the numbers of codes at first
MIN_SHARE = 0.4  # probability from which on a Gaussian belongs to the instance that it most likely shows
IDENTITY_WEIGHT = 1.0  # weight of the cross entropy of rendered identities, eq. 4
NEIGHBOUR_WEIGHT = 2.0  # weight of the neighbours' agreement, eq. 4
NEIGHBOURS = 5  # k, nearest Gaussians that should agree, section 3.2
NEIGHBOUR_SAMPLES = 1000  # m, Gaussians of a step that are compared with them


@dataclass(frozen=True)
class InstanceNumbers:
    """A Config's numbers of instances; those of Gaussian Grouping."""

    objects: Literal["no", "yes"] = "no"  # learn identity codes from label pictures, to edit by instance
    instances: Annotated[int, between(2, 256)] = 64  # instances that there is room for, labels 0 to one below
    identity_code: Annotated[int, between(4, 64)] = 16  # numbers of an identity code, section 3.2; a multiple of 4
    identity_lr: LearningRate = 2.5e-3  # learning rate of identity codes; the authors' release
    classifier_lr: LearningRate = 5e-4  # learning rate of the classifier; the authors' release
    identity_interval: Steps = 1  # steps between those that learn identities; more are faster
    identity_start: Share = 0.0  # share of the budget before identities are learnt; later: geometry is known


class Identities(Addition):
    """Identity codes and a linear classifier. They change neither positions nor colours.

    codes:  of each Gaussian
    places: positions of the Gaussians when codes were last learnt
    seen:   labels in the photographs
    """

    grows: ClassVar[tuple[str, ...]] = ("codes", "places")
    codes: nn.Parameter
    places: Tensor
    seen: Tensor

    def __init__(self, numbers: InstanceNumbers, count: int):
        super().__init__()
        self.numbers, n = numbers, numbers
        self.codes = nn.Parameter(torch.zeros(count, n.identity_code))
        self.classifier = nn.Linear(n.identity_code, n.instances + 1)  # and one class for no instance
        self.register_buffer("places", torch.zeros(count, 3))
        self.register_buffer("seen", torch.zeros(n.instances, dtype=torch.bool))
        self.optimizer: torch.optim.Adam | None = None
        self.data: Scene | None = None  # of the last step

    def layers(self, data: Scene) -> tuple[str, ...]:
        self.data = data
        return layers_of(data)

    # Following the cloud

    def begin_scene(self, cloud: Cloud, views: TrainingViews, data: Scene, sweep: Any) -> None:
        check_labels(data)

    def begin_cloud(self, cloud: Cloud, views: TrainingViews, chance: torch.Generator) -> None:
        """Random codes for a new cloud."""
        drawn = FIRST_DEVIATION * torch.randn(len(cloud), self.numbers.identity_code, generator=chance)
        self._set(drawn.to(self.places.device), cloud.means.detach().clone())

    def follow(self, source: Int[Tensor, " gaussian"]) -> None:
        self._set(self.codes.data[source], self.places[source])

    def _set(self, codes: Tensor, places: Tensor) -> None:
        """Replace the codes, with fresh optimizer moments, for a cloud changes every hundred steps."""
        self.places = places
        exchange(self, "codes", codes, self.optimizer)

    def optimizers(self) -> list[torch.optim.Optimizer]:
        n = self.numbers
        groups = [{"params": [self.codes], "lr": n.identity_lr}]
        groups.append({"params": [*self.classifier.parameters()], "lr": n.classifier_lr})
        self.optimizer = torch.optim.Adam(groups, eps=1e-15)
        return [self.optimizer]

    def storage(self) -> dict[str, Stored]:
        return {"codes": Stored("half"), "places": Stored("nothing")}

    # Learning

    def before_raster(self, step: Step) -> None:
        means = step.learnt.means.detach()
        if len(means) != len(self.places):  # in a run that was saved when codes followed the cloud only while learnt
            nearest = cKDTree(self.places.cpu().numpy()).query(means.cpu().numpy(), workers=-1)[1]
            self.follow(torch.from_numpy(nearest).to(means.device))

    def regularize(self, step: Step) -> None:
        """Cross entropy of rendered identities, and the neighbours' agreement (eqs. 3 and 4)."""
        n = self.numbers
        if step.progress < n.identity_start or step.drawn % n.identity_interval:
            return
        self.places = step.learnt.means.detach().clone()
        photograph, picture = step.photograph, step.picture
        labels, known = labels_of(photograph.extra, photograph.alpha, n.instances)
        if not known.any() and (other := self.labelled(step)) is not None:
            with torch.no_grad():
                picture = splat(step.whole, view_of(step.views.refined(other.camera), step.views.near_plane), bands=1)
            labels, known = labels_of(other.extra, other.alpha, n.instances)
        self.seen[labels[labels >= 0].unique()] = True
        logits = self.classifier(self.rendered(picture))
        target = torch.where(labels >= 0, labels, n.instances)
        if known.any():
            step.terms["identity"] = IDENTITY_WEIGHT * cross_entropy(logits[known], target[known])
        if len(self.codes) > NEIGHBOURS:
            step.terms["neighbours"] = NEIGHBOUR_WEIGHT * self.disagreement(step.chance)

    def labelled(self, step: Step) -> Photograph | None:
        """A random labelled photograph, for a step on one that has no labels; None without any."""
        if self.data is None or LABELS not in self.data.layers:
            return None
        planes = self.data.layers[LABELS].planes
        some = [i for i in self.data.splits["train"].tolist() if planes[i] is not None]
        if not some:
            return None
        found = self.data.photograph(some[int(torch.randint(len(some), (), generator=step.chance))], (LABELS,))
        return found.reduced(max(1, found.rgb.shape[0] // step.rgb.shape[0])).to(step.rgb.device)

    def rendered(self, picture: Splatted) -> Float[Tensor, "height width code"]:
        """Codes, composited as colours are; gradients reach the codes alone."""
        footprints = picture.centres.detach(), picture.conics.detach(), picture.opacities.detach()
        fixed = replace(picture, centres=footprints[0], conics=footprints[1], opacities=footprints[2])
        found = []
        for four in self.codes.split(CHANNELS, -1):
            rgb, last, _ = fixed.composited(four[:, :3].contiguous(), four[:, 3].contiguous(), 1e-4)
            found.append(torch.cat([rgb, last[..., None]], -1))
        return torch.cat(found, -1)

    def disagreement(self, chance: torch.Generator) -> Float[Tensor, ""]:
        """Mean KL divergence of some Gaussians' identities from those of their nearest neighbours (eq. 3), in a random
        part of the cloud that bounds the memory."""
        pool = torch.randperm(len(self.codes), generator=chance)[: 20 * NEIGHBOUR_SAMPLES]
        places = self.places.cpu()[pool].numpy()
        some = pool[:NEIGHBOUR_SAMPLES]
        count = min(NEIGHBOURS + 1, len(pool))
        _, near = cKDTree(places).query(places[: len(some)], count, workers=-1)
        near = pool[torch.from_numpy(np.asarray(near).reshape(len(some), -1)[:, 1:])]
        own = log_softmax(self.classifier(self.codes[some]), -1)
        others = log_softmax(self.classifier(self.codes[near]), -1)
        return (own.exp()[:, None] * (own[:, None] - others)).sum(-1).mean()

    # Editing

    @torch.no_grad()
    def labels(self, cloud: Gaussians) -> Int[Tensor, " gaussian"]:
        """The instance of each Gaussian; -1 for none."""
        probability, label = self.classifier(self.codes).softmax(-1).max(-1)
        return torch.where((probability >= MIN_SHARE) & (label < self.numbers.instances), label, -1)

    @property
    def controls(self) -> tuple[Control, ...]:
        return edit_controls(self.seen, 1.0)

    def recoloured_cloud(self, method: Configured, cloud: Gaussians) -> Gaussians:
        """The cloud under the edit of the settings."""
        edit = edit_of(method)
        if edit is None:
            return cloud
        own = self.labels(cloud) == edit.number
        if edit.kind == ALONE or not own.any():
            return cloud[own] if own.any() or edit.kind == ALONE else cloud
        parts = [cloud[~own]] if edit.leaves else [cloud]
        if edit.appears:
            place = edit.place(cloud.means[own].median(0).values)
            parts.append(cloud[own].transformed(place.matrix))
        return joined(parts)
