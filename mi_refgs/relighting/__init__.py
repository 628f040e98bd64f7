"""Relight a trained scene: images, a scene file, and a score where there is ground truth."""
