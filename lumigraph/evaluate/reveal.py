"""What an evaluation lets a method see of a dataset that it has not learnt from."""

from __future__ import annotations

from dataclasses import replace

from ..dataset import Dataset
from ..method import Method
from ..scene import Scene


def reveal(method: Method, data: Dataset) -> Method:
    """The method, told of a dataset if it accepts that kind: of photographs those to learn from, none held out."""
    if not isinstance(data, tuple(method.accepts)):
        return method
    if isinstance(data, Scene):
        return method.given(replace(data, splits={"train": data.splits["train"]}))
    return method.given(data)
