"""Removal of moving features from matching, by epipolar residuals."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import LumigraphError
from ..files.names import counted
from ..system.library import pycolmap
from .diagnosis import MIN_MATCHES
from .photos import Photo

MIN_PAIRS = 2  # pairs in which a feature is matched before it can be found to move
MAX_STILL_SHARE = 0.5  # share of these pairs that agree with the camera's motion; what has less moves
MAX_MOVING_SHARE = 0.6  # of the features; above it nothing is still enough to find a camera by


@dataclass(frozen=True)
class MovingFeatures:
    """Number of features found to move, among those with enough matches."""

    moving: int
    judged: int

    def say(self) -> str:
        """A sentence for the user."""
        if not self.moving:
            return f"nothing was found to move, by {self.judged:,} features; the capture is as without --moving"
        return f"{self.moving:,} of {self.judged:,} features move, and were left out of matching"


def leave_out_moving(database: Path) -> MovingFeatures:
    """Delete matches of moving features from the verified pairs of a database.

    A match is an inlier of its pair if both features lie within COLMAP's error of each other's epipolar line. The
    pair's geometry is that of most matches, the static ones. A feature with matches in MIN_PAIRS pairs or more, and an
    inlier of fewer than half of them, moves.
    """
    with closing(pycolmap.Database.open(database)) as opened:
        count = {image.image_id: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()}
        tried, fitting = ({number: np.zeros(n, int) for number, n in count.items()} for _ in range(2))
        pairs = []
        for identity, matches in zip(*opened.read_all_matches(), strict=True):
            pair = pycolmap.pair_id_to_image_pair(identity)
            if not opened.exists_two_view_geometry(*pair):
                continue
            geometry = opened.read_two_view_geometry(*pair)
            if len(geometry.inlier_matches) < MIN_MATCHES:
                continue
            pairs.append((pair, geometry))
            for column, number in enumerate(pair):
                np.add.at(tried[number], matches[:, column], 1)
                np.add.at(fitting[number], geometry.inlier_matches[:, column], 1)
        judged = {number: tried[number] >= MIN_PAIRS for number in count}
        moves = {number: judged[number] & (fitting[number] < MAX_STILL_SHARE * tried[number]) for number in count}
        for (a, b), geometry in pairs:
            inliers = geometry.inlier_matches
            still = inliers[~(moves[a][inliers[:, 0]] | moves[b][inliers[:, 1]])]
            opened.delete_two_view_geometry(a, b)
            if len(still) >= MIN_MATCHES:
                geometry.inlier_matches = still
                opened.write_two_view_geometry(a, b, geometry)
    return MovingFeatures(*(int(sum(x.sum() for x in found.values())) for found in (moves, judged)))


def check_still(source: str, found: MovingFeatures) -> None:
    """Raise LumigraphError if too few static features remain to find cameras."""
    if found.moving > MAX_MOVING_SHARE * found.judged:
        raise LumigraphError(
            f"{source}: {100 * found.moving / found.judged:.0f} % of what is seen again moves, so nothing is still "
            "enough to find the camera by; film so that things that stand still fill most of the picture"
        )


def check_times(source: str, photos: Sequence[Photo]) -> None:
    """Raise LumigraphError for photographs without the time that a dynamic scene needs."""
    if without := [photo.name for photo in photos if photo.time is None]:
        raise LumigraphError(
            f"{source}: {counted(len(without), 'photograph')} have no time of exposure, {without[0]} first; name a "
            "video, or leave out --moving"
        )
