"""Memory of training, estimated before the first step."""

from __future__ import annotations

from .. import methods
from ..datasets.dataset import Dataset
from ..datasets.scene import Scene
from ..method import Method
from ..run.settings import bytes_of
from ..system.memory import free_on, gigabytes

PICTURE_BYTES = 120  # per pixel of a photograph, while a method learns from it or is compared with it; splats took 107


def about_memory(method: Method, data: Dataset) -> str:
    """Sentence on the memory of photographs, of the method with its optimizer state, and of one picture."""
    own = bytes_of(type(method), method.frame, method.config, learning=True) + method.growth_bytes()
    parts = [f"{methods.name_of(method)} up to {gigabytes(own)} with its optimizer state"]
    if isinstance(data, Scene):
        pixels = data.cameras.size.prod(-1)
        held = "read again and again" if data.images.streams else "in a file" if data.images.shuffled else "in memory"
        parts.insert(0, f"photographs {gigabytes(4 * int(pixels.sum()))}, {held}")
        parts.append(f"{gigabytes(PICTURE_BYTES * int(pixels.max()))} for one picture in training and evaluation")
    return f"Memory: {'; '.join(parts)}; {gigabytes(free_on(method.device))} are free"
