"""Metrics: PSNR, SSIM, LPIPS, IoU, chamfer distance; scores."""

from .score import Score as Score
from .score import named as named
from .score import scores_of as scores_of
from .similarity import WINDOW as WINDOW
from .similarity import psnr as psnr
from .similarity import ssim as ssim
from .similarity import ssim_map as ssim_map
