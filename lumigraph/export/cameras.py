"""Pictures of many cameras in order: any sizes, range images of spinning sensors, several small ones at once."""

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

import numba
import torch

from ..camera import Camera
from ..camera.lens import Equirectangular, OpenCV, Pinhole
from ..camera.rays import Rendering
from ..method import Method
from ..method.capabilities import HasGaussians, can, needs
from ..system.threads import processors
from ..system.work import at_work
from .panorama import sphere, through_lens

# Of a picture and of a cloud, up to which each thread renders a picture of its own (`benchmarks/many_cameras.py`).
PARALLEL_PIXELS, PARALLEL_GAUSSIANS = 640 * 480, 300_000
AHEAD = 2  # pictures of each thread that wait to be taken


def pictures(method: Method, cameras: Sequence[Camera]) -> Iterator[Rendering]:
    """Renderings (height, width) of cameras in order, depth in scene units. The next ones are rendered meanwhile.

    cameras: batches of one. An upright `Equirectangular` lens sees all around for every method, see `Camera.spinning`
    Clouds of Gaussians on a CPU render one picture on each thread: a small picture does not keep all of them busy.
    """
    largest = max((int(camera.size.prod()) for camera in cameras), default=0)
    count = min(processors(), len(cameras))
    apart = count > 1 and largest <= PARALLEL_PIXELS and method.device.type == "cpu"
    gaussians = needs(method, HasGaussians).gaussians if apart and can(method, HasGaussians) else None
    if gaussians is None or len(gaussians()) > PARALLEL_GAUSSIANS:
        yield from (picture_of(method, camera) for camera in cameras)
        return
    with ThreadPoolExecutor(count, "pictures", one_thread) as pool:
        rest = iter(cameras)
        tasks = deque(pool.submit(picture_of, method, camera) for camera in islice(rest, AHEAD * count))
        try:
            while tasks:
                found = tasks.popleft().result()
                tasks.extend(pool.submit(picture_of, method, camera) for camera in islice(rest, 1))
                yield found
        finally:
            pool.shutdown(cancel_futures=True)


def picture_of(method: Method, camera: Camera) -> Rendering:
    """Rendering of one camera; by flat pictures where the method has none of its lens."""
    with at_work(), torch.no_grad():
        if method.any_lens or isinstance(camera.lens, Pinhole | OpenCV):
            return method.render(camera)
        if isinstance(camera.lens, Equirectangular):
            return sphere(method, camera, "Around")
        return through_lens(method, camera)


def one_thread() -> None:
    """Let the calling thread compute alone."""
    numba.set_num_threads(1)
    torch.set_num_threads(1)
