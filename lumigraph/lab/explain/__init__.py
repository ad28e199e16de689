"""Equations of papers, measured and drawn on the user's data."""
