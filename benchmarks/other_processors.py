"""Code of the CPU kernels for another processor, from Numba's code for this one: which compile, and how they vectorise.

    NUMBA_OPT=0 NUMBA_CACHE_DIR=EMPTY_FOLDER python benchmarks/other_processors.py [KERNEL...] [--triple TRIPLE]

Each kernel runs its typical case once, forward, so that Numba compiles it, without the optimisation that is this
processor's own; LLVM optimises and translates the code for the other one. The table has instructions of vectors and of
all kinds. It is a check that the code exists and is not scalar; speed needs such a machine.

    python benchmarks/other_processors.py [KERNEL...] --plain FOLDER [--scene SCENE]

times kernels, and steps of training on a scene, on this processor as it is and as the plainest x86-64, whose vectors
are SSE2's, one after the other for each kernel, in processes with caches of their own in a folder. Numba keeps this
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
from pathlib import Path

import llvmlite.binding as llvm
import torch
from numba.core.dispatcher import Dispatcher

from lumigraph import kernels
from lumigraph.kernels import _operation

HEADER = re.compile(r"^(target (?:triple|datalayout) = |source_filename).*$", re.MULTILINE)
HOST = re.compile(r'"(target-cpu|target-features)"="[^"]*"')
VECTOR = re.compile(r"^\s+\w+\s+.*\bv\d+\.(?:2d|4s|8h|16b)", re.MULTILINE)
INSTRUCTION = re.compile(r"^\t[a-z]\w*(?:\.\w+)?\s", re.MULTILINE)


def translated(code: str, machine: llvm.TargetMachine, triple: str) -> str:
    """Assembly for another processor of code that was optimised for this one."""
    module = llvm.parse_assembly(HOST.sub("", HEADER.sub("", code)))
    module.triple, module.data_layout = triple, str(machine.target_data)
    module.verify()
    passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    passes.getModulePassManager().run(module, passes)
    return machine.emit_assembly(module)


TIME = """import sys
from pathlib import Path
from lumigraph.kernels.bench import bench_kernels
bench_kernels([sys.argv[1]], "cpu", 1 << 16, 7, Path(sys.argv[2]))"""


def figures(words: list[str], place: Path, plain: bool) -> dict:
    """What a program writes that times kernels or steps in a process of its own, with Numba's code for the plainest
    x86-64 or for this processor."""
    name, result = "plain" if plain else "own", place / "result.json"
    named = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "+sse,+sse2"} if plain else {}
    cache = {"NUMBA_CACHE_DIR": str(place / name), "LUMIGRAPH_CACHE": str(place / f"{name}-cache")}
    result.unlink(missing_ok=True)
    command = [sys.executable, *words, str(result)]
    subprocess.run(command, check=True, env=os.environ | named | cache, stdout=subprocess.DEVNULL)
    return json.loads(result.read_text())


def compare(names: list[str], place: Path, scene: str | None) -> None:
    """Print how many times longer each kernel and each step of training takes as the plainest x86-64."""
    print("| | forward | backward |\n|---|---|---|", flush=True)
    for name in names:
        words = ["-c", TIME, name]
        own, plain = (figures(words, place, x)["operations"][name]["engines"]["cpu"] for x in (False, True))
        ratios = [own[key] / plain[key] if key in own else 0.0 for key in ("forward_per_second", "backward_per_second")]
        print(f"| `{name}` | {' | '.join(f'{x:.2f}' if x else '' for x in ratios)} |", flush=True)
    for method in ("gaussian-splatting", "instant-ngp") if scene else ():
        words = ["-m", "lumigraph", "bench", "step", method, str(scene), "--warmup", "60", "--steps", "20", "--output"]
        own, plain = (figures(words, place, x)["ms"] for x in (False, True))
        print(f"| a step of {method} | {plain / own:.2f} | |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kernels", nargs="*", default=_operation.operations())
    parser.add_argument("--triple", default="aarch64-unknown-linux-gnu")
    parser.add_argument("--plain", type=Path)
    parser.add_argument("--scene")
    said = parser.parse_args()
    if said.plain:
        compare(said.kernels, said.plain, said.scene)
        return
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(said.triple).create_target_machine(opt=3)
    print("| kernel | functions | instructions | of vectors |\n|---|---|---|---|")
    for name in said.kernels:
        place = importlib.import_module(f"lumigraph.kernels.{name}")
        cpu, cases = (
            importlib.import_module(f"lumigraph.kernels.{name}.cpu"),
            place.cases(torch.Generator().manual_seed(0)),
        )
        with kernels.using("cpu"), torch.no_grad():
            getattr(kernels, name)(*list(cases)[place.FACTS.typical])
        functions = instructions = vectors = 0
        for function in (x for x in vars(cpu).values() if isinstance(x, Dispatcher)):
            for code in function.inspect_llvm().values():
                text = translated(code, machine, said.triple)
                functions, instructions = functions + 1, instructions + len(INSTRUCTION.findall(text))
                vectors += len(VECTOR.findall(text))
        print(f"| `{name}` | {functions} | {instructions} | {100 * vectors / max(instructions, 1):.0f} % |", flush=True)


if __name__ == "__main__":
    main()
