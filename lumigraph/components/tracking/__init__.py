"""Tracking: pose estimation of a moving depth camera, simultaneous with mapping."""
