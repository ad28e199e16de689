"""The command line: one file per command, a dataclass of options with a thin `run`; `calls` from Python.

PyTorch is imported inside `run`, so that help comes at once.
"""
