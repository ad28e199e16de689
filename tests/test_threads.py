"""How threads wait: what Lumigraph settles before PyTorch and Numba are loaded, and what it leaves to the user."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import tiny
import torch

from lumigraph.commands.cli import main
from lumigraph.errors import LumigraphError
from lumigraph.evaluation.options import EvaluationOptions
from lumigraph.evaluation.views import evaluate
from lumigraph.export.options import PointsOptions
from lumigraph.export.points import extract_points
from lumigraph.system import threads, work
from lumigraph.system.allocation import USER_SETTINGS
from lumigraph.system.work import OPT_OUT
from lumigraph.training import fit

LOOP = """
import lumigraph, torch, numba, numpy
from lumigraph.camera.loops import undistort
none = numpy.zeros((0, 2), numpy.float32)
undistort(none, numpy.zeros(0, int), none, none, none, none, 1, 0.1, numpy.zeros((0, 3), numpy.float32))
torch.ones(1 << 18).exp().sum()
print(numba.threading_layer())
"""

MEMORY = """
import ctypes, resource, threading
from lumigraph.commands import cli
cli.main(["methods"])
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p
def step():
    taken = [ctypes.c_void_p(libc.malloc(50 << 20)) for _ in range(2)]
    for place in taken:
        ctypes.memset(place, 1, 50 << 20)
    for place in taken:
        libc.free(place)
step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    step()
print("faults", resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before, flush=True)
alive = threading.Barrier(4)  # who comes after another has ended takes over its arena
def take():
    alive.wait()
    for _ in range(1000):
        libc.malloc(1000)
    alive.wait()
takers = [threading.Thread(target=take) for _ in range(4)]
for taker in takers:
    taker.start()
for taker in takers:
    taker.join()
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
"""

LOOKING = """
import threading, time
import torch  # ahead of Lumigraph, as in many scripts: Numba then has a copy of OpenMP of its own
from lumigraph.system import threads
import numpy
from lumigraph.camera.loops import undistort
numbers, pixels = torch.ones(torch.get_num_threads() << 16), numpy.ones((1 << 12, 2), numpy.float32)
pair, bend, out = pixels[:1], numpy.zeros((1, 8), numpy.float32), numpy.zeros((1 << 12, 3), numpy.float32)
def by_torch():
    numbers.exp()
def by_numba():
    undistort(pixels, numpy.zeros(0, int), pair, pair, bend, pair, 1, 0.1, out)
def looking(work):
    spent = 0.0
    for _ in range(10):
        work()
        begin = time.process_time()
        time.sleep(0.02)
        spent += time.process_time() - begin
    return spent
for work in (by_torch, by_numba):
    looking(work)
    alone, leave = looking(work), threading.Event()
    crowd = threading.Thread(target=threads.crowd, args=(leave,))
    crowd.start()
    time.sleep(0.2)
    print(alone, looking(work))
    leave.set()
    crowd.join()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="GNU's OpenMP")
def test_torch_and_numba_share_one_set_of_threads_which_wait_for_a_bounded_time():
    environment = {name: value for name, value in os.environ.items() if name not in threads.USER_SETTINGS}
    environment |= {"PYTHONPATH": str(Path(__file__).parent.parent), "OMP_DISPLAY_ENV": "VERBOSE"}
    told = subprocess.run([sys.executable, "-c", LOOP], env=environment, capture_output=True, text=True, check=True)
    copies = told.stderr.split("OPENMP DISPLAY ENVIRONMENT BEGIN")[1:]  # each copy of the library says so when loaded
    assert len(copies) == 1
    assert f"GOMP_SPINCOUNT = '{threads.SPIN_COUNT}'" in copies[0]
    assert told.stdout.strip() == "omp"  # TBB's threads, where it is installed, would delay the end of the process


@pytest.mark.parametrize("own", threads.USER_SETTINGS)
def test_a_users_own_way_of_waiting_stays(own):
    environment = {own: "1", "NUMBA_THREADING_LAYER_PRIORITY": "tbb"}
    before = dict(environment)
    threads.settle(environment)
    assert environment == before


