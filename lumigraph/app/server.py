"""The app's server: routes, and the viewer's guard in front of all of them. State is in files only."""

import asyncio
import contextlib
import io
import json
import math
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket
from websockets.datastructures import Headers
from websockets.http11 import Request as PlainRequest

from .. import methods
from ..budget import Quality
from ..errors import LumigraphError
from ..files import expanded, refusal, refuse_link
from ..files.locks import lock_folder
from ..files.ranges import Count, Downscale, Pixels
from ..system.children import REQUESTED
from ..viewer.address import Address
from ..viewer.guard import ISOLATION_HEADERS, MAX_MESSAGE_BYTES, Guard
from . import jobs, pace, pictures, progress, projects, rows, sharing, uploads
from .job_record import JobState, Making, Mapper, ShareName, read_job
from .jobs import Runner
from .projects import APP_FOLDER, SHARED, Item, find_item, relocate
from .scene_views import SceneView, SceneViews, answers, forward, forward_messages

PAGE = Path(__file__).parent / "page"
MEDIA_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
MAX_BODY_BYTES = 1 << 16  # of a request that is no upload
SLOW_THREADS = 2  # that decode photographs; large ones have a thread of their own
HOME_SECONDS = 0.3  # that an answer for the home page may look through folders
SWEEP_SECONDS = 15.0  # between looks for viewers without clients
CONTENT_SECURITY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "frame-src 'self'; media-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {name.lower(): value for name, value in ISOLATION_HEADERS.items()}
Title = Annotated[str, msgspec.Meta(max_length=400)]
PathText = Annotated[str, msgspec.Meta(max_length=4096)]
ShortName = Annotated[str, msgspec.Meta(max_length=255)]


class NewBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of a request for a new project. path: photographs on this machine; empty for uploads"""

    title: Title
    path: PathText = ""


class TitleBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of a request to rename."""

    title: Title


class MakeBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of a request to make a scene: options of `lumigraph capture` and `train`."""

    quality: Quality = "draft"
    minutes: Annotated[float, msgspec.Meta(gt=0, le=100_000)] | None = None
    method: ShortName = "gaussian-splatting"
    mapper: Mapper = "incremental"
    frames: Count | None = None
    downscale: Downscale | None = None
    mask_object: bool = False


class MoreBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of a request for more training: a quality, or total minutes of training; neither to continue as before."""

    quality: Quality | None = None
    minutes: Annotated[float, msgspec.Meta(gt=0, le=100_000)] | None = None


class ShareBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of a request for a file to share. size: longer side of a film in pixels"""

    kind: ShareName
    run: ShortName
    size: Pixels | None = None


class RunBody(msgspec.Struct, forbid_unknown_fields=True):
    """Body of a request to show a run; empty for the training under way or the latest run."""

    run: ShortName = ""


class Answer(JSONResponse):
    """JSON response that any browser reads, also of received files: numbers that are not finite become null, and
    invalid Unicode, as in file names, escapes."""

    def render(self, content: Any) -> bytes:
        try:
            return json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        except ValueError:
            return json.dumps(finite(content), separators=(",", ":")).encode()


def finite(value: Any) -> Any:
    """JSON with null for numbers that are not finite."""
    match value:
        case dict():
            return {key: finite(one) for key, one in value.items()}
        case list() | tuple():
            return [finite(one) for one in value]
        case float() if not math.isfinite(value):
            return None
    return value


class Gate:
    """The viewer's guard as ASGI middleware: requests and websockets that it refuses get 403 and reach no route."""

    def __init__(self, app: ASGIApp, address: Address):
        self.app, self.guard, self.address = app, Guard(address), address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        if why := self.guard.refusal(plain(scope)):
            await self._refuse(scope, receive, send, why)
            return

        async def sealed(message: Any) -> None:
            if message["type"] == "http.response.start":
                present = {name.lower() for name, _ in message["headers"]}
                added = [(k.encode(), v.encode()) for k, v in HEADERS.items() if k.encode() not in present]
                if self.address.token:
                    added.append((b"set-cookie", self.guard.cookie.encode()))
                message["headers"] = [*message["headers"], *added]
            await send(message)

        await self.app(scope, receive, sealed)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, why: str) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008})  # before it is accepted: 403
            return
        await PlainTextResponse(f"{why}.\n", 403, HEADERS)(scope, receive, send)


