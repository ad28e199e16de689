"""Exports of `lumigraph export`: one file each, a dataclass of options and a thin run()."""
