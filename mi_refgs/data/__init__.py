"""Data sets: reading folders of pictures with cameras, and path-tracing new ones."""
