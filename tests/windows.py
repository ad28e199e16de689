"""Windows of a real browser on pages from disk, and the pictures in them."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
import torch
from browser import listen
from PIL import Image
from tiny import poses

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole

SIZE = 256


def some_camera(index: int = 1, angle: float = 45.0) -> Camera:
    focal = SIZE / 2 / math.tan(math.radians(angle) / 2)
    lens = Pinhole(torch.tensor([[focal, focal]]), torch.tensor([[SIZE / 2, SIZE / 2]]))
    return Camera(poses()[index : index + 1], lens, torch.tensor([[SIZE, SIZE]]))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return -10 * math.log10(max(float(np.square(a - b).mean()), 1e-10))


class Window:
    """A browser's window on a page from disk, with the network cut and everything it asks for written down."""

    def __init__(self, chromium, path: Path, **context):
        context = {"viewport": {"width": SIZE, "height": SIZE}} | context
        self.context = chromium.new_context(offline=True, reduced_motion="reduce", **context)  # no swinging out
        self.page = self.context.new_page()
        self.faults = listen(self.page)
        self.requests: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.page.evaluate("lumigraph.ready")
        self.page.wait_for_function("document.body.classList.contains('open')")
        self.page.add_style_tag(
            content="#caption, #buttons, #wait { display: none !important } * { transition: none !important }"
        )

    def look(self, camera: Camera, angle: float = 45.0) -> np.ndarray:
        self.page.evaluate("([pose, angle]) => lumigraph.setCamera(pose, angle)", [camera.pose[0].tolist(), angle])
        return self.picture()

    def picture(self) -> np.ndarray:
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")) / 255

    def settled(self) -> np.ndarray:
        """The picture once it has stopped moving."""
        self.page.evaluate("lumigraph.rest()")
        return self.picture()

    def drag(self, by: float) -> None:
        """From the middle to the right, by a share of the window's width."""
        width, height = (self.page.viewport_size[side] for side in ("width", "height"))
        self.page.mouse.move(width / 2, height / 2)
        self.page.mouse.down()
        self.page.mouse.move((0.5 + by) * width, height / 2, steps=3)
        self.page.mouse.up()

    def close(self) -> None:
        """At the end nothing was complained of, and nothing asked of a network."""
        self.context.close()
        assert self.faults == []
        assert {url.partition(":")[0] for url in self.requests} <= {"file", "blob", "data"}
