"""Canonical fields: what all of a kind share, found from trained fields in any pose, and each turned to stand as the
others do. Agaram et al., "Canonical Fields: Self-Supervised Learning of Pose-Canonicalized Neural Fields", CVPR 2023.

    grids        a density as weighted points, centred and scaled
    network      equivariant features, invariant canonical coordinates, a frame
    learning     its losses
    mean_shape   what is found, refined by trying all rotations against the mean shape
    canonicalise from a folder of runs to the files that `run.canonicalised` opens
"""

from .canonicalise import canonicalise as canonicalise
from .canonicalise import found_in as found_in
from .grids import Instance as Instance
from .grids import sampled as sampled
from .learning import PRESETS as PRESETS
from .learning import Config as Config
from .solve import Solution as Solution
from .solve import solve as solve
