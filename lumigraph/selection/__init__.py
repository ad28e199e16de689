"""Select a part of a scene by strokes: features distilled onto points, matching, growth in 3-D (Goel 2023)."""

from .descriptors import describe as describe
from .distilled import Distilled as Distilled
from .distilled import distil_features as distil_features
from .networks import feature_network as feature_network
from .selection import Selection as Selection
from .strokes import Strokes as Strokes
from .strokes import read_segments as read_segments
from .strokes import read_strokes as read_strokes
