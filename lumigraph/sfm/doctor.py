"""Findings: faulty photographs of a capture or a run, with evidence and advice."""

import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageOps

from ..datasets.images import in_parallel
from ..files import read_json
from ..geometry import evenly
from ..readers import colmap
from ..readers.capture import Capture, Shot
from ..readers.finding import paired
from ..readers.oddities import fold, in_steps
from ..readers.pictures import eight_bits
from ..readers.points import similarity
from ..readers.transforms import Made
from .coverage import coverage
from .photos import Photo
from .photos.judge import JUDGED_SIDE, Judgement, blurred, exposure_jumps, judge

MIN_JUDGED = 4  # photographs; fewer have no usual value to compare with
MAX_OBSERVATIONS = 500  # of sparse points, measured in each photograph
MIN_OBSERVATIONS = 20  # of a photograph that is judged by them
MIN_COUNT_SHARE = 0.1  # of the others' points that a photograph has at least
MIN_TRACK_LENGTH = 3  # photographs that show a point; two could agree on a wrong place
MISPLACED_ERROR = 4.0  # pixels of a picture 1000 wide, and
MISPLACED_FACTOR = 5.0  # times the median error of all, from which on a pose is wrong
MAX_LIKENESS = 0.5  # correlation with the colours of its points below which a photograph shows something else, if
MIN_LIKENESS_DROP = 0.3  # below that of the others; a mirrored photograph correlates as they do
MIN_DEVIATIONS = 4.0  # robust standard deviations below the median that count as a fault
PSNR_SPREAD, FLOATING_SPREAD = 1.0, 0.06  # smallest standard deviations: dB, and share of the pixels
FLOATING_DEVIATIONS = 3.0  # of PSNR that floating surfaces come with; alone they are a fault of the run
MIRRORED_PSNR = 1.5  # dB by which a mirrored photograph must fit its rendering better

BLURRED = "blurred"  # fault of a photograph
FOLDED = "folded cameras"  # fault of a capture whose cameras leap where its photographs do not
LACKING = "lacking directions"  # fault of a capture with directions that lack photographs
TURNING = "turning subject"  # fault of a capture whose subject turned before a background at rest

Array = Float[np.ndarray, " photo"]


@dataclass(frozen=True)
class Finding:
    """A fault of one photograph, or of the whole capture.

    photograph: its name; empty for the whole capture
    fault:      in a few words
    evidence:   the measurement
    advice:     what to do, with the command where there is one
    """

    photograph: str
    fault: str
    evidence: str
    advice: str

    def __str__(self) -> str:
        name = f"{self.photograph}: " if self.photograph else ""
        return f"{name}{self.evidence}{'; ' if self.advice else ''}{self.advice}"


@dataclass(frozen=True)
class Residual:
    """Difference between a photograph and its rendering by a run, after the run's own exposure and appearance.

    psnr:     dB, after a gain and an offset per colour
    mirrored: the same of the mirrored photograph
    floating: share of its rendered surface that other cameras see through (floaters)
    baselines: psnr of trivial stand-ins for a held-out photograph
    """

    photograph: str
    split: str
    psnr: float
    mirrored: float
    floating: float
    baselines: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TrackAgreement:
    """Agreement of a photograph with its sparse points.

    count:    features of reliable points; the other fields are NaN below 20
    error:    median reprojection error, pixels of a picture 1000 wide
    share:    of its features with an error above 4 of these pixels
    likeness: correlation of its pixels with the colours of the points;  mirrored: the same of the mirrored photograph;
              NaN without a file
    """

    count: int
    error: float = np.nan
    share: float = np.nan
    likeness: float = np.nan
    mirrored: float = np.nan


