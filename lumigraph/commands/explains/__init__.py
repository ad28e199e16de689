"""Explanations of `lumigraph explain`: one file each, a dataclass of options and a thin run()."""
