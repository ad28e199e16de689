"""Compression of a trained run, with fine-tuning (Li 2023, VQRF)."""

from .compress import compress as compress
from .model import LADDER as LADDER
