"""Evaluate trained methods, under a stated protocol for each kind of dataset."""
