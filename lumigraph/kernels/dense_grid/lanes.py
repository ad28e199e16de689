"""The innermost operations of the Numba engine: all channels of a corner in one register, as in hash encoding."""

from ..hash_encode.lanes import BLOCK as BLOCK
from ..hash_encode.lanes import blend as blend
from ..hash_encode.lanes import spread as spread
