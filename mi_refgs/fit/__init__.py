"""Fitting: data sets, losses, optimiser, adaptive control, training loop, metrics."""
