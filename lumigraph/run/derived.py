"""Derived runs: records of compressions, conversions and inferences; runs that a prior creates; selected Gaussians.

compress.json, convert.json    results, in the derived run
config.json                    `converted`, `inferred`: origin of the run
"""

import contextlib
import shutil
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from .. import files
from ..camera import Camera
from ..datasets.dataset import Dataset
from ..datasets.scene import Frame
from ..errors import LumigraphError
from ..exchange import SUFFIXES, claim_splats, names_splats, write_gaussians
from ..files.ranges import Count, Lasted, Name, Seed, Share, Tally, typed
from ..files.reading import reads
from ..method import Method
from ..method.capabilities import CanPrune, needs
from ..method.prior import Prior
from ..system.work import at_work
from .checkpoint import Checkpoints, State
from .folder import Run, check_new
from .opened import Opened
from .settings import Settings

LearntFrom = Literal["photographs", "renderings of the source"]


@dataclass(frozen=True)
class Record:
    """A record file in the folder of a derived run."""

    file: ClassVar[str]

    def write(self, folder: Path) -> None:
        files.write_json(folder / self.file, asdict(self), ours=True)

    @classmethod
    @reads()
    def read(cls, folder: Path) -> Any:
        """The record in a run's folder; None in other runs. Raises LumigraphError for a damaged record."""
        return files.read_json(folder / cls.file, cls) if files.is_file(folder / cls.file) else None


@dataclass(frozen=True)
class Origin:
    """Origin of a run, an entry of config.json."""

    key: ClassVar[str]

    def within(self, settings: Settings) -> Settings:
        """Add this entry to settings."""
        return replace(settings, said=settings.said | {self.key: asdict(self)})

    @classmethod
    def of(cls, settings: Settings, file: Path) -> Any:
        """Origin in settings; None for a run of another origin. file: named in faults"""
        entry = settings.said.get(cls.key)
        return None if entry is None else typed(cls, entry, f"{file}: {cls.key}")


@dataclass(frozen=True)
class Compressed(Record):
    """A run before and after compression.

    source:       the original run
    bytes_before, bytes_after: of the model's weights
    folder_before, folder_after: of the whole runs
    psnr_before, psnr_after: of held-out views in dB; before is None where the references are renderings
    compared_with: reference of the held-out views and of the tuning
    pruned:       pruned share of importance;  codebook, apart, coarser: see `packing.Recipe`
    steps, seconds: of tuning
    """

    file = "compress.json"

    source: str
    method: str
    bytes_before: Tally
    bytes_after: Tally
    folder_before: Tally
    folder_after: Tally
    psnr_after: float
    compared_with: Literal["photographs", "renderings of the run"]
    views: Count
    pruned: Share
    codebook: Tally
    apart: Share
    coarser: Tally
    steps: Tally
    seconds: Lasted
    psnr_before: float | None = None

    @property
    def times(self) -> float:
        """Compression ratio of the model."""
        return self.bytes_before / max(self.bytes_after, 1)


@dataclass(frozen=True)
class ConversionStart(Origin):
    """A conversion in progress, as `converted` in config.json.

    source:      the run or file that is converted
    learnt_from: data of the student's further training
    taking_over: seconds of the student's initialisation from the teacher
    """

    key = "converted"

    source: str
    learnt_from: LearntFrom
    taking_over: Lasted


@dataclass(frozen=True)
class MeasuredModel:
    """Teacher or student of a conversion.

    bytes:   size of the stored model
    seconds: rendering time of a view
    psnr:    of held-out views against their photographs, in dB; None without photographs
    """

    method: Name
    bytes: Tally
    seconds: Lasted
    psnr: float | None = None


@dataclass(frozen=True)
class Converted(Record):
    """Teacher and student of a conversion.

    source, learnt_from, taking_over: see `ConversionStart`
    how:     transfer by the teacher's field, its Gaussians, its depth, or its pictures alone
    psnr:    of the student's held-out views against the teacher's, in dB
    steps, seconds: of further training
    """

    file = "convert.json"

    source: str
    how: Literal["field", "gaussians", "depth", "pictures"]
    learnt_from: LearntFrom
    teacher: MeasuredModel
    student: MeasuredModel
    psnr: float
    views: Count
    taking_over: Lasted
    steps: Tally
    seconds: Lasted


@dataclass(frozen=True)
class Inferred(Origin):
    """Origin of a run inferred by a prior. prior: run of the prior; views: photographs or shapes used; seconds: of
    inference;
    seed: of the random code of a generated object"""

    key = "inferred"

    prior: Name
    views: Tally
    seconds: Lasted
    seed: Seed | None = None


