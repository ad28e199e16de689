"""Messages accepted from a browser: those of our page, with their types and ranges.

viser sets every attribute that a message names and prints a traceback for unusable values, so others must not reach it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec

MAX_MESSAGE_BYTES = 1 << 20  # bytes of a message; our page sends less than a thousandth
MAX_COORDINATE = 1e9  # scene units
MAX_TEXT_LENGTH = 10_000  # letters of a text
RANGE_TOLERANCE = 1e-6  # beyond a range: what a browser rounds

Number = Annotated[float, msgspec.Meta(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Triple = tuple[Number, Number, Number]
Unit = Annotated[float, msgspec.Meta(ge=-1.001, le=1.001)]
Quaternion = tuple[Unit, Unit, Unit, Unit]
Pixels = Annotated[int, msgspec.Meta(ge=0, le=16_384)]
Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT_LENGTH)]


class Said(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """A message; the name of each kind below is viser's."""


class ViewerCameraMessage(Said, tag=True):
    wxyz: Quaternion
    position: Triple
    fov: Annotated[float, msgspec.Meta(gt=0, lt=math.pi)]
    near: Number
    far: Number
    image_height: Pixels
    image_width: Pixels
    look_at: Triple
    up_direction: Triple


class GuiUpdateMessage(Said, tag=True):
    uuid: Text
    updates: dict[Literal["value"], Any]


class SceneNodeClickMessage(Said, tag=True):
    name: Text
    instance_index: Annotated[int, msgspec.Meta(ge=0, le=1 << 31)] | None
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: tuple[Number, Number]
    modifier: Text | None
    owner: Text = ""


class TransformControlsUpdateMessage(Said, tag=True):
    name: Text
    wxyz: Quaternion
    position: Triple
    owner: Text = ""


class TransformControlsDragStartMessage(Said, tag=True):
    name: Text
    owner: Text = ""


class TransformControlsDragEndMessage(Said, tag=True):
    name: Text
    owner: Text = ""


DECODER = msgspec.msgpack.Decoder(
    ViewerCameraMessage
    | GuiUpdateMessage
    | SceneNodeClickMessage
    | TransformControlsUpdateMessage
    | TransformControlsDragStartMessage
    | TransformControlsDragEndMessage
)


def understood(frame: bytes | str, handle: Callable[[str], Any]) -> bytes | None:
    """A message as viser may have it; None for what our page does not say.

    handle: viser's handle of a part of a panel by its number, None where there is none
    """
    if not isinstance(frame, bytes):
        return None
    try:
        said = DECODER.decode(frame)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
    if not is_finite(msgspec.structs.astuple(said)):
        return None
    if isinstance(said, GuiUpdateMessage):
        part = handle(said.uuid)
        if part is None or not fits(part, said.updates.get("value")):
            return None
    elif isinstance(said, (ViewerCameraMessage, TransformControlsUpdateMessage)) and not is_turn(said.wxyz):
        return None
    return msgspec.msgpack.encode(said)


def is_finite(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def is_turn(wxyz: Quaternion) -> bool:
    return abs(math.hypot(*wxyz) - 1) < 1e-2


def fits(part: Any, value: Any) -> bool:
    """True if a panel's input accepts a value, by its type, range and choices."""
    now = part.value
    if isinstance(now, bool) or now is None:
        return isinstance(value, bool)
    if isinstance(now, str):
        choices = getattr(part, "options", None)
        return isinstance(value, str) and len(value) <= MAX_TEXT_LENGTH and (choices is None or value in choices)
    if isinstance(now, (int, float)):
        low, high = (getattr(part, name, None) for name in ("min", "max"))
        return (
            is_number(value)
            and (low is None or value >= low - RANGE_TOLERANCE)
            and (high is None or value <= high + RANGE_TOLERANCE)
        )
    if isinstance(now, tuple):
        return isinstance(value, list) and len(value) == len(now) and all(map(is_number, value))
    return False


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_COORDINATE
