"""Received folders: nothing in them runs, and nothing that they name is written to."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

import pytest
from budgets import budget
from starlette.testclient import TestClient
from test_app import BASE, app, calls, client, jpeg, let, project, put, running, state  # noqa: F401
from waiting import until

from lumigraph.app import jobs, sharing
from lumigraph.app.job_record import NOT_SEALED, read_job, user_key
from lumigraph.app.projects import LOG_FILE, WRITTEN, find_item, new_project
from lumigraph.app.scene_views import SceneView, SceneViews
from lumigraph.app.server import App, build, serve
from lumigraph.commands.app import door
from lumigraph.commands.request import command_of
from lumigraph.errors import LumigraphError
from lumigraph.run import Run
from lumigraph.viewer.address import Address, choose_address, new_token

pytestmark = budget("exports", 12)

PACKAGE = Path(__file__).parents[1] / "lumigraph"
EVIL = "import pathlib; (pathlib.Path(__file__).parent / 'RAN').touch(); raise SystemExit('a received file ran')\n"
# Imported by commands, or by Python as it begins.
MODULES = {"numpy", "torch", "numba", "tyro", "msgspec", "PIL", "scipy", "rich", "lumigraph", "sitecustomize"}
TITLES = ["--method-file=/tmp/x.py", "--help", "a\nb\0c", "x" * 10_000, "<script>alert(1)</script>", "\u202egpj"]


def with_evil_modules(folder: Path, leave: set[str] = frozenset()) -> Path:
    """A folder with a module of each name that a command imports, and a configuration of Numba."""
    for name in (MODULES | set(sys.stdlib_module_names)) - {"antigravity", *leave}:
        (folder / f"{name}.py").write_text(EVIL)
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {folder}\ncache_locator_classes: numpy.Evil\n")
    return folder


# Where children begin

STARTERS = {"Popen", "run", "call", "check_call", "check_output", "system", "popen", "execv", "execve", "spawnv"}

BEGINNERS = re.compile(r"\b(subprocess|os|multiprocessing|pty|asyncio)\b")


def test_one_function_begins_processes():
    """Beside it: COLMAP's worker, which imports nothing of ours, and the file manager."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        source = path.read_text("utf-8")
        for node in ast.walk(ast.parse(source)) if BEGINNERS.search(source) else ():
            match node:
                case ast.Call(func=ast.Attribute(value=ast.Name(id="subprocess" | "os"), attr=name)) if (
                    name in STARTERS
                ):
                    found.add(path.relative_to(PACKAGE).as_posix())
                case ast.Import(names=[ast.alias(name="multiprocessing" | "pty")]):
                    found.add(path.relative_to(PACKAGE).as_posix())
                case ast.Attribute(
                    value=ast.Name(id="asyncio"), attr="create_subprocess_exec" | "create_subprocess_shell"
                ):
                    found.add(path.relative_to(PACKAGE).as_posix())
    assert found == {"system/children.py", "sfm/worker.py", "app/sharing.py"}
    assert '[sys.executable, "-P", str(COUNTER)' in (PACKAGE / "sfm/worker.py").read_text("utf-8")


