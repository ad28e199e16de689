"""Figures: values as colours, contact sheets, charts."""

from .pictures import EMPTY_COLOUR as EMPTY_COLOUR
from .pictures import ERROR_GAIN as ERROR_GAIN
from .pictures import RAMP as RAMP
from .pictures import Range as Range
from .pictures import Row as Row
from .pictures import colour_depth as colour_depth
from .pictures import colour_error as colour_error
from .pictures import contact_sheet as contact_sheet
from .pictures import depth_range as depth_range
from .pictures import fit_into as fit_into
from .pictures import hex_colour as hex_colour
from .pictures import ramp as ramp
from .pictures import save_picture as save_picture
from .pictures import to_bytes as to_bytes
from .pictures import to_image as to_image
