"""What a process is told to have needed."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph import methods
from lumigraph.errors import LumigraphError
from lumigraph.export.film import film
from lumigraph.files.ranges import changed
from lumigraph.run import build
from lumigraph.run.settings import bytes_of
from lumigraph.system import memory
from lumigraph.system.memory import peak_memory, want_of_memory
from lumigraph.training import fit

pytestmark = budget("runs", 12)

TAKE = """
import torch
from lumigraph import methods
from lumigraph.system import memory
from lumigraph.errors import LumigraphError
from lumigraph.export.film import film
from lumigraph.system.memory import peak_memory, want_of_memory
from lumigraph.run import build
from lumigraph.run.settings import bytes_of
before = peak_memory(torch.device("cpu"))
taken = torch.ones({size}, dtype=torch.uint8)
del taken
print(peak_memory(torch.device("cpu")) - before)
"""


def test_the_peak_grows_by_what_was_taken_and_stays():
    size = 300_000_000
    ran = subprocess.run([sys.executable, "-c", TAKE.format(size=size)], capture_output=True, text=True, check=True)
    assert abs(int(ran.stdout) - size) < 20_000_000


def test_a_run_remembers_its_peak(tmp_path):
    run = tiny.new_run(tmp_path / "run")
    fit(tiny.method(run.frame), tiny.scene(), run, steps=2, show=False)
    assert 0 < run.state.peak_memory <= peak_memory(torch.device("cpu"))


CPU = torch.device("cpu")
ASKING = {  # what asks for too much, where a process may have a few gigabytes
    "PyTorch": ("import torch; torch.empty(10**11)", "400 GB"),
    "NumPy": ("import numpy; numpy.empty(10**12, numpy.uint8)", "1,000 GB"),
    "Python": ("bytearray(10**12)", "more"),
}
CHILD = """
import resource
resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
from lumigraph.commands import cli
from lumigraph.commands.methods import Methods
def ask(self):
    {ask}
