"""Tracking: poses of a moving depth camera that are found beside the map."""
