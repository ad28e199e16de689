"""Address: the host and port that the viewer listens at."""

import ipaddress
import secrets
import socket
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ..errors import LumigraphError, LumigraphWarning

HOST, PORT = "127.0.0.1", 8080
Server = TypeVar("Server")
MAX_PORT_TRIES = 100  # ports after the usual one


class PortTakenError(LumigraphError):
    """A port that was free when it was chosen, and is in use when a server starts."""


@dataclass(frozen=True)
class Address:
    """Host as the user named it, and a port that was free when checked.

    token: secret that a browser must send; empty where only this machine can reach the viewer
    """

    host: str
    port: int
    token: str = ""

    @property
    def url(self) -> str:
        """The address to open in a browser on this machine."""
        return self.urls[0]

    @property
    def cookie(self) -> str:
        """Cookie that carries the token."""
        return f"lumigraph-{self.port}={self.token}"

    @property
    def urls(self) -> list[str]:
        """All addresses that reach the viewer, as far as they can be found."""
        hosts = own_addresses() if is_wildcard(self.host) else [self.host]
        secret = f"/?token={self.token}" if self.token else ""
        return [f"http://{f'[{host}]' if ':' in host else host}:{self.port}{secret}" for host in hosts]


def choose_address(host: str = HOST, port: int | None = None, token: str = "") -> Address:
    """Choose an address to listen at. Without a port, the first free one from 8080 on.

    token: secret shared with the parent process; without one, other machines get one in the address, with a warning
    Raises LumigraphError for a host that is not this machine's, and for a port in use.
    """
    if port is not None and not 0 <= port <= 65535:
        raise LumigraphError(f"There is no port {port}; give --port a number from 1 to 65535")
    wanted = range(PORT, PORT + MAX_PORT_TRIES) if port is None else [port]
    found = next((free for number in wanted if (free := free_port(host, number)) is not None), None)
    if found is None and port is None:
        raise LumigraphError(f"Ports {PORT} to {PORT + MAX_PORT_TRIES - 1} are all in use; choose another by --port")
    if found is None:
        raise LumigraphError(f"Port {port} is in use; choose another by --port, or leave it out to get a free one")
    address = Address(host, found, token or ("" if is_local(host) else new_token()))
    if address.token and not token:
        warnings.warn(
            "Whoever can reach this machine and knows the token in the address can look at the scene and use the "
            f"viewer: {', '.join(address.urls)}",
            LumigraphWarning,
            stacklevel=2,
        )
    return address


def at_free_address(host: str, port: int | None, token: str, start: Callable[[Address], Server]) -> Server:
    """Start a server at an address of `choose_address`; at the next where another program takes the port meanwhile,
    unless `port` names it. Raises LumigraphError as that does."""
    while True:
        try:
            return start(choose_address(host, port, token))
        except PortTakenError:
            if port is not None:
                raise


def new_token() -> str:
    return secrets.token_urlsafe(16)  # 128 bits


def free_port(host: str, port: int) -> int | None:
    """The port if it is free (any free one for 0), None if it is in use."""
    try:
        family, kind, *_, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        with socket.create_server(place[:2], family=family, reuse_port=False) as listening:
            return listening.getsockname()[1]
    except (socket.gaierror, UnicodeError) as error:  # the latter for what is no name at all
        reason = getattr(error, "strerror", None) or "it is no name of a host"
        raise LumigraphError(f"There is no host {host[:60]!r} ({reason}); give --host one of this machine") from error
    except PermissionError as error:
        raise LumigraphError(f"Port {port} may not be used by this user; give --port one from 1024 on") from error
    except OSError as error:
        if "in use" in str(error).lower():
            return None
        raise LumigraphError(
            f"{host} is not an address that this machine can listen at ({error.strerror}); "
            "give --host one of its own, or 0.0.0.0 for all"
        ) from error


def is_wildcard(host: str) -> bool:
    return host in ("", "0.0.0.0", "::")


def is_local(host: str) -> bool:
    """True if only this machine can reach a host."""
    if is_wildcard(host):
        return False
    places = {entry[4][0] for entry in socket.getaddrinfo(host, None)}
    return all(ipaddress.ip_address(str(place).partition("%")[0]).is_loopback for place in places)


def own_addresses() -> list[str]:
    """This machine's addresses: the loopback first, then those by which other machines may reach it."""
    found = ["127.0.0.1"]
    try:
        found += [str(entry[4][0]) for entry in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)]
    except socket.gaierror:
        pass
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:  # finds the address in use; sends nothing
        try:
            probe.connect(("192.0.2.1", 9))
            found.append(probe.getsockname()[0])
        except OSError:
            pass
    return list(dict.fromkeys(found))
