"""What `lumigraph export` can write: one thing, one file, each a dataclass of options and a thin run()."""
