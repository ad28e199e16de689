"""Image-based rendering: photographs that a method keeps, a depth map of each, and the surface seen by a new camera."""
