"""Photographs with poses.csv: file name, focal length in pixels, then the 3x4 camera-to-world matrix by rows.

Axes are +x right, +y down, +z forward.
"""

import csv

import numpy as np
import torch
from PIL import Image

from lumigraph.camera.lens import Pinhole
from lumigraph.errors import LumigraphError
from lumigraph.readers import Capture, Shot

EXPECTED_FILES = {"a table of poses": ("poses.csv",)}


def recognises(folder):
    """True for a folder with the table."""
    return (folder / "poses.csv").is_file()


def read(folder):
    """The photographs of the table."""
    shots = []
    with open(folder / "poses.csv", newline="", encoding="utf-8") as file:
        for line, (name, focal, *numbers) in enumerate(csv.reader(file), 1):
            if len(numbers) != 12:
                raise LumigraphError(f"{folder / 'poses.csv'}: line {line} should have 14 columns; correct it")
            with Image.open(folder / name) as image:
                width, height = image.size
            lens = Pinhole(torch.full((1, 2), float(focal)), torch.tensor([[width / 2, height / 2]]))
            pose = np.array(numbers, dtype=float).reshape(3, 4)
            shots.append(Shot(name, pose, lens, (width, height), {1: folder / name}))
    return Capture(str(folder), shots)