@pytest.mark.parametrize("module", [True, False])
def test_a_terminal_in_a_received_folder_runs_nothing_of_it(tmp_path, ball_run, module):
    shutil.copytree(ball_run.path, run := tmp_path / "run")
    with_evil_modules(run, {"lumigraph"} if module else set())  # Python itself finds a lumigraph.py for -m
    program = [sys.executable, "-m", "lumigraph"] if module else [str(Path(sys.executable).with_name("lumigraph"))]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment["PYTHONPATH"] = str(PACKAGE.parent)
    done = subprocess.run([*program, "info", "."], cwd=run, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and "a run of voxel-grid" in done.stdout, done.stderr
    assert not (run / "RAN").exists()


@pytest.mark.parametrize("title", TITLES)
def test_the_text_of_a_request_stays_a_value(title):
    options = {"source": "/runs/a", "output": "/shared/a.html", "title": title}
    command = command_of(json.dumps({"command": "export web", "options": options}).encode())
    assert command.title == title and command.source == Path("/runs/a")


@pytest.mark.parametrize(
    ("request_", "sentence"),
    [
        ({"command": "--method-file=x.py"}, "no command"),
        ({"command": "export"}, "no command"),
        ({"command": "train", "options": {"method": "--method-file=evil.py", "scene": "a"}}, "No method"),
        ({"command": "view", "options": {"source": "a", "method_file": "x.py"}}, "nothing is known of 'method_file'"),
        ({"command": "view", "options": {"source": "a\0b"}}, "source"),
        ({"command": "view", "options": {"source": "a", "port": 10**9}}, "from 1 to 65,535"),
        ({"command": "view", "options": [1]}, "options"),
        ({"command": "view", "words": ["--help"]}, "nothing is known of 'words'"),
        ([], "should"),
    ],
)
def test_requests_that_no_app_makes_are_refused(request_, sentence):
    with pytest.raises(LumigraphError, match=sentence):
        command_of(json.dumps(request_).encode())


# Records of a received project


HOSTILE = {
    "make": {"state": "queued", "asked": 1.0, "method": "--method-file=evil.py", "stage": "train"},
    "shares": [
        {
            "name": "x.html",
            "kind": "page",
            "run": "a",
            "options": ["--method-file=e.py"],
            "state": "running",
            "asked": 1,
        }
    ],
}


def received(item, **changes) -> None:
    (item.path / "job.json").write_text(json.dumps(HOSTILE | changes))


def test_jobs_that_this_app_did_not_write_wait_for_a_click(app, project):  # noqa: F811
    item = find_item(app.root, project)
    (item.path / "photos" / "a.jpg").write_bytes(jpeg())
    received(item)
    let(app)
    with TestClient(build(app), base_url=BASE) as client:  # noqa: F811
        shown = client.get(f"/api/items/{project}").json()
        assert (shown["make"]["state"], shown["make"]["fault"]) == ("paused", NOT_SEALED)
        assert shown["shares"][0]["state"] == "failed" and client.get("/api/home").json()["queue"] == []
        time.sleep(0.3)
        assert calls(app, project) == [] and app.runner.queue() == []
        client.post(f"/api/items/{project}/more", json={})  # the click
        until(lambda: state(client, project) == "failed")
        assert "No method '--method-file=evil.py' is installed" in read_job(item).make.fault
        assert calls(app, project) == []


def test_a_sealed_job_goes_on_and_a_changed_one_does_not(app, project):  # noqa: F811
    item = find_item(app.root, project)
    (item.path / "photos" / "a.jpg").write_bytes(jpeg())
    jobs.make(item)
    assert len(app.runner.queue()) == 1
    place = item.path / "job.json"
    place.write_text(place.read_text().replace("gaussian-splatting", "instant-ngp"))
    assert app.runner.queue() == [] and read_job(item).make.state == "paused"
    jobs.make(item)
    jobs.ask_to_share(item, sharing.ShareJob("a.html", "page", "a", "done", 1.0))
    shutil.copytree(item.path, app.root / "received")  # sealed by this user, at another place
    assert [task.item.key for task in app.runner.queue()] == [project]
    pages = [read_job(find_item(app.root, key)).shares[0].state for key in (project, "received")]
    assert pages == ["done", "failed"]  # a page opens by itself, but none that came with a project


@pytest.mark.parametrize(
    "share",
    [{"name": "../../up.html"}, {"name": ".hidden"}, {"name": "a/b"}, {"kind": "rm"}, {"run": "../a"}, {"size": -1}],
)
def test_records_that_lead_elsewhere_are_refused(app, client, project, share):  # noqa: F811
    item = find_item(app.root, project)
    received(item, shares=[HOSTILE["shares"][0] | share])
    assert "job.json" in client.get(f"/api/items/{project}").json()["fault"]
    received(item, make=HOSTILE["make"] | {"run": "../../evil"})
    assert "job.json" in client.post(f"/api/items/{project}/more", json={}).json()["fault"]


@pytest.mark.parametrize("title", TITLES)
def test_a_received_title_is_one_readable_line(app, client, project, title):  # noqa: F811
    place = app.root / project / "project.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | {"title": title}))
    shown = client.get(f"/api/items/{project}").json()["title"]
    assert shown.isprintable() and 0 < len(shown) <= 120
    share = sharing.ShareJob("x.html", "page", "a", "queued", 1.0)
    (app.root / project / "runs" / "a").mkdir(parents=True)
    (app.root / project / "runs" / "a" / "config.json").write_text("{}")
    request = sharing.share_request(find_item(app.root, project), share)
    assert request.command == "export web" and request.options["title"] == shown


def test_files_to_share_hold_no_place_on_earth(app, project):  # noqa: F811
    (app.root / project / "runs" / "a").mkdir(parents=True)
    (app.root / project / "runs" / "a" / "config.json").write_text("{}")
    asked = {}
    for kind in sharing.KINDS:
        share = sharing.ShareJob(f"x{sharing.KINDS[kind].ending}", kind, "a", "queued", 1.0)
        request = sharing.share_request(find_item(app.root, project), share)
        command = command_of(json.dumps(asdict(request)).encode())
        asked[kind] = getattr(command, "origin", False)  # pages, films and splats have none
    assert asked == dict.fromkeys(sharing.KINDS, False)


# Links


@pytest.mark.parametrize("name", [*WRITTEN, "."])
def test_linked_folders_of_a_project_are_refused(app, client, project, tmp_path, name):  # noqa: F811
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "project.json").write_text('{"title": "x", "made": 1}')
    before = sorted(outside.rglob("*"))
    place = app.root / project / name
    shutil.rmtree(place, ignore_errors=True)
    place.symlink_to(outside)
    assert "is a link" in put(client, project, "a.jpg", jpeg()).json()["fault"]
    for method, path in (("POST", "/make"), ("POST", "/reveal"), ("POST", "/duplicate"), ("DELETE", "")):
        answer = client.request(method, f"/api/items/{project}{path}", json={} if path == "/make" else None)
        assert "is a link" in answer.json()["fault"]
    assert sorted(outside.rglob("*")) == before


