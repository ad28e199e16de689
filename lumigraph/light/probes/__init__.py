"""Light probes: spherical harmonics of radiance and distance maps on a grid, their files, and interpolated light."""

from .grid import FREE as FREE
from .grid import MATTER as MATTER
from .grid import UNSEEN as UNSEEN
from .grid import ProbeGrid as ProbeGrid
from .grid import lattice as lattice
from .harmonics import projected as projected
from .storage import read_probes as read_probes
from .storage import write_probes as write_probes
