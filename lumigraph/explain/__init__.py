"""Equations of papers, measured and drawn on your own data: pages with pictures and the figures behind them."""
