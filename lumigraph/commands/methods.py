"""`lumigraph methods`: the list of methods."""

from dataclasses import dataclass

from .. import methods
from .common import show


@dataclass(frozen=True)
class Methods:
    """List the installed methods."""

    def run(self) -> int:
        show({name: methods.summary(name) for name in methods.available()})
        return 0
