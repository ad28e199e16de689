"""The commands, one file each: a dataclass whose fields are the options, and `run`, a thin door onto the library.

PyTorch is imported inside `run`, so that help comes at once.
"""
