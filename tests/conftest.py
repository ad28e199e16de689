"""Before any test: Triton interprets where there is no GPU, and the shapes written at every door are executed.

Around each: no test may hang, and its cost is noted. Costly files come first, so that workers end together; tests that
need a browser come last, for they share one. In a fresh clone the contract compiles most kernels: meanwhile the other
worker has tests that compile none, because a kernel that two workers compile at the same time is compiled twice.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from collections.abc import Iterator
from typing import Any

# A process for each processor: threads that look for work hold up the others. The process that starts them has set how
# long ours look, which outvotes OMP_WAIT_POLICY.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ |= {"OMP_NUM_THREADS": "1", "GOMP_SPINCOUNT": "0"}

# Byte code is kept, here and in the processes that tests start: compiling takes each worker 20 s and each process 3 s.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    sys.dont_write_bytecode = False

import lumigraph  # noqa: F401  # isort: skip
import pytest  # isort: skip
import shape_checks  # isort: skip
import torch  # isort: skip
from browser import chromium, faults, page  # noqa: F401  # isort: skip
from budgets import MUCH, Ledger, busy, share_of  # isort: skip
from numba.core import event  # isort: skip

LIMIT = 300  # seconds of waiting, in whatever state the machine is, that a test's setup, body or end may take
# The contract compiles kernels, and the others none: they run them as plain Python, or run Triton and COLMAP.
FIRST_FILES = ["test_contract", "test_bounds", "test_seeded_faults", "test_gpu_compiles", "test_capture_motion"]

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported

    with contextlib.suppress(ImportError):  # Triton is for Linux alone
        import interpreter

        interpreter.hasten()

shape_checks.install()

from lumigraph.system.allocation import settle_memory

gc.set_threshold(20_000)  # at 700, looking for cycles is a seventh of compiling and four fifths of parsing
os.fsync = lambda file: None  # of a folder that the session removes; waiting for disks was 3 % of the contract
settle_memory()  # as commands do: memory that one training step frees is kept for the next


# Background jobs of a shell ignore Ctrl-C, and so would what tests start; they press it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

LONGEST_NAME = 16  # bytes
LEDGER = Ledger()
event.register("numba:compile", LEDGER.compiling)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def order(item: pytest.Item) -> tuple[bool, int, float]:
        file, share = item.path.stem, share_of(item.get_closest_marker("budget"))[1]
        place = FIRST_FILES.index(file) if file in FIRST_FILES else len(FIRST_FILES)
        return "chromium" in getattr(item, "fixturenames", ()), place, -share

    items.sort(key=order)
    from lumigraph import methods

    LEDGER.methods = len(methods.available())
    gc.collect()
    gc.freeze()  # looking again and again through what collection made, which stays, takes a second each time


def pytest_make_parametrize_id(val: object) -> str | None:
    """Names of cases do not repeat the bytes of files, which may hold the moment at which they were packed."""
    return f"{len(val)} bytes" if isinstance(val, bytes) and len(val) > LONGEST_NAME else None


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    before = LEDGER.readings()
    shape_checks.next_test()
    done = yield
    LEDGER.note(item.path.stem, share_of(item.get_closest_marker("budget")), before)
    return done


@pytest.fixture(autouse=True)
def _random_numbers_of_its_own() -> None:
    """No test draws other numbers because of the tests before it."""
    torch.manual_seed(0)


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Fail instead of waiting for ever."""

    def fail(*_: object) -> None:
        pytest.fail(f"still waiting after {LIMIT} s")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(LIMIT)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Iterator[None]:
    with limited():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    with limited():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown() -> Iterator[None]:
    with limited():
        return (yield)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """A worker has ended: its costs are the session's."""
    LEDGER.add(getattr(node, "workeroutput", {}).get("costs"))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    gc.unfreeze()  # libraries count what is left at the end of the process
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["costs"] = LEDGER.to_plain()
    elif exitstatus == 0 and LEDGER.excessive() and not busy():
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    terminalreporter.section("what the tests cost")
    for line in [*LEDGER.table(), *LEDGER.excessive(MUCH)]:
        terminalreporter.write_line(line)
    if LEDGER.excessive() and busy():
        terminalreporter.write_line("which may be for other programs are running; it counts where the machine is idle")


# What many files need, made once. Nobody may change it; a test that would takes a copy.


@pytest.fixture(scope="session")
def ball_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene as a Blender folder."""
    import tiny

    return tiny.write_blender(tmp_path_factory.mktemp("scenes") / "ball")


@pytest.fixture(scope="session")
def ball_run(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A Run of the tests' own method, which has learnt the tiny scene for 60 steps."""
    import tiny

    from lumigraph.training import fit

    run = tiny.new_run(tmp_path_factory.mktemp("runs") / "ball")
    fit(run.new_method(), tiny.scene(), run, steps=60, show=False, rehearsal=False)
    return run


@pytest.fixture
def window(chromium: Any) -> Iterator[Any]:  # noqa: F811
    """What opens a Window on a page from disk; at the end nothing was complained of."""
    from windows import Window

    opened: list[Window] = []

    def open_(path: Path, **context: Any) -> Window:
        opened.append(Window(chromium, path, **context))
        return opened[-1]

    yield open_
    for each in opened:
        each.close()


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
