"""Conversions between methods, by capability, so that a new method is supported without an entry here."""

from __future__ import annotations

from typing import Literal

from ... import methods
from ...datasets.dataset import check_kind
from ...datasets.scene import Scene
from ...errors import LumigraphError
from ...method import Method
from ...method.capabilities import FromField, HasDensity, HasField, HasGaussians, HasLooks, can
from ...run import Opened

Way = Literal["field", "gaussians", "depth", "pictures"]
SPATIAL_CAPABILITIES = FromField, HasField, HasDensity, HasLooks, HasGaussians  # one of them is needed


def way(teacher: type[Method], student: type[Method]) -> Way | None:
    """Conversion of a teacher to a student: by the teacher's field at points, by its Gaussians as they are, by the
    depth of what it renders, or by learning from its pictures alone; None if not at all."""
    shows = issubclass(Scene, teacher.learns_from) or Scene in teacher.accepts  # a prior's runs are of scenes too
    if not (shows and issubclass(Scene, student.learns_from)):
        return None
    if can(student, FromField):
        if can(teacher, HasGaussians) and can(student, HasGaussians):
            return "gaussians"
        return "field" if can(teacher, HasField) else "depth"
    return "pictures" if any(can(student, capability) for capability in SPATIAL_CAPABILITIES) else None


def ways() -> dict[str, dict[str, Way | None]]:
    """By the name of each installed method as teacher, the way into each as student."""
    kinds = {name: methods.find(name) for name in methods.available()}
    return {name: {other: way(teacher, student) for other, student in kinds.items()} for name, teacher in kinds.items()}


def check(source: Opened, student: type[Method]) -> None:
    """Raise LumigraphError, in one sentence, unless what was opened can become a student."""
    name = methods.name_of(student)
    if (reason := source.conversion_fault) is not None:
        raise LumigraphError(f"{source.path} {reason}")
    if source.frame.times is not None:
        raise LumigraphError(f"{source.path} is of a scene that moves, and what is converted stands still")
    check_kind(name, student.learns_from, Scene, str(source.path), methods.learning_from(Scene))
    if not any(can(student, capability) for capability in SPATIAL_CAPABILITIES):
        raise LumigraphError(
            f"{name} holds pictures, and no scene in space; `lumigraph convert --list` says what goes into what"
        )
