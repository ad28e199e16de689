"""Composition: several methods in one picture with mutual occlusion, and crops of one method."""

from ..system import kernel_cache as kernel_cache
from .composed import Composed as Composed
from .composed import PickedCloud as PickedCloud
from .composed import compose as compose
from .composed import cropped as cropped
from .lit import LitComposition as LitComposition
from .lit import LitMesh as LitMesh
from .lit import ShadedMesh as ShadedMesh
from .placed import Placed as Placed
from .placed import frame_around as frame_around
from .placed import standing as standing
from .played import FilteredCloud as FilteredCloud
from .played import PlayedCloud as PlayedCloud
from .voxel_mask import VoxelMask as VoxelMask
from .voxel_mask import mask_of as mask_of
from .voxel_mask import read_mask as read_mask
