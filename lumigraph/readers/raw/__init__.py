"""Raw photographs: sensor measurements under a colour filter mosaic, in linear light.

photo = open_raw(path)             a camera's own file, or one of a folder of mosaics photo.read()
light (height, width): 0 at black, 1 at white, with noise photo.developed(brightness)        as an ordinary picture
"""

from .library import exif_of as exif_of
from .photo import RawPhoto as RawPhoto
from .remembered import RAW_FILE as RAW_FILE
from .remembered import Developed as Developed
from .remembered import Remembered as Remembered
from .remembered import facts as facts
from .remembered import is_raw as is_raw
from .remembered import open_raw as open_raw
from .remembered import planes as planes
from .remembered import with_raw as with_raw
