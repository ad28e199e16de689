"""Composition: several methods in one picture, each at a place of its own, hiding one another as things do."""

from .composed import compose as compose
from .placed import Placed as Placed
from .standing import frame_around as frame_around
from .standing import standing as standing
