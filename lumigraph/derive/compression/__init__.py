"""Compression: a trained run becomes a smaller one, tuned to look the same (Li 2023, VQRF)."""

from .compress import compress as compress
from .model import LADDER as LADDER
from .model import Rung as Rung
