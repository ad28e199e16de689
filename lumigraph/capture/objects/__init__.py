"""An object before a backdrop: where it is in each photograph of a capture, found from the photographs themselves."""

from .masking import Masked as Masked
from .masking import mask_object as mask_object
