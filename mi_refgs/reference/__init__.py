"""The method in NumPy float64 loops: the executable specification. Only tests and benchmarks import it."""
