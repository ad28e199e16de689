"""Compare a capture with a reference: camera positions after the best similarity between the two.

    python benchmarks/capture_poses.py SCENE REFERENCE

Both are folders that Lumigraph opens. Photographs are matched by file name without suffix. Written: how many both have,
and the median and largest distance as a share of the reference's extent, which is the diagonal of the box around its
cameras; the same for directions, in degrees.
"""

from __future__ import annotations

import argparse
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
from jaxtyping import Float

from lumigraph.readers import choose_reader


def poses(folder: Path) -> dict[str, Float[np.ndarray, "3 4"]]:
    """Camera-to-world by name."""
    return {PurePosixPath(shot.name).stem: shot.pose for shot in choose_reader(folder).read(folder).shots}


def compare(
    found: dict[str, Float[np.ndarray, "3 4"]], reference: dict[str, Float[np.ndarray, "3 4"]]
) -> dict[str, float]:
    names = sorted(found.keys() & reference.keys())
    a, b = (np.stack([poses[name] for name in names]) for poses in (found, reference))
    extent = float(np.linalg.norm(np.ptp(b[:, :, 3], axis=0)))
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = 0.05 * extent, 0
    fitted = pycolmap.estimate_sim3d_robust(a[:, :, 3], b[:, :, 3], options)
    assert fitted, "the two share no similarity"
    similarity = fitted["tgt_from_src"]
    rotation = similarity.rotation.matrix()
    away = np.linalg.norm(a[:, :, 3] @ (similarity.scale * rotation).T + similarity.translation - b[:, :, 3], axis=-1)
    between = np.einsum("nij,nik->njk", rotation @ a[:, :, :3], b[:, :, :3])
    turned = np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    return {
        "photographs in both": len(names),
        "median distance, % of extent": 100 * float(np.median(away)) / extent,
        "largest distance, % of extent": 100 * float(away.max()) / extent,
        "median turn, degrees": float(np.median(turned)),
        "largest turn, degrees": float(turned.max()),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("reference", type=Path)
    arguments = parser.parse_args()
    for name, value in compare(poses(arguments.scene), poses(arguments.reference)).items():
        print(f"{name:<30} {value:.3f}")
