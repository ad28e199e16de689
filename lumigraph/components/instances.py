"""Instances: labelled objects of a scene, and the controls that remove, move or copy one of them."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..datasets.images import LayerSource
from ..datasets.scene import Scene
from ..errors import LumigraphError, LumigraphWarning
from ..geometry import Similarity
from ..method.controls import Configured, Control

LABELS = "labels"
BESIDE = "beside"  # layer of `with_beside`
BESIDE_REACH = 0.2  # share of a photograph's longer side, within which another label is beside a pixel
MIN_LABEL_VIEWS = 4  # photographs that should show an instance
MOVE, COPY, REMOVE, ALONE = EDITS = "move", "copy", "remove", "alone"
AXES = "x", "y", "z"
CONTROLS = {"edit", "turn", *(f"shift_{axis}" for axis in AXES)}
SHIFT, TURN = (f"{change} of what is moved or copied" for change in ("Shift", "Rotation"))
NOT_AN_INSTANCE = -1  # label of pixels that show no object, or an unknown one
OPAQUE_ALPHA = 0.5


@dataclass(frozen=True)
class Edit:
    """An edit of one instance.

    number: label of the instance
    kind:   one of EDITS
    shift:  scene units
    turn:   degrees about the vertical through its middle, counterclockwise from above
    """

    number: int
    kind: str
    shift: tuple[float, float, float]
    turn: float

    @property
    def leaves(self) -> bool:
        """True if the instance is removed from its original place."""
        return self.kind in (REMOVE, MOVE)

    @property
    def appears(self) -> bool:
        """True if the instance is shown at another place."""
        return self.kind in (MOVE, COPY)

    def place(self, middle: Float[Tensor, " 3"]) -> Similarity:
        """Similarity from its original place to the other one. middle: centre of its rotation"""
        angle, middle = math.radians(self.turn), middle.double().cpu()
        cosine, sine = math.cos(angle), math.sin(angle)
        rotation = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        return Similarity.make(1.0, rotation, middle - rotation @ middle + torch.tensor(self.shift).double())


def edit_controls(learnt: Bool[Tensor, " label"], reach: float) -> tuple[Control, ...]:
    """Controls of edits; none before instances are trained."""
    names = tuple(str(x) for x in learnt.nonzero()[:, 0].tolist())
    if not names:
        return ()
    far, choices = 2 * reach, tuple(f"{kind} {name}" for kind in EDITS for name in names)
    about = "Move, copy or remove an instance by its label, or show it alone; to move and copy, shift or turn it."
    return (
        Control("edit", choices[0], choices=choices, about=about),
        *(Control(f"shift_{x}", 0.0, range=(-far, far), unit="scene units", about=f"{SHIFT} along {x}.") for x in AXES),
        Control("turn", 0.0, range=(-180.0, 180.0), unit="degrees", about=f"{TURN} about the vertical."),
    )


def edit_of(method: Configured) -> Edit | None:
    """The edit of a method's settings; None for the scene as it is."""
    if not method.settings.keys() & CONTROLS:
        return None
    kind, label = str(method.control("edit")).split()
    x, y, z = (float(method.control(f"shift_{axis}")) for axis in AXES)
    edit = Edit(int(label), kind, (x, y, z), float(method.control("turn")))
    return None if edit.appears and not (x or y or z or edit.turn) else edit


def check_labels(scene: Scene) -> None:
    """Raise LumigraphError for photographs without labels and without alpha."""
    if LABELS not in scene.layers and not scene.images.has_alpha:
        raise LumigraphError(
            f"{scene.source} has no labels of objects; put a picture of whole numbers for each photograph, of its "
            "name, into a folder `labels` beside them (`lumigraph segment --action masks` makes one)"
        )
    if LABELS in scene.layers and not len(scene.layers[LABELS]):
        raise LumigraphError(f"No label picture of {scene.source} matches a photograph; name each after its photograph")
    if LABELS in scene.layers:
        warn_of_few_views(scene)


def warn_of_few_views(scene: Scene) -> None:
    """Warn of labels that hardly any training photograph shows."""
    layer, train = scene.layers[LABELS], scene.splits["train"].tolist()
    every = (layer.stored(i) for i in train if layer.planes[i])
    views = Counter[int](label for stored in every for label in np.unique(stored[layer.known(stored)]).tolist())
    few = [label for label, count in sorted(views.items()) if count < MIN_LABEL_VIEWS]
    if few:
        warnings.warn(
            f"Of {len(train)} photographs hardly any shows the objects of labels {', '.join(map(str, few))}; an object "
            f"that fewer than {MIN_LABEL_VIEWS} show is not told from what is around it, so label more photographs",
            LumigraphWarning,
            stacklevel=3,
        )


def with_beside(scene: Scene) -> Scene:
    """The scene with a layer of the label at a random place near each pixel. A pixel beside a mask thus meets that mask
    as often as the mask's pixels meet it: the closer and the larger, the more often. Labelled photographs are repeated
    in the training split, where they are few, to make up about half of it. Without labels, the scene."""
    if LABELS not in scene.layers:
        return scene
    layer = scene.layers[LABELS]

    def beside(image: int) -> np.ndarray:
        stored, chance = layer.stored(image), np.random.default_rng(image)
        shape: tuple[int, int] = stored.shape[:2]
        angle, away = chance.uniform(0, 2 * np.pi, shape), BESIDE_REACH * max(shape) * chance.random(shape) ** 2
        moved = np.indices(shape) + np.rint(away * np.stack([np.sin(angle), np.cos(angle)])).astype(int)
        row, column = np.clip(moved, 0, np.array(shape)[:, None, None] - 1)
        return stored[row, column]

    planes = [plane and LayerSource(partial(beside, image)) for image, plane in enumerate(layer.planes)]
    train = scene.splits["train"]
    labelled = train[[layer.planes[i] is not None for i in train.tolist()]]
    repeated = labelled.repeat(max(len(train) // max(len(labelled), 1) - 1, 0))
    splits = scene.splits | {"train": torch.cat([train, repeated])}
    return replace(scene, splits=splits, layers=scene.layers | {BESIDE: layer.like(scene.images, planes)})


def labels_of(
    extra: dict[str, Tensor], alpha: Tensor | None, room: int
) -> tuple[Int[Tensor, "*pixels"], Bool[Tensor, "*pixels"]]:
    """Label of each pixel, NOT_AN_INSTANCE for none; and a mask of known ones. Without labels the opaque pixels of
    photographs with alpha are instance 0. Raises LumigraphError for labels beyond `room`."""
    if LABELS not in extra:
        assert alpha is not None
        opaque = alpha > OPAQUE_ALPHA
        return torch.where(opaque, 0, NOT_AN_INSTANCE), torch.ones_like(opaque)
    labels = extra[LABELS]
    if bool((labels >= room).any()):
        raise LumigraphError(
            f"The labels go up to {int(labels.max())}, and there is room for {room} instances; give --instances "
            f"{int(labels.max()) + 1}, or number them from 0"
        )
    known = labels >= 0
    return labels, known if alpha is None else known | (alpha <= OPAQUE_ALPHA)


def layers_of(scene: Scene) -> tuple[str, ...]:
    """Names of the layers with instance labels."""
    return (LABELS,) if LABELS in scene.layers else ()
