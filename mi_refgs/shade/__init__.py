"""Reflectance and light: split-sum table, prefiltered environment, spherical harmonics, and the models made
of them."""
