"""Scenes too large for one field (Tancik 2022): blocks that train as runs and render as one.

layout               positions of blocks, at street crossings or evenly spread, and the photographs of each
plan, planning       blocks.json, the task of each block, and a map of the plan, before any training
worker               train one block: a restartable function of its folder
training             train all blocks, in this process or on workers, or one of them again;  monitor  their progress
block_run            opened run of all blocks;  block_cache  LRU cache of blocks compositing, weights render nearby
blocks and mix their pictures; one cloud of the blocks' clouds of Gaussians opening              open runs, in blocks or
not, and everything else that opens alignment            one appearance and one exposure for all blocks
"""

from .alignment import align_appearance as align_appearance
from .block_cache import Nearby as Nearby
from .block_run import BlockRun as BlockRun
from .compositing import InBlocks as InBlocks
from .compositing import merged as merged
from .opening import open_any as open_any
from .opening import open_run as open_run
from .weights import Mixing as Mixing
