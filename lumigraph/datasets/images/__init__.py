"""Photographs as bytes, and other values of every pixel: in memory, or, where they are too large, in files."""

from .cache import in_parallel as in_parallel
from .layer import UNKNOWN_INDEX as UNKNOWN_INDEX
from .layer import Layer as Layer
from .layer import LayerSource as LayerSource
from .layer import cosines as cosines
from .resize import resized as resized
from .store import ImageSource as ImageSource
from .store import ImageStore as ImageStore
from .store import Runs as Runs
from .store import runs_of as runs_of
from .store import shuffled_order as shuffled_order
from .store import spread as spread
from .stream import ImageStream as ImageStream
from .stream import load as load
