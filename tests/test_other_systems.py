"""Other systems than Linux: its features are taken away one by one, and their fallbacks hold."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
from budgets import budget
from listing import names

from lumigraph import files
from lumigraph.errors import LumigraphError
from lumigraph.files import locks, partials
from lumigraph.system import allocation, cache, children, memory

pytestmark = budget("house", 5)  # 0.5 s alone; 5.0 s at the end of a session, whose garbage is collected three times
fcntl = pytest.importorskip("fcntl")
LEFTOVER = ".lumigraph-0123456789abcdef.partial"


@pytest.fixture
def on(monkeypatch):
    """A function that lets modules take this system for another one."""

    def on_(platform: str, *modules: object) -> None:
        for module in modules:
            monkeypatch.setattr(module, "sys", SimpleNamespace(platform=platform))

    return on_


def test_windows_locks_a_byte(tmp_path, monkeypatch, on):
    """With msvcrt's call, which Linux's own stands in for."""
    asked = []

    def locking(descriptor: int, mode: int, count: int) -> None:
        asked.append((mode, count))
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)

    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(locking=locking, LK_NBLCK=2))
    monkeypatch.setitem(sys.modules, "fcntl", None)
    on("win32", locks)
    with locks.lock_folder(tmp_path, "trained"):
        monkeypatch.setattr(locks, "_ours", set())  # as another process
        with pytest.raises(LumigraphError, match="is being trained by process"), locks.lock_folder(tmp_path, "trained"):
            pass
    with locks.lock_folder(tmp_path, "trained"):
        assert asked == [(2, 1)] * 3


def test_without_locks_files_are_written_and_leftovers_stay(tmp_path, monkeypatch, on):
    monkeypatch.setitem(sys.modules, "fcntl", None)
    on("win32", partials)
    (tmp_path / LEFTOVER).write_bytes(b"half")
    for data in (b"1", b"2"):
        files.write_bytes(tmp_path / "a", data)
    assert (tmp_path / "a").read_bytes() == b"2" and (tmp_path / LEFTOVER).exists()


@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_children_begin_where_no_call_ties_them(monkeypatch, on, platform):
    on(platform, children)
    monkeypatch.setattr(children, "tied", None)
    assert children.start_python(["-S", "-c", "raise SystemExit(7)"]).wait(60) == 7


@pytest.mark.parametrize(
    ("platform", "library"),
    [("darwin", None), ("win32", None), ("linux", SimpleNamespace())],  # the last is a C library without mallopt
)
def test_memory_is_left_to_other_libraries(monkeypatch, on, platform, library):
    monkeypatch.setattr(allocation, "ctypes", SimpleNamespace(CDLL=lambda name: library))
    on(platform, allocation)
    allocation.settle_memory.__wrapped__()
    allocation.give_back_memory()


@pytest.mark.parametrize(("platform", "unit"), [("darwin", 1), ("freebsd", 1024)])
def test_peak_memory_without_proc(monkeypatch, on, tmp_path, platform, unit):
    monkeypatch.setattr(memory, "STATUS_FILE", tmp_path / "none")
    used = SimpleNamespace(getrusage=lambda who: SimpleNamespace(ru_maxrss=5000), RUSAGE_SELF=0)
    monkeypatch.setitem(sys.modules, "resource", used)
    on(platform, memory)
    assert memory.peak_memory(memory.torch.device("cpu")) == 5000 * unit
    on("win32", memory)
    assert memory.peak_memory(memory.torch.device("cpu")) == 0


def test_folders_change_places_without_renameat2(tmp_path, monkeypatch):
    monkeypatch.setattr(files.atomic, "ctypes", SimpleNamespace(CDLL=lambda name: SimpleNamespace()))
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    assert not files.atomic.swapped(tmp_path / "one", tmp_path / "two")
    with files.replacing_folder(tmp_path / "film", "pictures of a film") as new:
        (new / "1").touch()
    with files.replacing_folder(tmp_path / "film", "pictures of a film") as new:
        (new / "2").touch()
    assert names(tmp_path / "film") == ["2"]


@pytest.mark.parametrize("platform", ["darwin", "win32", "linux"])
def test_the_cache_has_a_place(monkeypatch, on, tmp_path, platform):
    monkeypatch.delenv("LUMIGRAPH_CACHE", raising=False)
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    on(platform, cache)
    assert cache.cache_folder().is_relative_to(tmp_path)
