"""Reconstruction: from photographs or a video to a folder with poses, in stages."""

import re
import shutil
import sqlite3
from collections.abc import Container, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..errors import LumigraphError
from ..files import claim as claim_file
from ..files import read_json, remove, replacing, replacing_folder, write_bytes, write_json
from ..files.locks import lock_folder
from ..files.names import counted, natural
from ..files.ranges import typed
from ..readers.colmap import poses_of
from ..readers.raw import RAW_FILE, Remembered
from ..readers.transforms import Made
from ..readers.transforms import read as read_transforms
from ..system.library import pycolmap
from ..system.memory import free_memory
from ..system.progress import counting, tell
from .agreement import Agreement, agreement, still_share
from .demand import demand_of, fitted, reduced_pixels
from .diagnosis import (
    ALL_TURNED_SHARE,
    MIN_FEATURES,
    Diagnosis,
    Matches,
    diagnose,
    folds,
    read_matches,
    triangulation_angle,
)
from .doctor import FOLDED, TURNING, Finding, findings
from .drawings import draw_capture, draw_photographs
from .folder import (
    DRAWING_FILES,
    MASKS,
    PANORAMA_FILE,
    RESULT_FILE,
    claim,
    claim_results,
    copy_masks,
    copy_photographs,
    stamp,
    write_model,
)
from .georeference import Georeference, georeference, gps_positions, upright
from .lenses import MIN_FULL_MODEL_VIEWS, MODEL, SPHERE, group_by_lens, prior, write_database
from .moving import MovingFeatures, check_still, check_times, leave_out_moving
from .options import MotionOptions
from .pairs import SEQUENTIAL_NEIGHBOURS, Matching, choose_matching, choose_pairs
from .photos import Intake, Photo, gather
from .photos.photo import Track, untracked
from .sphere import flat_views
from .stages import Stages, key_of
from .stitching import stitch

MIN_VIEWS = 3  # photographs of a model
MIN_PARALLAX = 0.3  # degrees, median over points: below it photographs that turned have no depth
BLACK = -10.5  # mean log2 of the luminance, below which a photograph is black: 2 of 255
MAX_FEATURES = 8192
FEATURE_BUDGETS = ((80, MAX_FEATURES), (200, 4096))  # most photographs, and features of each; matching is quadratic
MIN_FEATURE_BUDGET = 2048
PIXELS_PER_FEATURE = 150  # of a photograph that may have its features without the octave of twice its size
MAX_SECOND_SIDE = 3200  # pixels of the longer side, for photographs that found no place
SECOND_CONTRAST = 0.5  # of COLMAP's threshold for features, for the same
MIN_KEPT_SHARE = 0.8  # share of the photographs that a model without folds must keep to be preferred
MIN_STILL_SHARE = 0.3  # share of pairs with a background at rest, from which on the subject turned
MIN_AGREEMENT = 0.8  # share of the matches, below which photographs are placed in other ways too
NOTE_FILE = "note.txt"  # beside models that were made in another way than was asked for: why, in a sentence
OTHER_SEEDS = 1, 2
MAX_THOROUGH = 400  # photographs up to which other first pairs are tried, and models adjusted as often as by COLMAP
OTHER_MAPPER: dict[str, Literal["incremental", "global"]] = {"incremental": "global", "global": "incremental"}
WAYS = {"incremental": "one by one", "global": "all at once"}
SNAPSHOTS, MAX_SNAPSHOTS = "snapshots", 40  # folder among the work of models while cameras are placed, and their number
MOVING_FILE = "moving.json"  # among the work: features that move
UNSAFE_CHARACTERS = re.compile(r"[\s#]")  # COLMAP's lists of pairs end names at spaces
OUTPUT_VERSION = 4  # another number makes all outputs be written again


