"""The run folder: its files, checkpoints, interruption, and what is exported from it."""