Methods.run = ask
raise SystemExit(cli.main(["methods"]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of addresses")
@pytest.mark.parametrize(("ask", "amount"), ASKING.values(), ids=ASKING)
def test_want_of_memory_ends_in_a_sentence(ask, amount):
    ran = subprocess.run([sys.executable, "-c", CHILD.format(ask=ask)], capture_output=True, text=True)
    assert ran.returncode == 2 and ran.stdout == ""
    assert ran.stderr.startswith(f"lumigraph: Memory is short: {amount} was asked for"), ran.stderr
    assert ran.stderr.count("\n") == 1


def test_other_faults_are_no_want_of_memory():
    assert want_of_memory(RuntimeError("size mismatch")) is None
    told = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has ...")
    assert "21.5 GB was asked for, which the device does not have" in str(want_of_memory(told))
    assert "8.0 TB" not in str(want_of_memory(np._core._exceptions._ArrayMemoryError((10,), np.dtype("f8"))))


GREEDY = {  # what would take most, by method, and the option to name
    "instant-ngp": ({"log2_hashmap_size": 26, "levels": 16, "max_resolution": 4096}, "log2-hashmap-size"),
    "nerf": ({"hidden_width": 8192, "depth": 32, "occupancy_resolution": 16}, "hidden-width"),
    "mip-nerf": ({"occupancy_resolution": 512, "rays_per_step": 1}, "occupancy-resolution"),
    "dvgo": ({"voxels": 1 << 29}, "voxels"),
    "fourier-features": ({"hidden_width": 8192, "layers": 64}, "hidden-width"),
    "tensorf": ({"final_resolution": 2048, "samples_per_step": 4096}, "final-resolution"),
}


@pytest.mark.parametrize("name", GREEDY)
def test_what_memory_does_not_hold_is_told_before_it_is_made(name, monkeypatch):
    """A build that was not refused would take gigabytes here, and the test's time."""
    numbers, option = GREEDY[name]
    kind = methods.find(name)
    monkeypatch.setattr(memory, "free_memory", lambda: 200_000_000)
    with pytest.raises(
        LumigraphError, match=rf"{name} .* would need .* GB of memory, and 0\.2 GB are free.* --{option} "
    ):
        build(kind, tiny.scene().frame, changed(kind.Config(), **numbers), CPU, 0, learning=True)


def test_it_is_told_how_large_a_grid_would_fit(monkeypatch):
    kind, frame = methods.find("dvgo"), tiny.scene().frame
    monkeypatch.setattr(memory, "free_memory", lambda: 400_000_000)
    with pytest.raises(LumigraphError, match="--voxels than 536,870,912; ([0-9,]+) would fit") as told:
        build(kind, frame, kind.Config(voxels=1 << 29, coarse_voxels=4096), CPU, 0, learning=True)
    fitting = int(str(told.value).split("; ")[-1].split()[0].replace(",", ""))
    assert bytes_of(kind, frame, kind.Config(voxels=fitting, coarse_voxels=4096), learning=True) <= 400_000_000


GIGABYTE = 10**9
GROUPS = {  # /proc/self/cgroup, where the group's files lie, and what they are called
    "version 1": (
        "4:memory:/jobs/one\n1:cpu:/",
        "memory/jobs/one",
        "limit_in_bytes",
        "usage_in_bytes",
        "total_inactive_file",
    ),
    "version 2": ("0::/jobs/one", "jobs/one", "max", "current", "inactive_file"),
    "around it": ("0::/jobs/one", "jobs", "max", "current", "inactive_file"),
}


@pytest.mark.parametrize(("own", "place", "limit", "use", "cached"), GROUPS.values(), ids=GROUPS)
def test_a_control_group_limits_what_is_free(own, place, limit, use, cached, tmp_path, monkeypatch):
    folder = tmp_path / place
    (tmp_path / "memory/jobs/one").mkdir(parents=True)
    folder.mkdir(parents=True, exist_ok=True)
    (tmp_path / "own").write_text(own)
    (folder / f"memory.{limit}").write_text(f"{8 * GIGABYTE}\n")
    (folder / f"memory.{use}").write_text(f"{8 * GIGABYTE - 10**8}\n")
    (folder / "memory.stat").write_text(f"cache 5\n{cached} {4 * 10**7}\n")
    monkeypatch.setattr(memory, "CONTROL_GROUPS", tmp_path)
    monkeypatch.setattr(memory, "OWN_GROUPS", tmp_path / "own")
    assert memory.group_limits() == [(8 * GIGABYTE, 8 * GIGABYTE - 14 * 10**7)]
    assert memory.free_memory() == 14 * 10**7  # cached files count as free
    assert memory.memory_for_images() == int(memory.FREE_IMAGES_SHARE * 14 * 10**7)
    assert memory.threads_for(GIGABYTE) == 1


LIMITED = """
import resource
from lumigraph.system import memory
resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
[(limit, used)] = memory.address_limit()
assert limit == 8 << 30 and 10**8 < used < limit and memory.free_memory() <= limit - used, (limit, used)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of addresses")
def test_a_limit_of_addresses_limits_what_is_free():
    subprocess.run([sys.executable, "-c", LIMITED], check=True)


ESTIMATED = ["instant-ngp", "nerf", "mip-nerf", "dvgo", "fourier-features", "tensorf", "nerf-w", "voxel-grid"]


@pytest.mark.parametrize("name", ESTIMATED)
def test_the_estimate_is_what_a_method_takes(name):
    kind, frame = methods.find(name), tiny.scene().frame
    config = kind.smallest()
    made = build(kind, frame, config, CPU, 0)
    weights = sum(4 * x.numel() for x in made.parameters())
    held = sum(x.numel() * x.element_size() for x in made.buffers())
    looking = bytes_of(kind, frame, config, learning=False) - kind.further_bytes(frame, config, learning=False)
    learning = bytes_of(kind, frame, config, learning=True) - kind.further_bytes(frame, config, learning=True)
    assert looking == weights + held and learning == 4 * weights + held


def test_a_picture_that_memory_does_not_hold_is_told(ball_run, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 1_000_000)
    camera = ball_run.cameras()["test"][0].resized(8.0)
    with pytest.raises(LumigraphError, match="A picture of 192 x 192 pixels would need .* give a smaller --size"):
        film(ball_run.method(), camera, tmp_path / "film.mp4")
    assert list(tmp_path.iterdir()) == []
