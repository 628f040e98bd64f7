"""Edits of a trained scene: selection, changes, union of two scenes."""
