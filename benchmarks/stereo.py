"""Stereo beside OpenCV's, and optical flow at OpenCV's presets, on Middlebury's Motorcycle pair.

    NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 python benchmarks/stereo.py FOLDER

FOLDER has motorcycle_left.png, motorcycle_right.png and motorcycle_disp.npz, as scikit-image ships them. One run, one
thread, processor seconds of the fastest of some repetitions. The error is over all pixels with truth. Pixels that
OpenCV leaves out are filled from the farther of both neighbours in their row, as is usual; "sure" counts only those
that the method gives itself.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from lumigraph.depth_maps import stereo
from lumigraph.depth_maps.optical_flow import optical_flow

DISPARITIES, REPETITIONS = 64, 5


def seconds(work: Callable):
    """Result, and processor seconds of the fastest run."""
    fastest = np.inf
    for _ in range(REPETITIONS):
        begin = time.process_time()
        found = work()
        fastest = min(fastest, time.process_time() - begin)
    return found, fastest


def filled_along_rows(disparity: np.ndarray) -> np.ndarray:
    """Holes (negative) take the smaller of the next values to their left and right."""
    out = disparity.copy()
    for row in out:
        known = np.flatnonzero(row >= 0)
        holes = np.flatnonzero(row < 0)
        after = np.searchsorted(known, holes)
        left = np.where(after > 0, row[known[np.maximum(after - 1, 0)]], np.inf)
        right = np.where(after < len(known), row[known[np.minimum(after, len(known) - 1)]], np.inf)
        row[holes] = np.minimum(left, right)
    return out


def report(name: str, time_taken: float, error: np.ndarray, sure: np.ndarray) -> None:
    """A row of the table: bad-2.0 and mean error of all pixels, share and errors of those that are sure."""
    of_sure = error[sure]
    print(
        f"| {name} | {100 * (error > 2).mean():.2f} % | {error.mean():.3f} | {100 * sure.mean():.0f} % "
        f"| {100 * (of_sure > 2).mean():.2f} % | {of_sure.mean():.3f} | {time_taken:.3f} |"
    )


def main(folder: Path) -> None:
    import cv2

    cv2.setNumThreads(1)
    left, right = (np.array(Image.open(folder / f"motorcycle_{side}.png").convert("RGB")) for side in ("left", "right"))
    truth = np.load(folder / "motorcycle_disp.npz")["arr_0"]
    known = np.isfinite(truth)
    a, b = torch.from_numpy(left), torch.from_numpy(right)

    print("| disparity | bad-2.0 | mean error | sure | bad-2.0 | mean error | processor s |")
    print("|---|---|---|---|---|---|---|")
    for name, mode in (("SGBM", cv2.STEREO_SGBM_MODE_SGBM), ("SGBM, 8 paths", cv2.STEREO_SGBM_MODE_HH)):
        numbers = {"P1": 8 * 27, "P2": 32 * 27, "disp12MaxDiff": 1, "preFilterCap": 63, "uniquenessRatio": 10}
        matcher = cv2.StereoSGBM_create(0, DISPARITIES, 3, speckleWindowSize=100, speckleRange=2, mode=mode, **numbers)
        given, taken = seconds(lambda matcher=matcher: matcher.compute(left, right))
        given = given.astype(np.float32) / 16
        error = np.abs(filled_along_rows(given) - truth)[known]
        report(f"OpenCV's {name}", taken, error, (given >= 0)[known])
    found, taken = seconds(lambda: stereo.semi_global(a, b, 0, DISPARITIES))
    report("`stereo.semi_global`", taken, np.abs(found.values.numpy() - truth)[known], found.sure.numpy()[known])
    print("\n| flow | bad-2.0 | mean error | processor s |\n|---|---|---|---|")
    ways = {f"OpenCV's DIS, preset {k}": cv2.DISOpticalFlow_create(k).calc for k in (0, 1, 2)}
    greys = [cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in (left, right)]
    results = {name: seconds(lambda way=way: way(*greys, None)) for name, way in ways.items()}
    results["`optical_flow`"] = seconds(lambda: optical_flow(a, b).numpy())
    for name, (flow, taken) in results.items():
        error = np.hypot(flow[..., 0] + truth, flow[..., 1])[known]
        print(f"| {name} | {100 * (error > 2).mean():.1f} % | {error.mean():.2f} | {taken:.3f} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
