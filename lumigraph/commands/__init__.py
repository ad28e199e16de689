"""The command line: one file per command, a dataclass of options with a thin `run`.

PyTorch is imported inside `run`, so that help comes at once. A command with a result returns it from `made`, and `run`
prints its rows (`results`). `calls` makes a command of values from Python, `request` one of JSON.
"""
