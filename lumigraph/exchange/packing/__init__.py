"""Packing: compressed tensors. Storage declarations, encodings of tables, and one file."""

from .file import read as read
from .file import write as write
from .forms import most_important as most_important
from .table import Recipe as Recipe
from .table import Stored as Stored
from .table import Table as Table
from .table import packed as packed
