"""Vectors, rotations, similarities, and choosing some of many evenly."""

from .transforms import RIGID_TOLERANCE as RIGID_TOLERANCE
from .transforms import Rows as Rows
from .transforms import Similarity as Similarity
from .transforms import Vector as Vector
from .transforms import is_similarity as is_similarity
from .transforms import look_at as look_at
from .transforms import multiply as multiply
from .transforms import nearest_to_lines as nearest_to_lines
from .transforms import normals_from_depth as normals_from_depth
from .transforms import rotated as rotated
from .transforms import to_matrix as to_matrix
from .transforms import to_quaternion as to_quaternion
from .transforms import turning as turning
from .transforms import unit as unit
