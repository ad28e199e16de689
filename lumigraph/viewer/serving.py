"""viser's server, with a guard at its door: who may connect, and what they may say."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
from collections.abc import Iterator
from typing import Any

import rich
import viser
import websockets.asyncio.server

from ..errors import LumigraphError
from .address import Address
from .frames import LARGEST, understood
from .guard import Guard

_patching = threading.Lock()


def start_server(address: Address, title: str) -> Any:
    """viser's server, at this address and nowhere else. Raises LumigraphError if the port has just been taken."""
    door = Door(address)
    with quiet(), door.built_in():
        server = viser.ViserServer(address.host, address.port, label=title, verbose=False)
    door.server = server
    if server.get_port() != address.port:
        with quiet():
            server.stop()
        raise LumigraphError(f"Port {address.port} has just been taken; start the viewer again")
    server.request_share_url = lambda *_, **__: None  # viser would connect to the outside if a client asked it to
    return server


class Door:
    """What stands between the network and viser, which has no place of its own for it."""

    def __init__(self, address: Address):
        self._guard = Guard(address)
        self.server: Any = None

    @contextlib.contextmanager
    def built_in(self) -> Iterator[None]:
        """Inside this block a server of websockets that is started gets the door; one must be."""
        module, built = websockets.asyncio.server, []
        begin = module.serve

        def serve(handler: Any, host: Any, port: Any, *, process_request: Any, **options: Any) -> Any:
            built.append(True)
            asyncio.get_running_loop().set_exception_handler(self._swallow)
            options |= {"max_size": LARGEST, "logger": silent_logger()}
            answer = self._guard.answering(process_request)
            return begin(self._hearing(handler), host, port, process_request=answer, **options)

        with _patching:
            module.serve = serve  # type: ignore[assignment, misc]
            try:
                yield
            finally:
                module.serve = begin  # type: ignore[misc]
        assert built, "viser does not start its server as it used to, so it would stand open"

    def _hearing(self, handler: Any) -> Any:
        """viser's own function for a client, which hears what makes sense and nothing else."""

        async def hear(connection: Any) -> None:
            if connection.subprotocol != f"viser-v{viser.__version__}":
                await connection.close(1002, "The viewer has been updated; load the page again")
                return
            receive = connection.recv

            async def sensible() -> bytes:
                while (frame := understood(await receive(), self._handle)) is None:
                    pass
                return frame

            connection.recv = sensible
            await handler(connection)

        return hear

    def _handle(self, number: str) -> Any:
        """The part of somebody's panel that has this number."""
        if self.server is None:
            return None
        for owner in (self.server, *self.server.get_clients().values()):
            if part := owner.gui._gui_input_handle_from_uuid.get(number):
                return part
        return None

    def _swallow(self, loop: asyncio.AbstractEventLoop, fault: dict[str, Any]) -> None:
        """What goes wrong with one client is not printed, unless somebody looks for it."""
        if os.environ.get("LUMIGRAPH_DEBUG"):
            loop.default_exception_handler(fault)


def silent_logger() -> logging.Logger:
    """For what strangers do at the door: a scan of ports is no fault of ours."""
    logger = logging.getLogger("lumigraph.viewer")
    logger.propagate = bool(os.environ.get("LUMIGRAPH_DEBUG"))
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return logger


class quiet:  # noqa: N801
    """viser greets on stdout, where our results go; inside this block it does not."""

    def __enter__(self) -> None:
        self._before, rich.get_console().quiet = rich.get_console().quiet, True

    def __exit__(self, *fault: object) -> None:
        rich.get_console().quiet = self._before
