"""A client of the viewer without a browser: it has a camera, and reads what it is sent. For tests."""

from __future__ import annotations

import io
import time

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from websockets.sync.client import connect


class Client:
    """Connected from the moment it is made.

    size:   of its window
    target: looked at
    angle:  of view, vertical, radians
    """

    def __init__(self, url: str, position=(3.0, 0.0, 0.5), size=(120, 90), target=(0.0, 0.0, 0.0), angle=0.8):
        self.size, self.target, self.angle = size, target, angle
        self.socket = connect(
            url.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
            compression=None,
            close_timeout=1,
        )
        self.look_from(position)

    def look_from(self, position) -> None:
        """Look at the target from there."""
        forward = np.array(self.target) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward], 1)
        message = {
            "type": "ViewerCameraMessage",
            "wxyz": viser.transforms.SO3.from_matrix(rotation).wxyz.tolist(),
            "position": [float(x) for x in position],
            "fov": self.angle,
            "near": 0.01,
            "far": 1000.0,
            "image_height": self.size[1],
            "image_width": self.size[0],
            "look_at": [float(x) for x in self.target],
            "up_direction": [0.0, 0.0, 1.0],
        }
        self.socket.send(msgspec.msgpack.encode(message))

    def turn(self, handle, value) -> None:
        """Set a slider or a list of this client's panel, as its browser would."""
        message = {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": value}}
        self.socket.send(msgspec.msgpack.encode(message))

    def click(self, place, origin, direction) -> None:
        """Click in the scene at a place of the window, (x, y) in [0, 1], and on a ray, as a browser does."""
        message = {
            "type": "ScenePointerMessage",
            "event_type": "click",
            "ray_origin": [float(x) for x in origin],
            "ray_direction": [float(x) for x in direction],
            "screen_pos": [place],
            "modifier": None,
        }
        self.socket.send(msgspec.msgpack.encode(message))

    def drag(self, handle, position) -> None:
        """Drag arrows in the scene to a place, as its browser would."""
        message = {
            "type": "TransformControlsUpdateMessage",
            "name": handle.name,
            "owner": handle._impl.api._owner_id,
            "wxyz": (1.0, 0.0, 0.0, 0.0),
            "position": position,
        }
        self.socket.send(msgspec.msgpack.encode(message))

    def messages(self, seconds: float):
        """What comes within so many seconds, each a dict."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                data = self.socket.recv(timeout=left)
            except TimeoutError:
                return
            packed = int.from_bytes(data[8:16], "little")
            inner = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed]))
            begins = 16 + packed
            buffers = []
            for length in inner["binaryBufferLengths"]:
                begins += -begins % 8
                buffers.append(data[begins : begins + length])
                begins += length
            for message in inner["messages"]:
                yield message | {"buffers": buffers}

    def picture(self, seconds: float = 20.0, width: int | None = None) -> np.ndarray:
        """The next picture that is streamed, bytes (height, width, 3); only one of a certain width, if that is told."""
        for message in self.messages(seconds):
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                image = Image.open(io.BytesIO(whole(message["rgb_data"], message))).convert("RGB")
                if width is None or image.width == width:
                    return np.asarray(image)
        raise AssertionError(f"no picture came within {seconds} s")

    def close(self) -> None:
        self.socket.close()

    def vanish(self) -> None:
        """Without a farewell, as when a cable is pulled."""
        self.socket.socket.close()


def whole(value, message) -> bytes:
    """Bytes, wherever in the message they lie."""
    return bytes(message["buffers"][value["__binary_index"]]) if isinstance(value, dict) else bytes(value)
