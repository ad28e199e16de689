"""Initial view of a scene, in the viewer and on pages, and its centre of rotation."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from .automatic import Surroundings

OUTWARD_FOCUS_DISTANCE = (
    0.02  # scene units: of what a camera turns about that looks outward, so that it turns on the spot
)
MIN_FOCUS_SHARE = 0.1  # of the typical distance to the focus: nothing is turned about that is nearer


def pivot(around: Surroundings, position: Float[Tensor, " 3"], forward: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The point that a camera turns about, on its optical axis and in the scene's frame.

    Among photographs that look inward it is the point of the axis nearest to their focus, c + max(d . (f - c), m) d,
    where m keeps a camera that looks elsewhere from turning about a point in its own lens. Among those that look
    outward it lies OUTWARD_FOCUS_DISTANCE of the camera.

    forward: unit length
    """
    if not around.inward:
        return position + OUTWARD_FOCUS_DISTANCE * forward
    least = MIN_FOCUS_SHARE * float(around.polar[:, 2].median().exp())
    return position + max(float((around.focus - position) @ forward), least) * forward


def best_centred(around: Surroundings) -> int:
    """Number of the photograph whose optical axis passes the focus at the smallest angle; the one in the middle of all,
    where they look outward."""
    if not around.inward:
        return around.middle
    return int(around.cosine.argmax())