def test_the_log_of_a_job_is_no_link(app, running, project, tmp_path):  # noqa: F811
    secret = tmp_path / "secret"
    secret.write_text("kept")
    let(app)
    put(running, project, "a.jpg", jpeg())
    item = find_item(app.root, project)
    (item.path / LOG_FILE).symlink_to(secret)
    assert jobs.log_lines(item) == []
    running.post(f"/api/items/{project}/make", json={})
    until(lambda: state(running, project) == "failed")
    assert secret.read_text() == "kept" and "is a link" in read_job(item).make.fault
    (item.path / LOG_FILE).unlink()
    (item.path / "scene" / "work").mkdir(parents=True)
    (item.path / "scene" / "work" / "database.db").symlink_to(secret)
    running.post(f"/api/items/{project}/more", json={})
    until(lambda: state(running, project) == "failed")
    assert calls(app, project) == [] and secret.read_text() == "kept"


def test_a_received_run_does_not_lead_its_files_elsewhere(tmp_path, ball_run):
    shutil.copytree(ball_run.path, folder := tmp_path / "run")
    (tmp_path / "secret").write_text("kept")
    (folder / "metrics.jsonl").unlink()
    (folder / "metrics.jsonl").symlink_to(tmp_path / "secret")
    (folder / "renders").symlink_to(tmp_path)
    with pytest.raises(LumigraphError, match="is a link"), Run(folder).lock():
        pass
    with pytest.raises(LumigraphError, match="is a link"):
        _ = Run(folder).renders


