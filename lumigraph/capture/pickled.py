"""Arrays and dictionaries of them in pickled .npy files, as some data sets are published. Nothing else is read.

A pickle is a program. This one may call what builds arrays, numbers and their types, and a file that names anything
else is refused before it runs.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from ..errors import LumigraphError
from ..files import read_bytes

CALLS = {("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")}
CALLS |= {(f"numpy.{core}.multiarray", name) for core in ("core", "_core") for name in ("_reconstruct", "scalar")}


class ArrayUnpickler(pickle.Unpickler):
    """An unpickler of arrays alone."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in CALLS:
            raise ValueError(f"it names {module}.{name}, which is no array")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def load_pickled(path: Path) -> Any:
    """The dictionary of arrays, numbers and lists in a pickled .npy file. Raises LumigraphError for others."""
    file = io.BytesIO(read_bytes(path))
    try:
        version = npy.read_magic(file)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, dtype = header(file)
        if dtype != np.dtype(object) or shape != ():
            raise ValueError("it holds numbers and no dictionary")
        found = ArrayUnpickler(file, encoding="latin1").load()
    except Exception as fault:  # damaged pickles fail in many ways
        reason = " ".join(str(fault).split()) or type(fault).__name__
        raise LumigraphError(f"{path} cannot be read as arrays ({reason}); restore it") from fault
    return found.item() if isinstance(found, np.ndarray) else found
