"""Measures: how near a rendering comes to a photograph, and scores, which are what any measure gives."""

from .score import Score as Score
from .score import named as named
from .score import scores_of as scores_of
from .similarity import WINDOW as WINDOW
from .similarity import psnr as psnr
from .similarity import ssim as ssim
from .similarity import ssim_map as ssim_map