def test_the_app_keeps_no_files_behind_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / ".lumigraph-app").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(LumigraphError, match="is a link"):
        serve(tmp_path / "scenes", Address("127.0.0.1", 8080), lambda: None)
    assert list((tmp_path / "elsewhere").iterdir()) == []


# Who may look


def test_the_key_of_seals_is_of_this_user_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("LUMIGRAPH_CACHE", str(tmp_path / "cache"))
    user_key.cache_clear()
    key = user_key()
    user_key.cache_clear()
    assert user_key() == key and len(key) == 32
    assert (tmp_path / "cache" / "app.key").stat().st_mode & 0o777 == 0o600
    monkeypatch.setenv("LUMIGRAPH_CACHE", str(tmp_path / "cache" / "app.key" / "none"))  # cannot be written
    user_key.cache_clear()
    assert user_key() == user_key() != key
    user_key.cache_clear()


class Child:
    """In place of a viewer's process."""

    def poll(self) -> None:
        return None

    def send_signal(self, number: int) -> None: ...

    def wait(self, seconds: float) -> None: ...


def test_nobody_loses_a_viewer_that_is_in_use(tmp_path, monkeypatch):
    views = SceneViews(tmp_path, ["-S", "-c", "import sys, time; print(sys.stdin.read()); time.sleep(9)"])
    monkeypatch.setattr("lumigraph.app.scene_views.free_memory", lambda: 1 << 30)
    for number, name in enumerate(("a", "b")):
        views.views[tmp_path / name] = SceneView(Address("127.0.0.1", number + 1), Child(), tmp_path / name, 1)
    with pytest.raises(LumigraphError, match="2 scenes are open already"):
        views.open(tmp_path / "c")
    views.views[tmp_path / "a"].connections = 0
    views.views[tmp_path / "a"].used -= 60
    view = views.open(tmp_path / "c")
    assert set(views.views) == {tmp_path / "b", tmp_path / "c"}
    with pytest.raises(LumigraphError, match="scenes are open already"):
        views.open(tmp_path / "d")  # the page of c is still loading
    asked = json.loads(until(lambda: view.log.read_text().strip()))
    assert asked["options"]["token"] == view.address.token and len(view.address.token) > 20
    assert view.log.stat().st_mode & 0o777 == 0o600
    arguments = Path(f"/proc/{view.child.pid}/cmdline")
    assert not arguments.exists() or view.address.token not in arguments.read_text()
    views.close_all()


def test_a_viewer_of_the_app_answers_with_its_token_alone():
    token = new_token()
    address = choose_address("127.0.0.1", None, token)  # without a warning: nobody else can reach it
    assert address.token == token and address.cookie.endswith(f"={token}")


def test_the_token_is_no_argument_of_the_browser():
    with door(Address("127.0.0.1", 8080)) as url:
        assert url == "http://127.0.0.1:8080"
    with door(Address("0.0.0.0", 8080, "secret")) as url:
        page = Path(url.removeprefix("file://"))
        assert "secret" not in url and "?token=secret" in page.read_text()
        assert page.parent.stat().st_mode & 0o777 == 0o700 and page.stat().st_mode & 0o777 == 0o600
    assert not page.exists()


def test_an_item_that_is_moved_in_begins_nothing(tmp_path):
    """A project that was received while the app does not run."""
    item = new_project(tmp_path, "Garden")
    received(item)
    app = App(tmp_path, Address("127.0.0.1", 8080), ["-S", "-c", "raise SystemExit"])  # noqa: F811
    app.runner.begin()
    time.sleep(0.3)
    app.runner.end()
    assert json.loads((item.path / "job.json").read_text()) == HOSTILE and not (item.path / LOG_FILE).exists()
