"""Cameras, their lenses, and the rays of their pixels."""

from ..system import kernel_cache as kernel_cache
from .camera import PIXEL_RADIUS as PIXEL_RADIUS
from .camera import Camera as Camera
from .camera import dome as dome
from .camera import ring as ring
