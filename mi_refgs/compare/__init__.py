"""Comparison of methods: many fits, each a run, and their table."""
