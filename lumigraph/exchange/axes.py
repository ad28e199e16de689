"""Between a file's axes and this house's: half a turn around x, which is its own inverse, as changes of sign.

PLY files and this house have y down and z forward; .spz and glTF have y up and z back. So y and z change their signs,
and with them those harmonics that are odd in y and z together.
"""

from __future__ import annotations

import numpy as np

TURN_MEAN = np.array([1, -1, -1])
TURN_ROTATION = np.array([1, 1, -1, -1])  # of (w, x, y, z)
# y, z, x | xy, yz, z^2, xz, x^2 - y^2 | and so on
TURN_HARMONICS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)[:, None]
