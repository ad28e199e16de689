"""Evidence that an evaluation gives a method of a dataset that it has not learnt from."""

from __future__ import annotations

from dataclasses import replace

from ..capture.views import with_fewer_views
from ..datasets.dataset import Dataset
from ..datasets.scene import Scene
from ..method import Method


def reveal(method: Method, data: Dataset) -> Method:
    """The method, told of a dataset if it accepts that kind: of photographs those to learn from, none held out,
    and no more than `Method.evidence_views`."""
    if not isinstance(data, method.takes):
        return method
    if isinstance(data, Scene):
        there = len(data.splits["train"])
        fewer = with_fewer_views(data, min(method.evidence_views or there, there))
        return method.given(replace(fewer, splits={"train": fewer.splits["train"]}))
    return method.given(data)
