"""Derived runs: converted, compressed, aligned within a category."""
