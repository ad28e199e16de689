"""The command line: one file per command, a dataclass of options with a thin `run`.

PyTorch is imported inside `run`, so that help comes at once.
"""
