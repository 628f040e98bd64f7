"""Every reader of the package on mutated files: a right answer or an `InputError`, and nothing else.

A failure is another exception, a crash, a hang (SECONDS), more memory than MEBIBYTES beyond what the process
had, a file opened outside the folder, or code run from a file. `python -m benchmarks.fuzz --help` says more.
"""

SECONDS = 10
"""For which one file may be read."""
MEBIBYTES = 512
"""Memory that reading one file may take; the files themselves have less than one."""
