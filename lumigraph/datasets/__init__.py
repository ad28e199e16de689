"""Data that methods learn from: photographs with cameras, shapes, collections of either."""