def plain(scope: Scope) -> PlainRequest:
    """A request as input of the guard."""
    path = scope["path"] + ("?" + scope["query_string"].decode("latin-1") if scope["query_string"] else "")
    headers = Headers([(name.decode("latin-1"), value.decode("latin-1")) for name, value in scope["headers"]])
    return PlainRequest(path, headers)


class App:
    """State of the app: its folder, the jobs, the viewers. Everything persistent is in files."""

    def __init__(self, root: Path, address: Address, program: Sequence[str] = REQUESTED):
        self.root, self.address = root.resolve(), address
        self.runner = Runner(self.root, program)
        self.views = SceneViews(self.root / APP_FOLDER, program)
        self._slow = ThreadPoolExecutor(SLOW_THREADS, "slow")
        self._large = ThreadPoolExecutor(1, "large")

    async def later(self, answer: Callable[..., Any], *arguments: Any, is_large: bool = False) -> Any:
        """Result of slow work, in threads of its own, so that uploads need not wait for it. is_large: it decodes a
        large photograph, for which others need not wait"""
        pool = self._large if is_large else self._slow
        return await asyncio.get_running_loop().run_in_executor(pool, answer, *arguments)

    @property
    def is_local(self) -> bool:
        return not self.address.token

    @property
    def phone_url(self) -> str:
        """Address, with the token, for other machines on the network; empty if none can reach the app."""
        url = self.address.urls[-1]  # the address in use stands last
        return "" if self.is_local or "://127.0.0.1:" in url else url

    # Home

    def home(self) -> dict[str, Any]:
        until = time.monotonic() + HOME_SECONDS
        found = [rows.card(item, until) for item in projects.items(self.root)]
        waiting = [{"key": task.item.key, "share": task.share} for task in self.runner.queue()]
        return {
            "folder": str(self.root),
            "local": self.is_local,
            "phone": self.phone_url,
            "cards": found,
            "trash": projects.trash(self.root, until),
            "queue": waiting,
        }

    def new(self, body: NewBody) -> dict[str, Any]:
        source = None
        if body.path:
            if not self.is_local:
                raise LumigraphError("A path is for browsers on this machine; drop the photographs instead")
            source = expanded(body.path.strip())
            source = source if source.is_absolute() else self.root / source
            check_source(source)
        item = projects.new_project(self.root, body.title or (source.stem if source else "Scene"), source)
        return {"key": item.key}

    def example(self) -> dict[str, Any]:
        return {"key": projects.new_example(self.root).key}

    # One item

    def item(self, key: str) -> Item:
        return find_item(self.root, key)

    def detail(self, item: Item) -> dict[str, Any]:
        """Contents of an item's page."""
        record, job = item.record, read_job(item)
        files = pictures.photographs_of(item)
        runs = [rows.run_row(path) for path in item.runs]
        making = self.runner.making
        faults = [pictures.listing_fault(item), *(run.get("fault", "") for run in runs)]
        result = None
        try:
            result = rows.result_of(item)
        except LumigraphError as fault:
            faults.append(str(fault))
        return {
            "key": item.key,
            "kind": item.kind,
            "title": record.title,
            "phone": f"{url}#{item.key}" if (url := self.phone_url) else "",
            "folder": str(item.path),
            "local": self.is_local,
            "source": record.source,
            "photographs": [
                {"name": name, "version": pictures.version_of(path), "video": pictures.is_film(path)}
                for name, path in files.items()
            ],
            "runs": runs,
            "make": rows.making_row(item, job.make) if job.make else None,
            "live": making is not None and making.item == item and making.viewer is not None,
            "shares": [rows.share_row(item, share) for share in reversed(job.shares)],
            "result": result,
            "faults": list(filter(None, faults)),
            "ahead": self.ahead(item),
        }

    def ahead(self, item: Item) -> dict[str, Any] | None:
        """Title of the scene that a waiting one waits for, seconds until that ends if known, and how many wait before
        it."""
        making = self.runner.making
        if making is None or making.item == item or not isinstance(job := making.job, Making):
            return None
        waiting = [task.item for task in self.runner.queue() if task.share is None and task.item != making.item]
        left = progress.progress_of(making.item, job).get("left")
        between = waiting.index(item) if item in waiting else 0
        return {"title": making.item.record.title, "left": left, "between": between}

    def estimates(self, item: Item) -> dict[str, Any]:
        """Seconds that each quality would take of each method, from what earlier ones took on this machine."""
        return pace.estimates(item)

    def put_first(self, item: Item) -> dict[str, Any]:
        self.runner.put_first(item)
        return self.detail(item)

    def advice(self, item: Item) -> list[dict[str, Any]]:
        return [{"text": one.text, "names": one.names} for one in pictures.advice(pictures.photographs_of(item))]

    def rename(self, item: Item, body: TitleBody) -> dict[str, Any]:
        self.views.close(item.path)
        return {"key": projects.rename(item, body.title).key}

    def duplicate(self, item: Item) -> dict[str, Any]:
        if (making := self.runner.making) and making.item == item:
            raise LumigraphError("This scene is being made; pause it first, then duplicate it")
        return {"key": projects.duplicate(item).key}

    def delete(self, item: Item) -> dict[str, Any]:
        self.views.close(item.path)
        self.runner.release(item)
        return {"trash": projects.delete(item)}

    def make(self, item: Item, body: MakeBody) -> dict[str, Any]:
        name = methods.check(body.method)
        if item.kind == "scene":  # which stays as it is
            item = projects.new_project(self.root, item.path.name, item.path)
        relocate(item)
        budget = {"seconds": 60 * body.minutes} if body.minutes else {"quality": body.quality}
        rest = {"mapper": body.mapper, "frames": body.frames, "downscale": body.downscale}
        jobs.make(item, method=name, mask_object=body.mask_object, **rest, **budget)
        self.runner.wake()
        return self.detail(item)

    def stop(self, item: Item, state: JobState) -> dict[str, Any]:
        job = read_job(item).make
        if job is None or job.state not in ("queued", "running", "paused"):
            raise LumigraphError("Nothing is being made here any more")
        self.runner.stop(jobs.QueuedJob(item, None), state)
        return self.detail(item)

    def more(self, item: Item, body: MoreBody) -> dict[str, Any]:
        budget: dict[str, Any] = {"quality": body.quality} if body.quality else {}
        if body.minutes:
            budget = {"seconds": 60 * body.minutes}
        job = read_job(item).make
        if budget and job and (job.state, job.stage) == ("running", "train"):
            self.runner.extend(item, **budget)
            return self.detail(item)
        self.views.close(item.path)
        relocate(item)
        jobs.go_on(item, **budget)
        self.runner.wake()
        return self.detail(item)

    def leave_out(self, item: Item, name: str) -> dict[str, Any]:
        """Move an uploaded photograph out of the scene, into a folder beside the photographs."""
        is_own = item.kind == "project" and not item.record.source
        if not is_own or pictures.named_file(item.photographs, name) is None:
            raise LumigraphError(f"{name[:80]!r} is not among the uploaded photographs; load the page again")
        uploads.album(item.photographs).leave_out(name, item.path / "left-out")
        return self.detail(item)

    def upload(self, key: str, name: str, size: str, content: str) -> uploads.Upload:
        item = self.item(key)
        if item.kind != "project" or item.record.source:
            raise LumigraphError("Photographs can be added to scenes that were made by uploads; make a new one")
        return uploads.upload(item.photographs, name, whole(size), content)

    def share(self, item: Item, body: ShareBody) -> dict[str, Any]:
        job = sharing.share_job(item, body.kind, item.run(body.run), time.time(), body.size)
        jobs.ask_to_share(item, job)
        self.runner.wake()
        return self.detail(item)

    def kinds(self, item: Item, body: RunBody) -> list[dict[str, Any]]:
        return sharing.kinds_for(item.run(body.run))

    def reveal(self, item: Item) -> dict[str, Any]:
        if not self.is_local:
            raise LumigraphError("A folder is shown to browsers on its machine; download the file instead")
        sharing.reveal(item.path / SHARED)
        return {}

    def view(self, item: Item, run: str) -> dict[str, Any]:
        """Address of the scene view of a run, and whether it answers."""
        making = self.runner.making
        if not run and making and making.item == item and (viewer := making.viewer):
            return {"url": f"/scene/{quote(item.key)}/live/", "ready": answers(viewer)}
        path = item.run(run) if run else next(iter(reversed(item.runs)), None)
        if path is None:
            raise LumigraphError("There is no run to show yet")
        relocate(item)
        view = self.views.open(path)
        return {"url": f"/scene/{quote(item.key)}/{quote(path.name)}/", "ready": self.views.is_ready(view)}

    def viewer_of(self, key: str, run: str) -> tuple[Address | None, SceneView | None]:
        """Address of the viewer behind a scene's address, and its view; None if there is none."""
        item, making = self.item(key), self.runner.making
        if run == "live":
            return (making.viewer if making and making.item == item else None), None
        view = self.views.views.get(item.run(run))
        return (view.address if view else None), view


