"""Scene views: `lumigraph view` in separate processes, proxied by the app's own address.

A training has its own viewer (`--view`), proxied in the same way. Only the app is reachable from outside.
"""

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

from starlette.requests import Request as BrowserRequest
from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from ..errors import LumigraphError
from ..files import open_anew
from ..system.children import REQUESTED, Request
from ..system.memory import free_memory
from ..viewer.address import Address
from ..viewer.guard import ISOLATION_HEADERS
from .jobs import child_address

MAX_VIEWS, MAX_VIEWS_IN_MEMORY = 2, 8  # processes of viewers at a time, each with a scene; where memory is free
FREE_BYTES = 4 << 30  # of memory that a further viewer leaves for training
OPENING_SECONDS = 20.0  # since a page asked for a viewer, during which it is in use although nobody is connected
IDLE_SECONDS = 120.0  # after the last connection, at which a viewer ends
HOP_HEADERS = {"connection", "content-length", "transfer-encoding", "server", "date", "keep-alive"}


@dataclass
class SceneView:
    """A viewer's process."""

    address: Address
    child: subprocess.Popen[Any]
    log: Path
    connections: int = 0
    used: float = field(default_factory=time.monotonic)

    @property
    def in_use(self) -> bool:
        return bool(self.connections) or time.monotonic() - self.used < OPENING_SECONDS


class SceneViews:
    """Viewers by the path of their scene."""

    def __init__(self, folder: Path, program: Sequence[str] = REQUESTED):
        self.folder, self.program = folder, list(program)
        self.views: dict[Path, SceneView] = {}
        self._opening = threading.Lock()

    def open(self, path: Path) -> SceneView:
        """The viewer of a run or a splat file, which may still be starting.

        Raises LumigraphError if the maximum number of viewers is in use.
        """
        with self._opening:
            return self._open(path)

    def _open(self, path: Path) -> SceneView:
        view = self.views.get(path)
        if view is None or view.child.poll() is not None:
            self._make_room()
            address = child_address()
            self.folder.mkdir(parents=True, exist_ok=True)
            log = self.folder / f"view-{address.port}.log"
            request = Request("view", {"source": str(path), "port": address.port, "token": address.token})
            with open_anew(log) as said:
                view = SceneView(address, request.start(self.program, stdout=said, stderr=subprocess.STDOUT), log)
            self.views[path] = view
        view.used = time.monotonic()
        return view

    def is_ready(self, view: SceneView) -> bool:
        """True if a viewer answers. Raises LumigraphError, with its sentence, if it has ended."""
        if view.child.poll() is not None:
            lines = view.log.read_text("utf-8", errors="replace").splitlines()
            said = [line.removeprefix("lumigraph: ") for line in lines if line.startswith("lumigraph: ")]
            raise LumigraphError(said[-1] if said else "The viewer ended by itself; open the scene again")
        return answers(view.address)

    def close(self, path: Path) -> None:
        """End the viewers of a path and of everything below it."""
        for shown, view in list(self.views.items()):
            if shown == path or path in shown.parents:
                end(view)
                del self.views[shown]

    def sweep(self) -> None:
        """End unused viewers."""
        for path, view in list(self.views.items()):
            if view.child.poll() is not None or (not view.connections and time.monotonic() - view.used > IDLE_SECONDS):
                end(view)
                del self.views[path]

    def close_all(self) -> None:
        for view in self.views.values():
            end(view)
        self.views.clear()

    def _make_room(self) -> None:
        """End the least recently used viewer if there are too many."""
        most = MAX_VIEWS_IN_MEMORY if free_memory() > FREE_BYTES else MAX_VIEWS
        if len(self.views) < most:
            return
        idle = [path for path, view in self.views.items() if not view.in_use]
        if not idle:
            raise LumigraphError(f"{len(self.views)} scenes are open already; close the page of one and try again")
        end(self.views.pop(min(idle, key=lambda path: self.views[path].used)))


def end(view: SceneView) -> None:
    if view.child.poll() is None:
        view.child.send_signal(signal.SIGTERM)
        try:
            view.child.wait(5)
        except subprocess.TimeoutExpired:
            view.child.kill()
            view.child.wait()
    view.log.unlink(missing_ok=True)


def answers(address: Address) -> bool:
    """True if a viewer answers."""
    try:
        socket.create_connection((address.host, address.port), 2).close()
        return True
    except OSError:
        return False


async def forward(request: BrowserRequest, viewer: Address, path: str) -> Response:
    """Forward a GET to a viewer."""
    status, headers, body = await asyncio.to_thread(fetch, viewer, path, request.headers.get("accept-encoding", ""))
    kept = {name: value for name, value in headers if name.lower() not in HOP_HEADERS | {"set-cookie"}}
    return Response(body, status, kept | ISOLATION_HEADERS)


def fetch(viewer: Address, path: str, encoding: str) -> tuple[int, list[tuple[str, str]], bytes]:
    connection = http.client.HTTPConnection(viewer.host, viewer.port, timeout=60)
    try:
        connection.request("GET", path, headers={"Accept-Encoding": encoding, "Cookie": viewer.cookie})
        response = connection.getresponse()
        return response.status, response.getheaders(), response.read()
    except (OSError, http.client.HTTPException):
        return 503, [("content-type", "text/plain")], b"The viewer is starting, or has ended; load the page again.\n"
    finally:
        connection.close()


async def forward_messages(browser: WebSocket, viewer: Address, view: SceneView | None) -> None:
    """Connect a browser's websocket to a viewer's, until either closes."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import WebSocketException

    wanted = browser.scope.get("subprotocols", [])
    try:
        there = await connect(
            f"ws://{viewer.host}:{viewer.port}/",
            subprotocols=wanted,
            additional_headers={"Cookie": viewer.cookie},
            max_size=None,
            compression=None,
            proxy=None,
            open_timeout=20,
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
