"""Reconstructions in Python: fit, load, import."""