def findings(
    capture: Capture,
    left_out: Mapping[str, str] | None = None,
    upright: Float[np.ndarray, "3 3"] | None = None,
    residuals: Sequence[Residual] = (),
    judged: Sequence[Photo] = (),
) -> list[Finding]:
    """Faults of a capture's photographs, grouped by kind, then directions that lack photographs.

    left_out:  name and reason of photographs without a pose; None to read them from the folder's capture.json
    upright:   the rotation to +z up; None for upright poses
    residuals: of a run trained on them
    judged:    photographs whose pixels were judged already; the others' files are read
    Raises LumigraphError for a damaged COLMAP model or capture.json beside the photographs.
    """
    capture = replace(capture, shots=[replace(shot, name=label(shot.name)) for shot in capture.shots])
    shots, folder = capture.shots, Path(capture.source)
    poses = np.stack([shot.pose for shot in shots])
    found = [
        Finding(name, "left out", why, "retake it, or take photographs between it and the others")
        for name, why in (said_left_out(folder) if left_out is None else left_out).items()
    ]
    if len(shots) >= MIN_JUDGED:
        found += of_pixels(shots, {photo.name: photo for photo in judged})
        found += of_tracks(shots, tracks_of(capture), folder, {f.photograph for f in found if f.fault == BLURRED})
        found += of_residuals(residuals, shots, {f.photograph for f in found})
        found += of_folds(shots, poses, folder)
    turned = poses if upright is None else upright @ poses
    if capture.bounds is None and (around := coverage([shot.name for shot in shots], turned)) is not None:
        covered = f"photographs cover {around.degrees:.0f} of 360 degrees around the subject"
        found += [Finding("", LACKING, covered, advice) for advice in around.advice]
    return found


def label(name: str) -> str:
    """Display name of a photograph, without the common folder."""
    return name.removeprefix("images/")


def said_left_out(folder: Path) -> dict[str, str]:
    """Photographs without a pose, and the reasons, from capture.json; empty for other folders."""
    path = folder / "capture.json"
    return read_json(path, Made).left_out if path.is_file() else {}


def leave_out(shot: Shot) -> str:
    """Advice with the command that moves a photograph out of its folder. Readers ignore missing ones."""
    if not isinstance(shot.image, dict):
        return "leave it out"
    moves = [shlex.join(["mv", str(path), f"{path}.out"]) for path in shot.image.values()]
    return f"retake it, or leave it out: {' && '.join(moves)}"


def find_again(shot: Shot, folder: Path) -> str:
    """Advice with the command that reconstructs all poses again; by another mapper, if they came from ours.

    shot: one of them
    """
    source = str(first_file(shot).parent) if isinstance(shot.image, dict) else "PHOTOS"
    other = ["--mapper", "global"] if (folder / "capture.json").is_file() else []
    again = shlex.join(["lumigraph", "capture", source, "--output", f"{folder}-again", *other])
    return f"find the poses again: {again}"


def of_folds(shots: Sequence[Shot], poses: Float[np.ndarray, "photo 3 4"], folder: Path) -> list[Finding]:
    """Findings of jumps of the camera between consecutive photographs with the same view."""
    if (found := fold(shots, poses)) is None:
        return []
    evidence = (
        f"{found.before} and {found.after} are next to each other and show the same, but their cameras are "
        f"{found.times:.0f} times as far apart as neighbours usually are"
    )
    return [Finding("", FOLDED, evidence, find_again(shots[0], folder))]


def of_pixels(shots: Sequence[Shot], before: Mapping[str, Photo]) -> list[Finding]:
    """Findings of blurred photographs, and of jumps of the exposure, from their files.

    before: photographs that were judged already, by name
    """
    judged = in_parallel(lambda i: before.get(shots[i].name) or judged_file(shots[i]), range(len(shots)))
    known = {shot.name: (shot, x) for shot, x in zip(shots, judged, strict=True) if x is not None}
    if len(known) < MIN_JUDGED:
        return []
    found = [
        Finding(name, BLURRED, why, leave_out(known[name][0]))
        for name, why in blurred({name: x.sharpness for name, (_, x) in known.items()}).items()
    ]
    files = [shot for shot, _ in known.values()]
    in_order = in_steps(np.stack([shot.pose[:, 3] for shot in files]))
    for i, stops in exposure_jumps([x.brightness for _, x in known.values()], in_order).items():
        than = "its neighbours" if in_order else "the others"
        evidence = f"{abs(stops):.1f} stops {'brighter' if stops > 0 else 'darker'} than {than}"
        found.append(Finding(files[i].name, "exposure jump", evidence, leave_out(files[i])))
    return found


def first_file(shot: Shot) -> Path:
    """The file of a photograph at its full size."""
    assert isinstance(shot.image, dict)
    return shot.image[min(shot.image)]


def judged_file(shot: Shot) -> Judgement | None:
    """Judgement of a photograph; None for pictures without a file that Pillow reads."""
    if not isinstance(shot.image, dict):
        return None
    try:
        with Image.open(first_file(shot)) as image:
            return judge(image)
    except OSError:
        return None


