"""The viewer: a scene in the browser, during training and afterwards."""

from ..system import kernel_cache as kernel_cache
from .address import at_free_address as at_free_address
from .address import choose_address as choose_address
from .shared import Subject as Subject
from .viewer import Viewer as Viewer
