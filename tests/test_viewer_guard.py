"""Who may speak to the viewer and what they may say: asked with real connections."""

from __future__ import annotations

import http.client
import math
import os
import socket
import time
from urllib.parse import urlsplit

import msgspec
import pytest
import tiny
import viser
from budgets import budget
from test_viewer import subject
from viewer_client import Client
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from lumigraph.paths.keyframes import CameraPath, Keyframe
from lumigraph.viewer import Viewer
from lumigraph.viewer.address import Address, choose_address, free_port
from lumigraph.viewer.guard import MAX_MESSAGE_BYTES, understood

pytestmark = [budget("exports"), pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")]
TOKEN = "a-token-nobody-guesses"


@pytest.fixture(scope="module")
def viewer(ball_run, tmp_path_factory):
    about = subject(tiny.scene(), tmp_path_factory.mktemp("run"))
    with Viewer(ball_run.method(), about, choose_address(port=0)) as made:
        yield made


@pytest.fixture(scope="module")
def guarded(ball_run, tmp_path_factory):
    """A viewer that other machines could reach if it listened to them, so that it wants a token."""
    address = Address("127.0.0.1", free_port("127.0.0.1", 0), TOKEN)
    with Viewer(ball_run.method(), subject(tiny.scene(), tmp_path_factory.mktemp("run")), address) as made:
        yield made


def got(address: Address, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    """What a GET gives; header names with _ for -. Host=... stands for the address's own."""
    connection = http.client.HTTPConnection("127.0.0.1", address.port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in ({"Host": f"127.0.0.1:{address.port}"} | headers).items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    return connection.getresponse()


def shaken(address: Address, path: str = "/", host: str | None = None, **options):
    """A websocket, as a browser would open it to a host, whatever that host's name stands for."""
    place = socket.create_connection(("127.0.0.1", address.port), 10)
    uri = f"ws://{host or f'127.0.0.1:{address.port}'}{path}"
    return connect(uri, sock=place, subprotocols=[f"viser-v{viser.__version__}"], proxy=None, **options)


def is_let_in(address: Address, **options) -> bool:
    try:
        shaken(address, **options).close()
        return True
    except InvalidStatus as refusal:
        assert refusal.response.status_code == 403
        return False


@pytest.mark.parametrize("host", ["127.0.0.1:{}", "localhost:{}", "LocalHost:{}", "[::1]:{}", "localhost:9000"])
def test_our_own_page_is_let_in_by_all_our_names_and_through_a_tunnel(viewer, host):
    host = host.format(viewer.address.port)
    assert got(viewer.address, Host=host).status == 200
    assert is_let_in(viewer.address, host=host.lower(), origin=f"http://{host.lower()}")


def test_programs_need_no_origin(viewer):
    assert is_let_in(viewer.address)


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        "https://127.0.0.1:{}",
        "http://localhost:{}",
        "http://127.0.0.1:1",
        "http://127.0.0.1",
    ],
)
def test_another_page_is_refused(viewer, origin):
    origin = origin.format(viewer.address.port)
    assert not is_let_in(viewer.address, origin=origin)
    assert got(viewer.address, Origin=origin).status == 403


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:{}",
        "localhost.evil.example:{}",
        "192.0.2.7:{}",
        "[::2]:{}",
        "",
        "127.0.0.1:{}@evil",
        "a:b",
        "evil@127.0.0.1:{}",
        "a:b@localhost",
    ],
)
def test_another_name_of_this_machine_is_refused(viewer, host):
    """As after DNS rebinding, where Origin and Host agree."""
    host = host.format(viewer.address.port)
    assert got(viewer.address, Host=host).status == 403
    assert got(viewer.address, Host=host, Origin=f"http://{host}").status == 403


def test_a_name_that_was_rebound_gets_no_websocket(viewer):
    host = f"evil.example:{viewer.address.port}"
    assert not is_let_in(viewer.address, host=host, origin=f"http://{host}")


def test_two_hosts_are_refused(viewer):
    with socket.create_connection(("127.0.0.1", viewer.address.port), 10) as place:
        place.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{viewer.address.port}\r\nHost: evil\r\n\r\n".encode())
        assert b"403" in place.recv(100)


