"""What the benchmarks share: views, lights, references with a standard error, times, errors, reports."""
