"""Access control of the viewer: its own page, opened at its own address, with the token if one is required; and the
messages accepted from it, by type and range.

A browser sends requests to any address that any page names, so a foreign page could see the scene and press buttons.
Its headers are reliable: the page that sends the request (Origin) and the name of the server (Host). A page of another
site has another Origin. A page whose name was redirected to this machine after loading (DNS rebinding) has a foreign
Host. If other machines can reach the server, an unguessable token in the address is required too; the page keeps it
as a cookie, so that its websocket has it.

viser sets every attribute that a message names and prints a traceback for unusable values, so no other message reaches
it.
"""

import hmac
import ipaddress
import math
import socket
from collections.abc import Awaitable, Callable, Iterable
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Annotated, Any, Literal
from urllib.parse import parse_qs, urlsplit

import msgspec
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from .address import Address, is_wildcard

LOOPBACK = ("localhost", "127.0.0.1", "::1")
# Headers of our pages: no page may frame them, read them from another site, or get their address.
ISOLATION_HEADERS = {
    "Content-Security-Policy": "frame-ancestors 'self'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
}


# Of a server: to a connection and its request.
Answers = Callable[[Any, Request], Response | None | Awaitable[Response | None]]


class Guard:
    """Check of requests by their headers, including the websocket's handshake."""

    def __init__(self, address: Address):
        self.token = address.token
        self._address = address
        self._names = own_names(address)

    def refusal(self, request: Request) -> str | None:
        """Reason to refuse a request; None to accept it."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self.is_ours(hosts[0]):
            return "This is no address of the viewer; open the one that it printed"
        if any(origin != f"http://{hosts[0]}" for origin in origins):
            return "Another page may not use the viewer"
        if self.token and not self.has_token(request):
            return "Open the address that the viewer printed, with its token"
        return None

    def is_ours(self, host: str) -> bool:
        """True if a Host header names this machine. Any port is accepted, because a tunnel may lead here.

        With a token any IP address is accepted: DNS rebinding uses a name, and has no token.
        """
        if "@" in host:  # user information, which no browser sends
            return False
        try:
            name = (urlsplit(f"//{host}").hostname or "").rstrip(".")
            _ = urlsplit(f"//{host}").port
        except ValueError:
            return False
        return name in self._names or (bool(self.token) and is_ip_address(name))

    @property
    def cookie(self) -> str:
        """Value of the header Set-Cookie that keeps the token."""
        return f"{self._address.cookie}; HttpOnly; SameSite=Strict; Path=/"

    def has_token(self, request: Request) -> bool:
        tokens = parse_qs(urlsplit(request.path).query).get("token", [])
        for line in request.headers.get_all("Cookie"):
            tokens += cookies(line, self._address.cookie.partition("=")[0])
        return any(hmac.compare_digest(one.encode(), self.token.encode()) for one in tokens)

    def answering(self, answer: Answers) -> Answers:
        """Another server's answers for accepted requests; 403 for the rest."""

        async def guarded(connection: Any, request: Request) -> Response | None:
            if why := self.refusal(request):
                return refused(why)
            given = answer(connection, request)
            response = await given if isinstance(given, Awaitable) else given
            if response is not None:
                response.headers.update(ISOLATION_HEADERS)
                if self.token:
                    response.headers["Set-Cookie"] = self.cookie
            return response

        return guarded


def refused(why: str) -> Response:
    body = f"{why}.\n".encode()
    about = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body)), "Connection": "close"}
    return Response(HTTPStatus.FORBIDDEN, "Forbidden", Headers(about | ISOLATION_HEADERS), body)


def own_names(address: Address) -> set[str]:
    """Hosts by which a browser may reach the viewer, as `urlsplit` gives them."""
    names: Iterable[str] = LOOPBACK
    if address.token:
        here = socket.gethostname()
        names = [*names, here, f"{here}.local"]
    if not is_wildcard(address.host):
        names = [*names, address.host]
    return {name.lower() for name in names}


def is_ip_address(name: str) -> bool:
    """True if a host is an IP address, not a name."""
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def cookies(line: str, name: str) -> list[str]:
    """The values of a cookie in a header."""
    try:
        return [morsel.value for key, morsel in SimpleCookie(line).items() if key == name]
    except CookieError:
        return []


