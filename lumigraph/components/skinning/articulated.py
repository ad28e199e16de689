"""Articulated: common part of methods of bodies on bones: time and a user's poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...camera import Camera
from ...method import Method
from ...method.controls import Value
from .bone_motion import AT_REST, CAPTURED, BoneMotion, clip_of


class Articulated(Method):
    """A Method with a BoneMotion as `bones`."""

    bones: BoneMotion

    def moment_of(self, camera: Camera | None = None) -> float:
        """Current time: of the settings, else of the camera, else the first."""
        if "time" not in self.settings and camera is not None and camera.time is not None:
            return float(camera.time[0])
        first, _ = self.frame.times or (0.0, 0.0)
        return float(self.settings.get("time", first))

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Check poses: `pose` names a bones.json, joint angles or a glTF animation. Raises LumigraphError for a file
        without poses of this character."""
        if (path := str(controls.get("pose", CAPTURED))) not in (CAPTURED, AT_REST):
            clip_of(path, self.frame)
