"""Fitting: where it starts, losses, optimiser, adaptive control, the training loop."""
