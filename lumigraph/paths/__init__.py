"""Camera paths of films: automatic ones, and curves through keyframes."""

from .automatic import PATHS as PATHS
from .automatic import UP as UP
from .automatic import Surroundings as Surroundings
from .automatic import angle_of_view as angle_of_view
from .automatic import camera_path as camera_path
from .automatic import film_size as film_size
from .automatic import fitting as fitting
from .film import PATH_KINDS as PATH_KINDS
from .film import best_centred as best_centred
from .film import film_cameras as film_cameras
from .film import pivot as pivot
