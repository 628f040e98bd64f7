"""The splatter alone: its times, its work, its memory and its errors, against other renderers of surfels."""