def reconstruct(
    sources: Sequence[Path], folder: Path, options: MotionOptions | None = None, track: Track = untracked
) -> dict[str, Any]:
    """Find the cameras of photographs and write a scene's folder. Returns the contents of its capture.json.

    sources: a folder, a list of image files, or one video; they are only read
    folder:  output: images, sparse/0, transforms.json, points.ply, capture.json, two pictures, and a folder `work`, not
             needed afterwards. Results of an earlier call for the same sources are reused
    Raises LumigraphError if there are too few photographs, if none can be registered, and for a folder with other
    contents or in use by another process.
    """
    options = options or MotionOptions()
    check(options)
    for source in sources:
        if not source.exists():
            raise LumigraphError(f"{source} does not exist; check the path")
    fresh = not folder.exists()
    work = claim(folder, sources)
    with lock_folder(work, "worked in"):
        try:
            intake, photos = taken_in(sources, work, options, track)
        except LumigraphError:
            if fresh:  # it holds nothing to keep or to go on from
                shutil.rmtree(folder, ignore_errors=True)
            raise
        if options.moving:
            check_times(intake.source, photos)
        work_to_do = Reconstruction(sources, folder, work, options, intake, photos, track)
        if (known := finished(folder, work_to_do.keys["result"])) is not None:
            return known
        work_to_do.fit(free_memory())
        return finished(folder, work_to_do.keys["result"]) or work_to_do.run()


def taken_in(sources: Sequence[Path], work: Path, options: MotionOptions, track: Track) -> tuple[Intake, list[Photo]]:
    """Gather photographs, and list those that are no duplicates. Raises LumigraphError if there are too few."""
    intake = with_safe_names(gather(sources, work, options.frames, track))
    photos = [photo for photo in intake.photos if photo.name not in intake.duplicates]
    if all(photo.brightness < BLACK for photo in photos):
        raise LumigraphError(
            f"{intake.source}: {counted(len(intake.photos), 'photograph')}, and every one is black; open one to see "
            f"whether its file is at fault, and take them again with more light"
        )
    if len(photos) < MIN_VIEWS:
        raise LumigraphError(
            f"{intake.source} has {counted(len(photos), 'photograph')} that can be used, and {MIN_VIEWS} are the "
            f"least{also_unreadable(intake)}{also_repeated(intake)}; take some from other places"
        )
    return intake, photos


def check(options: MotionOptions) -> None:
    if options.max_size < 200:
        raise LumigraphError(f"--max-size {options.max_size} leaves no details to find; give at least 200 pixels")
    if options.frames is not None and options.frames < MIN_VIEWS:
        raise LumigraphError(f"--frames {options.frames} are too few to tell depth from; give at least {MIN_VIEWS}")


def with_safe_names(intake: Intake) -> Intake:
    """The intake with names that COLMAP's lists allow."""
    new: dict[str, str] = {}
    for photo in intake.photos:
        name = UNSAFE_CHARACTERS.sub("_", photo.name)
        while name in new.values():
            name = f"_{name}"
        new[photo.name] = name
    return replace(
        intake,
        photos=[replace(photo, name=new[photo.name]) for photo in intake.photos],
        blurred={new[name]: why for name, why in intake.blurred.items()},
        duplicates={new[name]: new[other] for name, other in intake.duplicates.items()},
        raw={new[name]: raw for name, raw in intake.raw.items()},
    )


def intake_identity(intake: Intake) -> list[Any]:
    """Everything in the intake that the result depends on, as JSON."""
    photos = [[p.name, *stamp(p.path), p.device, p.focal, p.gps, round(p.brightness, 3)] for p in intake.photos]
    raw = [asdict(Remembered(intake.raw))] if intake.raw else []
    return [photos, intake.in_order, intake.blurred, intake.duplicates, intake.unreadable, *raw]


def finished(folder: Path, key: str) -> dict[str, Any] | None:
    """Result of an earlier finished call with the same inputs, or None."""
    needed = ("transforms.json", "sparse/0/images.bin", "images", RESULT_FILE)
    if not all((folder / name).exists() for name in needed):
        return None
    known = read_json(folder / RESULT_FILE)
    return known if typed(Made, known, folder / RESULT_FILE).key == key else None