def check_source(source: Path) -> None:
    """Raise LumigraphError unless a path on this machine is a photograph folder, a video or a scene."""
    if not source.exists():
        raise LumigraphError(f"{source} does not exist; check the path")
    poses = any((source / name).exists() for name in projects.SCENE_FILES)
    if not poses and not pictures.files_of(source) or (source.is_file() and not pictures.is_film(source)):
        raise LumigraphError(f"{source} holds no photographs and no video; name another folder")


# Routes


class RequestHandlers:
    """Answers of an app to the requests of the routes of `build`."""

    def __init__(self, app: App):
        self.app = app

    def asked(self, kind: Any, answer: Callable[..., Any]) -> Callable[[Request], Awaitable[Response]]:
        """Route that reads a JSON body of a kind (None for none) and answers with JSON from a thread."""

        async def route(request: Request) -> Response:
            arguments: list[Any] = []
            if "key" in request.path_params:
                arguments.append(await asyncio.to_thread(self.app.item, request.path_params["key"]))
            if kind is not None:
                arguments.append(await body_of(request, kind))
            return Answer(await asyncio.to_thread(answer, *arguments))

        return route

    async def page(self, request: Request) -> Response:
        name = request.path_params.get("name", "index.html")
        if name not in os.listdir(PAGE):
            return PlainTextResponse("There is no such file.\n", 404)
        about = {"Cache-Control": "no-cache", "Content-Security-Policy": CONTENT_SECURITY}
        return FileResponse(PAGE / name, media_type=MEDIA_TYPES[Path(name).suffix], headers=about)

    async def opened(self, request: Request) -> uploads.Upload:
        about = (request.query_params.get(name, "") for name in ("name", "size", "hash"))
        return await asyncio.to_thread(self.app.upload, request.path_params["key"], *about)

    async def take(self, request: Request) -> Response:
        offset = whole(request.query_params.get("offset", "0"))
        return Answer(asdict(await (await self.opened(request)).take(offset, request.stream())))

    async def have(self, request: Request) -> Response:
        return Answer(asdict(await asyncio.to_thread((await self.opened(request)).arrived)))

    async def leave_out(self, request: Request) -> Response:
        item = await asyncio.to_thread(self.app.item, request.path_params["key"])
        return Answer(await asyncio.to_thread(self.app.leave_out, item, request.query_params.get("name", "")))

    async def picture(self, request: Request) -> Response:
        item, query = await asyncio.to_thread(self.app.item, request.path_params["key"]), request.query_params
        found = await asyncio.to_thread(rows.picture, item, query.get("name", ""), query.get("run", ""))
        side = min(max(whole(query.get("side", "320")), 16), 2048)
        is_large = await asyncio.to_thread(pictures.is_large_file, found)
        small = await self.app.later(pictures.thumbnail, found, side, is_large=is_large)
        kept = "max-age=86400" if "v" in query else "no-cache"
        return Response(small, media_type="image/jpeg", headers={"Cache-Control": kept})

    async def advice(self, request: Request) -> Response:
        return Answer(await self.app.later(self.app.advice, self.app.item(request.path_params["key"])))

    async def marks(self, request: Request) -> Response:
        item, name = self.app.item(request.path_params["key"]), request.query_params.get("name", "")
        return Answer(await asyncio.to_thread(progress.features, item, name))

    async def code(self, request: Request) -> Response:
        if not self.app.phone_url:
            raise LumigraphError("Other machines cannot reach the app; start it with --host 0.0.0.0")
        key = request.query_params.get("key", "")
        url = f"{self.app.phone_url}#{self.app.item(key).key}" if key else self.app.phone_url
        return Response(qr_code(url), media_type="image/svg+xml", headers={"Cache-Control": "no-store"})

    async def shared(self, request: Request) -> Response:
        item, name = self.app.item(request.path_params["key"]), request.path_params["name"]
        place = item.path / SHARED / name
        if not projects.is_plain_name(name) or place.is_symlink() or not place.is_file():
            raise LumigraphError(f"There is no file {name[:80]!r} here; make it again")
        shows = "inline" if "show" in request.query_params else "attachment"
        title = item.record.title.translate(NO_FILE_NAME).strip(". ") or place.stem
        return FileResponse(place, filename=title + place.suffix, content_disposition_type=shows, headers=SHOWN_HEADERS)

    async def forget(self, request: Request) -> Response:
        item = await asyncio.to_thread(self.app.item, request.path_params["key"])
        await asyncio.to_thread(jobs.forget_share, item, request.path_params["name"])
        return Answer(await asyncio.to_thread(self.app.detail, item))

    async def restore(self, request: Request) -> Response:
        item = await asyncio.to_thread(projects.restore, self.app.root, request.path_params["name"])
        return Answer({"key": item.key})

    async def scene(self, request: Request) -> Response:
        viewer, _ = self.app.viewer_of(request.path_params["key"], request.path_params["run"])
        if viewer is None:
            return PlainTextResponse("This scene is not open; load the page again.\n", 404)
        return await forward(request, viewer, "/" + quote(request.path_params.get("rest", "")))

    async def scene_socket(self, socket: WebSocket) -> None:
        try:
            viewer, view = self.app.viewer_of(socket.path_params["key"], socket.path_params["run"])
        except LumigraphError:
            viewer, view = None, None
        if viewer is None:
            await socket.close(1013)
            return
        await forward_messages(socket, viewer, view)