def test_a_busy_machine_is_told(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(threads, "processors", lambda: 2)
    monkeypatch.setattr(os, "getloadavg", lambda: (1.5, 0.0, 0.0))
    assert threads.description() == "2 threads"
    monkeypatch.setattr(os, "getloadavg", lambda: (3.25, 0.0, 0.0))
    assert threads.description() == "2 threads, on a machine that is busy (load 3.2)"


def test_threads_sleep_for_a_while_when_others_hold_them_up(monkeypatch):
    threads.WATCH.stop()  # of earlier tests
    monkeypatch.setattr(threads, "POLL_SECONDS", 0.0)
    monkeypatch.setattr(threads, "SLEEP_POLLS", 3)
    shares, log, over = iter([0.0, 0.1, 0.9, 0.0, 0.9, 0.9, 0.0, 0.5]), [], threading.Event()

    def held() -> float:
        share = next(shares, None)
        if share is None:
            over.set()
        return share or 0.0

    def crowd(leave: threading.Event) -> None:
        log.append(leave)
        leave.wait(10)
        time.sleep(0.05)  # as PyTorch takes a moment to come back

    monkeypatch.setattr(threads, "crowd", crowd)
    threads.make_way(over, held)
    assert "crowd" not in [thread.name for thread in threading.enumerate()]  # Python that ended now would abort
    assert len(log) == 2  # at 0.9 until three looks later, and at 0.5
    assert all(leave.is_set() for leave in log)


@pytest.fixture
def watch(monkeypatch):
    """A watch of one's own, in an environment in which threads may be watched."""
    made = threads.ContentionWatch()
    monkeypatch.setattr(threads, "WATCH", made)
    monkeypatch.setenv("GOMP_SPINCOUNT", str(threads.SPIN_COUNT))
    monkeypatch.delenv(OPT_OUT, raising=False)
    yield made
    made.stop()


@pytest.mark.skipif(not threads.TASKS_FOLDER.exists(), reason="tells what threads wait for by /proc")
def test_the_watch_outlives_short_work_and_ends_after_it(watch, monkeypatch):
    monkeypatch.setattr(threads, "POLL_SECONDS", 0.01)
    monkeypatch.setattr(threads, "LINGER_SECONDS", 0.3)
    with threads.considerate():
        first = watch._thread
        with threads.considerate():
            assert watch._thread is first and watch.running
    with threads.considerate():
        assert watch._thread is first
        time.sleep(0.5)
        assert watch.running  # as long as anybody works
    first.join(10)
    assert not watch.running
    with threads.considerate():
        assert watch.running and watch._thread is not first


@pytest.mark.skipif(not threads.TASKS_FOLDER.exists(), reason="tells what threads wait for by /proc")
@pytest.mark.parametrize("way", ["fit", "render", "evaluate", "export", "cli"])
def test_python_works_as_the_command_line_does(watch, monkeypatch, way, ball_run):
    """Every way enters the same watch and settles memory, so that steps take equally long."""
    settled = list[str]()
    monkeypatch.setattr(work, "settle_memory", lambda: settled.append(way))
    method, scene = tiny.method().eval(), tiny.scene()
    seen = list[bool]()
    monkeypatch.setattr(type(method), "render_rays", noting(type(method).render_rays, seen, watch))
    monkeypatch.setattr(type(method), "batch", noting(type(method).batch, seen, watch))
    if way == "fit":
        fit(method, scene, steps=2, show=False, rehearsal=False)
    elif way == "render":
        method.render(scene.cameras[0])
    elif way == "evaluate":
        evaluate(method, scene, EvaluationOptions(views=1))
    elif way == "export":
        with contextlib.suppress(LumigraphError):  # nothing of an untrained method is solid
            extract_points(method, scene.cameras, PointsOptions(count=10, size=8, views=2))
    else:
        assert main(["eval", str(ball_run.folder), "--views", "1"]) == 2  # its photographs are in memory alone
        assert main(["render", str(ball_run.folder), "--frames", "1", "--overwrite"]) == 0
    assert seen and all(seen) and settled
    watch.stop()
    settled.clear()
    monkeypatch.setenv(OPT_OUT, "1")
    method.render(scene.cameras[0])
    assert not watch.running and not settled


def noting(function, seen: list[bool], watch: threads.ContentionWatch):
    """A function that notes whether the watch is on while it runs."""

    def noted(*told, **more):
        seen.append(watch.running)
        return function(*told, **more)

    return noted


@pytest.mark.skipif(not threads.TASKS_FOLDER.exists(), reason="tells what threads wait for by /proc")
def test_who_waits_behind_another_thread_is_held_up():
    held, end = threads.Contention(), time.monotonic() + 0.3
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    program = f"import os\nwhile os.getppid() == {os.getpid()}: pass"
    other = subprocess.Popen([sys.executable, "-S", "-c", program])
    try:
        while time.monotonic() < end:
            pass
        assert held() > 0.1
    finally:
        other.kill()
        other.wait()
        os.sched_setaffinity(0, before)


def test_who_hardly_runs_is_not_held_up(monkeypatch):
    second = 10**9
    states = iter([{"1": [0, 0], "2": [5, 5]}, {"1": [second // 1000, second // 1000], "3": [second, second]}])
    monkeypatch.setattr(threads.Contention, "_now", staticmethod(lambda: next(states)))
    assert (
        threads.Contention()() < threads.MAX_WAITING_SHARE
    )  # half of very little; threads that came or went between do not count


@pytest.mark.skipif(threads.processors() < 2, reason="one thread waits for nobody")
@pytest.mark.skipif(sys.platform != "linux", reason="GNU's OpenMP")
def test_crowded_threads_of_torch_and_numba_hardly_look_for_work():
    environment = {name: value for name, value in os.environ.items() if name not in threads.USER_SETTINGS}
    environment |= {"PYTHONPATH": str(Path(__file__).parent.parent), "OMP_NUM_THREADS": f"{threads.processors()}"}
    told = subprocess.run([sys.executable, "-c", LOOKING], env=environment, capture_output=True, text=True, check=True)
    for line in told.stdout.splitlines():
        alone, crowded = map(float, line.split())
        assert crowded < 0.5 * alone


@pytest.mark.skipif(sys.platform != "linux", reason="GNU's C library")
@pytest.mark.parametrize(
    ("own", "arenas", "faults"),
    [({"MALLOC_ARENA_MAX": "3"}, 3, (0, 2000)), ({"MALLOC_MMAP_THRESHOLD_": "131072"}, 1, (100_000, 1_000_000))],
)
def test_commands_keep_memory_in_one_place_but_for_what_a_user_settles(own, arenas, faults):
    """Threads share an arena, and a step's freed memory stays there; a user's setting changes one and not the other."""
    environment = {name: value for name, value in os.environ.items() if name not in USER_SETTINGS.values()} | own
    done = subprocess.run([sys.executable, "-c", MEMORY], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.count("<heap nr") == arenas
    assert faults[0] <= int(done.stdout.partition("faults ")[2].split()[0]) <= faults[1]