MAX_MESSAGE_BYTES = 1 << 20  # bytes of a message; our page sends less than a thousandth
MAX_COORDINATE = 1e9  # scene units
MAX_TEXT_LENGTH = 10_000  # letters of a text
RANGE_TOLERANCE = 1e-6  # beyond a range: what a browser rounds

Number = Annotated[float, msgspec.Meta(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
Triple = tuple[Number, Number, Number]
Unit = Annotated[float, msgspec.Meta(ge=-1.001, le=1.001)]
Quaternion = tuple[Unit, Unit, Unit, Unit]
Pixels = Annotated[int, msgspec.Meta(ge=0, le=16_384)]
Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT_LENGTH)]


class Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """A message; the name of each kind below is viser's."""


class ViewerCameraMessage(Message, tag=True):
    wxyz: Quaternion
    position: Triple
    fov: Annotated[float, msgspec.Meta(gt=0, lt=math.pi)]
    near: Number
    far: Number
    image_height: Pixels
    image_width: Pixels
    look_at: Triple
    up_direction: Triple


class GuiUpdateMessage(Message, tag=True):
    uuid: Text
    updates: dict[Literal["value"], Any]


class SceneNodeClickMessage(Message, tag=True):
    name: Text
    instance_index: Annotated[int, msgspec.Meta(ge=0, le=1 << 31)] | None
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: tuple[Number, Number]
    modifier: Text | None
    owner: Text = ""


class ScenePointerMessage(Message, tag=True):
    event_type: Literal["click"]
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: tuple[tuple[Number, Number]]
    modifier: Text | None


class TransformControlsUpdateMessage(Message, tag=True):
    name: Text
    wxyz: Quaternion
    position: Triple
    owner: Text = ""


class TransformControlsDragStartMessage(Message, tag=True):
    name: Text
    owner: Text = ""


class TransformControlsDragEndMessage(Message, tag=True):
    name: Text
    owner: Text = ""


DECODER = msgspec.msgpack.Decoder(
    ViewerCameraMessage
    | GuiUpdateMessage
    | SceneNodeClickMessage
    | ScenePointerMessage
    | TransformControlsUpdateMessage
    | TransformControlsDragStartMessage
    | TransformControlsDragEndMessage
)


def understood(frame: bytes | str, handle: Callable[[str], Any]) -> bytes | None:
    """Message after validation; None for messages that our page does not send.

    handle: viser's handle of a panel input by its number, None for no such input
    """
    if not isinstance(frame, bytes):
        return None
    try:
        message = DECODER.decode(frame)
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return None
    if not is_finite(msgspec.structs.astuple(message)):
        return None
    if isinstance(message, GuiUpdateMessage):
        part = handle(message.uuid)
        if part is None or not fits(part, message.updates.get("value")):
            return None
    elif isinstance(message, ViewerCameraMessage):  # a hidden window has no size, and ratios of it are taken
        message.image_width, message.image_height = max(1, message.image_width), max(1, message.image_height)
    if isinstance(message, (ViewerCameraMessage, TransformControlsUpdateMessage)) and not (
        abs(math.hypot(*message.wxyz) - 1) < 1e-2
    ):
        return None
    return msgspec.msgpack.encode(message)


def is_finite(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return all(map(is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def fits(part: Any, value: Any) -> bool:
    """True if a panel's input accepts a value, by its type, range and choices."""
    now = part.value
    if isinstance(now, bool) or now is None:
        return isinstance(value, bool)
    if isinstance(now, str):
        choices = getattr(part, "options", None)
        return isinstance(value, str) and len(value) <= MAX_TEXT_LENGTH and (choices is None or value in choices)
    if isinstance(now, (int, float)):
        low, high = (getattr(part, name, None) for name in ("min", "max"))
        return (
            is_number(value)
            and (low is None or value >= low - RANGE_TOLERANCE)
            and (high is None or value <= high + RANGE_TOLERANCE)
        )
    if isinstance(now, tuple):
        return isinstance(value, list) and len(value) == len(now) and all(map(is_number, value))
    return False


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_COORDINATE
