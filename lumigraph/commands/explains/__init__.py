"""What `lumigraph explain` can draw: one thing, one file, each a dataclass of options and a thin run()."""
