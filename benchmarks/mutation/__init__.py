"""Mutation testing: mutants, each with the test that must catch it."""
