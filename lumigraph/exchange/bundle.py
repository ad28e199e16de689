"""Some files that are one: a .zip archive of them, or a folder. What they promise is believed within limits."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path

from ..errors import LumigraphError
from ..files.ranges import shown
from .checks import MAX_RATIO, SMALL_BYTES

DATE = (1980, 1, 1, 0, 0, 0)  # the earliest that an archive can say, so that like files have like bytes


class Bundle:
    """Files by name, and the bytes that they take together. Raises LumigraphError for what is no archive."""

    def __init__(self, path: Path):
        self.path, self._archive = path, None
        if path.is_dir():
            self.size = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
            return
        data = path.read_bytes()
        self.size = len(data)
        try:
            self._archive = zipfile.ZipFile(io.BytesIO(data))
        except (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError) as fault:
            raise LumigraphError(f"{path} is no archive, or a part of one ({fault}); copy it again") from fault

    def read(self, name: str) -> bytes:
        """A file at the top. Raises LumigraphError if it is not there, is damaged or unpacks beyond belief."""
        if self._archive is None:
            file = self.path / name
            if Path(name).name != name or file.is_symlink() or not file.is_file():
                raise LumigraphError(f"{self.path} lacks the file {shown(name)}; copy the whole folder again")
            return file.read_bytes()
        try:
            about = self._archive.getinfo(name)
            if about.file_size > max(SMALL_BYTES, MAX_RATIO * self.size):
                raise LumigraphError(
                    f"{self.path}: {shown(name)} would unpack to {about.file_size:,} bytes; get it anew"
                )
            with self._archive.open(about) as stream:
                return stream.read(about.file_size)  # no more, whatever is there
        except KeyError as fault:
            raise LumigraphError(f"{self.path} lacks the file {shown(name)}; copy or download it again") from fault
        except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, NotImplementedError, RuntimeError) as fault:
            raise LumigraphError(
                f"{self.path}: {shown(name)} is damaged ({fault}); copy or download it again"
            ) from fault


def zipped(files: dict[str, bytes]) -> bytes:
    """An archive of files that are packed already, the same for the same files."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, DATE), data)
    return held.getvalue()
