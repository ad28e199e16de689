"""Runs and everything else that can be opened: training folders, splat files, compositions."""

from .checkpoint import State as State
from .folder import Run as Run
from .folder import build as build
from .folder import check_new as check_new
from .folder import is_block_run as is_block_run
from .folder import processor as processor
from .opened import Opened as Opened
from .opened import Trained as Trained
from .settings import check_memory as check_memory
