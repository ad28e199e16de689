"""COLMAP in a separate process: Ctrl-C ends it at once, and its memory and messages stay outside.

Run as a script with jobs on its standard input, a line of JSON each. It imports nothing of the package, so it starts in
half a second. Progress goes to standard output, a number to a line, and at the end of a job "done"; COLMAP's messages
go to standard error. The process ends when its standard input does.
"""

import ctypes
import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

pycolmap.logging.logtostderr = True  # and no files in the system's temporary folder, with names of photographs
COUNTER = Path(__file__).with_name("counter.py")
SAMPLED_VIEWS = 2  # photographs that decide whether features are looked for without the octave of twice their size
BLOCK_VIEWS = 16  # photographs whose features are written to the database together
BLOCK_PAIRS = 64  # pairs that COLMAP compares between two writes to the database
MIN_MODEL_VIEWS = 3  # photographs of a model
MAX_THREADS = 16  # more threads need more memory than they save time
SELDOM_GROWTH = 1.4  # of a large model between two adjustments of all of it; COLMAP's is 1.1
SELDOM_REFINEMENTS, SELDOM_STEPS = 2, 15  # passes of such an adjustment and their steps; COLMAP's are 5 and 50
MIN_ADDED_INLIERS = 18  # inliers that place a photograph in a finished model; COLMAP's 30 hold while it grows
MIN_VIEW_POINTS = 15  # points that a placed photograph shows in the end, as two photographs must share to be compared
MAX_ADJUSTMENT_STEPS = 10  # in a model that is adjusted already: more do not change the error of held-out tracks
MIN_HELD_POINTS = 30  # points whose error decides on a lens
MIN_GAIN = 0.99  # error of held-out tracks with the full lens, of that with the simple one, below which it is kept
MIN_SHARED_POINTS = 15  # points of two models that one similarity maps onto each other
MIN_SHARED_RATIO = 0.3  # share of those points among all that matches connect
JOIN_TOLERANCE = 0.05  # distance of two points that count as one, of the median distance from the model's centre


def find_features(job: dict[str, Any]) -> None:
    """Detect scale-invariant features (Lowe 2004), as root-SIFT, outside masks, of photographs without any.

    COLMAP keeps the largest features up to the requested number. The octave of twice a photograph's size takes three
    quarters of the time; where the other octaves have enough features, it adds none. So `coarse` (large) photographs
    are tried without it first, unless a sample of them has too few.
    """
    known = described(job["database"])
    coarse = [name for name in job["coarse"] if name not in known]
    sample = evenly(coarse, SAMPLED_VIEWS)
    if 2 * add_coarse(job, sample) >= max(len(sample), 1):
        rest = [name for name in coarse if name not in sample]
        for i in range(0, len(rest), BLOCK_VIEWS):
            add_coarse(job, rest[i : i + BLOCK_VIEWS])
    extract(job["database"], job, job["names"], first_octave=-1)