def test_no_page_frames_ours(viewer):
    answer = got(viewer.address)
    assert (
        answer.headers["X-Frame-Options"] == "SAMEORIGIN"
        and "frame-ancestors" in answer.headers["Content-Security-Policy"]
    )


def test_with_a_token_nobody_is_let_in_without(guarded):
    address = guarded.address
    assert address.url.endswith(f"/?token={TOKEN}")
    for path in ("/", "/?token=", "/?token=wrong", f"/?token={TOKEN}x", f"/?tokens={TOKEN}"):
        assert got(address, path).status == 403 and not is_let_in(address, path=path)
    assert not is_let_in(address, additional_headers={"Cookie": f"lumigraph-{address.port}=wrong"})
    assert not is_let_in(address, additional_headers={"Cookie": f"other={TOKEN}"})


def test_the_token_is_kept_as_a_cookie(guarded):
    address = guarded.address
    answer = got(address, urlsplit(address.url).path + "?" + urlsplit(address.url).query)
    said = answer.headers["Set-Cookie"]
    assert answer.status == 200 and "HttpOnly" in said and "SameSite=Strict" in said
    cookie = said.partition(";")[0]
    assert got(address, Cookie=f"a=b; {cookie}").status == 200
    own = f"http://127.0.0.1:{address.port}"
    assert is_let_in(address, origin=own, additional_headers={"Cookie": cookie})
    assert not is_let_in(address, origin="http://evil.example", additional_headers={"Cookie": cookie})
    assert is_let_in(address, path=f"/?token={TOKEN}")


def test_a_phone_finds_it_by_number_and_rebound_names_do_not(guarded):
    port, query = guarded.address.port, f"/?token={TOKEN}"
    assert got(guarded.address, query, Host=f"192.168.1.20:{port}").status == 200
    assert got(guarded.address, query, Host=f"{socket.gethostname()}:{port}").status == 200
    assert got(guarded.address, query, Host=f"evil.example:{port}").status == 403


def test_a_host_that_others_reach_has_a_token():
    with pytest.warns(Warning, match=r"knows the token .*\?token="):
        first, second = choose_address("0.0.0.0", 0), choose_address("0.0.0.0", 0)
    assert len(first.token) > 20 and first.token != second.token
    assert choose_address("127.0.0.1", 0).token == choose_address("localhost", 0).token == ""


