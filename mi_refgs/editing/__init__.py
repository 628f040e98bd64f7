"""Edits of a trained scene: selection and changes of its surfels."""
