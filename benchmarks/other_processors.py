"""Code of the CPU kernels for another processor, from Numba's code for this one: which compile, and how they vectorise.

    NUMBA_OPT=0 NUMBA_CACHE_DIR=EMPTY_FOLDER python benchmarks/other_processors.py [KERNEL...] [--triple TRIPLE]

Each kernel runs its typical case once, forward, so that Numba compiles it, without the optimisation that is this
processor's own; LLVM optimises and translates the code for the other one. The table has instructions of vectors and of
all kinds, and those that calculate with vectors. It is a check that the code exists and is not scalar; speed needs such
a machine.

    python benchmarks/other_processors.py [KERNEL...] --plain FOLDER [--scene SCENE]

times kernels, and steps of training on a scene, on this processor as it is and as the plainest x86-64, whose vectors
are SSE2's: least processor seconds of one thread, in processes with caches of their own in a folder. Numba keeps this
processor's instructions where NUMBA_CPU_NAME is set alone, so NUMBA_CPU_FEATURES is set too.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import llvmlite.binding as llvm
import torch
from numba.core.dispatcher import Dispatcher

from lumigraph import kernels
from lumigraph.kernels import _operation

HEADER = re.compile(r"^(target (?:triple|datalayout) = |source_filename).*$", re.MULTILINE)
REPEATS = 9
ONE_THREAD = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
HOST = re.compile(r'"(target-cpu|target-features)"="[^"]*"')
VECTOR = re.compile(r"^\s+\w+\s+.*\bv\d+\.(?:2d|4s|8h|16b)", re.MULTILINE)
ARITHMETIC = re.compile(
    r"^\s+f?(?:add|sub|mul|mla|mls|div|sqrt|max|min|cvt\w*)\w*\s+v\d+\.(?:2d|4s|2s|8h)", re.MULTILINE
)
INSTRUCTION = re.compile(r"^\t[a-z]\w*(?:\.\w+)?\s", re.MULTILINE)


def translated(code: str, machine: llvm.TargetMachine, triple: str) -> str:
    """Assembly for another processor of code that was optimised for this one."""
    module = llvm.parse_assembly(HOST.sub("", HEADER.sub("", code)))
    module.triple, module.data_layout = triple, str(machine.target_data)
    module.verify()
    passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    passes.getModulePassManager().run(module, passes)
    return machine.emit_assembly(module)


def timed(names: list[str], result: Path) -> None:
    """Write the least processor time of a call of each kernel, forward and backward."""
    found = {}
    for name in names:
        place = importlib.import_module(f"lumigraph.kernels.{name}")
        inputs = place.benchmark_case(torch.Generator().manual_seed(0), 1 << 14)
        wanted = [x for x in inputs if isinstance(x, torch.Tensor) and x.requires_grad]
        with kernels.using("cpu"):
            outputs = [x for x in _operation.tensors(getattr(place, name)(*inputs)) if x.requires_grad]
            calls = [lambda: getattr(place, name)(*inputs)]  # noqa: B023 (called here)
            if wanted:
                slopes = [torch.ones_like(x) for x in outputs]
                calls.append(lambda: torch.autograd.grad(outputs, wanted, slopes, retain_graph=True))  # noqa: B023
            found[name] = [least(call) for call in calls]
    result.write_text(json.dumps(found))


def least(call: Callable[[], object]) -> float:
    times = []
    for _ in range(REPEATS):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)


def figures(words: list[str], place: Path, plain: bool) -> dict:
    """Times of kernels or steps from a process with Numba's code for the plainest x86-64, or for this processor."""
    name, result = "plain" if plain else "own", place / "result.json"
    named = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "+sse,+sse2"} if plain else {}
    cache = {"NUMBA_CACHE_DIR": str(place / name), "LUMIGRAPH_CACHE": str(place / f"{name}-cache")}
    result.unlink(missing_ok=True)
    subprocess.run([sys.executable, *words, str(result)], check=True, env=os.environ | ONE_THREAD | named | cache)
    return json.loads(result.read_text())


def compare(names: list[str], place: Path, scene: str | None) -> None:
    """Print how many times longer each kernel and each step of training takes as the plainest x86-64."""
    place.mkdir(parents=True, exist_ok=True)
    own, plain, again = (figures([__file__, *names, "--timed"], place, x) for x in (False, True, False))
    print("| | forward | backward |\n|---|---|---|")
    for name in names:
        both = zip(own[name], plain[name], again[name], strict=True)
        ratios = [f"{slow / min(a, b):.2f}" for a, slow, b in both]
        print(f"| `{name}` | {' | '.join([*ratios, ''][:2])} |", flush=True)
    for method in ("gaussian-splatting", "instant-ngp") if scene else ():
        words = ["-m", "lumigraph", "bench", "step", method, str(scene), "--warmup", "40", "--steps", "20", "--output"]
        own, plain = (figures(words, place, x)["processor_ms"] for x in (False, True))
        print(f"| a step of {method} | {plain / own:.2f} | |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kernels", nargs="*", default=_operation.operations())
    parser.add_argument("--triple", default="aarch64-unknown-linux-gnu")
    parser.add_argument("--plain", type=Path)
    parser.add_argument("--scene")
    parser.add_argument("--timed", type=Path)
    said = parser.parse_args()
    if said.timed:
        timed(said.kernels, said.timed)
        return
    if said.plain:
        compare(said.kernels, said.plain, said.scene)
        return
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(said.triple).create_target_machine(opt=3)
    print("| kernel | functions | instructions | of vectors | arithmetic of vectors |\n|---|---|---|---|---|")
    for name in said.kernels:
        place = importlib.import_module(f"lumigraph.kernels.{name}")
        cpu, cases = (
            importlib.import_module(f"lumigraph.kernels.{name}.cpu"),
            place.cases(torch.Generator().manual_seed(0)),
        )
        with kernels.using("cpu"), torch.no_grad():
            getattr(kernels, name)(*list(cases)[place.FACTS.typical])
        functions = instructions = vectors = sums = 0
        for function in (x for x in vars(cpu).values() if isinstance(x, Dispatcher)):
            for code in function.inspect_llvm().values():
                text = translated(code, machine, said.triple)
                functions, instructions = functions + 1, instructions + len(INSTRUCTION.findall(text))
                vectors, sums = vectors + len(VECTOR.findall(text)), sums + len(ARITHMETIC.findall(text))
        share = f"{100 * vectors / max(instructions, 1):.0f} %"
        print(f"| `{name}` | {functions} | {instructions} | {share} | {sums} |", flush=True)


if __name__ == "__main__":
    main()