@dataclass
class Reconstruction:
    """One run of all stages: copies, features, matching, mapping, writing."""

    sources: Sequence[Path]
    folder: Path
    work: Path
    options: MotionOptions
    intake: Intake
    photos: list[Photo]
    track: Track

    def __post_init__(self) -> None:
        self.stages = Stages(self.work)
        self.spherical = self.options.camera == "spherical"
        self.lens = SPHERE if self.spherical else MODEL
        place = self.work / "panoramas" if self.spherical else self.folder  # a scene has flat views of panoramas
        self.images, self.mask_folder, self.database = place / "images", place / MASKS, self.work / "database.db"
        self.models, self.unfolded = self.work / "models", self.work / "unfolded"
        self.completed, self.refined = self.work / "completed", self.work / "refined"
        self.near, self.second = self.work / "near.db", self.work / "second.db"
        self.masks: Path | None = None
        self.names = [photo.name for photo in self.photos]
        self.groups = group_by_lens(self.photos, self.intake.in_order, self.options.camera)
        # A panorama shows four times the angle of a photograph on its longer side.
        self.max_size = self.options.max_size * (2 if self.spherical else 1)
        chosen = choose_matching(len(self.photos), self.intake.in_order)
        self.matching: Matching = chosen if self.options.matching == "auto" else self.options.matching
        self.preempt = self.options.matching != "exhaustive"
        budgets = (features for most, features in FEATURE_BUDGETS if len(self.photos) <= most)
        self.features = next(budgets, MIN_FEATURE_BUDGET)
        self.keys = self.make_keys()

    def fit(self, free: int) -> None:
        """Choose sizes that fit into free memory (bytes), and print memory and time."""
        asked = demand_of(self.photos, self.matching, self.max_size, self.features, self.preempt)
        chosen, cuts = fitted(asked, free)
        self.max_size, self.features = chosen.max_size, chosen.features
        self.keys = self.make_keys()
        for sentence in (chosen.say(), *cuts):
            tell(sentence)

    def make_keys(self) -> dict[str, str]:
        """Hash of the inputs of each stage."""
        features = key_of(
            pycolmap.__version__,
            [[p.name, *stamp(p.path), *(stamp(p.mask) if p.mask else ())] for p in self.photos],
            [[prior(group), self.lens, [p.name for p in group]] for group in self.groups],
            self.max_size,
            self.features,
        )
        places = [p.gps for p in self.photos] if self.matching == "retrieval" else None
        more = [name for name, on in (("moving", self.options.moving), ("every pair", not self.preempt)) if on]
        matching = key_of(features, self.matching, places, *more)
        mapping = key_of(matching, self.options.mapper)
        result = key_of(OUTPUT_VERSION, mapping, intake_identity(self.intake))
        return {"features": features, "matching": matching, "mapping": mapping, "result": result}

    def run(self) -> dict[str, Any]:
        claim_results(self.folder)
        copy_photographs(self.photos, self.images, self.track)
        self.masks = copy_masks(self.photos, self.mask_folder, self.track)
        with closing(self.stages):
            self.find_features(self.keys["features"])
            self.compare(self.keys["matching"])
            self.leave_out(self.keys["matching"])
            self.place(self.keys["mapping"])
            self.unfold(self.keys["mapping"])
            self.complete(self.keys["mapping"])
            self.refine(self.keys["mapping"])
        with counting("Writing the scene"):
            return self.write(self.keys["result"])

    def find_features(self, key: str) -> None:
        if self.stages.is_done("features", key) and self.database.is_file():
            return
        if not self.stages.was_begun("features", key) or not self.database.is_file():
            remove_database(self.database)
            with replacing(self.database, ours=True) as partial:
                write_database(partial, self.groups, self.lens)
        with self.stages.working("features", key):
            self.detect("Finding details", self.database, self.names, self.max_size, self.features, 1.0)

    def detect(
        self, description: str, database: Path, names: list[str], max_size: int, features: int, contrast: float
    ) -> None:
        """Detect features of photographs without any in a database, at the largest size that memory allows. contrast:
        factor on COLMAP's threshold"""
        asked = replace(demand_of(self.photos, self.matching, max_size, features, self.preempt), count=len(names))
        chosen, _ = fitted(asked, free_memory())
        area = PIXELS_PER_FEATURE * features
        coarse = [p.name for p in self.photos if p.name in names and reduced_pixels(p.size, chosen.max_size) >= area]
        self.colmap(
            description,
            len(self.names),
            database,
            stage="features",
            names=names,
            coarse=coarse,
            images=str(self.images),
            masks=self.masks and str(self.masks),
            max_size=chosen.max_size,
            features=features,
            contrast=contrast,
            threads=chosen.threads,
        )

    def compare(self, key: str) -> None:
        if self.stages.is_done("matching", key):
            return
        if not self.stages.was_begun("matching", key):
            with closing(pycolmap.Database.open(self.database)) as opened:
                opened.clear_matches()
                opened.clear_two_view_geometries()
        with self.stages.working("matching", key):
            self.match(self.database)

    def leave_out(self, key: str) -> None:
        """Delete matches of moving features, for a dynamic scene."""
        if not self.options.moving:
            return
        if not self.stages.is_done("moving", key):
            with self.stages.working("moving", key), counting("Looking for what moves"):
                write_json(self.work / MOVING_FILE, asdict(leave_out_moving(self.database)), ours=True)
        check_still(self.intake.source, self.found_to_move())

    def found_to_move(self) -> MovingFeatures:
        """Moving features found by `leave_out`."""
        return typed(MovingFeatures, read_json(self.work / MOVING_FILE), self.work / MOVING_FILE)

    def match(self, database: Path, among: Container[str] | None = None) -> None:
        """Match the chosen pairs; with `among`, those that include one of these photographs, none left out."""
        with counting("Choosing pairs"):
            places = gps_positions(self.photos)
            pairs = choose_pairs(self.matching, self.names, database, places, preempt=self.preempt and among is None)
        named = [(self.names[i], self.names[j]) for i, j in pairs]
        if among is not None:
            named = [(a, b) for a, b in named if a in among or b in among]
        listed = self.work / "pairs.txt"
        write_bytes(listed, "".join(f"{a} {b}\n" for a, b in named).encode(), ours=True)
        description, since = ("Comparing again", "begin") if among else ("Comparing pairs", "ever")
        self.colmap(description, len(named), database, stage="matching", pairs=str(listed), since=since)

    def place(self, key: str) -> None:
        """Register photographs by the requested mapper. If many matches contradict its model, or it finds none, try the
        other mapper and other initial pairs, until a model agrees. The one that most matches confirm is kept.

        Incremental mapping needs an initial pair with parallax, which a walk straight ahead may lack, and a poor one
        leads to a wrong model; global mapping needs focal lengths and many pairs.
        """
        if self.stages.is_done("mapping", key) and self.models.is_dir() and largest(self.models) >= MIN_VIEWS:
            return
        asked = self.options.mapper
        seeds = OTHER_SEEDS if len(self.photos) <= MAX_THOROUGH else ()
        ways = [(asked, 0), (OTHER_MAPPER[asked], 0), *(("incremental", seed) for seed in seeds)]
        with self.stages.working("mapping", key), replacing_folder(self.models, ours=True) as chosen:
            found, matches = list[Agreement](), read_matches(self.database)
            for mapper, seed in ways:
                attempt = chosen / "attempt"
                attempt.mkdir()
                self.map(self.database, attempt, mapper, seed=seed)
                now = self.agreement(attempt, matches)
                if all(now.confirmed > other.confirmed for other in found):
                    for place in set(chosen.iterdir()) - {attempt}:
                        remove(place)
                    for place in attempt.iterdir():
                        place.rename(chosen / place.name)
                    if found:
                        note = made_otherwise(found[0].share, mapper, seed, now.share)
                        write_bytes(chosen / NOTE_FILE, note.encode(), ours=True)
                remove(attempt)
                found.append(now)
                if now.share >= MIN_AGREEMENT:
                    break

    def agreement(self, models: Path, matches: Matches) -> Agreement:
        """Agreement of the largest model with the matches. Panoramas count as agreeing."""
        found = read_models(models)
        if not found or found[0].num_reg_images() < MIN_VIEWS:
            return Agreement(matches=1, confirmed=0)
        return Agreement(0, 0) if self.spherical else agreement(found[0], self.database, matches)

    def unfold(self, key: str) -> None:
        """If the model jumps between neighbours, rebuild it from matches of near neighbours alone. Far photographs that
        merely look similar, as two sides of a can do, fold a model."""
        if self.stages.is_done("unfolding", key):
            return
        with self.stages.working("unfolding", key):
            remove(self.unfolded)
            with counting("Looking for folds"):
                found, matches = read_models(self.models), read_matches(self.database)
                folded = bool(found) and self.leaps(found[0], matches) > 0
            if folded:
                copy_database(self.database, self.near)
                keep_near(self.near, self.names, SEQUENTIAL_NEIGHBOURS)
                with replacing_folder(self.unfolded, ours=True) as partial:
                    self.map(self.near, partial, "incremental")

    def complete(self, key: str) -> None:
        """Join separate models, then register the remaining photographs in a second pass.

        Their features are detected at the sizes and contrasts that the first pass left out, they are matched again, and
        mapping continues from the largest model.
        """
        if self.stages.is_done("completing", key) and self.completed.is_dir():
            return
        with self.stages.working("completing", key), replacing_folder(self.completed, ours=True) as partial:
            remove_database(self.second)  # of other photographs
            found, _, database = self.choose(read_matches(self.database))
            apart = [partial / f"apart{i}" for i in range(len(found))]
            for place, model in zip(apart, found, strict=True):
                place.mkdir()
                model.write(place)
            best = apart[0] if apart else None
            if len(apart) > 1:
                best = partial / "joined"
                self.colmap(
                    "Joining models", len(apart), database, stage="joining", apart=list(map(str, apart)),
                    images=str(self.images), models=str(best),
                )  # fmt: skip
            left = set(self.names) - (registered(pycolmap.Reconstruction(best)) if best else set())
            if left:
                self.match_again(left, database)
                again = partial / "again"
                again.mkdir()
                self.map(self.second, again, "incremental", best)

    def match_again(self, left: set[str], database: Path) -> None:
        """Create the database of the second pass: new features of the unregistered photographs, and matches.

        Photographs that had the maximum number of features, at full size, keep theirs."""
        copy_database(database, self.second)
        found = read_matches(database).features
        full = {p.name for p in self.photos if max(p.size) <= self.max_size and found[p.name] >= MAX_FEATURES}
        if not (left := left - full):
            return
        delete_features(self.second, left)
        side = max(MAX_SECOND_SIDE, self.max_size)
        self.detect("Finding more details", self.second, sorted(left), side, MAX_FEATURES, SECOND_CONTRAST)
        self.match(self.second, left)
        if self.options.moving:
            leave_out_moving(self.second)

    def refine(self, key: str) -> None:
        """Refine the lens with all its coefficients, if that reduces the error of held-out points."""
        if self.stages.is_done("lenses", key) and self.refined.is_dir():
            return
        with self.stages.working("lenses", key):
            remove(self.refined)
            models = [path.parent for path in sorted(self.completed.rglob("images.bin"))]
            best = max(models, key=lambda place: pycolmap.Reconstruction(place).num_reg_images(), default=None)
            if best:
                self.colmap(
                    "Refining the lens",
                    1,
                    self.database,
                    stage="lenses",
                    model=str(best),
                    models=str(self.refined),
                    views=MIN_FULL_MODEL_VIEWS,
                )

    def leaps(self, model: pycolmap.Reconstruction, matches: Matches) -> int:
        poses = poses_of(model)
        names = [name for name in self.names if name in poses]
        return len(folds(names, np.stack([poses[name] for name in names]), matches, self.intake.in_order))

    def map(self, database: Path, models: Path, mapper: str, model: Path | None = None, seed: int = 0) -> None:
        snapshots = self.work / SNAPSHOTS
        remove(snapshots)
        snapshots.mkdir()
        if mapper == "global":  # it changes what it finds in the database
            copy_database(database, database := self.work / "global.db")
        self.colmap(
            "Placing the rest" if model else "Placing cameras",
            len(self.names),
            database,
            stage=mapper,
            images=str(self.images),
            models=str(models),
            model=model and str(model),
            seed=seed,
            seldom=len(self.names) > MAX_THOROUGH,
            snapshots=str(snapshots),
            snapshot_every=max(1, len(self.names) // MAX_SNAPSHOTS),
            calibrate=not (self.spherical or all(prior(group)[1] for group in self.groups)),
        )

    def choose(self, matches: Matches) -> tuple[list[pycolmap.Reconstruction], list[str], Path]:
        """The models, largest first, notes on how they were made, and the database of their matches."""
        found, notes, database = read_models(self.models), [], self.database
        if (self.models / NOTE_FILE).exists():
            notes.append((self.models / NOTE_FILE).read_text())
        if self.unfolded.is_dir() and (unfolded := read_models(self.unfolded)):
            enough = unfolded[0].num_reg_images() >= MIN_KEPT_SHARE * found[0].num_reg_images()
            if enough and self.leaps(unfolded[0], matches) < self.leaps(found[0], matches):
                found, database = unfolded, self.near
                notes.append(
                    f"parts of the place look alike and the model folded, so it was made again from the nearest "
                    f"{SEQUENTIAL_NEIGHBOURS} neighbours of each photograph alone; look at capture.png"
                )
        return found, notes, database

    def colmap(self, description: str, total: int, database: Path, **job: Any) -> None:
        with closing(self.stages.colmap(total, database=str(database), **job)) as done:
            for _ in self.track(done, description, total):
                pass

    def write(self, key: str) -> dict[str, Any]:
        """Write the largest model as the scene. capture.json is last: if it exists, the rest is complete."""
        database = self.second if self.second.is_file() else self.database
        matches = read_matches(database)
        found, told, chosen = self.choose(matches)
        if self.refined.is_dir():
            found = [pycolmap.Reconstruction(self.refined), *found]
        flat = bool(found) and matches.are_turned() and triangulation_angle(found[0]) < MIN_PARALLAX
        if not found or found[0].num_reg_images() < MIN_VIEWS or flat or matches.are_turned(ALL_TURNED_SHARE):
            instead = self.folder / PANORAMA_FILE
            stitched = matches.are_turned() and stitch(database, self.images, instead)
            raise LumigraphError(nothing_fits(self.intake, self.photos, matches, instead if stitched else None))
        for name in (RESULT_FILE, "transforms.json"):
            claim_file(self.folder / name, "capture")
            remove(self.folder / name)
        model = found[0]
        place = self.turn_upright(model)
        others = [sorted(poses_of(other).keys() - poses_of(model).keys(), key=natural) for other in found[1:]]
        diagnosis = diagnose(self.intake, self.photos, model, [names for names in others if len(names) > 1], matches)
        known = place is not None and place.new_from_old is not None
        if self.options.moving:
            told.append(self.found_to_move().say())
        used = self.second if self.second.is_file() else chosen  # without far matches, where the model was unfolded
        if not self.spherical and (share := agreement(model, used, matches).share) < MIN_AGREEMENT:
            told.append(
                f"{1 - share:.0%} of the matches contradict the cameras' places, so some may be wrong; look at "
                f"capture.png, and take photographs between those that stand far apart"
            )
        if place is not None and not known:
            told.append(place.say)
        diagnosis = replace(diagnosis, warnings=[*self.intake.remarks, *diagnosis.warnings, *told])
        written, photos = model, self.photos
        if self.spherical:
            written, photos = flat_views(model, photos, self.folder, self.masks, self.track)
        write_model(self.folder, written, photos, known, self.options.moving)
        if self.intake.raw:
            write_json(self.folder / RAW_FILE, asdict(Remembered(self.intake.raw)), "capture")
        capture_sheet, photograph_sheet = (self.folder / name for name in DRAWING_FILES)
        draw_capture(capture_sheet, model, diagnosis, known)
        draw_photographs(photograph_sheet, self.intake, diagnosis)
        found = findings(read_transforms(self.folder), diagnosis.left_out, judged=self.photos)
        told_once = [asdict(finding) for finding in found if finding.fault != FOLDED]  # the warnings know, by matches
        if not self.spherical and (still := still_share(model, used)) > MIN_STILL_SHARE:
            evidence = f"in {still:.0%} of the pairs of photographs the background is at rest while the subject turns"
            advice = "train on the subject alone, by the masks of `lumigraph capture --mask-object`"
            told_once.append(asdict(Finding("", TURNING, evidence, advice)))
        result = self.summary(key, model, place, diagnosis) | {"findings": told_once}
        write_json(self.folder / RESULT_FILE, result, "capture")
        return read_json(self.folder / RESULT_FILE)

    def turn_upright(self, model: pycolmap.Reconstruction) -> Georeference | None:
        """Rotate a model to +z up; by GPS if possible, which also gives metres and the origin."""
        poses = poses_of(model)
        photos = [photo for photo in self.photos if photo.name in poses]
        stacked = np.stack([poses[photo.name] for photo in photos])
        place = georeference(stacked[:, :, 3], photos)
        points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
        model.transform((place and place.new_from_old) or upright(stacked, points))
        return place

    def summary(
        self, key: str, model: pycolmap.Reconstruction, place: Georeference | None, diagnosis: Diagnosis
    ) -> dict[str, Any]:
        priors = {photo.name: prior(group)[1] for group in self.groups for photo in group}
        known = {image.camera_id: priors[image.name] for image in model.images.values()}
        cameras = [
            {
                "model": camera.model.name,
                "size": [camera.width, camera.height],
                "parameters": camera.params.tolist(),
                "photographs": sum(image.camera_id == number and image.has_pose for image in model.images.values()),
                "focal length from EXIF": known[number],
            }
            for number, camera in sorted(model.cameras.items())
        ]
        used = place is not None and place.new_from_old is not None
        gps = place and {"used": used, "say": place.say, "origin": place.origin, "error": place.error}
        return {
            "key": key,
            "source": self.intake.source,
            "sources": [str(path.resolve()) for path in self.sources],
            "options": {x.name: getattr(self.options, x.name) for x in fields(MotionOptions)}
            | {"matching": self.matching, "features": self.features},
            **asdict(diagnosis),
            "cameras": cameras,
            "gps": gps,
            "film": self.intake.film and asdict(self.intake.film) | {"tags": str(self.intake.film)},
            "seconds": self.stages.seconds(),
        }


def read_models(folder: Path) -> list[pycolmap.Reconstruction]:
    """COLMAP's models in a folder, the largest first."""
    found = [pycolmap.Reconstruction(place) for place in sorted(folder.iterdir()) if place.is_dir()]
    return sorted(found, key=lambda model: (model.num_reg_images(), model.num_points3D()), reverse=True)


def made_otherwise(first: float, mapper: str, seed: int, share: float) -> str:
    """Sentence on a model made otherwise than requested. first, share: confirmed matches of the first model, this
    one"""
    why = f"the first model contradicted {1 - first:.0%} of the matches" if first else "there was no model at first"
    how = f"{WAYS[mapper]}, from another pair" if seed else WAYS[mapper]
    return f"{why}, so photographs were placed {how}; this one contradicts {1 - share:.0%}"


def registered(model: pycolmap.Reconstruction) -> set[str]:
    """Names of the registered photographs of a model."""
    return {image.name for image in model.images.values() if image.has_pose}


def largest(folder: Path) -> int:
    """Number of photographs in the largest of COLMAP's models in a folder; 0 if there is none."""
    return max((model.num_reg_images() for model in read_models(folder)), default=0)


def remove_database(path: Path) -> None:
    """Delete a database and SQLite's files beside it."""
    for ending in ("", "-journal", "-wal", "-shm"):
        remove(path.with_name(path.name + ending))


def copy_database(source: Path, target: Path) -> None:
    remove_database(target)
    with closing(sqlite3.connect(source)) as old, closing(sqlite3.connect(target)) as new:
        old.backup(new)


def delete_features(path: Path, names: Container[str]) -> None:
    """Delete the features of photographs and their matches from a database."""
    with closing(pycolmap.Database.open(path)) as database:
        gone = {image.image_id for image in database.read_all_images() if image.name in names}
        pairs = [pycolmap.pair_id_to_image_pair(number) for number, _ in zip(*database.read_all_matches(), strict=True)]
        for a, b in pairs:
            if a in gone or b in gone:
                database.delete_matches(a, b)
                if database.exists_two_view_geometry(a, b):
                    database.delete_two_view_geometry(a, b)
    with closing(sqlite3.connect(path)) as rows:
        for table in ("keypoints", "descriptors"):
            rows.executemany(f"DELETE FROM {table} WHERE image_id = ?", [(number,) for number in gone])
        rows.commit()


def keep_near(path: Path, names: Sequence[str], reach: int) -> None:
    """Delete the matches between photographs more than `reach` places apart."""
    place = {name: i for i, name in enumerate(names)}
    shared = read_matches(path).shared
    with closing(pycolmap.Database.open(path)) as database:
        number = {image.name: image.image_id for image in database.read_all_images()}
        for a, b in shared:
            if abs(place[a] - place[b]) > reach:
                database.delete_two_view_geometry(number[a], number[b])


def also_unreadable(intake: Intake) -> str:
    """Addition to the error for too few photographs: an unreadable one, why, and how many more."""
    if not intake.unreadable:
        return ""
    name, why = next(iter(intake.unreadable.items()))
    more = len(intake.unreadable) - 1
    return f" ({name} could not be used: {why}{f'; nor {more} more' if more else ''})"


def also_repeated(intake: Intake) -> str:
    """Addition to the error for too few photographs: how many others repeat one of them."""
    count, first = len(intake.duplicates), next(iter(intake.duplicates.values()), "")
    return f" ({count} more {'shows' if count == 1 else 'show'} what {first} shows)" if count else ""


def nothing_fits(intake: Intake, photos: Sequence[Photo], matches: Matches, panorama: Path | None = None) -> str:
    """Sentence on the reason for no model. panorama: of all of them, made instead"""
    poor = sum(matches.features.get(photo.name, 0) < MIN_FEATURES for photo in photos)
    if poor > len(photos) / 2:
        why = f"{poor} of {len(photos)} show too few details, being blank, dark or out of focus"
    elif not matches.shared:
        why = f"no two of {len(photos)} show the same things"
    elif matches.are_turned():
        why = "they were taken from one place, so that nothing shows parallax, which depth is found by"
        why += f"; {panorama} is a panorama of them instead" if panorama else ""
    else:
        largest = len(matches.groups()[0])
        why = f"at most {largest} of {len(photos)} show the same things, and not from places that tell depth"
    return (
        f"{intake.source}: the photographs' cameras could not be found, for {why}{also_unreadable(intake)}; take "
        f"20 or more of one thing from places a step apart, so that neighbours overlap by two thirds"
    )
