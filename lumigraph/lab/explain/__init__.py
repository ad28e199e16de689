"""Equations of papers, measured and plotted on the user's data."""
