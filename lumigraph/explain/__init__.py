"""What papers say, measured and drawn on one's own data: pages with pictures and the figures behind them."""