def tracks_of(capture: Capture) -> dict[str, TrackAgreement]:
    """Agreement of photographs, by name, with the tracks of the COLMAP model beside them; empty without a model.

    Points are transformed into the capture's frame by the similarity of both sets of camera positions, so poses changed
    after the reconstruction are found too. Points with fewer than three photographs do not count.
    """
    place = colmap.model_folder(Path(capture.source))
    if place is None:
        return {}
    model = colmap.read_model(place)
    shots = {shot.name: shot for shot in capture.shots}
    by_name = {image.name: image for image in model.images.values() if image.has_pose}
    images = {name: by_name[other] for name, other in paired(shots, by_name).items()}
    poses = colmap.poses_of(model)
    matrix = similarity(
        np.array([poses[image.name][:, 3] for image in images.values()]),
        np.array([shots[k].pose[:, 3] for k in images]),
    )
    if matrix is None:
        return {}
    reliable = {k: p for k, p in model.points3D.items() if p.track.length() >= MIN_TRACK_LENGTH}
    found: dict[str, TrackAgreement] = {}
    measured: list[tuple[Shot, np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]] = []
    for name, image in images.items():
        seen = [(p.xy, reliable[p.point3D_id]) for p in image.get_observation_points2D() if p.point3D_id in reliable]
        found[name] = TrackAgreement(len(seen))
        if len(seen) < MIN_OBSERVATIONS:
            continue
        features, points = zip(*evenly(seen, MAX_OBSERVATIONS), strict=True)
        camera, there = model.cameras[image.camera_id], np.array([p.xyz for p in points])
        there = there @ matrix[:3, :3].T + matrix[:3, 3]
        colours = np.array([p.color for p in points], np.float64)
        measured.append((shots[name], np.array(features), there, colours, (camera.width, camera.height)))

    def agreement(i: int) -> TrackAgreement:
        shot, features, points, colours, size = measured[i]
        away = reprojection(shot, features, points, size)
        error, share = float(np.median(away)), float((away > MISPLACED_ERROR).mean())
        return TrackAgreement(found[shot.name].count, error, share, *likeness(shot, features, colours, size))

    agreements = in_parallel(agreement, range(len(measured)))
    return found | {shot.name: tracks for (shot, *_), tracks in zip(measured, agreements, strict=True)}


def reprojection(
    shot: Shot, features: Float[np.ndarray, "point 2"], points: Float[np.ndarray, "point 3"], size: tuple[int, int]
) -> Float[np.ndarray, " point"]:
    """Reprojection errors, pixels of a picture 1000 wide; infinity for invalid projections.

    features: pixels of a picture of `size`;  points: in the frame of the shot's pose
    """
    inward = torch.from_numpy((points - shot.pose[:, 3]) @ shot.pose[:, :3]).float()
    pixels, valid = shot.lens.project(inward)
    there = pixels.double().numpy() / np.array(shot.size or size) * np.array(size)
    away = np.linalg.norm(there - features, axis=-1) * 1000 / max(size)
    return np.where(valid.numpy(), away, np.inf)


def likeness(
    shot: Shot, features: Float[np.ndarray, "point 2"], colours: Float[np.ndarray, "point 3"], size: tuple[int, int]
) -> tuple[float, float]:
    """Correlation of a photograph's pixels at its features with the colours of their points, and the same when
    mirrored. NaN without a file or without variation."""
    if not isinstance(shot.image, dict):
        return np.nan, np.nan
    try:
        with Image.open(first_file(shot)) as image:
            image.draft("RGB", (JUDGED_SIDE, JUDGED_SIDE))
            pixels = np.asarray(ImageOps.exif_transpose(eight_bits(image).convert("RGB")), np.float64)
    except OSError:
        return np.nan, np.nan
    height, width = pixels.shape[:2]
    x, y = (features / np.array(size) * (width, height)).astype(int).clip(0, (width - 1, height - 1)).T
    with np.errstate(invalid="ignore", divide="ignore"):
        both = [np.corrcoef(shown.ravel(), colours.ravel())[0, 1] for shown in (pixels[y, x], pixels[y, width - 1 - x])]
    return float(both[0]), float(both[1])


