"""From photographs to a data set with cameras: structure from motion by COLMAP (extra `capture`)."""
