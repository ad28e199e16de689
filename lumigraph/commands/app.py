"""`lumigraph app`: photographs in and scene out, in a browser."""

import contextlib
import html
import tempfile
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional

from ..errors import LumigraphError
from ..files import explained, open_anew
from ..files.options import option
from ..files.ranges import Port
from ..system.signals import until_interrupted
from .common import show


@dataclass(frozen=True)
class AppCommand:
    """Make scenes from photographs in a browser: drop them, watch the cameras and the training, crop, share.

    Scenes are folders in FOLDER, and hold the files that the other commands write. Ctrl-C ends the app; what it was
    making goes on when it starts again.
    """

    folder: Annotated[Positional[Path], option("FOLDER", "the current folder")] = Path(".")
    """Folder of the scenes; it is made if it does not exist."""
    host: Annotated[str, option("ADDRESS", "127.0.0.1, this machine only")] = "127.0.0.1"
    """Address to listen at; 0.0.0.0 gives access to other machines, with the token in the printed address."""
    port: Annotated[Port | None, option("N", "8080, or the next free port")] = None
    """Port to listen at."""
    browser: bool = True
    """Open the page in the browser."""

    def run(self) -> int:
        from ..app.server import serve
        from ..viewer import choose_address

        folder = self.folder.expanduser()
        if folder.exists() and not folder.is_dir():
            raise LumigraphError(f"{folder} is a file; name a folder for the scenes")
        with explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
        address = choose_address(self.host, self.port)

        with until_interrupted(), door(address) as url:

            def opened() -> None:
                show({"app": f"{address.url} (Ctrl-C ends it)"})
                if self.browser:
                    webbrowser.open(url)

            serve(folder, address, opened)
        return 0


@contextlib.contextmanager
def door(address: Any) -> Iterator[str]:
    """Address for the browser's command line. An address with a token, which other users could see among the arguments,
    is replaced by a local page, readable by this user alone, that redirects to it."""
    if not address.token:
        yield address.url
        return
    with tempfile.TemporaryDirectory(prefix="lumigraph-") as folder:  # of mode 700
        page = Path(folder) / "app.html"
        with open_anew(page) as file:
            file.write(
                f'<!doctype html><meta http-equiv="refresh" content="0; url={html.escape(address.url)}">'.encode()
            )
        yield page.as_uri()
