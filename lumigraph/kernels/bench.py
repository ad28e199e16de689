"""Benchmark of each engine and of the reference on the same device, in one run."""

import importlib
import math
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numba
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from ..files import claim, write_json
from ..system.console import console as plain_console
from ..system.progress import track
from ._operation import Engine, tensors, using
from ._operation import operations as all_operations

MAX_SECONDS = 5.0  # seconds: what takes longer is repeated less often, but three times at least


def bench_kernels(
    operations: Sequence[str] | None = None,
    device: torch.device | str | None = None,
    size: int = 2**18,
    repeats: int = 11,
    output: Path | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Time the engines of a device, print a table, and return its contents (and write them to `output`).

    operations: their names; None for all
    device:     "cpu" for `reference` and `cpu`, "cuda" for `reference` and `gpu`; None for CUDA where there is one
    size:       samples, directions or pixels in each operation's benchmark case; marching takes one ray for every 64
    repeats:    number of calls for each median. The call before them is reported separately because it includes
                compilation

    Backward is the gradient in the inputs that training differentiates (for hash encoding the table alone), given a
    gradient of the outputs. Rates are in operations["unit"] per second. Raises LumigraphError if `output` cannot be
    written.
    """
    if output is not None:
        claim(output, "benchmark")
    device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    fast: Engine = "gpu" if device.type == "cuda" else "cpu"
    result: dict[str, Any] = {"protocol": _protocol(device, size, repeats), "operations": {}}
    names = all_operations() if operations is None else operations
    for name in track(names, "Timing kernels", len(names)):
        folder = importlib.import_module(f"{__package__}.{name}")
        inputs = [_to_device(x, device) for x in folder.benchmark_case(torch.Generator().manual_seed(0), size)]
        count = math.prod(inputs[0].shape[: folder.FACTS.unit_axes])
        run = getattr(folder, name)
        engines = {engine: _measure(run, engine, inputs, count, repeats) for engine in (fast, "reference")}
        ratios = {k: v / engines["reference"][k] for k, v in engines[fast].items() if k.endswith("per_second")}
        engines[fast] |= {k.replace("per_second", "ratio"): v for k, v in ratios.items()}
        result["operations"][name] = {"unit": folder.FACTS.unit, "count": count, "engines": engines}
    _print(result, console or plain_console())
    if output is not None:
        write_json(output, result, "benchmark")
    return result


def _to_device(x: Any, device: torch.device) -> Any:
    if isinstance(x, Tensor):
        return x.detach().to(device).requires_grad_(x.requires_grad)
    return x.to(device) if hasattr(x, "to") else x


def _measure(
    operation: Callable[..., Any], engine: Engine, inputs: list[Any], count: int, repeats: int
) -> dict[str, float]:
    wanted = [x for x in inputs if isinstance(x, Tensor) and x.requires_grad]

    def forward() -> tuple[Tensor, ...]:
        with using(engine):
            return tensors(operation(*inputs))

    first, seconds = _time(forward, inputs[0].device, repeats)
    row = {"forward_per_second": count / seconds, "forward_first_seconds": first}
    if wanted:
        outputs = tuple(x for x in forward() if x.requires_grad)
        gradients = [torch.randn_like(x) for x in outputs]  # laid out in memory as the outputs are

        def backward() -> tuple[Tensor, ...]:
            return torch.autograd.grad(outputs, wanted, gradients, retain_graph=True)

        first, seconds = _time(backward, inputs[0].device, repeats)
        row |= {"backward_per_second": count / seconds, "backward_first_seconds": first}
    return row


def _time(call: Callable[[], Any], device: torch.device, repeats: int) -> tuple[float, float]:
    """Seconds of the first call, and the median of the following ones."""

    def once() -> float:
        _wait(device)
        start = time.perf_counter()
        call()
        _wait(device)
        return time.perf_counter() - start

    first, times = once(), [once()]
    while len(times) < repeats and (len(times) < 3 or sum(times) < MAX_SECONDS):
        times.append(once())
    return first, statistics.median(times)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _protocol(device: torch.device, size: int, repeats: int) -> dict[str, Any]:
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu",
        "torch": torch.__version__,
        "torch_threads": torch.get_num_threads(),
        "numba_threads": numba.get_num_threads(),
        "dtype": "float32",
        "size": size,
        "statistic": f"median of up to {repeats} calls after the first",
    }


def _print(result: dict[str, Any], console: Console) -> None:
    protocol = result["protocol"]
    table = Table(
        "operation",
        "engine",
        *(f"{direction}\n{unit}" for direction in ("forward", "backward") for unit in ("million/s", "× ref.")),
        "first calls\ns",
        title="Kernels",
        caption=f"{protocol['device']}, {protocol['torch_threads']} threads, {protocol['dtype']}, "
        f"{protocol['statistic']}; backward in what training differentiates",
    )
    for column in table.columns[2:]:
        column.justify = "right"
    for name, operation in result["operations"].items():
        for engine, row in operation["engines"].items():
            cells = [f"{name}\n{operation['count']:,} {operation['unit']}" if engine != "reference" else "", engine]
            for direction in ("forward", "backward"):
                rate, ratio = row.get(f"{direction}_per_second"), row.get(f"{direction}_ratio")
                cells += [f"{rate / 1e6:.3g}" if rate else "", f"{ratio:.0f}" if ratio else ""]
            first = row["forward_first_seconds"] + row.get("backward_first_seconds", 0)
            table.add_row(*cells, f"{first:.2f}", end_section=engine == "reference")
    console.print(table)
