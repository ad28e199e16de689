"""Packing: tensors in few bytes. How a tensor may be stored, the forms that tables of numbers take, and one file."""

from .file import read as read
from .file import write as write
from .forms import most_important as most_important
from .table import Recipe as Recipe
from .table import Stored as Stored
from .table import Table as Table
from .table import packed as packed
