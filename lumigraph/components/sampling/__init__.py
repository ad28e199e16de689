"""Sampling along rays: spaces, samplers, empty space skipping."""