def build(app: App) -> ASGIApp:
    """The ASGI application: routes behind the guard."""
    here = RequestHandlers(app)
    item = "/api/items/{key}"
    routes = [
        Route("/", here.page),
        Route("/static/{name}", here.page),
        Route("/api/home", here.asked(None, app.home)),
        Route("/api/phone.svg", here.code),
        Route("/api/projects", here.asked(NewBody, app.new), methods=["POST"]),
        Route("/api/example", here.asked(None, app.example), methods=["POST"]),
        Route("/api/trash", here.asked(None, lambda: projects.empty_trash(app.root)), methods=["DELETE"]),
        Route("/api/trash/{name}", here.restore, methods=["POST"]),
        Route(item, here.asked(None, app.detail)),
        Route(item, here.asked(TitleBody, app.rename), methods=["PATCH"]),
        Route(item, here.asked(None, app.delete), methods=["DELETE"]),
        Route(f"{item}/duplicate", here.asked(None, app.duplicate), methods=["POST"]),
        Route(f"{item}/photographs", here.take, methods=["PUT"]),
        Route(f"{item}/photographs", here.have),
        Route(f"{item}/photographs", here.leave_out, methods=["DELETE"]),
        Route(f"{item}/advice", here.advice),
        Route(f"{item}/picture", here.picture),
        Route(f"{item}/states", here.asked(None, progress.photographs_state)),
        Route(f"{item}/features", here.marks),
        Route(f"{item}/model", here.asked(None, progress.model)),
        Route(f"{item}/make", here.asked(MakeBody, app.make), methods=["POST"]),
        Route(f"{item}/pause", here.asked(None, lambda one: app.stop(one, "paused")), methods=["POST"]),
        Route(f"{item}/stop", here.asked(None, lambda one: app.stop(one, "stopped")), methods=["POST"]),
        Route(f"{item}/more", here.asked(MoreBody, app.more), methods=["POST"]),
        Route(f"{item}/first", here.asked(None, app.put_first), methods=["POST"]),
        Route(f"{item}/estimates", here.asked(None, app.estimates)),
        Route(f"{item}/view", here.asked(RunBody, lambda one, body: app.view(one, body.run)), methods=["POST"]),
        Route(f"{item}/kinds", here.asked(RunBody, app.kinds), methods=["POST"]),
        Route(f"{item}/shares", here.asked(ShareBody, app.share), methods=["POST"]),
        Route(f"{item}/reveal", here.asked(None, app.reveal), methods=["POST"]),
        Route(f"{item}/shares/{{name}}", here.shared),
        Route(f"{item}/shares/{{name}}", here.forget, methods=["DELETE"]),
        Route("/scene/{key}/{run}/{rest:path}", here.scene),
        WebSocketRoute("/scene/{key}/{run}", here.scene_socket),
        WebSocketRoute("/scene/{key}/{run}/", here.scene_socket),
    ]
    faults: Any = dict.fromkeys((LumigraphError, OSError, ClientDisconnect, msgspec.MsgspecError), refused)
    inner = Starlette(routes=routes, exception_handlers=faults, lifespan=lambda _: living(app))
    return Gate(inner, app.address)


