"""Tab `Export` of a client: the visible scene in the formats of `lumigraph export`."""

import shlex
from collections.abc import Callable
from typing import Any

from ..errors import LumigraphError
from .cameras import ViewRequest
from .path_panel import code
from .shared import NAME, NAME_RULE, Exporter, ExportOption


class ExportPanel:
    """Contents of the tab.

    tab:      of viser, parent of the contents
    title:    of the scene, for file names
    request:  returns the client's view, with crop, cleaning and controls for the export
    notify:   notifies the client with a title and a text
    """

    def __init__(
        self,
        client: Any,
        tab: Any,
        exporter: Exporter,
        title: str,
        request: Callable[[], ViewRequest],
        notify: Callable[[str, str], None],
    ):
        self._exporter, self._title, self._request, self._notify = exporter, title, request, notify
        gui = client.gui
        with tab:
            self._format = gui.add_dropdown("Format", tuple(exporter.formats))
            self._about = gui.add_markdown("")
            self._name = gui.add_text("File", "", hint="Written beside the scene, never over a file that is there")
            with gui.add_folder("Options", expand_by_default=False) as self._folder:
                self._options = {
                    name: {option.name: add_option(gui, option) for option in kind.options}
                    for name, kind in exporter.formats.items()
                }
            self._button = gui.add_button("Export")
            self._result = gui.add_markdown("The crop of the tab Crop and the controls of the tab View apply.")
        self._format.on_update(lambda _: self._choose())
        self._button.on_click(lambda _: self._export())
        self._choose()

    def _choose(self) -> None:
        kind = self._exporter.formats[self._format.value]
        self._about.content, self._name.value = kind.about, self._title + kind.ending
        self._folder.visible = bool(kind.options)
        for name, handles in self._options.items():
            for handle in handles.values():
                handle.visible = name == self._format.value

    def _export(self) -> None:
        name = self._name.value.strip()
        if not NAME.fullmatch(name):
            self._notify("Not exported", NAME_RULE)
            return
        values = {option: handle.value for option, handle in self._options[self._format.value].items()}
        self._button.disabled = True
        try:
            command = self._exporter.command(self._format.value, name, values, self._request())
            said = self._exporter.run(command, self._say)
            self._say("\n\n".join([*said.splitlines(), f"The same again: {code(shlex.join(command))}"]))
        except LumigraphError as error:
            self._say("")
            self._notify("Not exported", str(error))
        finally:
            self._button.disabled = False

    def _say(self, text: str) -> None:
        self._result.content = text


def add_option(gui: Any, option: ExportOption) -> Any:
    """A checkbox, a list or a text, set to an option's default."""
    label, hint = option.name.replace("-", " ").capitalize(), option.hint or None
    if isinstance(option.default, bool):
        return gui.add_checkbox(label, option.default, hint=hint)
    if option.choices:
        return gui.add_dropdown(label, option.choices, initial_value=option.default, hint=hint)
    return gui.add_text(label, option.default, hint=hint)
