"""Scenes too large for one field (Tancik 2022): blocks that train as runs and render as one.

layout, crossings    positions of blocks, and the photographs of each;  drawing  the plan seen from above
plan, planning       blocks.json and the task of each block, written before anything is trained
worker               train one block: a function over its folder, which may be called again at any time
training, on_ray     train all blocks, in this process or on workers;  monitor  their progress
update               train one block again, from other photographs
block_run            the run of all blocks as something that opens;  block_cache  blocks in memory
compositing, weights render nearby blocks and mix their pictures;  visibility  what a block's photographs saw
appearance_alignment, exposure_alignment  one appearance and one exposure for all blocks
merging              one cloud of the blocks' clouds of Gaussians
"""

from .appearance_alignment import align_appearance as align_appearance
from .block_cache import Nearby as Nearby
from .block_run import BlockRun as BlockRun
from .compositing import InBlocks as InBlocks
from .merging import merged as merged
from .weights import Mixing as Mixing
