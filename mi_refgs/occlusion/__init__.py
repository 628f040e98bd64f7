"""Depth maps to a closed mesh, and one bit of visibility through it."""