def of_tracks(
    shots: Sequence[Shot], tracks: Mapping[str, TrackAgreement], folder: Path, blurred: Collection[str] = ()
) -> list[Finding]:
    """Findings of photographs whose pose or pixels contradict their sparse points.

    blurred: names of photographs whose pixels are no evidence
    """
    if sum(t.error == t.error for t in tracks.values()) < MIN_JUDGED:
        return []
    many = float(np.median([t.count for t in tracks.values()]))
    usual = float(np.nanmedian([t.error for t in tracks.values()]))
    likenesses = [t.likeness for t in tracks.values() if t.likeness == t.likeness]
    alike = float(np.median(likenesses)) if likenesses else 0.0
    found = []
    for shot in shots:
        if (t := tracks.get(shot.name)) is None:
            continue
        if t.count < min(MIN_OBSERVATIONS, MIN_COUNT_SHARE * many):
            evidence = f"{t.count} of its details are points that other photographs show, of others {many:.0f}"
            advice = "look at it in capture.png, and take photographs between it and the others"
            found.append(Finding(shot.name, "placed by few points", evidence, advice))
        if t.error > max(MISPLACED_ERROR, MISPLACED_FACTOR * usual):
            evidence = (
                f"its details are {t.error:.0f} pixels from their points (per 1000), those of others {usual:.1f}; "
                f"{100 * t.share:.0f} % of its tracks disagree"
            )
            found.append(Finding(shot.name, "placed badly", evidence, find_again(shot, folder)))
        if shot.name not in blurred and t.likeness < min(MAX_LIKENESS, alike - MIN_LIKENESS_DROP):
            evidence = f"correlation with the colours of its points {t.likeness:.2f}, others {alike:.2f}"
            fault = "shows something else"
            if t.mirrored > alike - MIN_LIKENESS_DROP:
                fault, evidence = "mirrored", f"{evidence}, mirrored {t.mirrored:.2f}"
            else:
                evidence += ": or its place is another, as where two sides of the subject look alike"
            found.append(Finding(shot.name, fault, evidence, leave_out(shot)))
    return found


def of_residuals(residuals: Sequence[Residual], shots: Sequence[Shot], named: set[str]) -> list[Finding]:
    """Findings of photographs that a run renders far worse than the others of their split, or with floaters.

    named: photographs with a finding; a residual adds the evidence of the run
    """
    by_name, found = {shot.name: shot for shot in shots}, []
    for split in dict.fromkeys(r.split for r in residuals):
        rows = [r for r in residuals if r.split == split]
        if len(rows) < MIN_JUDGED:
            continue
        psnr, floating = (np.array([getattr(r, name) for r in rows]) for name in ("psnr", "floating"))
        low, adrift = deviations(psnr, PSNR_SPREAD), deviations(-floating, FLOATING_SPREAD)
        for i, r in enumerate(rows):
            advice = leave_out(by_name[r.photograph]) if r.photograph in by_name else ""
            if low[i] > MIN_DEVIATIONS:
                fault = "rendered badly"
                evidence = f"PSNR {r.psnr:.1f} dB, others {np.median(psnr):.1f}"
                if r.mirrored > r.psnr + MIRRORED_PSNR:
                    fault, evidence = "mirrored", f"{evidence}, mirrored {r.mirrored:.1f}"
                elif r.photograph not in named:
                    evidence += ": its pose is wrong, or it shows something else"
                found.append(Finding(r.photograph, fault, evidence, advice))
            if adrift[i] > MIN_DEVIATIONS and low[i] > FLOATING_DEVIATIONS:
                evidence = (
                    f"other cameras see past {100 * r.floating:.0f} % of its surface, of others past "
                    f"{100 * np.median(floating):.0f} %"
                )
                found.append(Finding(r.photograph, "contradicts depth", evidence, advice))
    return found


def deviations(values: Array, least: float) -> Array:
    """Deviations below the median, in robust standard deviations (median absolute deviation), at least `least`."""
    below = np.median(values) - values
    return below / max(1.4826 * float(np.median(np.abs(below))), least)


def grouped(found: Sequence[Finding]) -> dict[str, list[str]]:
    """Lines for display, by fault; photographs with the same evidence and advice in one line, without repetition."""
    lines: dict[str, dict[Finding, list[str]]] = {}
    for finding in found:
        alike = lines.setdefault(finding.fault, {})
        alike.setdefault(replace(finding, photograph=""), []).append(finding.photograph)
    told: dict[str, list[str]] = {}
    for fault, alike in lines.items():
        given = ""
        for finding, photographs in alike.items():
            names = ", ".join(filter(None, photographs))
            again = not names and finding.evidence == given
            told.setdefault(fault, []).append(finding.advice if again else str(replace(finding, photograph=names)))
            given = finding.evidence
    return told
