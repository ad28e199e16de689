"""Conversion: any method's run becomes another method's, and what that cost is measured."""

from .convert import Aim as Aim
from .convert import convert as convert
from .ways import Way as Way
from .ways import ways as ways
