"""Code of the CPU kernels for another processor, from Numba's code for this one: which compile, and how they vectorise.

    NUMBA_OPT=0 NUMBA_CACHE_DIR=EMPTY_FOLDER python benchmarks/other_processors.py [KERNEL...] [--triple TRIPLE]

Each kernel runs its typical case once, forward, so that Numba compiles it, without the optimisation that is this
processor's own; LLVM optimises and translates the code for the other one. The table has instructions of vectors and of
all kinds. It is a check that the code exists and is not scalar; speed needs such a machine.
"""

from __future__ import annotations

import argparse
import importlib
import re

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kernels", nargs="*", default=_operation.operations())
    parser.add_argument("--triple", default="aarch64-unknown-linux-gnu")
    said = parser.parse_args()
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