@at_work()
def infer(
    made_by: Run, prior: Prior, data: Dataset, output: Path, options: dict[str, Any], evidence: Any = None
) -> Run:
    """Infer the run of one scene or shape with a prior, in a new or empty folder.

    options:  of `open_dataset` for the data, to open them again
    evidence: input of the prior, where that is not the data
    """
    check_new(output)
    begin = time.perf_counter()
    method = prior.infer(data if evidence is None else evidence)
    seconds = time.perf_counter() - begin
    said = Inferred(str(made_by.folder.resolve()), len(data.splits.get("train", ())), round(seconds, 3))
    return kept(output, method, data, made_by.settings.seed, said, options)


def draw(made_by: Run, prior: Prior, seed: int, output: Path) -> Run:
    """Generate an object with a prior, as a run in a new or empty folder. seed: of its random code"""
    check_new(output)
    begin = time.perf_counter()
    method = prior.draw(seed)
    seconds = time.perf_counter() - begin
    said = Inferred(str(made_by.folder.resolve()), 0, round(seconds, 3), seed)
    return kept(output, method, Drawn(f"{made_by.title}, seed {seed}", method.frame), seed, said)


@dataclass(frozen=True)
class Drawn:
    """Empty Dataset of a generated object."""

    kind: ClassVar[str] = "a random code"

    source: str
    frame: Frame
    splits: dict[str, Tensor] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def preview(self) -> Camera | None:
        return None


class Pictured(Drawn):
    """Dataset of a shape reconstructed from a single picture."""

    kind: ClassVar[str] = "a picture"


def kept(
    output: Path, method: Method, data: Dataset, seed: int, said: Inferred, options: dict[str, Any] | None = None
) -> Run:
    """Write the run of a method created by a prior, with its origin in config.json, atomically."""
    with whole_run(output) as folder:
        run = Run.create(folder, method, data, seed=seed, options=options)
        run.settings = said.within(run.settings)
        run.settings.write(folder / "config.json")
        run.save(State(seconds=said.seconds), method, [], torch.Generator().manual_seed(0))
    return Run(output)


@contextlib.contextmanager
def whole_run(output: Path) -> Iterator[Path]:
    """Temporary folder for a run that replaces `output` when complete."""
    for leftover in output.iterdir() if output.is_dir() else ():
        files.remove(leftover)  # of a killed process, as `check_new` has made sure of
    with files.replacing_folder(output) as folder:
        yield folder


def check_output(opened: Opened, output: Path, overwrite: bool | None = None, reads: Iterable[Path] = ()) -> None:
    """Check the output path of selected Gaussians. Raises LumigraphError unless it is a file that may be written (see
    `files.claim`), or a new folder for a run."""
    if not names_splats(output):
        if not isinstance(opened, Run):
            raise LumigraphError(
                f"{opened.path} is no run, so it cannot become another one; give --output a file that ends in "
                f"{', '.join(SUFFIXES)}"
            )
        check_new(output)
    else:
        claim_splats(output, overwrite, reads)


def save_picked(opened: Opened, keep: Bool[Tensor, " gaussian"], output: Path, why: dict[str, Any]) -> None:
    """Write the selected Gaussians of an opened model; a mask in the order of its method's `gaussians()`.

    output: a splat file in the source's frame, or a folder for a run at the same step, for `resume`: with settings,
            cameras and history, and the optimizers' state of the Gaussians left
    why:    entry "cleaned" of the new run's config.json
    Raises LumigraphError as `check_output` does, and for a method that cannot continue with fewer Gaussians.
    """
    check_output(opened, output)
    if names_splats(output):
        write_gaussians(output, opened.source_gaussians()[keep])
        return
    assert isinstance(opened, Run)
    method, generator = needs(opened.method(), CanPrune), torch.Generator()
    optimizers = method.optimizers()
    opened.restore_training(optimizers, generator)
    method.prune(keep)
    settings = replace(
        opened.settings, said=opened.settings.said | {"cleaned": {"source": str(opened.folder.resolve())} | why}
    )
    with files.replacing_folder(output) as partial:
        for name in ("cameras.json", "metrics.jsonl"):
            if (opened.folder / name).exists():
                shutil.copy2(opened.folder / name, partial / name)
        if (opened.folder / "previews").is_dir():
            shutil.copytree(opened.folder / "previews", partial / "previews")
        Checkpoints(partial, opened.method_name).save(opened.state, method, optimizers, generator)
        settings.write(partial / "config.json")
