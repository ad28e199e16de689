"""Open trained or exported models: runs of one field or in blocks, splat files, SNeRG folders and compositions."""

from pathlib import Path

from ..errors import LumigraphError
from ..exchange import is_moving, is_splat_file, place_of, refuse_several, snerg
from ..files import exists, is_file, read_json
from ..files.foreign import about_file
from ..files.reading import reads
from ..run import Opened, Run, Trained, is_block_run
from ..run.composition import CANONICAL_FORMAT, Canonicalised, Composition, Nesting
from ..run.files import MovingFile, SampleCloud, SnergFolder, SplatFile
from .block_run import BlockRun

SAMPLE = "sample:"  # before the name of a cloud of the package
SAMPLES: dict[str, float | None] = {"still-life": None, "room": 2.6}  # metres to a unit, where its scene has a size


def without_sample(path: Path | str) -> Path:
    """File of "sample:NAME"; any other path as it is. Raises LumigraphError for an unknown name."""
    if not str(path).startswith(SAMPLE):
        return Path(path)
    if (name := str(path).removeprefix(SAMPLE)) not in SAMPLES:
        raise LumigraphError(f"There is no sample {name!r}; there are: {', '.join(SAMPLES)}")
    return Path(__file__).parents[1] / "samples" / f"{name}.sog"


@reads()
def open_any(path: Path | str, within: Nesting | None = None) -> Opened:
    """Open a path: a run's folder, one in blocks, a splat file (`exchange.SUFFIXES`, SOG, streamed or not), a moving
    one (.4dgs), a folder of SNeRG's viewer, a composition (.json), a run placed by `lumigraph canonicalise` (.json).
    "sample:NAME" is a cloud of the package, see `SAMPLES`.

    within: composition of which it is a part
    Raises LumigraphError, in one sentence, for anything else.
    """
    if str(path).startswith(SAMPLE):
        return SampleCloud(without_sample(path), SAMPLES[str(path).removeprefix(SAMPLE)])
    path = Path(path)
    if is_moving(path):
        return MovingFile(path)
    if is_splat_file(path):
        return SplatFile(place_of(path))
    if path.suffix.lower() == ".json" and not path.is_dir():
        said = read_json(path)
        if isinstance(said, dict) and said.get("format") == CANONICAL_FORMAT:
            return Canonicalised(path)
        return Composition(path, open_any, within)
    if is_file(path):
        raise LumigraphError(
            about_file(path) or f"{path} is none of the files that open: a splat file, or a composition's JSON"
        )
    if not exists(path / "config.json"):
        refuse_several(path)
    return SnergFolder(path) if snerg.recognises(path) and not is_block_run(path) else open_run(path)


@reads()
def open_run(path: Path | str) -> Trained:
    """A run, of one field or in blocks. Raises LumigraphError for a folder that is neither."""
    return BlockRun(path) if is_block_run(Path(path)) else Run(path)
