"""Generated objects compared with photographs: FID and KID, and cameras of both."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..camera import Camera
from ..components.fields.kept_photographs import chance, photographed, square
from ..datasets.collection import Collection
from ..method import Method
from ..method.capabilities import CanDraw, DrawsPictures, can, needs
from ..metrics import Score
from ..metrics.distribution import FeatureNetwork, distances
from ..system.progress import track
from ..system.work import at_work

Pictures = Float[Tensor, "picture height width 3"]
MAX_SIDE = 299  # pixels across, above which no network looks


def photographs_of(data: Collection, count: int, seed: int, split: str = "train") -> tuple[Pictures, Camera]:
    """Random training photographs of a split's members, as squares of one size, and their cameras."""
    generator, pictures, cameras = torch.Generator().manual_seed(seed), list[Tensor](), list[Camera]()
    side = 0
    for _ in track(range(count), "Reading photographs", count):
        scene = photographed(data.sample_member(generator, split)[1], "FID")
        there = scene.splits["train"]
        photograph = scene.photograph(int(there[chance(len(there), generator)]))
        side = side or min(MAX_SIDE, *photograph.rgb.shape[:2])
        picture, camera = square(photograph, scene.frame, side)
        pictures.append(picture.permute(1, 2, 0))
        cameras.append(camera)
    return torch.stack(pictures), Camera.cat(cameras)


@at_work()
def drawn_pictures(method: Method, cameras: Camera, seed: int) -> Pictures:
    """A picture of a different generated object for each camera; all cameras have one size."""
    method.eval()
    if can(method, DrawsPictures):
        return needs(method, DrawsPictures).pictures(cameras, torch.Generator().manual_seed(seed)).clamp(0, 1)
    drawing: Any = needs(method, CanDraw)
    numbers = track(range(len(cameras)), "Drawing", len(cameras))
    return torch.stack([drawing.draw_object(seed + i).render(cameras[i]).rgb.cpu().clamp(0, 1) for i in numbers])


def drawing_scores(
    method: Method, data: Collection, count: int, networks: Sequence[FeatureNetwork], seed: int = 0
) -> tuple[list[Score], dict[str, Any]]:
    """FID and KID of generated pictures against as many training photographs, by each network; and the protocol.
    Generated pictures have the photographs' cameras."""
    needs(method, CanDraw)
    real, cameras = photographs_of(data, count, seed)
    made = drawn_pictures(method, cameras, seed)
    scores = [score for network in networks for score in distances(real, made, network)]
    protocol = {
        "photographs": f"{count} random ones of the training split of {data.source}, seed {seed}",
        "drawn": f"{count} random objects from their cameras, controls {dict(method.settings)}",
        "networks": [network.definition for network in networks],
    }
    return scores, protocol
