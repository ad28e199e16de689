"""Controls of a method as text, NAME=VALUE: those of --set and --animate, with photographs by their names."""

from __future__ import annotations

from collections.abc import Iterable

from ..errors import LumigraphError
from ..method import Method
from .opened import Opened


def controlled(opened: Opened, method: Method, settings: Iterable[str]) -> Method:
    """The method with the controls of --set. Raises LumigraphError for controls that it does not have."""
    values = dict(parted("--set", "NAME=VALUE", text) for text in settings)
    return method.given(**{name: by_number(opened, method, name, value) for name, value in values.items()})


def stations_of(opened: Opened, method: Method, animations: Iterable[str]) -> dict[str, list[str]]:
    """Values of each control of --animate, NAME=A:B. Raises LumigraphError for controls that are set already."""
    stations = {}
    for name, text in (parted("--animate", "NAME=A:B", text) for text in animations):
        if name in method.settings:
            raise LumigraphError(f"{name} is both set and animated; leave out --set {name} or --animate {name}")
        if ":" not in text:
            raise LumigraphError(f"--animate {name}={text} goes nowhere; write where it goes, as in {name}=A:B")
        stations[name] = [by_number(opened, method, name, value) for value in text.split(":")]
    return stations


def parted(option: str, form: str, text: str) -> tuple[str, str]:
    """The two sides of NAME=VALUE."""
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise LumigraphError(f"{option} {text} gives no value for a control; write {option} {form}")
    return name.strip().replace("-", "_"), value.strip()


def by_number(opened: Opened, method: Method, name: str, value: str) -> str:
    """The value, or the number of the photograph that it names if the control takes one; in a blend, A:B:0.5, the
    numbers of both."""
    control = next((control for control in method.controls if control.name == name), None)
    if control is None or not control.of_photographs:
        return value
    by_name = numbers(opened)
    if value in by_name or not control.blends:
        return by_name.get(value, value)
    return ":".join(by_name.get(part, part) for part in value.split(":"))


def numbers(opened: Opened) -> dict[str, str]:
    """The number of each photograph, by its name."""
    cameras = opened.cameras()
    return {
        name: str(number)
        for split, names in opened.view_names().items()
        for name, number in zip(names, cameras[split].image_index.tolist(), strict=True)  # type: ignore[union-attr]
    }


def at_one_moment(method: Method) -> Method:
    """A method that moves, at the moment of --set or at its first one, for all cameras; any other as it is."""
    control = next((one for one in method.controls if one.name == "time"), None)
    return method if control is None else method.given(time=method.control("time"))