NO_FILE_NAME = str.maketrans(dict.fromkeys('<>:"/\\|?*', "-"))  # letters that no system takes in a name
# A page that was made to share runs its program apart from the app's own address, and reaches no network.
SANDBOX = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; connect-src data: blob:; frame-ancestors 'self'"
)
SHOWN_HEADERS = {"Content-Security-Policy": SANDBOX, "Cache-Control": "no-cache"}


def qr_code(text: str) -> bytes:
    """SVG of a QR code."""
    import segno

    out = io.BytesIO()
    segno.make(text, error="m", micro=False).save(out, kind="svg", scale=5, border=3, light="#fff")
    return out.getvalue()


async def body_of(request: Request, kind: Any) -> Any:
    """Body of a request, parsed as a kind. Raises LumigraphError for anything else."""
    data = b""
    async for piece in request.stream():
        data += piece
        if len(data) > MAX_BODY_BYTES:
            raise LumigraphError("The request is too long")
    return msgspec.json.decode(data or b"{}", type=kind)


def whole(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 15:
        raise LumigraphError(f"{text[:20]!r} is no size; load the page again")
    return int(text)


def refused(request: Request, fault: Exception) -> Response:
    """Error response of one sentence."""
    if isinstance(fault, uploads.MisplacedError):
        return Answer({"fault": str(fault), "have": fault.have}, 409)
    if isinstance(fault, uploads.DiskFullError):
        return Answer({"fault": str(fault)}, 507)
    if isinstance(fault, LumigraphError):
        return Answer({"fault": str(fault)}, 400)
    if isinstance(fault, msgspec.MsgspecError):
        return Answer({"fault": f"The page and the app do not fit ({fault}); load the page again"}, 400)
    if isinstance(fault, ClientDisconnect):
        return Answer({"fault": "The connection ended"}, 400)
    assert isinstance(fault, OSError)
    return Answer({"fault": refusal(Path(os.fsdecode(fault.filename or "A file")), fault)}, 400)


@contextlib.asynccontextmanager
async def living(app: App) -> AsyncIterator[None]:
    """Lifetime of the server: jobs and viewers end with it."""

    async def sweep() -> None:
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            app.views.sweep()

    app.runner.begin()
    sweeping = asyncio.create_task(sweep())
    try:
        yield
    finally:
        sweeping.cancel()
        app.views.close_all()
        await asyncio.to_thread(app.runner.end)


class Announcing(uvicorn.Server):
    """A server with a callback when it is ready."""

    def __init__(self, config: uvicorn.Config, opened: Callable[[], object]):
        super().__init__(config)
        self.opened = opened

    async def startup(self, sockets: Any = None) -> None:
        await super().startup(sockets)
        self.opened()


def serve(root: Path, address: Address, opened: Callable[[], object]) -> None:
    """Serve a folder until Ctrl-C. opened: called when the server is ready

    Raises LumigraphError if another app serves the folder.
    """
    place = root / APP_FOLDER
    for folder in (place, projects.trash_folder(root)):
        refuse_link(folder)
    place.mkdir(parents=True, exist_ok=True)
    with lock_folder(place, "served"):
        app = App(root, address)
        config = uvicorn.Config(
            build(app),
            host=address.host,
            port=address.port,
            log_level="error",
            access_log=False,
            ws="websockets-sansio",
            ws_max_size=MAX_MESSAGE_BYTES,
            ws_per_message_deflate=False,
            server_header=False,
            timeout_graceful_shutdown=2,
        )
        Announcing(config, opened).run()
