"""Diffusion Policy's classes, and those of projects that save as it does: each rebuilt from ``Saved``."""
