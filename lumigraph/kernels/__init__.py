"""The hot loops, one folder per operation. Each has a reference in plain PyTorch that defines it."""

from ._dispatch import Engine as Engine
from ._dispatch import using as using
from .composite import composite as composite
from .dense_grid import dense_grid as dense_grid
from .distortion import distortion as distortion
from .factor_grid import Factors as Factors
from .factor_grid import factor_grid as factor_grid
from .harmonic_grid import harmonic_grid as harmonic_grid
from .hash_encode import HashLevels as HashLevels
from .hash_encode import hash_encode as hash_encode
from .march import march as march
from .octree_cells import Tree as Tree
from .octree_cells import octree_cells as octree_cells
from .octree_march import octree_march as octree_march
from .perceptron import perceptron as perceptron
from .plane_sweep import plane_sweep as plane_sweep
from .project import View as View
from .project import project as project
from .rasterize import rasterize as rasterize
from .sparse_grid import Nodes as Nodes
from .sparse_grid import sparse_grid as sparse_grid
from .spherical_harmonics import spherical_harmonics as spherical_harmonics
from .ssim import ssim as ssim
from .tile import Tiles as Tiles
from .tile import tile as tile
from .total_variation import total_variation as total_variation
