"""`--set` and `--animate`: controls of a method on the command line."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

from tyro.conf import UseAppendAction, arg

from ..errors import LumigraphError

Set = UseAppendAction[
    Annotated[
        tuple[str, ...],
        arg(
            name="set",
            metavar="NAME=VALUE",
            help="Set a control of the method; `lumigraph info RUN` lists them. Can be given several times.",
            help_behavior_hint="",
        ),
    ]
]
Animate = UseAppendAction[
    Annotated[
        tuple[str, ...],
        arg(
            name="animate",
            metavar="NAME=A:B",
            help="Change a control from A to B over the film, or on to C with A:B:C. Can be given several times.",
            help_behavior_hint="",
        ),
    ]
]


def open_method(source: Any, device: str, told: Iterable[str] = ()) -> tuple[Any, Any, Any]:
    """The opened run or file, its method with the controls of --set, and the cameras of its photographs by split, as
    the method has refined them."""
    from ..run import open_any
    from .common import choose_device

    opened = open_any(source)
    method = tell(opened, opened.method(choose_device(device)), told)
    return opened, method, {split: method.refined(cameras) for split, cameras in opened.cameras().items()}


def tell(opened: Any, method: Any, told: Iterable[str]) -> Any:
    """The method with the controls of --set. Raises LumigraphError for controls that it does not have."""
    values = dict(parted("--set", "NAME=VALUE", text) for text in told)
    return method.given(**{name: by_number(opened, method, name, value) for name, value in values.items()})


def animate(opened: Any, method: Any, told: Iterable[str], frames: int) -> Any:
    """The method of each frame of a film by --animate; the method itself without --animate."""
    from ..export.film import animated

    stations = {}
    for name, text in (parted("--animate", "NAME=A:B", text) for text in told):
        if name in method.settings:
            raise LumigraphError(f"{name} is both set and animated; leave out --set {name} or --animate {name}")
        if ":" not in text:
            raise LumigraphError(f"--animate {name}={text} goes nowhere; write where it goes, as in {name}=A:B")
        stations[name] = [by_number(opened, method, name, value) for value in text.split(":")]
    return animated(method, stations, frames) if stations else method


def parted(option: str, form: str, text: str) -> tuple[str, str]:
    """The two sides of NAME=VALUE."""
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise LumigraphError(f"{option} {text} does not say what a control should be; write {option} {form}")
    return name.strip().replace("-", "_"), value.strip()


def by_number(opened: Any, method: Any, name: str, value: str) -> str:
    """The value, or the number of the photograph that it names where the control wants one; in a blend, A:B:0.5, the
    numbers of both."""
    control = next((control for control in method.controls if control.name == name), None)
    if control is None or not control.of_photographs:
        return value
    known = numbers(opened)
    if value in known or not control.blends:
        return known.get(value, value)
    return ":".join(known.get(part, part) for part in value.split(":"))


def numbers(opened: Any) -> dict[str, str]:
    """The number of each photograph, by its name."""
    cameras = opened.cameras()
    return {
        name: str(number)
        for split, names in opened.view_names().items()
        for name, number in zip(names, cameras[split].image_index.tolist(), strict=True)
    }
