"""Conversion: any method's run becomes another method's, and what that cost is measured."""

from .convert import ConversionTarget as ConversionTarget
from .convert import convert as convert
from .ways import Way as Way
from .ways import ways as ways
