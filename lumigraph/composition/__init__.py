"""Composition: several methods in one picture with mutual occlusion, and parts of one method."""

from .composed import compose as compose
from .picked import PickedCloud as PickedCloud
from .picked import cropped as cropped
from .placed import Placed as Placed
from .standing import frame_around as frame_around
from .standing import standing as standing
