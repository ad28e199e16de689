"""Scene views: `lumigraph view` in a process of its own, behind the app's own address, so that there is one viewer.

A training shows itself (`--view`), and is reached in the same way. Only the app can be reached from outside.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from ..errors import LumigraphError
from ..system.signals import start
from ..viewer.address import HOST, free_port
from ..viewer.guard import ISOLATION_HEADERS
from .jobs import PROGRAM

MAX_VIEWS = 2  # processes of viewers at a time; each holds a scene in memory
IDLE_SECONDS = 120.0  # after the last connection, at which a viewer ends
HOP_HEADERS = {"connection", "content-length", "transfer-encoding", "server", "date", "keep-alive"}


@dataclass
class SceneView:
    """A viewer's process."""

    port: int
    child: subprocess.Popen[Any]
    log: Path
    connections: int = 0
    used: float = field(default_factory=time.monotonic)


class SceneViews:
    """Viewers by the path of what they show."""

    def __init__(self, folder: Path, program: Sequence[str] = PROGRAM):
        self.folder, self.program = folder, list(program)
        self.views: dict[Path, SceneView] = {}
        self._opening = threading.Lock()

    def open(self, path: Path) -> SceneView:
        """The viewer of a run or a splat file, which may still be starting."""
        with self._opening:
            return self._open(path)

    def _open(self, path: Path) -> SceneView:
        view = self.views.get(path)
        if view is None or view.child.poll() is not None:
            self._make_room()
            port = free_port(HOST, 0) or 0
            self.folder.mkdir(parents=True, exist_ok=True)
            log = self.folder / f"view-{port}.log"
            with open(log, "wb") as said:
                pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": said, "stderr": subprocess.STDOUT}
                words = [*self.program, "view", str(path), "--port", str(port)]
                view = SceneView(port, start(words, cwd=path.parent, **pipes), log)
            self.views[path] = view
        view.used = time.monotonic()
        return view

    def is_ready(self, view: SceneView) -> bool:
        """True if a viewer answers. Raises LumigraphError, with its sentence, if it has ended."""
        if view.child.poll() is not None:
            lines = view.log.read_text("utf-8", errors="replace").splitlines()
            said = [line.removeprefix("lumigraph: ") for line in lines if line.startswith("lumigraph: ")]
            raise LumigraphError(said[-1] if said else "The viewer ended by itself; open the scene again")
        return answers(view.port)

    def close(self, path: Path) -> None:
        """End the viewers of a path, or of what lies below it."""
        for shown, view in list(self.views.items()):
            if shown == path or path in shown.parents:
                end(view)
                del self.views[shown]

    def sweep(self) -> None:
        """End viewers that nobody looks at."""
        for path, view in list(self.views.items()):
            if view.child.poll() is not None or (not view.connections and time.monotonic() - view.used > IDLE_SECONDS):
                end(view)
                del self.views[path]

    def close_all(self) -> None:
        for view in self.views.values():
            end(view)
        self.views.clear()

    def _make_room(self) -> None:
        while len(self.views) >= MAX_VIEWS:
            path = min(self.views, key=lambda one: (self.views[one].connections > 0, self.views[one].used))
            end(self.views.pop(path))


def end(view: SceneView) -> None:
    if view.child.poll() is None:
        view.child.send_signal(signal.SIGTERM)
        try:
            view.child.wait(5)
        except subprocess.TimeoutExpired:
            view.child.kill()
            view.child.wait()
    view.log.unlink(missing_ok=True)


def answers(port: int) -> bool:
    """True if a viewer answers at a port."""
    try:
        socket.create_connection((HOST, port), 2).close()
        return True
    except OSError:
        return False


async def forward(request: Request, port: int, path: str) -> Response:
    """A viewer's answer to a GET."""
    status, headers, body = await asyncio.to_thread(fetch, port, path, request.headers.get("accept-encoding", ""))
    kept = {name: value for name, value in headers if name.lower() not in HOP_HEADERS | {"set-cookie"}}
    return Response(body, status, kept | ISOLATION_HEADERS)


def fetch(port: int, path: str, encoding: str) -> tuple[int, list[tuple[str, str]], bytes]:
    connection = http.client.HTTPConnection(HOST, port, timeout=60)
    try:
        connection.request("GET", path, headers={"Accept-Encoding": encoding})
        response = connection.getresponse()
        return response.status, response.getheaders(), response.read()
    except (OSError, http.client.HTTPException):
        return 503, [("content-type", "text/plain")], b"The viewer is starting, or has ended; load the page again.\n"
    finally:
        connection.close()


async def forward_messages(browser: WebSocket, port: int, view: SceneView | None) -> None:
    """Connect a browser's websocket with a viewer's, until either ends."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import WebSocketException

    wanted = browser.scope.get("subprotocols", [])
    try:
        there = await connect(
            f"ws://{HOST}:{port}/", subprotocols=wanted, max_size=None, compression=None, proxy=None, open_timeout=20
        )
    except (OSError, WebSocketException, TimeoutError):
        await browser.close(1013)
        return
    await browser.accept(subprotocol=there.subprotocol)
    if view:
        view.connections += 1

    async def up() -> None:
        while True:
            message = await browser.receive()
            if message["type"] == "websocket.disconnect":
                return
            data = message.get("bytes")
            await there.send(data if data is not None else message.get("text") or "")

    async def down() -> None:
        async for data in there:
            await (browser.send_bytes(data) if isinstance(data, bytes) else browser.send_text(data))

    tasks = [asyncio.create_task(up()), asyncio.create_task(down())]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        if view:
            view.connections -= 1
            view.used = time.monotonic()
        for task in tasks:
            task.cancel()
        for task in tasks:
            with contextlib.suppress(asyncio.CancelledError, WebSocketException, WebSocketDisconnect, RuntimeError):
                await task
        await there.close()
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):
            await browser.close()
