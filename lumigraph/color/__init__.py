"""Colours: sRGB encoding, and compositing before a background."""
