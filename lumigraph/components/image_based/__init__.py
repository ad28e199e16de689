"""Image-based rendering: stored photographs with depth maps, and the surface visible in a new camera."""
