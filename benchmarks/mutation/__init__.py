"""Mutants: changes of the package's source, each with the test that must catch it."""