def camera(**changes) -> dict:
    said = {"type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [3.0, 0.0, 0.5], "fov": 0.8}
    said |= {"near": 0.01, "far": 1000.0, "image_height": 90, "image_width": 120, "look_at": [0.0, 0.0, 0.0]}
    return said | {"up_direction": [0.0, 0.0, 1.0]} | changes


def packed(value) -> bytes:
    return msgspec.msgpack.encode(value)


NONSENSE = [
    *("text", b"", b"\x00", b"\xff" * 99, b"\x91" * 5000, packed([1]), packed({"type": 3}), packed({}), packed(None)),
    *(packed({"type": name}) for name in ("ViewerCameraMessage", "GuiUpdateMessage", "Message", "x")),
    *(packed(camera(position=x)) for x in ([math.nan, 0, 0], [math.inf] * 3, [1e300] * 3, [0], "abc", None, [[0]] * 3)),
    *(packed(camera(wxyz=x)) for x in ([0, 0, 0, 0], [5, 0, 0, 0], [1.0, 0, 0])),
    *(packed(camera(fov=x)) for x in (0, -1, 4, "wide")),
    *(packed(camera(image_width=x)) for x in (-1, 10**9, 10**30 % 2**63, 2.5)),
    packed(camera(extra=1)),
    packed({"type": "FileTransferStartUpload", "source_component_uuid": "a", "transfer_uuid": "b", "filename": "../c",
            "mime_type": "", "part_count": 1, "size_bytes": 1 << 40}),
    packed({"type": "TransformControlsUpdateMessage", "name": "/x", "wxyz": [0, 0, 0, 0], "position": [0, 0, 0]}),
    packed({"type": "RunJavascriptMessage", "source": "alert(1)"}),
    os.urandom(1000),
]  # fmt: skip


@pytest.mark.parametrize("frame", NONSENSE, ids=range(len(NONSENSE)))
def test_nonsense_is_not_understood(frame):
    assert understood(frame, lambda number: None) is None


def test_a_camera_is_understood():
    assert msgspec.msgpack.decode(understood(packed(camera()), lambda number: None)) == camera()


def test_a_window_without_a_size_gets_a_picture(viewer, capfd):
    client = Client(viewer.address.url, size=(0, 0))
    assert client.picture(width=1).shape == (1, 1, 3)
    client.close()
    assert "ZeroDivisionError" not in capfd.readouterr().err


def test_nonsense_harms_nobody(viewer, capfd):
    """Another visitor goes on, the same one too, and nobody is told of it."""
    other, rude = Client(viewer.address.url), Client(viewer.address.url)
    other.picture()
    visitor = list(viewer._everyone())[-1]
    number = visitor.controls._sharpest._impl.uuid
    props = [{"value": x} for x in ("a", None, [], {}, math.nan, 1e12, -1, True, "9" * 20000)]
    props += [{"sync_cb": None}, {"update_cb": []}, {"removed": True}, {"value": 512, "uuid": "x"}, {"options": []}]
    for updates in props:
        rude.socket.send(packed({"type": "GuiUpdateMessage", "uuid": number, "updates": updates}))
    for frame in NONSENSE:
        rude.socket.send(frame)
    rude.look_from((0.0, 3.0, 0.5))
    assert rude.picture().shape[2] == 3
    with pytest.raises(Exception, match="1009|close"):  # larger than any message of ours
        rude.socket.send(bytes(MAX_MESSAGE_BYTES + 1))
        for _ in range(1000):
            rude.socket.recv(10)
    for junk in (b"\x16\x03\x01\x02\x00", b"GET\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n", os.urandom(500) + b"\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", viewer.address.port), 10) as place:
            place.sendall(junk)
    with connect(viewer.address.url.replace("http", "ws")) as old, pytest.raises(ConnectionClosed, match="updated"):
        old.recv(10)
    other.look_from((0.0, -3.0, 0.5))
    assert other.picture().shape[2] == 3 and got(viewer.address).status == 200
    other.close()
    told = capfd.readouterr()
    assert told.out == "" and told.err == ""


def test_a_path_that_is_not_in_the_list_is_not_opened(viewer):
    row = (1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)
    outside = viewer.subject.paths.parent / "secret.json"
    CameraPath((Keyframe(row, 40.0, 0.0),)).save(outside)
    client = Client(viewer.address.url)
    client.picture()
    panel = list(viewer._everyone())[-1].path
    client.turn(panel._saved, "../secret")
    list(client.messages(0.5))
    assert panel._saved.value != "../secret"
    panel._saved._impl.value = "../secret"  # as if it had come through
    panel._open()
    assert panel._stops == []
    client.close()


def test_our_own_browser_opens_it_and_a_foreign_page_does_not(guarded, chromium):
    """With the token once, afterwards by the cookie; a page of another origin gets no socket even so."""
    context, port = chromium.new_context(), guarded.address.port
    sheet = context.new_page()
    for address in (guarded.address.url, f"http://127.0.0.1:{port}/"):
        known = len(guarded._everyone())
        assert sheet.goto(address).status == 200
        end = time.monotonic() + 30
        while len(guarded._everyone()) <= known:
            assert time.monotonic() < end, "no socket was opened"
            sheet.wait_for_timeout(50)
        sheet.goto("about:blank")
        while guarded._everyone():
            sheet.wait_for_timeout(50)
    opened = """address => new Promise(done => {
        const socket = new WebSocket(address, "%s");
        socket.onopen = () => done("open"); socket.onerror = () => done("refused"); })"""
    opened %= f"viser-v{viser.__version__}"
    assert sheet.evaluate(opened, f"ws://127.0.0.1:{port}/?token={TOKEN}") == "refused"  # of about:blank
    stranger = chromium.new_context().new_page()
    assert stranger.goto(f"http://127.0.0.1:{port}/").status == 403 and "token" in stranger.content()
    for one in (context, stranger.context):
        one.close()
