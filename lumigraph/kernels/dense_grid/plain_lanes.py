"""The operations of `lanes` number by number, for an engine that runs without Numba; every index is checked."""

from ..hash_encode.plain_lanes import BLOCK as BLOCK
from ..hash_encode.plain_lanes import blend as blend
from ..hash_encode.plain_lanes import spread as spread
