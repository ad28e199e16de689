"""MethodControls: sliders and lists for what the method can be told, for one client alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ..method import Method
from ..method.controls import Control, Value

STEPS = 200  # of a slider


class MethodControls:
    """The folder `Controls` in a client's tab `View`; nothing where the method has none.

    client:  viser's
    tab:     viser's, which holds the folder
    changed: called when any of them is turned
    """

    def __init__(self, client: Any, tab: Any, method: Method, changed: Callable[[], None]):
        controls: Sequence[Control] = method.controls
        self._controls, self._begun = controls, {x.name: method.control(x.name) for x in controls}
        self._handles: dict[str, Any] = {}
        if not controls:
            return
        with tab, client.gui.add_folder("Controls"):
            for control in controls:
                handle = self._handles[control.name] = add(client.gui, control, self._begun[control.name])
                handle.on_update(lambda _: changed())

    @property
    def values(self) -> tuple[tuple[str, Value], ...]:
        """The names and values of those that were turned away from where they began."""
        return tuple((name, value) for name, value in self._now().items() if value != self._begun[name])

    @property
    def time(self) -> float | None:
        """The moment that is shown, where the method follows a moving scene."""
        time = self._now().get("time")
        return None if time is None else float(time)

    def show_time(self, moment: float) -> None:
        """Turn the control `time` to a moment, where there is one."""
        if "time" in self._handles:
            self._handles["time"].value = moment

    def _now(self) -> dict[str, Value]:
        return {control.name: value_of(control, self._handles[control.name].value) for control in self._controls}


def add(gui: Any, control: Control, value: Value) -> Any:
    """A slider or a list, set to a value."""
    label = f"{control.name.replace('_', ' ').capitalize()}{f' ({control.unit})' if control.unit else ''}"
    if control.range is None:
        choices = tuple(dict.fromkeys((*control.choices, str(value))))  # a blend of two is told, and none of them
        return gui.add_dropdown(label, choices, initial_value=value, hint=control.about or None)
    least, most = control.range
    step = max((most - least) / STEPS, 1e-9)
    return gui.add_slider(label, least, most, step, float(value), hint=control.about or None)


def value_of(control: Control, shown: Any) -> Value:
    """The value of a client's slider or list, within the range: sliders round, also beyond its ends."""
    return shown if control.range is None else min(max(float(shown), control.range[0]), control.range[1])
