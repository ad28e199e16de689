"""Runs made of runs: converted, compressed, aligned within a category."""
