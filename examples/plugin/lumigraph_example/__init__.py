"""A template of a Lumigraph plugin."""
