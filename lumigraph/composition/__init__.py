"""Composition: several methods in one picture, each at a place of its own, hiding one another as things do; and parts
of one method."""

from .appearances import align_appearance as align_appearance
from .blocks import merged as merged
from .composed import compose as compose
from .in_blocks import InBlocks as InBlocks
from .mixing import Mixing as Mixing
from .nearby import Nearby as Nearby
from .picked import PickedCloud as PickedCloud
from .picked import cropped as cropped
from .placed import Placed as Placed
from .standing import frame_around as frame_around
from .standing import standing as standing
