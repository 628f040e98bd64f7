"""Measurements of speed and error; run from the repository root."""
