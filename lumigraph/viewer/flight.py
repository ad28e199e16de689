"""Flight: a client's camera moved by the server."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

STEP_SECONDS = 1 / 25  # seconds
FLIGHT_SECONDS = 0.6  # that a flight to a photograph takes
UP = np.array([0.0, 0.0, 1.0])


class Flight:
    """A mover of one client's camera. A new flight ends the one before."""

    def __init__(self, client: Any):
        self._client, self._number = client, 0

    def stop(self) -> None:
        self._number += 1

    def place(self, pose: Float[np.ndarray, "3 4"], distance: float, angle: float) -> None:
        """Set the camera: its pose, the distance to the point it turns about, its vertical angle of view in radians."""
        camera = self._client.camera
        with self._client.atomic():
            camera.up_direction = upwards(pose)
            camera.position = pose[:, 3]
            camera.look_at = pose[:, 3] + distance * pose[:, 2]
            camera.fov = angle

    def fly(self, pose: Float[np.ndarray, "3 4"], distance: float, angle: float) -> None:
        """Move the camera smoothly to what `place` would set. Returns on arrival, or when another flight begins."""
        self._number += 1
        number, camera = self._number, self._client.camera
        begin = np.array(camera.position), np.array(camera.look_at), np.array(camera.up_direction), camera.fov
        goal = pose[:, 3], pose[:, 3] + distance * pose[:, 2], upwards(pose), angle
        count = round(FLIGHT_SECONDS / STEP_SECONDS)
        for i in range(1, count):
            if number != self._number:
                return
            t = i / count
            t = t * t * (3 - 2 * t)
            position, ahead, up, fov = (a + t * (b - a) for a, b in zip(begin, goal, strict=True))
            with self._client.atomic():
                camera.up_direction = up
                camera.position = position
                camera.look_at = ahead
                camera.fov = fov
            time.sleep(STEP_SECONDS)
        self.place(pose, distance, angle)

    def play(
        self,
        poses: Float[np.ndarray, "frame 3 4"],
        distance: float,
        angles: list[float],
        seconds: float,
        shown: Callable[[int], None] = lambda frame: None,
    ) -> bool:
        """Move the camera along a path in a time, skipping frames if need be; returns whether it came to the end.

        shown: called with the number of each frame that is not skipped
        """
        self._number += 1
        number, begin = self._number, time.perf_counter()
        while (now := time.perf_counter() - begin) < seconds:
            if number != self._number:
                return False
            i = min(int(now / seconds * len(poses)), len(poses) - 1)
            self.place(poses[i], distance, angles[i])
            shown(i)
            time.sleep(STEP_SECONDS)
        self.place(poses[-1], distance, angles[-1])
        shown(len(poses) - 1)
        return True


def upwards(pose: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, " 3"]:
    """The up direction that makes the browser show a pose's own roll: as near to the scene's up as can be."""
    right = pose[:, 0]
    up = UP - (UP @ right) * right
    if up @ -pose[:, 1] < 0.05:  # upside down, or nearly level with the axis
        up = -pose[:, 1]
    return up / np.linalg.norm(up)
