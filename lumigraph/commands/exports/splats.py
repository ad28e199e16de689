"""`lumigraph export splats`: a trained cloud in the formats of splat viewers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional

from ...errors import LumigraphError
from ...files.ranges import between
from ..common import Overwrite, needed, option, show
from ..controls import Set, tell
from ..keeping import Keeping


@dataclass(frozen=True)
class Levels:
    """Levels of detail for viewers that stream large scenes."""

    lod: bool = False
    """Write a folder of streamed SOG: FILE/lod-meta.json, and chunks at several levels of detail."""
    levels: Annotated[Annotated[int, between(1, 10)] | None, option("N", "4")] = None
    """With --lod: number of levels of detail, including the finest."""
    ratio: Annotated[Annotated[float, between(1.5, 16)] | None, option("TIMES", "4")] = None
    """With --lod: Gaussians of a level per Gaussian of the next; larger makes coarser levels."""
    chunk: Annotated[Annotated[int, between(1024, 1 << 20)] | None, option("N", "65,536")] = None
    """With --lod: largest number of Gaussians in a chunk; smaller makes more files."""

    def output(self, path: Path) -> Path:
        """Path of lod-meta.json, or the path itself. Raises LumigraphError for options that need --lod."""
        if path.name == "lod-meta.json":
            return path
        if self.lod and path.suffix:
            raise LumigraphError(f"--lod writes a folder, and {path} is named like a file; name one without an ending")
        if self.given and not self.lod:
            raise LumigraphError(f"--{next(iter(self.given))} is about levels of detail; give --lod as well")
        return path / "lod-meta.json" if self.lod else path

    @property
    def given(self) -> dict[str, Any]:
        said = {name: getattr(self, name) for name in ("levels", "ratio", "chunk")}
        return {name: value for name, value in said.items() if value is not None}


@dataclass(frozen=True)
class ExportSplats:
    """Export a trained cloud of Gaussians for splat viewers, or convert a splat file to another format.

    The ending chooses the format: .ply (lossless), .glb (glTF), .sog, .spz, .compressed.ply, .splat (no view-dependent
    colour); NEW/meta.json is a folder of SOG, NEW/lod-meta.json (or NEW with --lod) one of streamed SOG. The export of
    a run is in the frame of its photographs.
    """

    source: Annotated[Positional[Path], needed("RUN_OR_FILE")]
    """Folder of a run, a splat file (.ply, .spz ...), or a composition (.json)."""
    output: Annotated[Positional[Path], needed("FILE")]
    """The new file."""
    detail: OmitArgPrefixes[Levels] = Levels()
    overwrite: Overwrite = False
    part: OmitArgPrefixes[Keeping] = Keeping()
    settings: Set = ()

    def run(self) -> int:
        from ...exchange import check_ending, claim_splats, is_splat_file, read_gaussians, size_of, write_gaussians
        from ...exchange.streamed_sog import Detail
        from ...export.splats import export_splats
        from ...method.capabilities import HasGaussians, needs
        from ...run import open_any
        from ...run.opening import frame_of

        output = self.detail.output(self.output)
        check_ending(output)
        claim_splats(output, self.overwrite, [self.source])
        detail = Detail(**self.detail.given)
        if is_splat_file(self.source):
            if self.settings:
                raise LumigraphError(f"{self.source} is a file of Gaussians, which has no controls; leave out --set")
            written = read_gaussians(self.source)
            if self.part.crops or self.part.floaters:
                frame = frame_of(written)
                crop = self.part.crop(frame)
                written = self.part.of_gaussians(written, crop and crop.moved(frame.to_source))
            write_gaussians(output, written, detail)
        else:
            opened = open_any(self.source)
            method = tell(opened, opened.method(), self.settings)
            gaussians = needs(method, HasGaussians).gaussians()
            gaussians = self.part.of_gaussians(gaussians, self.part.crop(method.frame))
            written = export_splats(gaussians, method.frame, output, detail)
        size = size_of(output)
        show(
            {
                "file": str(output),
                "Gaussians": f"{len(written):,}",
                "size": f"{size / 1e6:.1f} MB, {size / max(len(written), 1):.1f} bytes each",
            }
        )
        return 0
