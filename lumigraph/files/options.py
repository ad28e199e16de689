"""Options of commands: `--help` texts in the annotations of dataclass fields."""

from __future__ import annotations

from typing import Any, get_args

from tyro.conf import arg


def option(metavar: str, default: str | None = None, about: str | None = None, name: str | None = None) -> Any:
    """An option in --help: its placeholder, its default in words, its description, its name if not the field's."""
    hint = default and f"(default: {default})"
    return arg(metavar=metavar, help_behavior_hint=hint, help=about, name=name)


def needed(metavar: str, about: str | None = None, name: str | None = None) -> Any:
    """An argument without a default in --help."""
    return option(metavar, "", about, name)


def option_name(field: str, kind: Any) -> str:
    """The name of a field's option, from Python: that of its annotation, or its own."""
    return next((x.name for x in get_args(kind)[1:] if getattr(x, "name", None)), field).replace("-", "_")
