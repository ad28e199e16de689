"""Canonical fields: align trained fields of one category, in any pose, from their density alone. Agaram et al.,
"Canonical Fields: Self-Supervised Learning of Pose-Canonicalized Neural Fields", CVPR 2023.

    grids        a density as weighted points, centred and scaled
    harmonics    spherical harmonics, their rotations, moments of shapes
    network      equivariant features, invariant canonical coordinates, a frame; its losses and training
    canonicalise alignment to the mean shape; from a folder of runs to files that `run.composition.Canonicalised` opens
"""

from .canonicalise import Solution as Solution
from .canonicalise import canonicalise as canonicalise
from .canonicalise import found_in as found_in
from .canonicalise import solve as solve
from .grids import Instance as Instance
from .grids import sampled as sampled
from .network import PRESETS as PRESETS
from .network import CanonicalConfig as CanonicalConfig
