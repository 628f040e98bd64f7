"""Environment light: map, activation, prefilter, files."""
