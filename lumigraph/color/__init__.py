"""Colours: sRGB encoding and alpha compositing over a background."""