def evenly(names: list[str], count: int) -> list[str]:
    return names[:: -(-len(names) // count)] if names else []


def add_coarse(job: dict[str, Any], names: list[str]) -> int:
    """Add features of photographs with enough of them without the octave of twice their size; their number."""
    if not names:
        return 0
    with tempfile.TemporaryDirectory(dir=os.path.dirname(job["database"])) as place:
        aside = os.path.join(place, "coarse.db")
        extract(aside, job, names, first_octave=0)
        added = 0
        with closing(pycolmap.Database.open(aside)) as found, closing(pycolmap.Database.open(job["database"])) as into:
            for image in found.read_all_images():
                features = found.read_keypoints(image.image_id)
                if len(np.unique(features[:, :2], axis=0)) > job["features"]:  # those of two orientations count once
                    number = into.read_image_with_name(image.name).image_id
                    into.write_keypoints(number, features)
                    into.write_descriptors(number, found.read_descriptors(image.image_id))
                    added += 1
    return added


def described(database: str) -> set[str]:
    """Names of the photographs that have features in a database."""
    with closing(pycolmap.Database.open(database)) as opened:
        return {image.name for image in opened.read_all_images() if opened.exists_keypoints(image.image_id)}


def extract(database: str, job: dict[str, Any], names: list[str], first_octave: int) -> None:
    """Detect features of photographs without any in a database. first_octave: -1 is twice a photograph's size"""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = job["max_size"], job["threads"]
    options.sift.max_num_features, options.sift.first_octave = job["features"], first_octave
    options.sift.peak_threshold *= job["contrast"]
    reading = pycolmap.ImageReaderOptions()
    if job["masks"]:
        reading.mask_path = job["masks"]
    pycolmap.extract_features(
        database,
        job["images"],
        image_names=names,
        reader_options=reading,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def match(job: dict[str, Any]) -> None:
    """Match listed pairs with geometric verification; finished pairs are skipped."""
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads = job["threads"]
    pairing.match_list_path, pairing.block_size = job["pairs"], BLOCK_PAIRS
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job["seed"]
    pycolmap.match_image_pairs(job["database"], options, pairing, verification, device=pycolmap.Device.cpu)


def incremental_options(job: dict[str, Any]) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = job["threads"], job["seed"]
    options.min_model_size = MIN_MODEL_VIEWS
    if job.get("seldom"):
        options.ba_global_frames_ratio = options.ba_global_points_ratio = SELDOM_GROWTH
        options.ba_global_max_refinements, options.ba_global_max_num_iterations = SELDOM_REFINEMENTS, SELDOM_STEPS
    return options


def place_one_by_one(job: dict[str, Any]) -> None:
    """Incremental structure from motion (Schönberger and Frahm 2016), from the start or from a model, to which
    photographs are added with fewer inliers, since the model verifies them. seldom: run global bundle adjustment at
    larger steps of growth, which saves most of the time of large models"""
    options, placed = incremental_options(job), 2
    options.snapshot_path, options.snapshot_frames_freq = job["snapshots"], job["snapshot_every"]
    if job["model"]:
        options.mapper.abs_pose_min_num_inliers = MIN_ADDED_INLIERS
        options.multiple_models = False

    def another() -> None:
        nonlocal placed
        placed += 1
        keep_newest(job["snapshots"])
        tell(placed)

    def begun() -> None:
        nonlocal placed
        placed = 2
        tell(placed)

    pycolmap.incremental_mapping(
        job["database"],
        job["images"],
        job["models"],
        options,
        input_path=job["model"] or "",
        initial_image_pair_callback=begun,
        next_image_callback=another,
    )


def keep_newest(folder: str) -> None:
    """Delete all snapshots of a model but the last two."""
    for name in sorted(os.listdir(folder))[:-2]:
        shutil.rmtree(os.path.join(folder, name), ignore_errors=True)


def place_all_at_once(job: dict[str, Any]) -> None:
    """Global structure from motion (GLOMAP, Pan 2024). Unknown focal lengths are first estimated from pairs."""
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = job["threads"], job["seed"]
    options.min_model_size = MIN_MODEL_VIEWS
    if job["calibrate"]:
        pycolmap.calibrate_view_graph(job["database"])
    pycolmap.global_mapping(job["database"], job["images"], job["models"], options)


def refine_lenses(job: dict[str, Any]) -> None:
    """Refine lenses with four distortion coefficients and two focal lengths instead of one of each, if held-out tracks
    agree better.

    Every tenth point is left out of two bundle adjustments, one with each lens. Then it is triangulated with the
    resulting cameras; the lens with the smaller reprojection error is kept.
    """
    model = pycolmap.Reconstruction(job["model"])
    views = Counter(image.camera_id for image in model.images.values() if image.has_pose)
    lenses = [number for number, count in views.items() if count >= job["views"] and is_simple(model.cameras[number])]
    held = [number for number in sorted(model.point3D_ids()) if model.point3D(number).track.length() >= 3][::10]
    if lenses and len(held) >= MIN_HELD_POINTS:
        before, _ = held_out_error(model, [], held)
        after, sane = held_out_error(model, lenses, held)
        print(f"held-out tracks: {before:.4f} pixels, with the full lens {after:.4f}")
        if sane and after < MIN_GAIN * before:
            set_full(model, lenses)
            adjust(model)
    weak = [image for image in model.images.values() if image.has_pose and image.num_points3D < MIN_VIEW_POINTS]
    if model.num_reg_images() - len(weak) >= MIN_MODEL_VIEWS:
        for image in weak:  # so few do not determine a pose
            model.deregister_frame(image.frame_id)
    os.makedirs(job["models"])
    model.write(job["models"])


def is_simple(camera: pycolmap.Camera) -> bool:
    return camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL


def set_full(model: pycolmap.Reconstruction, lenses: list[int]) -> None:
    for number in lenses:
        camera = model.cameras[number]
        focal, cx, cy, k1 = camera.params
        camera.model = pycolmap.CameraModelId.OPENCV
        camera.params = [focal, focal, cx, cy, k1, 0.0, 0.0, 0.0]


def held_out_error(model: pycolmap.Reconstruction, lenses: list[int], held: list[int]) -> tuple[float, bool]:
    """Mean reprojection error in pixels of held-out points, and whether the lenses are plausible: focal lengths that
    agree to 5 percent, and no coefficient above 1."""
    model = pycolmap.Reconstruction(model)
    tracks = [(model.point3D(number).xyz.copy(), model.point3D(number).track.elements) for number in held]
    tracks = [(xyz, [(e.image_id, e.point2D_idx) for e in elements]) for xyz, elements in tracks]
    for number in held:
        model.delete_point3D(number)
    set_full(model, lenses)
    adjust(model)
    added = []
    for xyz, elements in tracks:
        track = pycolmap.Track()
        for image, feature in elements:
            track.add_element(image, feature)
        added.append(model.add_point3D(xyz, track))
    adjust(model, points_alone=True)
    model.update_point_3d_errors()
    parameters = [model.cameras[number].params for number in lenses]
    sane = all(abs(p[0] / p[1] - 1) < 0.05 and max(abs(p[4:])) < 1 for p in parameters)
    return sum(model.point3D(number).error for number in added) / len(added), sane


def adjust(model: pycolmap.Reconstruction, points_alone: bool = False) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.solver_options.max_num_iterations = MAX_ADJUSTMENT_STEPS
    if points_alone:
        options.refine_focal_length = options.refine_extra_params = options.refine_rig_from_world = False
    pycolmap.bundle_adjustment(model, options)


def join(job: dict[str, Any]) -> None:
    """Join several models, where a similarity aligns the points that two of them share.

    Two points are shared if a feature of a photograph in both models sees them, or if two matched features do.
    """
    found = [pycolmap.Reconstruction(place) for place in job["apart"]]
    with closing(pycolmap.Database.open(job["database"])) as database:
        pairs = list(zip(*database.read_two_view_geometries(), strict=True))
        cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
    joined, attempts = found[0], found[1:]
    for other in attempts:
        similarity = similarity_of(other, joined, pairs)
        if similarity is None:
            continue
        other.transform(similarity)
        joined = triangulated(cache, joined, other, job)
    os.makedirs(job["models"])
    joined.write(job["models"])


def similarity_of(source: pycolmap.Reconstruction, target: pycolmap.Reconstruction, pairs: list) -> Any:
    """Similarity between points of two models; None unless enough of the shared ones agree."""
    shared = set()
    for number, pair in pairs:
        a, b = pycolmap.pair_id_to_image_pair(number)
        for i, j, columns in ((a, b, (0, 1)), (b, a, (1, 0))):
            if i in source.images and j in target.images:
                first, second = source.images[i].points2D, target.images[j].points2D
                for k, m in pair.inlier_matches[:, columns]:
                    if first[k].has_point3D() and second[m].has_point3D():
                        shared.add((first[k].point3D_id, second[m].point3D_id))
    for number in set(source.images) & set(target.images):
        for first, second in zip(source.images[number].points2D, target.images[number].points2D, strict=True):
            if first.has_point3D() and second.has_point3D():
                shared.add((first.point3D_id, second.point3D_id))
    if len(shared) < MIN_SHARED_POINTS:
        return None
    ordered = sorted(shared)
    from_points = np.array([source.point3D(i).xyz for i, _ in ordered])
    to_points = np.array([target.point3D(j).xyz for _, j in ordered])
    options = pycolmap.RANSACOptions()
    spread = np.linalg.norm(to_points - np.median(to_points, axis=0), axis=1)
    options.max_error, options.random_seed = JOIN_TOLERANCE * float(np.median(spread)), 0
    found = pycolmap.estimate_sim3d_robust(from_points, to_points, options)
    if not found or found["num_inliers"] < max(MIN_SHARED_POINTS, MIN_SHARED_RATIO * len(ordered)):
        return None
    return found["tgt_from_src"]


def triangulated(
    cache: pycolmap.DatabaseCache, joined: pycolmap.Reconstruction, other: pycolmap.Reconstruction, job: dict[str, Any]
) -> pycolmap.Reconstruction:
    """A model with the photographs of two, its points triangulated anew; the first if the second adds none."""
    model = pycolmap.Reconstruction()
    model.load(cache)
    for part in (other, joined):
        for number, camera in part.cameras.items():
            model.cameras[number].params = camera.params
        for number in part.reg_frame_ids():
            model.frame(number).rig_from_world = part.frame(number).rig_from_world
    for number in {*joined.reg_frame_ids(), *other.reg_frame_ids()}:
        model.register_frame(number)
    with tempfile.TemporaryDirectory(dir=os.path.dirname(job["database"])) as place:
        model = pycolmap.triangulate_points(
            model, job["database"], job["images"], place, options=incremental_options(job), refine_intrinsics=True
        )
    kept = sum(image.has_pose and image.num_points3D >= MIN_SHARED_POINTS for image in model.images.values())
    return model if kept > joined.num_reg_images() else joined


STAGES: dict[str, tuple[Callable[[dict[str, Any]], None], str | None]] = {
    "features": (find_features, "keypoints"),
    "matching": (match, "two_view_geometries"),
    "incremental": (place_one_by_one, None),
    "global": (place_all_at_once, None),
    "joining": (join, None),
    "lenses": (refine_lenses, None),
}


def tell(line: int | str) -> None:
    print(line, file=REPORT, flush=True)


def listen(jobs: queue.SimpleQueue[str]) -> None:
    """Pass on jobs. The end of the input ends the process, also in the middle of a job."""
    for line in sys.stdin:
        jobs.put(line)
    os._exit(1)


def main() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # COLMAP's logging library has taken it
    jobs: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=listen, args=(jobs,), daemon=True).start()
    while True:
        do(json.loads(jobs.get()))
        with suppress(AttributeError):  # another C library than glibc
            ctypes.CDLL(None).malloc_trim(0)  # the next stage has the memory of this one
        tell("done")


def do(job: dict[str, Any]) -> None:
    job.setdefault("threads", min(os.cpu_count() or 1, MAX_THREADS))
    job.setdefault("seed", 0)
    run, table = STAGES[job["stage"]]
    if table is None:
        run(job)
        return
    with counting(job["database"], table, job.get("since", "ever")):
        run(job)


@contextmanager
def counting(database: str, table: str, since: str) -> Iterator[None]:
    """Context in which another process reports the number of rows of a table; see `counter.watch`."""
    command = [sys.executable, "-P", str(COUNTER), database, table, since]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=REPORT, stderr=subprocess.DEVNULL) as counter:
        try:
            yield
        finally:
            assert counter.stdin
            counter.stdin.close()


if __name__ == "__main__":
    REPORT = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever libraries print is chatter
    main()
