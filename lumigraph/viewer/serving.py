"""viser's server behind a guard that checks connections and messages."""

import asyncio
import contextlib
import functools
import logging
import os
import threading
from collections.abc import Awaitable, Callable, Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import rich
import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from .address import Address, PortTakenError
from .guard import MAX_MESSAGE_BYTES, Answers, Guard, understood

PAGE = "scene.html"  # where a scene that browsers draw by themselves is
_patching = threading.Lock()


def start_server(address: Address, title: str, page: Callable[[], bytes] | None = None) -> Any:
    """Start viser's server at exactly this address. Raises PortTakenError if the port is no longer free.

    page: makes the response at PAGE
    """
    door = Door(address, page)
    with quiet(), door.built_in():
        server = viser.ViserServer(address.host, address.port, label=title, verbose=False)
    door.server = server
    if server.get_port() != address.port:
        with quiet():
            server.stop()
        raise PortTakenError(f"Port {address.port} has just been taken; start the viewer again")
    server.request_share_url = lambda *_, **__: None  # viser would connect to the outside if a client requested it
    return server


class Door:
    """The guard between the network and viser, which has no hook for one."""

    def __init__(self, address: Address, page: Callable[[], bytes] | None = None):
        self._guard, self._page = Guard(address), page
        self.server: Any = None

    @contextlib.contextmanager
    def built_in(self) -> Iterator[None]:
        """Block in which a started websocket server gets the guard; exactly one must be started."""
        module, built = websockets.asyncio.server, []
        begin = module.serve

        def serve(handler: Any, host: Any, port: Any, *, process_request: Any, **options: Any) -> Any:
            built.append(True)
            asyncio.get_running_loop().set_exception_handler(self._swallow)
            options |= {"max_size": MAX_MESSAGE_BYTES, "logger": silent_logger()}
            answer = self._guard.answering(beside(process_request, self._page))
            return begin(self._filtering(handler), host, port, process_request=answer, **options)

        with _patching:
            module.serve = serve  # type: ignore[assignment, misc]
            try:
                yield
            finally:
                module.serve = begin  # type: ignore[misc]
        assert built, "viser does not start its server as it used to, so it would be unguarded"

    def _filtering(self, handler: Any) -> Any:
        """viser's own function for a client, with accepted messages only."""

        async def filtered(connection: Any) -> None:
            if connection.subprotocol != f"viser-v{viser.__version__}":
                await connection.close(1002, "The viewer has been updated; load the page again")
                return
            receive = connection.recv

            async def receive_accepted() -> bytes:
                while (frame := understood(await receive(), self._handle)) is None:
                    pass
                return frame

            connection.recv = receive_accepted
            await handler(connection)

        return filtered

    def _handle(self, number: str) -> Any:
        """The input of a client's panel with this number."""
        if self.server is None:
            return None
        for owner in (self.server, *self.server.get_clients().values()):
            if part := owner.gui._gui_input_handle_from_uuid.get(number):
                return part
        return None

    def _swallow(self, loop: asyncio.AbstractEventLoop, fault: dict[str, Any]) -> None:
        """Suppress the traceback of a client's error, unless LUMIGRAPH_DEBUG is set."""
        if os.environ.get("LUMIGRAPH_DEBUG"):
            loop.default_exception_handler(fault)


def beside(answer: Answers, page: Callable[[], bytes] | None) -> Answers:
    """viser's responses, and at PAGE a page that is made on first request."""
    if page is None:
        return answer
    once = functools.cache(page)

    async def shown() -> Response:
        body = await asyncio.to_thread(once)
        about = {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
        return Response(HTTPStatus.OK, "OK", Headers(about), body)

    def answered(connection: Any, request: Request) -> Response | None | Awaitable[Response | None]:
        return shown() if urlsplit(request.path).path == f"/{PAGE}" else answer(connection, request)

    return answered


def silent_logger() -> logging.Logger:
    """A logger for faults of foreign connections, such as scans of ports."""
    logger = logging.getLogger("lumigraph.viewer")
    logger.propagate = bool(os.environ.get("LUMIGRAPH_DEBUG"))
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger


class quiet:  # noqa: N801
    """Block in which viser prints no greeting to stdout, which is for our results."""

    def __enter__(self) -> None:
        self._before, rich.get_console().quiet = rich.get_console().quiet, True

    def __exit__(self, *fault: object) -> None:
        rich.get_console().quiet = self._before
