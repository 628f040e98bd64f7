"""Reflectance and light: split-sum table, prefiltered environment, spherical harmonics, shading models."""
